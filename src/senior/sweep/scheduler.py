"""Cells to workers, until all are finished or named: what failed is tried again from its checkpoint."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from typing import Protocol

from senior.sweep.cells import Cell, Done, Job, Outcome, is_finished, saved_step, standing

RETRIES = 3
"""How often a cell that failed is tried again."""
LOOK_SECONDS = 0.5


class Crew(Protocol):
    """Workers, wherever they are."""

    device: str
    """cpu or gpu"""

    @property
    def idle(self) -> int:
        """How many more jobs can be given."""
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
        self.found_finished = len(self.finished)
        self.waiting = deque(cell for cell in cells if cell not in self.finished)
        self.running: set[Cell] = set()
        self.failed: dict[Cell, str] = {}
        self._failures: Counter[Cell] = Counter()
        self._losses: Counter[Cell] = Counter()
        self._saved: dict[Cell, int] = {}

    def run(self, crew: Crew, spectator: Spectator) -> None:
        """Train what is not finished; returns when that is done, or, told to stop, when all is saved."""
        told = False
        while self.running or (self.waiting and not told):
            if spectator.stop and not told:
                told = True
                crew.stop()
            while self.waiting and crew.idle and not told:
                job = self._next(crew)
                self.running.update(job)
                crew.give(job)
            for done in crew.wait(LOOK_SECONDS):
                self._take(done, told, spectator)
            spectator.look(self)

    def _next(self, crew: Crew) -> Job:
        """One cell on a CPU; on a GPU, where cells share programs, an equal part of all that wait."""
        share = -(-len(self.waiting) // crew.idle) if crew.device == "gpu" else 1
        return tuple(self.waiting.popleft() for _ in range(share))

    def _take(self, done: Done, told: bool, spectator: Spectator) -> None:
        self.running.difference_update(done.job)
        outcomes: Sequence[Outcome | None] = done.outcomes or [None] * len(done.job)
        for cell, outcome in zip(done.job, outcomes, strict=True):
            if outcome is not None and outcome.finished:
                self.finished.add(cell)
            elif outcome is not None and outcome.failure is None:
                self.waiting.appendleft(cell)  # told to stop, all saved
            elif told:
                self.waiting.appendleft(cell)
            elif self._gives_up(cell, outcome):
                reason = outcome.failure if outcome else done.reason
                self.failed[cell] = reason or ""
                spectator.say(f"{cell} failed {RETRIES + 1} times and is left: {reason}")
            else:
                self.waiting.append(cell)
                reason = outcome.failure if outcome else done.reason
                spectator.say(f"{cell} is tried again from step {max(0, saved_step(cell.path)):,}: {reason}")

    def _gives_up(self, cell: Cell, outcome: Outcome | None) -> bool:
        """Whether a cell was tried often enough. A lost worker counts only if it had saved nothing new."""
        if outcome is not None:
            self._failures[cell] += 1
            return self._failures[cell] > RETRIES
        saved = saved_step(cell.path)
        self._losses[cell] = 1 if saved > self._saved.get(cell, -1) else self._losses[cell] + 1
        self._saved[cell] = saved
        return self._losses[cell] > RETRIES

    def steps_done(self) -> tuple[int, int]:
        """Environment steps taken and to be taken in all cells."""
        taken = 0
        for cell in self.cells:
            steps = cell.config.steps
            taken += steps if cell in self.finished else min(steps, int(standing(cell.path).get("step", 0)))
        return taken, sum(cell.config.steps for cell in self.cells)
