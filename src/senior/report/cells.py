"""What arms reached, as numbers and as cells of tables. Imports no JAX."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from senior.report.records import Run
from senior.report.statistics import Interval, Intervals, mean_and_deviation, mean_interval
from senior.report.tables import Cell, shown

Tasks = Mapping[str, Mapping[str, Sequence[Run]]]
"""Runs by task and by label, both in order."""


def finished(runs: Sequence[Run]) -> list[Run]:
    """Those that took all their steps."""
    return [run for run in runs if run.finished]


def tells_success(arms: Mapping[str, Sequence[Run]]) -> bool:
    """Whether the runs of a task are judged by success; else by true returns."""
    return any(run.evaluation.success is not None for runs in arms.values() for run in runs)


def scores_at(runs: Sequence[Run], step: int) -> np.ndarray:
    """Scores at a step ``[runs]``; without runs that were not evaluated until then."""
    values = np.array([run.score_at(step) for run in runs])
    return values[np.isfinite(values)]


def mean_of(values: Sequence[float] | np.ndarray) -> float:
    """NaN of nothing."""
    return mean_and_deviation(values)[0]


def interval_of_mean(runs: Sequence[Run], step: int) -> Interval | None:
    """Student's, of success at that step; None where no success is told, or no run was evaluated until then."""
    scores = scores_at(runs, step)
    if runs[0].evaluation.success is None or not len(scores):
        return None
    episodes = min(int(run.evaluation.episodes[-1]) for run in runs)
    return mean_interval(list(scores), episodes)


def single(found: Mapping[str, Intervals]) -> dict[str, Interval]:
    """By label, of intervals that hold one point each."""
    return {label: own.first() for label, own in found.items()}


def estimate_and_interval(found: Intervals) -> tuple[str, str | None]:
    """An estimate, and its interval."""
    interval = found.first()
    return number(interval.mean), bracketed(interval)


def with_interval(found: Intervals) -> str | None:
    """An estimate and its interval in one cell; None of nothing."""
    if math.isnan(float(found.mean[0])):
        return None
    told, interval = estimate_and_interval(found)
    return f"{told} {interval}" if interval else told


def counted(runs: Sequence[Run]) -> Cell:
    """How many there are, and have finished."""
    done = len(finished(runs))
    return done if done == len(runs) else f"{done} of {len(runs)} finished"


def plus_minus(values: Sequence[float] | np.ndarray) -> str | None:
    """Mean ± deviation; None of nothing."""
    mean, deviation = mean_and_deviation(values)
    if math.isnan(mean):
        return None
    return number(mean) if math.isnan(deviation) else f"{number(mean)} ± {number(deviation)}"


def number(value: float) -> str:
    """Rates to hundredths, larger numbers to three digits."""
    return f"{value:.2f}" if abs(value) < 10 else shown(float(value))


def bracketed(interval: Interval | None) -> str | None:
    """Its bounds; None of nothing."""
    if interval is None or math.isnan(interval.low):
        return None
    return f"[{number(interval.low)}, {number(interval.high)}]"


def span(values: Sequence[float]) -> str | None:
    """From the least to the most, or the one that all are."""
    if not values:
        return None
    ends = [_whole(value) for value in (min(values), max(values))]
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


def _whole(value: float) -> str:
    return f"{value:,.0f}" if float(value).is_integer() else shown(value)


def listed(words: Sequence[str]) -> str:
    """With commas and an "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
