"""`senior eval` judges policies, `senior bench` this machine."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from senior.cli.shared import DONE, FAILED
from senior.options import parse
from senior.types import BadInput


@dataclass(frozen=True)
class EvalOptions:
    """Judge a run's policy, as last saved, on fresh episodes."""

    run: tyro.conf.Positional[Path]
    """A run directory, or one that holds some."""
    episodes: int = 10
    """How many episodes."""
    video: Path | None = None
    """Write the first episode as MP4."""


@dataclass(frozen=True)
class BenchOptions:
    """Steps per second of the main phase, of pre-training and of environments alone, and where the time goes."""

    method: str = "all"
    """A method of `senior methods`, or all."""
    preset: str = "paper"
    """paper, quick or qpa_original."""
    task: str = "door-lock"
    """A task of `senior tasks`."""
    steps: int = 300
    """Main-phase steps to time, after the warm-up."""
    runs: tuple[int, ...] = (1,)
    """Runs in the program; several numbers are measured one after the other."""
    environments: int | None = None
    """Only step so many environments of the task, without learning: stock, here, and in worker processes.
    Of the other options --task and --json are used then."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to compute."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Number format of the networks' products."""
    json: Path | None = None
    """Write the figures there too."""


def evaluate(arguments: list[str]) -> int:
    options = parse(EvalOptions, arguments, None, "eval")
    from senior import judgement, rundir

    found = rundir.find_runs(options.run)
    if options.video and len(found) > 1:
        raise BadInput(f"--video films one run, and there are {len(found)} under {options.run}; name one of them.")
    judgement.check_asked(options.episodes, options.video)
    code = DONE
    for path in found:
        try:
            judged = judgement.evaluate_run(path, options.episodes, options.video)
        except BadInput as error:
            if len(found) == 1:
                raise
            print(f"{path}: {error}", file=sys.stderr)
            code = FAILED
            continue
        success = "not told" if judged.success_rate is None else f"{judged.success_rate:.3f}"
        print(
            f"{path}: policy of step {judged.step}, {judged.episodes} fresh episodes: success rate {success}, "
            f"true return {judged.return_mean:.1f} +- {judged.return_std:.1f}"
        )
        if options.video:
            print(judged.no_video or f"video: {judged.video}")
    return code


def bench(arguments: list[str]) -> int:
    options = parse(BenchOptions, arguments, None, "bench")
    from senior import bench

    if options.environments is not None:
        bench.run_environments(options.task, options.environments, options.json)
        return DONE
    bench.run(
        options.method,
        options.preset,
        options.task,
        options.steps,
        options.runs,
        options.device,
        options.precision,
        options.json,
    )
    return DONE
