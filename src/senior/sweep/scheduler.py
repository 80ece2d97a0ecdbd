"""Cells to workers, until all are finished or named: what failed is tried again from its checkpoint."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Sequence
from typing import Protocol

from senior.rundir import HELD, is_finished, saved_step, status
from senior.sweep.cells import Cell, Done, Job, Outcome, opened_at

RETRIES = 3
"""How often a cell that failed is tried again."""
LOOK_SECONDS = 0.5
LEAVE_SECONDS = 120.0
"""How long a worker that was told to stop may take to save what it does."""


class Crew(Protocol):
    """Workers, wherever they are."""

    device: str
    """cpu or gpu"""
    size: int
    """Workers, if all are there."""

    @property
    def idle(self) -> int:
        """How many more jobs can be given now."""
        ...

    def give(self, job: Job) -> None:
        """Have a job done."""
        ...

    def wait(self, seconds: float) -> list[Done]:
        """The jobs that are done, after at most so long."""
        ...

    def stop(self) -> None:
        """Tell all workers to save what they do and leave."""
        ...


class Spectator(Protocol):
    """Who looks on while a sweep runs."""

    def look(self, sweep: Sweep) -> None:
        """Called twice a second."""
        ...

    def say(self, sentence: str) -> None:
        """Something a person should read."""
        ...

    @property
    def stop(self) -> bool:
        """Whether to save everything and leave, as after an interrupt."""
        ...


class Sweep:
    """The state of a sweep: where every cell stands."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells = list(cells)
        self.finished = {cell for cell in cells if is_finished(cell.path)}
        self.waiting = deque(cell for cell in cells if cell not in self.finished)
        self.running: set[Cell] = set()
        self.failed: dict[Cell, str] = {}
        self._failures: Counter[Cell] = Counter()
        self._losses: Counter[Cell] = Counter()
        self._saved: dict[Cell, int] = {}
        self._opened: dict[Cell, int] = {}
        self._held: dict[Cell, tuple[float, float]] = {}  # when to look again, and the pause before that

    def run(self, crew: Crew, spectator: Spectator) -> None:
        """Train what is not finished; returns when that is done, or, told to stop, when all is saved."""
        told = False
        while self.running or (self.waiting and not told):
            if spectator.stop and not told:
                told = True
                crew.stop()
            while not told and crew.idle and (job := self._next(crew)):
                self.running.update(job)
                self._opened |= {cell: opened_at(cell.path) for cell in job}
                crew.give(job)
            for done in crew.wait(LOOK_SECONDS):
                self._take(done, told, spectator)
            for cell in [cell for cell in self.running if is_finished(cell.path)]:  # of a job that goes on
                self.running.remove(cell)
                self.finished.add(cell)
            spectator.look(self)

    def _next(self, crew: Crew) -> Job:
        """One cell on a CPU; on a GPU, where cells share programs, a worker's part of all. Nothing if none may yet."""
        share = -(-len(self.cells) // crew.size) if crew.device == "gpu" else 1
        now = time.monotonic()
        ready = [cell for cell in self.waiting if self._held.get(cell, (0.0, 0.0))[0] <= now][:share]
        for cell in ready:
            self.waiting.remove(cell)
        return tuple(ready)

    def _take(self, done: Done, told: bool, spectator: Spectator) -> None:
        begun = {cell for cell in done.job if opened_at(cell.path) != self._opened[cell]}
        outcomes: Sequence[Outcome | None] = done.outcomes or [None] * len(done.job)
        for cell, outcome in zip(done.job, outcomes, strict=True):
            if cell in self.finished:
                continue
            self.running.discard(cell)
            reason = (outcome.failure if outcome else done.reason) or ""
            if outcome.finished if outcome else is_finished(cell.path):
                self.finished.add(cell)
            elif told or (outcome and not outcome.failure):
                self.waiting.appendleft(cell)  # all saved
            elif outcome and HELD in reason:
                self._wait_for_other(cell, spectator)
            elif self._gives_up(cell, outcome, cell in begun or not begun):
                self.failed[cell] = reason
                spectator.say(f"{cell} failed {RETRIES + 1} times and is left: {reason}")
            else:
                self.waiting.append(cell)
                spectator.say(f"{cell} is tried again from step {max(0, saved_step(cell.path)):,}: {reason}")

    def _wait_for_other(self, cell: Cell, spectator: Spectator) -> None:
        """Look again later at a cell that another process trains, a worker of a sweep that was killed perhaps."""
        if cell not in self._held:
            spectator.say(f"{cell} {HELD}, and is waited for.")
        pause = min(60.0, 2 * self._held.get(cell, (0.0, 1.0))[1])
        self._held[cell] = time.monotonic() + pause, pause
        self.waiting.append(cell)

    def _gives_up(self, cell: Cell, outcome: Outcome | None, begun: bool) -> bool:
        """Whether a cell was tried often enough. A lost worker counts only if it had begun with the cell, or with none
        of its job, and if the cell had saved nothing new."""
        if outcome is not None:
            self._failures[cell] += 1
            return self._failures[cell] > RETRIES
        saved = saved_step(cell.path)
        progress = saved > self._saved.get(cell, -1)
        self._saved[cell] = saved
        self._losses[cell] = int(begun) if progress else self._losses[cell] + begun
        return self._losses[cell] > RETRIES

    def steps_done(self) -> tuple[int, int]:
        """Environment steps taken and to be taken in all cells but those that failed."""
        left = [cell for cell in self.cells if cell not in self.failed]
        taken = 0
        for cell in left:
            steps = cell.config.steps
            taken += steps if cell in self.finished else min(steps, int(status(cell.path).get("step", 0)))
        return taken, sum(cell.config.steps for cell in left)
