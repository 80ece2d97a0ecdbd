"""Runs on one device: as many at a time as its memory holds, those of one shape and step as one program."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np

from senior import checkpoint, protocol
from senior.config import Config
from senior.device import device_memory
from senior.envs.workers import Worker, Workers
from senior.label.address import Address, check_address
from senior.label.serving import Serving
from senior.learner import Learner, Run
from senior.loop import Training, Watcher
from senior.report.curves import learning_curve
from senior.runs import Lift, Runs, lift_for, state_bytes
from senior.trainee import Trainee
from senior.types import BadInput


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


class Pools:
    """Workers for the environments of each program: programs train in threads of their own, and share none."""

    def __init__(self, count: int | None, device: str) -> None:
        """``count``: most workers of a program; None: what suits the device."""
        self.count = count_workers(device) if count is None else count
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


def count_workers(device: str) -> int:
    """How many workers suit a program: on a CPU none, because the updates keep all processors busy."""
    return protocol.threads() if device == "gpu" else 0


class Waiting(NamedTuple):
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


def check_page(configs: Sequence[Config], page: Address) -> None:
    """`BadInput` for a page that cannot be served there, or for a fixed port where several runs have one."""
    asking = sum(config.teacher == "human" for config in configs)
    if asking:
        check_address(page)
    if asking > 1 and page.port:
        raise BadInput(f"--port {page.port} is for one page, and each of {asking} runs has its own; leave it out.")


def train_waiting(
    waiting: Sequence[Waiting],
    watcher: Watcher,
    lift: Lift | None,
    runs_per_device: int | None,
    alone: bool,
    page: Address,
) -> list[Result]:
    """Train runs of one device, as many at a time as there is room for.

    alone: one that cannot be opened ends it all, for there is no other. page: where people, if they are the teacher,
    are asked.
    """
    results: dict[Path, Result] = {}
    left = list(waiting)
    pages = ExitStack()
    try:
        check_page([trainee.config for trainee, _ in waiting], page)
        for trainee, _ in waiting:
            if trainee.config.teacher == "human":
                standing = checkpoint.standing(trainee.directory.checkpoints) or {}
                trainee.tell("starting", standing.get("step", 0))
                pages.enter_context(Serving(trainee.directory.path, page, watcher.say))
        while left and not (results and watcher.stop):
            device = left[0].trainee.config.device  # that of all
            how = lift or lift_for(device)
            together = _together([run.trainee for run in left], device, how, runs_per_device, watcher)
            results |= _train_batch(left[:together], watcher, how, alone)
            left = left[together:]
        for trainee, _ in left:
            trainee.stand(checkpoint.standing(trainee.directory.checkpoints))
            results[trainee.directory.path] = _finish(trainee)
    finally:
        for trainee, _ in left:
            trainee.close()
        pages.close()
    return [results[run.path] for run in waiting]


def _train_batch(batch: Sequence[Waiting], watcher: Watcher, lift: Lift, alone: bool) -> dict[Path, Result]:
    """Open some runs and train them, those of one learner that stand at one step as one program."""
    results: dict[Path, Result] = {}
    programs: dict[int, dict[int, list[tuple[Trainee, Run]]]] = defaultdict(lambda: defaultdict(list))
    try:
        for trainee, opened in batch:
            try:
                run = opened()
            except BadInput as error:
                trainee.failure = str(error)
                trainee.tell("stopped", trainee.progress.step)
                if alone:
                    raise
                results[trainee.directory.path] = unopened(trainee.directory.path, error, watcher)
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
    told = f"Training on the {device.upper()}, {protocol.threads()} threads. A run keeps {max(sizes) / 1e6:,.1f} MB"
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
    trainee.tell("finished" if finished else "stopped", progress.step)
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


def unopened(directory: Path, error: BadInput, watcher: Watcher) -> Result:
    """Tell of a run that cannot be opened; what there is to say of it."""
    watcher.say(f"{directory}: {error}")
    return Result(directory, None, 0, False, str(error), 0, None)
