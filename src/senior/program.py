"""Whole programs: train, resume, evaluate. What the command line calls, and what ``import senior`` offers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np

from senior import checkpoint, parts, rundir
from senior.checks import check
from senior.config import Config, load
from senior.envs.workers import Worker, Workers
from senior.learner import Learner, Run
from senior.loop import Training, Watcher
from senior.report.curves import learning_curve
from senior.runs import Lift, Runs, device_memory, lift_for, prepare_device, state_bytes
from senior.shape import shape
from senior.trainee import Trainee, make_environment
from senior.types import BadInput, EnvSpec


class Quiet:
    """A watcher that prints what is said and nothing else, and never says stop."""

    stop = False

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        pass

    def say(self, sentence: str) -> None:
        print(sentence)


@dataclass(frozen=True)
class Result:
    """What came of one run."""

    path: Path
    seed: int | None
    """None if the run could not be opened."""
    step: int
    """Environment steps taken."""
    finished: bool
    failure: str | None
    """Why the run was stopped, in a sentence."""
    labels: int
    success_rate: float | None
    """Of the last evaluation, in [0, 1]; None if the environment tells no success or nothing was evaluated."""


def train(
    config: Config,
    out: Path | str,
    seeds: int = 1,
    watcher: Watcher | None = None,
    lift: Lift | None = None,
    workers: int | None = None,
    runs_per_device: int | None = None,
) -> list[Result]:
    """Train ``seeds`` runs (seeds ``config.seed``, +1, ...) in one program, each in ``out/seed-N``.

    The other arguments, what comes back and what is raised: see `train_all`.
    """
    if seeds < 1:
        raise BadInput(f"--seeds must be at least 1, not {seeds}.")
    configs = [replace(config, seed=config.seed + number) for number in range(seeds)]
    runs = [(own, Path(out) / f"seed-{own.seed}") for own in configs]
    return train_all(runs, watcher, lift, workers, runs_per_device)


def train_all(
    runs: Sequence[tuple[Config, Path]],
    watcher: Watcher | None = None,
    lift: Lift | None = None,
    workers: int | None = None,
    runs_per_device: int | None = None,
) -> list[Result]:
    """Train runs of any configurations, each in its directory, on one device.

    Runs whose configurations have one `senior.shape` share one program: they may differ in seed, task,
    schedule, teacher and numbers. Programs of different shapes go side by side on a GPU, one after the other on a CPU.
    A run's result does not depend on what the runs beside it do; under ``vmap`` its last bits do on how many they are.

    watcher: who is told of every step and of warnings, and can stop the runs, all saved; None prints warnings.
    lift: how runs share a program, ``loop`` or ``vmap``; None takes what suits the device.
    workers: processes that the environments live in; 0: this one; None: as many as there are processors on a GPU,
        but not more than runs, and 0 on a CPU.
    runs_per_device: how many are trained at a time; None: as many as the memory holds.

    Returns one `Result` per run, in order; where there are several, one that cannot be opened is told in its own.
    Raises `BadInput` before anything is written if a configuration makes no sense, an environment does not fit, or a
    directory is not empty.
    """
    if not runs:
        raise BadInput("There is no run to train.")
    _check_machine(workers, runs_per_device)
    for config, _ in runs:
        check(config)
    if len({config.device for config, _ in runs}) > 1:
        raise BadInput("All runs of a program are on one device, so their --device must be the same.")
    if len({path.resolve() for _, path in runs}) < len(runs):
        raise BadInput("Every run needs a directory of its own.")
    watcher = watcher or Quiet()
    device = prepare_device(runs[0][0].device)
    with Pools(workers, device, len(runs)) as pools:
        trainees = []
        for config, path in runs:
            own = replace(config, device=device, answering=parts.answering(config))
            spec = spec_of(own)
            _check_fit(own, spec)
            learner = make_learner(own, spec)
            trainees.append(Trainee(own, path, learner, spec, pools.worker(learner)))
        for trainee in trainees:
            trainee.directory.check_free()
            trainee.reset(0)
        for trainee in trainees:
            trainee.directory.create(trainee.config, rundir.protocol(trainee.spec, device))
        waiting = [_Waiting(trainee, trainee.begin) for trainee in trainees]
        return _run(waiting, watcher, lift, runs_per_device, alone=len(runs) == 1)


def _check_machine(workers: int | None, runs_per_device: int | None) -> None:
    if workers is not None and not 0 <= workers <= 1024:
        raise BadInput(f"--workers {workers} must be between 0 and 1024.")
    if runs_per_device is not None and runs_per_device < 1:
        raise BadInput(f"--runs-per-device {runs_per_device} must be at least 1.")


def _check_fit(config: Config, spec: EnvSpec) -> None:
    """Refuse what does not fit into an environment's episodes."""
    if config.method.learns_reward and spec.horizon <= config.queries.segment:
        raise BadInput(
            f"A segment of {config.queries.segment} steps does not fit into an episode of {spec.horizon}; "
            "lower --segment."
        )
    if config.capacity < min(spec.horizon, config.steps):
        raise BadInput(
            f"A replay of {config.capacity} rows cannot hold an episode of {spec.horizon} steps; raise "
            "--replay-capacity."
        )


def resume(
    path: Path | str,
    watcher: Watcher | None = None,
    workers: int | None = None,
    runs_per_device: int | None = None,
) -> list[Result]:
    """Continue an interrupted run, or every run under a directory that is not finished.

    Runs of one shape that stand at the same step go on in one program. One that cannot go on is told, and the others
    do. ``workers``, ``runs_per_device``: see `train_all`. Raises `BadInput` if there is no run, or the only one cannot
    go on.
    """
    _check_machine(workers, runs_per_device)
    watcher = watcher or Quiet()
    found = find_runs(path)
    with ExitStack() as stack:
        pools: Pools | None = None
        waiting: list[_Waiting] = []
        results: list[Result] = []
        for directory in found:
            try:
                config = load(directory / "config.json")
                device = prepare_device(config.device)
                if pools is None:
                    pools = stack.enter_context(Pools(workers, device, len(found)))
                spec = spec_of(config)
                learner = make_learner(config, spec)
                trainee = Trainee(config, directory, learner, spec, pools.worker(learner))
                with rundir.told(directory):
                    trainee.directory.lock()
            except BadInput as error:
                if len(found) == 1:
                    raise
                results.append(_unopened(directory, error, watcher))
                continue
            _compare_protocol(trainee, device, watcher)
            waiting.append(_Waiting(trainee, partial(trainee.resume, watcher.say)))
        return results + _run(waiting, watcher, None, runs_per_device, alone=len(found) == 1)


def _unopened(directory: Path, error: BadInput, watcher: Watcher) -> Result:
    watcher.say(f"{directory}: {error}")
    return Result(directory, None, 0, False, str(error), 0, None)


def find_runs(path: Path | str) -> list[Path]:
    """The run directories at or under a path, in order; `BadInput` if there is none."""
    path = Path(path)
    with rundir.told(path):
        if (path / "config.json").is_file():
            return [path]
        found = sorted(file.parent for file in path.glob("**/config.json") if rundir.is_run(file.parent))
    if not found:
        raise BadInput(f"There is no run in {path}: no config.json of a run at or below it.")
    return found


def spec_of(config: Config) -> EnvSpec:
    """What there is to know of a configuration's environment; looks at it once."""
    environment, spec = make_environment(config)
    environment.close()
    return spec


def make_learner(config: Config, spec: EnvSpec | None = None) -> Learner:
    """The functions of a run of that configuration, whose environment has that ``spec``."""
    spec = spec or spec_of(config)
    if ":" not in config.method.explore:  # somebody's own bonus may look at all of it
        spec = replace(spec, name="", horizon=0, tells_success=False)
    return _learner(shape(config), spec)


@lru_cache(maxsize=64)
def _learner(config: Config, spec: EnvSpec) -> Learner:
    """One learner for configurations of one shape, so that what one run compiled serves the next."""
    return Learner(config, spec, parts.bonus(config, spec))


class Pools:
    """Workers for the environments of each program: programs train in threads of their own, and share none."""

    def __init__(self, count: int | None, device: str, runs: int) -> None:
        """``count``: of each program's; None: what suits so many runs on that device."""
        self.count = count_workers(device, runs) if count is None else count
        self._pools: dict[int, Workers] = {}

    def worker(self, learner: Learner) -> Worker | None:
        """The next worker of the program of that learner; None: its environments live in this process."""
        if not self.count:
            return None
        if id(learner) not in self._pools:
            self._pools[id(learner)] = Workers(self.count)
        return self._pools[id(learner)].next()

    def __enter__(self) -> Pools:
        return self

    def __exit__(self, *_: object) -> None:
        for pool in self._pools.values():
            pool.close()


def count_workers(device: str, runs: int) -> int:
    """How many workers suit so many runs: on a CPU none, because the updates keep all processors busy."""
    return min(rundir.threads(), runs) if device == "gpu" else 0


class _Waiting(NamedTuple):
    """A run that is to be trained, and what opens its state."""

    trainee: Trainee
    opened: Callable[[], Run]

    @property
    def path(self) -> Path:
        return self.trainee.directory.path


class _Together:
    """One watcher for programs that run side by side. ``stop``: all of them are to stop."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher = watcher
        self._lock = Lock()
        self._broken = False

    @property
    def stop(self) -> bool:
        return self._broken or self._watcher.stop

    def break_off(self) -> None:
        """Something happened that ends it all."""
        self._broken = True

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        with self._lock:
            self._watcher.advance(step, trainees)

    def say(self, sentence: str) -> None:
        with self._lock:
            self._watcher.say(sentence)


def _run(
    waiting: Sequence[_Waiting], watcher: Watcher, lift: Lift | None, runs_per_device: int | None, alone: bool
) -> list[Result]:
    """Train runs, as many at a time as there is room for.

    alone: one that cannot be opened ends it all, for there is no other.
    """
    results: dict[Path, Result] = {}
    left = sorted(waiting, key=lambda run: run.trainee.config.device)
    try:
        while left and not (results and watcher.stop):
            device = left[0].trainee.config.device
            how = lift or lift_for(device)
            alike = [run.trainee for run in left if run.trainee.config.device == device]
            together = _together(alike, device, how, runs_per_device, watcher)
            results |= _train_batch(left[:together], watcher, how, alone)
            left = left[together:]
        for trainee, _ in left:
            trainee.stand(checkpoint.standing(trainee.directory.checkpoints))
            results[trainee.directory.path] = _finish(trainee)
    finally:
        for trainee, _ in left:
            trainee.close()
    return [results[run.path] for run in waiting]


def _train_batch(batch: Sequence[_Waiting], watcher: Watcher, lift: Lift, alone: bool) -> dict[Path, Result]:
    """Open some runs and train them, those of one learner that stand at one step as one program."""
    results: dict[Path, Result] = {}
    programs: dict[int, dict[int, list[tuple[Trainee, Run]]]] = defaultdict(lambda: defaultdict(list))
    try:
        for trainee, opened in batch:
            try:
                run = opened()
            except BadInput as error:
                if alone:
                    raise
                results[trainee.directory.path] = _unopened(trainee.directory.path, error, watcher)
                continue
            programs[id(trainee.learner)][trainee.progress.step].append((trainee, run))
            del run
        _train([list(at_steps.values()) for at_steps in programs.values()], _Together(watcher), lift)
        opened_runs = [trainee for trainee, _ in batch if trainee.directory.path not in results]
        return results | {trainee.directory.path: _finish(trainee) for trainee in opened_runs}
    finally:
        for trainee, _ in batch:
            trainee.close()


def _together(
    trainees: Sequence[Trainee], device: str, lift: Lift, runs_per_device: int | None, watcher: Watcher
) -> int:
    """How many of the runs, from the first on, are trained at a time; tells what memory they take."""
    sizes = [state_bytes(trainee.learner, trainee.config) for trainee in trainees]
    # under vmap states are there twice while they are put into one array
    room = np.cumsum(sizes) * (2 if lift == "vmap" else 1) <= 0.9 * device_memory(device)
    count = max(1, min(int(room.sum()), runs_per_device or len(trainees)))
    told = f"Training on the {device.upper()}, {rundir.threads()} threads. A run keeps {max(sizes) / 1e6:,.1f} MB"
    if len(trainees) > 1:
        told += f"; {count} of {len(trainees)} runs at a time, {sum(sizes[:count]) / 1e6:,.1f} MB"
    watcher.say(f"{told}.")
    return count


def _train(groups: Sequence[Sequence[list[tuple[Trainee, Run]]]], watcher: _Together, lift: Lift) -> None:
    """Train the programs of each group one after the other, and the groups so too; or, under vmap, side by side, where
    the device would idle between them. The lists of runs are emptied: a state must not be held twice."""

    def train_group(programs: Sequence[list[tuple[Trainee, Run]]]) -> None:
        try:
            for program in programs:
                trainees = [trainee for trainee, _ in program]
                runs = Runs([run for _, run in program], lift)
                program.clear()
                Training(trainees, runs, watcher).train()
        except BaseException:
            watcher.break_off()
            raise

    if lift == "loop" or len(groups) < 2:
        for group in groups:
            train_group(group)
        return
    with ThreadPoolExecutor(len(groups)) as executor:
        under_way = [executor.submit(train_group, group) for group in groups]
        try:
            for done in under_way:
                done.result()
        except BaseException:  # an interrupt too
            watcher.break_off()
            raise


def _finish(trainee: Trainee) -> Result:
    """The learning curve, and what there is to say of a run."""
    progress, directory = trainee.progress, trainee.directory.path
    finished = trainee.failure is None and progress.step == trainee.config.steps
    if finished:
        learning_curve(directory)
    return Result(
        directory,
        trainee.config.seed,
        progress.step,
        finished,
        trainee.failure,
        progress.labels,
        progress.success,
    )


def _compare_protocol(trainee: Trainee, device: str, watcher: Watcher) -> None:
    """Say so if the bits may differ from those of the uninterrupted run."""
    then = rundir.read_protocol(trainee.directory.path)
    now = rundir.protocol(trainee.spec, device)
    changed = [name for name in ("device", "threads", "packages") if then.get(name) != now[name]]
    if changed:
        watcher.say(
            f"{trainee.name}: {' and '.join(changed)} differ from when the run began, so it goes on but may not equal "
            "the uninterrupted run bit for bit."
        )
