"""The plane that positions of a task are drawn in, with the task's object. Imports no JAX."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from senior.envs.metaworld import TASKS
from senior.files import Damaged, unpack
from senior.report.asked import Asked, asked
from senior.report.records import LeftOut, Run, Unusable

Arms = Mapping[str, Sequence[Run]]
"""Runs of one task by the label of their arm."""
COORDINATES = "xyz"
POSITIONS = "positions.npz"
MARGIN = 0.03
"""Share of the longer side that is left free around all that is drawn."""
NARROWEST = 0.2
"""Least share of the longer side that the shorter one has."""
PERCENTILES = (10, 50, 90)
"""Of the object's place."""

T = TypeVar("T")


@dataclass(frozen=True)
class Plane:
    """Two coordinates of a position, and the range of them that is drawn."""

    axes: tuple[int, int]
    """Which coordinates, in order."""
    size: int
    """How many a position has."""
    named: bool
    """Whether coordinates are x, y and z, in metres; else they have numbers."""
    low: np.ndarray
    """``[2]``: lower left corner."""
    high: np.ndarray
    """``[2]``: upper right corner."""
    object: np.ndarray | None
    """``[3, 2]``: `PERCENTILES` of where the object was; None where it is not known."""

    def of(self, positions: np.ndarray) -> np.ndarray:
        """Positions ``[..., d]`` as points of the plane ``[..., 2]``."""
        return positions[..., list(self.axes)]

    def coordinate(self, number: int) -> str:
        """Name of a coordinate of a position."""
        return COORDINATES[number] if self.named else f"coordinate {number + 1}"

    @property
    def labels(self) -> tuple[str, str]:
        """Of the two axes."""
        first, second = (self.coordinate(i) + (" (m)" if self.named else "") for i in self.axes)
        return first, second

    @property
    def aspect(self) -> float:
        """Height by width."""
        width, height = self.high - self.low
        return float(height / width)

    def edges(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Edges of nearly square cells, ``most`` of them along the longer side, that fill the plane."""
        sides = self.high - self.low
        counts = np.maximum(np.round(most * sides / sides.max()), 1).astype(int)
        first, second = (np.linspace(*ends) for ends in zip(self.low, self.high, counts + 1, strict=True))
        return first, second


def evenly(steps: Sequence[int], most: int) -> list[int]:
    """At most so many of them: the first and the last, and the others evenly between."""
    if len(steps) <= most:
        return list(steps)
    return [steps[i] for i in np.unique(np.linspace(0, len(steps) - 1, most).round().astype(int))]


def usable(read: Callable[[Run], T], run: Run, left_out: list[LeftOut]) -> T | None:
    """What a run's file holds; None where it cannot be used, which is then told in ``left_out``, once."""
    try:
        return read(run)
    except Unusable as reason:
        told = LeftOut(run.path, str(reason))
        if told not in left_out:
            left_out.append(told)
        return None


def visited(run: Run) -> dict[int, np.ndarray]:
    """Snapshots of a run by step: positions ``[n, d]``. Empty where there is none yet. Raises `Unusable`."""
    path = run.path / POSITIONS
    if not path.exists():
        return {}
    try:
        found = {int(name.removeprefix("step-")): np.asarray(array, float) for name, array in unpack(path).items()}
    except (Damaged, OSError, ValueError) as error:
        raise Unusable(f"{POSITIONS} cannot be used: {error}") from error
    if any(array.ndim != 2 or not len(array) or not np.isfinite(array).all() for array in found.values()):
        raise Unusable(f"{POSITIONS} is damaged: it holds something else than positions")
    return {step: positions for step, positions in sorted(found.items()) if step <= run.steps}


def firsts(arms: Arms, left_out: list[LeftOut]) -> list[Asked]:
    """What the first run of each arm that asked something asked."""
    held = ((usable(asked, run, left_out) for run in runs) for runs in arms.values())
    return [first for own in held if (first := next(filter(None, own), None))]


def plane_of(arms: Arms, pairs: Sequence[Asked], left_out: list[LeftOut]) -> Plane | None:
    """The plane of a task: the two coordinates of the largest spread (standard deviation) over all of its runs.

    All snapshots of all runs count; where there are none, the segments of the pairs. The object's place is taken from
    the pairs, and their segments lie within the plane. None if no position is known, or if it has one coordinate. What
    cannot be used is told in ``left_out``.
    """
    spread = _Spread()
    for run in (run for runs in arms.values() for run in runs):
        for positions in (usable(visited, run, left_out) or {}).values():
            spread.add(positions)
    known = spread.deviation if spread.count else None
    for one in pairs:
        spread.add(one.position.reshape(-1, one.position.shape[-1]))
    if spread.size < 2:
        return None
    chosen = sorted(np.argsort(-(spread.deviation if known is None else known), kind="stable")[:2].tolist())
    low, high = spread.low[chosen], spread.high[chosen]
    places = [one.object.reshape(-1, 3) for one in pairs if one.object is not None]
    middle = np.percentile(np.concatenate(places), PERCENTILES, axis=0)[:, chosen] if places else None
    if middle is not None:
        low, high = np.minimum(low, middle.min(axis=0)), np.maximum(high, middle.max(axis=0))
    longer = max(float((high - low).max()), 1e-6)
    margin = MARGIN * longer + np.maximum(NARROWEST * longer - (high - low), 0) / 2
    named = next(iter(arms.values()))[0].arm.task in TASKS
    return Plane((chosen[0], chosen[1]), spread.size, named, low - margin, high + margin, middle)


class _Spread:
    """Range and deviation of positions that are seen one array after the other, all of the size of the first."""

    def __init__(self) -> None:
        self.count = self.size = 0
        self.low = self.high = self._sum = self._square = np.zeros(0)

    def add(self, positions: np.ndarray) -> None:
        """``[n, d]``; other sizes than the first one's are passed over."""
        if not self.count:
            self.size = positions.shape[1]
            self.low, self.high = np.full(self.size, np.inf), np.full(self.size, -np.inf)
            self._sum, self._square = np.zeros(self.size), np.zeros(self.size)
        if positions.shape[1] != self.size:
            return
        self.count += len(positions)
        self.low = np.minimum(self.low, positions.min(axis=0))
        self.high = np.maximum(self.high, positions.max(axis=0))
        self._sum = self._sum + positions.sum(axis=0)
        self._square = self._square + (positions**2).sum(axis=0)

    @property
    def deviation(self) -> np.ndarray:
        """``[d]``"""
        return np.sqrt(np.maximum(self._square / self.count - (self._sum / self.count) ** 2, 0))
