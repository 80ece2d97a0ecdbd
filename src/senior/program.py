"""Whole programs: train and resume. What the command line calls, and what ``import senior`` offers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

from senior import checkpoint, parts, protocol, rundir
from senior.config import Config, load
from senior.device import prepare_device
from senior.envs.drawing import NoVideo, prepare_opengl
from senior.fit import check_fit, check_offered, spec_of
from senior.label.address import Address
from senior.label.serving import check_installed
from senior.learner import Learner
from senior.loop import Watcher
from senior.runs import Lift
from senior.shape import shape
from senior.together import Pools, Result, Waiting, check_page, train_waiting, unopened
from senior.trainee import Trainee
from senior.types import BadInput, EnvSpec

HERE = Address()
"""The labelling page's address, where nothing is said about it: on this machine."""


class Quiet:
    """A watcher that prints what is said and nothing else, and never says stop."""

    stop = False

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        pass

    def say(self, sentence: str) -> None:
        print(sentence)


def train(
    config: Config,
    out: Path | str,
    seeds: int = 1,
    watcher: Watcher | None = None,
    lift: Lift | None = None,
    workers: int | None = None,
    runs_per_device: int | None = None,
    page: Address = HERE,
) -> list[Result]:
    """Train ``seeds`` runs (seeds ``config.seed``, +1, ...) in one program, each in ``out/seed-N``.

    The other arguments, what comes back and what is raised: see `train_all`.
    """
    if seeds < 1:
        raise BadInput(f"--seeds must be at least 1, not {seeds}.")
    configs = [replace(config, seed=config.seed + number) for number in range(seeds)]
    runs = [(own, Path(out) / f"seed-{own.seed}") for own in configs]
    return train_all(runs, watcher, lift, workers, runs_per_device, page)


def train_all(
    runs: Sequence[tuple[Config, Path]],
    watcher: Watcher | None = None,
    lift: Lift | None = None,
    workers: int | None = None,
    runs_per_device: int | None = None,
    page: Address = HERE,
) -> list[Result]:
    """Train runs of any configurations, each in its directory, on one device.

    Runs whose configurations have one `senior.shape` share one program: they may differ in seed, task, teacher,
    learning rates, and in what is asked and when. Programs of different shapes go side by side on a GPU, one after
    the other on a CPU. A run's result does not depend on what the runs beside it do; under ``vmap`` its last bits do
    on how many they are.

    watcher: who is told of every step and of warnings, and can stop the runs, all saved; None prints warnings.
    lift: how runs share a program, ``loop`` or ``vmap``; None takes what suits the device.
    workers: processes that the environments of a program live in, not more than it has runs; 0: this one; None: as
        many as there are processors on a GPU, and 0 on a CPU.
    runs_per_device: how many are trained at a time; None: as many as the memory holds.
    page: where people, if they are the teacher, are asked; what each run's page is opened by is told to ``watcher``.

    Returns one `Result` per run, in order; where there are several, one that cannot be opened is told in its own.
    Raises `BadInput` before anything is written if a configuration makes no sense, an environment does not fit, or a
    directory is not empty.
    """
    device = _check_runs(runs, workers, runs_per_device)
    configs = [config for config, _ in runs]
    _ready_for_people(configs)
    check_page(configs, page)
    watcher = watcher or Quiet()
    with Pools(workers, device) as pools:
        trainees: list[Trainee] = []
        try:
            for config, path in runs:
                trainees.append(_trainee(config, path, device, pools))
            for trainee in trainees:
                trainee.directory.check_free()
                if not trainee.filmed:
                    trainee.reset(0)
            for trainee in trainees:
                trainee.directory.create(trainee.config, protocol.of(trainee.spec, device))
                if trainee.filmed:  # into that directory
                    trainee.reset(0)
        except BaseException:
            _close(trainees)
            raise
        waiting = [Waiting(trainee, trainee.begin) for trainee in trainees]
        return train_waiting(waiting, watcher, lift, runs_per_device, len(runs) == 1, page)


def continue_all(runs: Sequence[tuple[Config, Path]], watcher: Watcher) -> list[Result]:
    """`train_all`, but a run that is there goes on from its newest checkpoint, and a run that cannot be opened, or is
    another one, is told in its own result: the others go on. ``senior sweep`` stands on it."""
    device = _check_runs(runs, None, None)
    _ready_for_people([config for config, _ in runs])
    results: dict[Path, Result] = {}
    with Pools(None, device) as pools:
        waiting: list[Waiting] = []
        for config, path in runs:
            trainee = None
            try:
                trainee = _trainee(config, path, device, pools)
                waiting.append(_opened(trainee, device, watcher))
            except BadInput as error:
                _close([trainee] if trainee else [])
                results[path] = unopened(path, error, watcher)
        found = train_waiting(waiting, watcher, None, None, False, HERE)
        results |= {one.path: one for one in found}
    return [results[path] for _, path in runs]


def _opened(trainee: Trainee, device: str, watcher: Watcher) -> Waiting:
    """A run that is there, or a new one."""
    directory = trainee.directory
    if (directory.path / "config.json").is_file():
        directory.check_holds(trainee.config)
        return _reopened(trainee, device, watcher)
    directory.check_free()
    trainee.reset(0)
    directory.create(trainee.config, protocol.of(trainee.spec, device))
    return Waiting(trainee, trainee.begin)


def _reopened(trainee: Trainee, device: str, watcher: Watcher) -> Waiting:
    """A run that is there; `BadInput` if another process trains it."""
    with rundir.told(trainee.directory.path):
        trainee.directory.lock()
    trainee.directory.check_fits(trainee.spec)
    _compare_protocol(trainee, device, watcher)
    return Waiting(trainee, partial(trainee.resume, watcher.say))


def _check_runs(runs: Sequence[tuple[Config, Path]], workers: int | None, runs_per_device: int | None) -> str:
    """`BadInput` for runs that make no sense; the device that they are computed on."""
    if not runs:
        raise BadInput("There is no run to train.")
    _check_machine(workers, runs_per_device)
    for config, _ in runs:
        check_offered(config)
    if len({config.device for config, _ in runs}) > 1:
        raise BadInput("All runs of a program are on one device, so their --device must be the same.")
    if len({path.resolve() for _, path in runs}) < len(runs):
        raise BadInput("Every run needs a directory of its own.")
    return prepare_device(runs[0][0].device)


def _ready_for_people(configs: Sequence[Config]) -> None:
    """Before any environment is made: what runs need whose teachers are people. `BadInput` if it is not installed."""
    asking = [config for config in configs if config.teacher == "human"]
    if asking:
        check_installed()
    if any(config.env for config in asking):  # they may have to be filmed
        with suppress(NoVideo):  # which is told when an episode cannot be
            prepare_opengl()


def _trainee(config: Config, path: Path, device: str, pools: Pools) -> Trainee:
    own = replace(parts.resolved(config), device=device)
    spec = spec_of(own)
    check_fit(own, spec)
    learner = make_learner(own, spec)
    return Trainee(own, path, learner, spec, pools.worker(learner))


def _close(trainees: Sequence[Trainee]) -> None:
    for trainee in trainees:
        trainee.close()


def _check_machine(workers: int | None, runs_per_device: int | None) -> None:
    if workers is not None and not 0 <= workers <= 1024:
        raise BadInput(f"--workers {workers} must be between 0 and 1024.")
    if runs_per_device is not None and runs_per_device < 1:
        raise BadInput(f"--runs-per-device {runs_per_device} must be at least 1.")


def resume(
    path: Path | str,
    watcher: Watcher | None = None,
    workers: int | None = None,
    runs_per_device: int | None = None,
    page: Address = HERE,
) -> list[Result]:
    """Continue an interrupted run, or every run under a directory; those that are finished stay as they are.

    Runs of one shape that stand at the same step go on in one program. One that cannot go on is told, and the others
    do; so is one that is computed on another device than the first that has steps to take. ``workers``,
    ``runs_per_device``, ``page``: see `train_all`. Returns one `Result` per run, by path. Raises `BadInput` if there is
    no run, or the only one cannot go on.
    """
    _check_machine(workers, runs_per_device)
    watcher = watcher or Quiet()
    found = rundir.find_runs(path)
    with ExitStack() as stack:
        pools: Pools | None = None
        device = wanted = ""
        waiting: list[Waiting] = []
        results: list[Result] = []
        over = {directory: _is_over(directory) for directory in found}
        for directory in sorted(found, key=over.__getitem__):
            trainee = None
            try:
                config = load(directory / "config.json")
                finished = _finished(directory, config) if over[directory] else None
                if finished is not None:
                    results.append(finished)
                    continue
                _ready_for_people([config])
                if pools is None:
                    device, wanted = prepare_device(config.device), config.device
                    pools = stack.enter_context(Pools(workers, device))
                if config.device != wanted and not over[directory]:
                    raise BadInput(
                        f"It is computed on the {config.device.upper()}, and others here on the {wanted.upper()}; "
                        "resume it by itself."
                    )
                spec = spec_of(config)
                learner = make_learner(config, spec)
                trainee = Trainee(config, directory, learner, spec, pools.worker(learner))
                waiting.append(_reopened(trainee, device, watcher))
            except BadInput as error:
                _close([trainee] if trainee else [])
                if len(found) == 1:
                    raise
                results.append(unopened(directory, error, watcher))
        results += train_waiting(waiting, watcher, None, runs_per_device, len(found) == 1, page)
    return sorted(results, key=lambda result: found.index(result.path))


def _finished(run: Path, config: Config) -> Result | None:
    """What came of a run that has told that it is finished, without opening it; None if something is left to do."""
    stood = checkpoint.standing(run / "checkpoints")
    told_and_drawn = rundir.is_finished(run) and (run / "plots").is_dir()
    if stood is None or stood["step"] < config.steps or not told_and_drawn:
        return None
    return Result(run, config.seed, stood["step"], True, None, stood["labels"], stood["success"])


def _is_over(run: Path) -> bool:
    """Whether a run has no steps to take."""
    try:
        return rundir.saved_step(run) >= load(run / "config.json").steps
    except BadInput:
        return False


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


def _compare_protocol(trainee: Trainee, device: str, watcher: Watcher) -> None:
    """Say so if the bits may differ from those of the uninterrupted run."""
    then = protocol.read(trainee.directory.path)
    now = protocol.of(trainee.spec, device)
    changed = [name for name in ("device", "threads", "packages") if then.get(name) != now[name]]
    if changed:
        watcher.say(
            f"{trainee.name}: {' and '.join(changed)} differ from when the run began, so it goes on but may not equal "
            "the uninterrupted run bit for bit."
        )
