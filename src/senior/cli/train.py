"""`senior train` and `senior resume`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from senior.cli.display import Display
from senior.cli.shared import DONE, FAILED, INTERRUPTED, Machine, PageOptions
from senior.config import Config
from senior.options import parse, starting_from
from senior.presets import quick_changes


@dataclass(frozen=True)
class TrainOptions:
    """Train one run, or several in one program; each gets a directory of its own."""

    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    seeds: int | None = None
    """How many runs: seeds --seed, --seed + 1, ... in one program. Left out: one."""
    machine: Annotated[Machine, tyro.conf.arg(name="")] = field(default_factory=Machine)
    page: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)
    out: Path | None = None
    """Directory that takes seed-0/ and so on. Left out: runs/TASK-METHOD-PRESET."""


@dataclass(frozen=True)
class ResumeOptions:
    """Continue an interrupted run, or all runs under a directory."""

    run: tyro.conf.Positional[Path]
    """A run directory, or one that holds some."""
    machine: Annotated[Machine, tyro.conf.arg(name="")] = field(default_factory=Machine)
    page: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)


def train(arguments: list[str]) -> int:
    text = (
        "Train one run, or several in one program. Defaults below are those of the --task, --method, --preset, "
        "--budget and --compat given. The quick preset is for a CPU and changes from the paper's numbers (here those "
        "for door-close): " + quick_changes().replace("\n", "; ") + "."
    )
    options = parse(TrainOptions, arguments, TrainOptions(config=starting_from(arguments)), "train", text)
    from senior import program

    config = options.config
    name = config.environment.replace(":", "-").replace("/", "-")
    out = options.out or Path("runs") / f"{name}-{config.method.name}-{config.preset}"
    display = Display()
    try:
        seeds = 1 if options.seeds is None else options.seeds
        results = program.train(config, out, seeds, display, page=options.page.address(), **options.machine.arguments())
    finally:
        display.close()
    return _report(results, display)


def resume(arguments: list[str]) -> int:
    options = parse(ResumeOptions, arguments, None, "resume")
    from senior import program

    display = Display()
    try:
        results = program.resume(options.run, display, page=options.page.address(), **options.machine.arguments())
    finally:
        display.close()
    return _report(results, display)


def _report(results: Sequence[Any], display: Display) -> int:
    """Say what came of the runs and where their files are."""
    from senior import judgement

    for result in results:
        print(f"\n{result.path}" if result.seed is None else f"\nseed {result.seed}: {result.path}")
        if result.seed is None:
            print(f"  cannot go on: {result.failure}")
        elif result.failure:
            print(f"  stopped at step {result.step}: {result.failure}")
        elif not result.finished:
            print(f"  interrupted at step {result.step}, all saved; go on with: senior resume {result.path}")
        else:
            success = "not told by the environment" if result.success_rate is None else f"{result.success_rate:.0%}"
            print(f"  success rate   {success} in the last evaluation; labels used: {result.labels}")
            print(f"  learning curve {result.path / 'plots' / 'learning-curve.png'}")
            video = result.path / "videos" / "final.mp4"
            reason = None if video.exists() else judgement.film_policy(result.path, video)
            print(f"  video          {reason or video}")
    if any(result.failure for result in results):
        return FAILED
    return INTERRUPTED if display.stop and not all(result.finished for result in results) else DONE
