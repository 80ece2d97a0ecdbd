"""The command line: parse, call, print. Bad input ends with one sentence and code 2."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import tyro
from tqdm import tqdm

from senior.config import Config
from senior.label.serving import Address, check_installed
from senior.options import parse
from senior.presets import preset, quick_changes, release, with_budget
from senior.types import BadInput

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


@dataclass(frozen=True)
class Machine:
    """How the runs of a command share this machine."""

    workers: int | Literal["auto"] = "auto"
    """Processes that the environments live in; 0: this one. auto: 0 on a CPU, one per processor on a GPU."""
    runs_per_device: int | Literal["auto"] = "auto"
    """How many runs are trained at a time, the others after them. auto: as many as the memory holds."""

    def arguments(self) -> dict[str, Any]:
        """As `senior.program` takes them."""
        return {name: None if value == "auto" else value for name, value in asdict(self).items()}


@dataclass(frozen=True)
class PageOptions:
    """Where the labelling page is served (--teacher human)."""

    host: str = "127.0.0.1"
    """Address to listen on. 0.0.0.0 lets other machines in; who opens the page needs the token in its address."""
    port: int | Literal["auto"] = "auto"
    """auto: where the run was served before, else the first free one from 8642 on."""
    allowed_host: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A further name that browsers may know this machine by; may be given several times."""
    token: str | None = None
    """Token of the page's address; left out: the run's own. Empty: everybody on this machine may."""

    def address(self) -> Address:
        """As `senior.label` takes it."""
        port = 0 if self.port == "auto" else self.port
        if not 0 <= port < 2**16:
            raise BadInput(f"--port {port} must be between 1 and 65535.")
        return Address(self.host, port, self.allowed_host, self.token)


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
class LabelOptions:
    """Serve the labelling page of a run whose teacher are people, without training it."""

    run: tyro.conf.Positional[Path]
    """A run directory."""
    page: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)


@dataclass(frozen=True)
class ExportOptions:
    """Write all that was asked in a run and said of it into files (docs/labels.md)."""

    run: tyro.conf.Positional[Path]
    """A run directory."""
    out: Path
    """File to write, NAME.jsonl; the segments go to NAME.npz beside it."""


@dataclass(frozen=True)
class ImportOptions:
    """Put exported labels into a run of people's that has not asked anything yet."""

    run: tyro.conf.Positional[Path]
    """A run directory."""
    file: tyro.conf.Positional[Path]
    """NAME.jsonl, with NAME.npz beside it."""


@dataclass(frozen=True)
class StatsOptions:
    """Tell who said what in a run, and how far people agree."""

    run: tyro.conf.Positional[Path]
    """A run directory."""
    json: bool = False
    """Print JSON."""


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
    """Only step so many environments of the task, without learning: stock, here, and in worker processes. Of the other
    options --task and --json are used then."""
    device: str = "auto"
    """auto, cpu or gpu."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Number format of the networks' products."""
    json: Path | None = None
    """Write the figures there too."""


@dataclass(frozen=True)
class NoOptions:
    """No options."""


class Display:
    """A progress bar and a graceful end on SIGINT and SIGTERM; a second signal ends the program at once."""

    def __init__(self) -> None:
        self.stop = False
        self._bar: tqdm[Any] | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._asked_to_stop)

    def advance(self, step: int, trainees: Sequence[Any]) -> None:
        """Draw, ten times a second at most."""
        if self._bar is None:
            steps = trainees[0].config.steps
            form = "{l_bar}{bar}| {n_fmt}/{total_fmt} steps {rate_fmt}{postfix} {remaining} left"
            self._bar = tqdm(total=steps, initial=step - 1, unit="step", bar_format=form, dynamic_ncols=True)
        if step % 20 == 0 or step == self._bar.total:
            told = [trainee.progress.success for trainee in trainees if trainee.progress.success is not None]
            labels = sum(trainee.progress.labels for trainee in trainees)
            budget = sum(trainee.config.queries.budget for trainee in trainees)
            success = f"{sum(told) / len(told):.0%}" if told else "-"
            asked = f"labels {labels}/{budget}, " if trainees[0].config.method.learns_reward else ""
            self._bar.set_postfix_str(f"{asked}success {success}", refresh=False)
            self._bar.update(step - self._bar.n)

    def say(self, sentence: str) -> None:
        """A line of its own above the bar."""
        tqdm.write(sentence, file=sys.stderr)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def _asked_to_stop(self, number: int, frame: FrameType | None) -> None:
        if self.stop:
            raise KeyboardInterrupt
        self.stop = True


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if not arguments or arguments[0] in ("-h", "--help"):
            print(_overview())
            return DONE
        if arguments[0] == "--version":
            from importlib.metadata import version

            print(f"senior {version('senior-rl')}")
            return DONE
        if arguments[0] not in COMMANDS:
            raise BadInput.unknown("command", arguments[0], COMMANDS)
        return COMMANDS[arguments[0]](arguments[1:])
    except BadInput as error:
        print(f"senior: {error}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED


def _train(arguments: list[str]) -> int:
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    starts = {"task": "door-lock", "method": "m-senior", "preset": "paper", "env": None, "compat": "none"}
    for name, default in starts.items():
        first.add_argument(f"--{name}", default=default)
    first.add_argument("--budget", type=int)
    try:
        known, _ = first.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        needs = "a whole number" if "invalid int" in str(error) else "a value"
        raise BadInput(f"{error.argument_name} needs {needs}.") from error
    start = preset(known.preset, known.task, known.method)
    if known.budget is not None:
        start = with_budget(start, known.budget)
    if known.compat == "release":
        start = release(start)
    text = (
        "Train one run, or several in one program. Defaults below are those of the --task, --method, --preset, "
        "--budget and --compat given. The quick preset is for a CPU and changes from the paper's numbers (here those "
        "for door-close): " + quick_changes().replace("\n", "; ") + "."
    )
    options = parse(TrainOptions, arguments, TrainOptions(config=start), "train", text)
    from senior import program

    config = options.config
    name = (config.env or config.task).replace(":", "-").replace("/", "-")
    out = options.out or Path("runs") / f"{name}-{config.method.name}-{config.preset}"
    display = Display()
    try:
        seeds = 1 if options.seeds is None else options.seeds
        results = program.train(config, out, seeds, display, page=options.page.address(), **options.machine.arguments())
    finally:
        display.close()
    return _report(results, display)


def _resume(arguments: list[str]) -> int:
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
            reason = judgement.film_policy(result.path, video)
            print(f"  video          {reason or video}")
    if any(result.failure for result in results):
        return FAILED
    return INTERRUPTED if display.stop and not all(result.finished for result in results) else DONE


def _eval(arguments: list[str]) -> int:
    options = parse(EvalOptions, arguments, None, "eval")
    from senior import judgement, program

    found = program.find_runs(options.run)
    if options.video and len(found) > 1:
        raise BadInput(f"--video films one run, and there are {len(found)} under {options.run}; name one of them.")
    for path in found:
        judged = judgement.evaluate_run(path, options.episodes, options.video)
        success = "not told" if judged.success_rate is None else f"{judged.success_rate:.3f}"
        print(
            f"{path}: policy of step {judged.step}, {judged.episodes} fresh episodes: success rate {success}, "
            f"true return {judged.return_mean:.1f} +- {judged.return_std:.1f}"
        )
        if options.video:
            print(judged.no_video or f"video: {judged.video}")
    return DONE


def _label(arguments: list[str]) -> int:
    options = parse(LabelOptions, arguments, None, "label")
    check_installed()
    from senior import program
    from senior.label import server

    found = program.find_runs(options.run)
    if len(found) > 1:
        raise BadInput(f"There are {len(found)} runs under {options.run}; name one of them.")
    served = server.serve(found[0], options.page.address(), "user")
    if served.process != os.getpid():
        print(f"The run is served already: {served.url}")
    return DONE


def _labels(arguments: list[str]) -> int:
    actions = {"export": _export, "import": _import, "stats": _stats}
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: senior labels export|import|stats RUN ...\n\nsenior labels export --help tells its options.")
        sys.exit(DONE)
    if arguments[0] not in actions:
        raise BadInput.unknown("action of senior labels", arguments[0], actions)
    return actions[arguments[0]](arguments[1:])


def _export(arguments: list[str]) -> int:
    options = parse(ExportOptions, arguments, None, "labels export")
    from senior import labels

    count = labels.export_labels(options.run, options.out)
    print(f"{count} pairs: {options.out} and {options.out.with_suffix('.npz')}")
    return DONE


def _import(arguments: list[str]) -> int:
    options = parse(ImportOptions, arguments, None, "labels import")
    from senior import labels

    print(f"{labels.import_into(options.run, options.file)} pairs taken over into {options.run}")
    return DONE


def _stats(arguments: list[str]) -> int:
    options = parse(StatsOptions, arguments, None, "labels stats")
    check_installed()
    from senior import labels

    found = labels.stats(options.run)
    print(json.dumps(found, indent=2) if options.json else labels.describe(found))
    return DONE


def _tasks(arguments: list[str]) -> int:
    parse(NoOptions, arguments, None, "tasks")
    from senior import envs

    print(table(("task", "what is to be done", "goal"), envs.tasks_table()))
    return DONE


def _methods(arguments: list[str]) -> int:
    parse(NoOptions, arguments, None, "methods")
    from senior.methods import METHODS

    rows = []
    for row in METHODS.values():
        config = preset("paper", "door-lock", row.name)
        mixes = {
            "uniform": "uniform",
            "curiosity": f"{config.pge.share:.0%} curiosity",
            "recent": f"{config.qpa.share:.0%} recent",
        }
        outer = f"{row.outer} every {config.bilevel.every:,} steps"
        reward = config.reward
        fit = f"{reward.members} member{'s' if reward.members > 1 else ''}" + (", snippets" if reward.snippets else "")
        cells = (row.name, row.select, row.explore, mixes[row.mix], outer if row.outer != "none" else "none")
        rows.append([cell if cell != "none" else "-" for cell in cells] + [fit if row.learns_reward else "true reward"])
    print(table(("method", "select", "explore", "replay mix", "outer step", "reward fit"), rows))
    return DONE


def _bench(arguments: list[str]) -> int:
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


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": _train,
    "resume": _resume,
    "eval": _eval,
    "label": _label,
    "labels": _labels,
    "tasks": _tasks,
    "methods": _methods,
    "bench": _bench,
}
_SUMMARIES = {
    "train": "train one run, or several seeds in one program",
    "resume": "continue an interrupted run, or all runs under a directory",
    "eval": "judge a run's policy on fresh episodes, and film it",
    "label": "serve the page on which people compare a run's clips",
    "labels": "export, import, or look at what people said",
    "tasks": "list the tasks",
    "methods": "list the methods, cell by cell",
    "bench": "measure steps per second and where the time goes",
}


def _overview() -> str:
    lines = ["usage: senior COMMAND [OPTIONS]", "", "Teach robots by preference.", ""]
    lines += [f"  {name:8} {summary}" for name, summary in _SUMMARIES.items()]
    return "\n".join([*lines, "", "senior COMMAND --help tells a command's options."])


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Plain columns."""
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in [head, *rows]]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


if __name__ == "__main__":
    sys.exit(main())
