"""What many runs say together: means, interquartile means, areas, and how sure one can be of them. Imports no JAX.

A run is one draw of a method on a task; seeds are what is averaged over. Two kinds of interval are made here.

Those of `mean_interval` and `difference_interval` are for verdicts. They are Student's and Welch's, and never narrower
than the evaluations themselves allow: a success rate of ten episodes is known to a tenth and no better, so five seeds
that all say 1.0 have not shown that the policy never fails.

Those of `interquartile_means`, `means`, `improvement` and `profiles` are for comparing methods as the field does
(Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice): percentiles of a bootstrap
that draws runs with replacement within every task, by ``rliable``. They know nothing of the episodes, and are of no
width where all runs say the same.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy import special

REPETITIONS = 2000
"""Draws of a bootstrap."""
CONFIDENCE = 0.95
"""Of the bootstrap's intervals."""

Scores = Sequence[np.ndarray]
"""What a method's runs scored: per task an array ``[runs, ...]``, with equally many runs or not."""


class Interval(NamedTuple):
    """An estimate and the interval around it; NaN where one run leaves it open."""

    mean: float
    low: float
    high: float


class Intervals(NamedTuple):
    """Estimates and intervals of several things at once, each ``[points]``."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def first(self) -> Interval:
        """Of the first thing, where there is one alone."""
        return Interval(*(float(bound[0]) for bound in self))


# Few seeds, and episodes that are counted.


def mean_and_deviation(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean and sample standard deviation (n - 1) over runs; the latter is NaN of one run, both of none."""
    values = np.asarray(values, float)
    mean = float(values.mean()) if len(values) else float("nan")
    return mean, float(values.std(ddof=1)) if len(values) > 1 else float("nan")


class Group(NamedTuple):
    """Success rates of one evaluation per seed, and how they enter a sum."""

    rates: Sequence[float]
    """Per seed, the share of its episodes that succeeded, in [0, 1]."""
    episodes: int
    """Of each evaluation."""
    weight: float = 1.0


def contrast(groups: Sequence[Group], confidence: float = 0.9, seeds: int | None = None) -> Interval:
    """Interval of a weighted sum of success rates: of a difference (weights 1 and -1), or of an average over tasks.

    sum(w m) +- t * sqrt(sum(w^2 v / n)), with Student's t and the degrees of freedom of Welch and Satterthwaite, cut to
    what rates in [0, 1] can add up to. m and v are mean and sample variance over a group's n seeds, but v is at least
    p (1 - p) / episodes, which is what counting episodes leaves open: p is the rate over all seeds' episodes, drawn
    towards a half by half a success in one more episode, so that it is never 0 or 1. Where a group has one seed, which
    tells nothing of others: all that is possible.

    seeds: what the interval would be if every group had so many, of the same mean and variance.
    Raises ValueError for no seeds, rates outside [0, 1] or no episodes.
    """
    rates = [_rates(group.rates, group.episodes) for group in groups]
    mean = sum(group.weight * float(own.mean()) for group, own in zip(groups, rates, strict=True))
    least, most = sum(min(0.0, group.weight) for group in groups), sum(max(0.0, group.weight) for group in groups)
    if min(map(len, rates)) < 2:
        return Interval(mean, least, most)
    counts = [seeds or len(own) for own in rates]
    variances = [_variance(own, group.episodes) for group, own in zip(groups, rates, strict=True)]
    parts = [group.weight**2 * v / n for group, v, n in zip(groups, variances, counts, strict=True)]
    freedom = sum(parts) ** 2 / sum(part**2 / (n - 1) for part, n in zip(parts, counts, strict=True))
    half = _student(freedom, confidence) * math.sqrt(sum(parts))
    return Interval(mean, max(least, mean - half), min(most, mean + half))


def mean_interval(successes: Sequence[float], episodes: int, confidence: float = 0.9) -> Interval:
    """Interval of a method's success rate, from one evaluation per seed: `contrast` of one group."""
    return contrast([Group(successes, episodes)], confidence)


def difference_interval(
    one: Sequence[float],
    other: Sequence[float],
    episodes: int,
    other_episodes: int | None = None,
    confidence: float = 0.9,
) -> Interval:
    """Interval of how much higher one method's success rate is than another's: `contrast` of two groups (Welch)."""
    return contrast([Group(one, episodes), Group(other, other_episodes or episodes, -1.0)], confidence)


def _rates(successes: Sequence[float], episodes: int) -> np.ndarray:
    rates = np.asarray(successes, float)
    if not len(rates) or not ((rates >= 0) & (rates <= 1)).all():
        raise ValueError(f"Success rates of at least one seed, between 0 and 1, are needed, not {list(successes)}.")
    if episodes < 1:
        raise ValueError(f"An evaluation has at least one episode, not {episodes}.")
    return rates


def _variance(rates: np.ndarray, episodes: int) -> float:
    """Over seeds, at least that of an evaluation of so many episodes."""
    trials = len(rates) * episodes
    p = (rates.sum() * episodes + 0.5) / (trials + 1)
    return max(float(rates.var(ddof=1)), p * (1 - p) / episodes)


def _student(freedom: float, confidence: float) -> float:
    """How many standard errors to each side."""
    return float(special.stdtrit(freedom, (1 + confidence) / 2))


# Runs over tasks, by the bootstrap.


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half along the first axis: a quarter of ``values`` ``[n, ...]``, rounded down, goes from each
    end."""
    cut = len(values) // 4
    return np.sort(values, axis=0)[cut : len(values) - cut].mean(axis=0)


def interquartile_means(scores: Mapping[str, Scores]) -> dict[str, Intervals]:
    """Per method, the interquartile mean over all runs of all tasks; points are what a run's score has of them.

    Every task weighs the same: where it has fewer runs than another, each of them weighs more.
    """
    return _estimates({name: (own,) for name, own in scores.items()}, _interquartile)


def means(scores: Mapping[str, Scores]) -> dict[str, Intervals]:
    """Per method, the mean over tasks of the mean over runs."""
    return _estimates({name: (own,) for name, own in scores.items()}, _mean)


def improvement(scores: Mapping[str, Scores]) -> dict[tuple[str, str], Interval]:
    """Of every two methods, in both orders, the probability that a run of the first beats one of the second.

    On a task, P(X > Y) + P(X = Y) / 2 over all pairs of runs (Mann and Whitney's U by its greatest value); the mean of
    that over the tasks. Both methods must have the same tasks in the same order, and a run one number per task.
    """
    names = list(scores)
    pairs = [(one, other) for place, one in enumerate(names) for other in names[place + 1 :]]
    found = _estimates({f"{i}": (scores[one], scores[other]) for i, (one, other) in enumerate(pairs)}, _improvement)
    both: dict[tuple[str, str], Interval] = {}
    for pair, estimate in zip(pairs, found.values(), strict=True):
        mean, low, high = both[pair] = estimate.first()
        both[pair[1], pair[0]] = Interval(1 - mean, 1 - high, 1 - low)
    return both


def profiles(scores: Mapping[str, Scores], thresholds: np.ndarray) -> dict[str, Intervals]:
    """Per method, the share of runs that score more than each threshold ``[points]``, every task weighing the same."""

    def above(blocks: Blocks) -> np.ndarray:
        return _mean([block[:, :, None] > thresholds[:, None] for block in blocks])

    return _estimates({name: (own,) for name, own in scores.items()}, above)


# A block is ``[runs, tasks, ..., g]``: tasks of equally many runs, and g groups of equal shape side by side. rliable
# resamples runs task by task, point by point and group by group, so groups do not touch each other.
Blocks = Sequence[np.ndarray]


def _interquartile(blocks: Blocks) -> np.ndarray:
    values = np.concatenate([block.reshape(-1, *block.shape[2:]) for block in blocks])
    if len(blocks) == 1:
        return interquartile_mean(values)
    weights = np.concatenate([np.full(len(block), 1 / (len(block) * len(blocks))) for block in blocks])
    order = np.argsort(values, axis=0)
    end = np.cumsum(weights[order], axis=0)
    middle = np.minimum(end, 0.75) - np.maximum(end - weights[order], 0.25)  # of what a run weighs, in order
    return 2 * (np.take_along_axis(values, order, axis=0) * np.maximum(middle, 0)).sum(axis=0)


def _mean(blocks: Blocks) -> np.ndarray:
    tasks = sum(block.shape[1] for block in blocks)
    return np.sum([block.mean(axis=0).sum(axis=0) for block in blocks], axis=0) / tasks


def _improvement(one: Blocks, other: Blocks) -> np.ndarray:
    tasks = sum(block.shape[1] for block in one)
    shares = []
    for x, y in zip(one, other, strict=True):
        x, y = x[:, None], y[None]  # [runs, runs, tasks, g]
        shares.append((np.mean(x > y, axis=(0, 1)) + np.mean(x == y, axis=(0, 1)) / 2).sum(axis=0))
    return np.sum(shares, axis=0) / tasks


def _estimates(groups: Mapping[str, Sequence[Scores]], statistic: Callable[..., np.ndarray]) -> dict[str, Intervals]:
    """A statistic of each group and its interval. A group is the scores of the methods that the statistic takes.

    The interval is NaN where some task has one run of some method: to draw it again and again would show no spread.
    """
    alike: dict[Any, list[str]] = defaultdict(list)
    blocks = {name: _blocks(group) for name, group in groups.items()}
    for name, own in blocks.items():
        alike[tuple(tuple(block.shape for block in method) for method in own)].append(name)
    found = {}
    for names in alike.values():
        together = [
            [np.stack(same, axis=-1) for same in zip(*methods, strict=True)]
            for methods in zip(*(blocks[name] for name in names), strict=True)
        ]
        bounds = statistic(*together), *_bootstrap(together, statistic)
        for place, name in enumerate(names):
            found[name] = Intervals(*(np.atleast_1d(bound[..., place]) for bound in bounds))
    return {name: found[name] for name in groups}


def _blocks(group: Sequence[Scores]) -> list[Blocks]:
    """Every method's scores as blocks ``[runs, tasks, ...]``, of the same tasks for all methods."""
    scores = [[np.asarray(task, float) for task in own] for own in group]
    if all(len({len(task) for task in own}) == 1 for own in scores):
        return [[np.stack(own, axis=1)] for own in scores]
    return [[task[:, None] for task in own] for own in scores]


def _bootstrap(together: Sequence[Blocks], statistic: Callable[..., np.ndarray]) -> np.ndarray:
    """Bounds ``[2, ..., g]``."""
    shape = statistic(*together).shape
    flat = [block for method in together for block in method]
    if min(len(block) for block in flat) < 2:
        return np.full((2, *shape), np.nan)
    ends = [0, *np.cumsum([len(method) for method in together])]

    def of_draw(*drawn: np.ndarray) -> np.ndarray:
        return statistic(*(drawn[start:end] for start, end in pairwise(ends))).ravel()

    from rliable import library  # takes a second, and is not installed by default

    with _repeatable():
        _, bounds = library.get_interval_estimates(
            {"": flat}, of_draw, reps=REPETITIONS, confidence_interval_size=CONFIDENCE
        )
    return bounds[""].reshape(2, *shape)


@contextmanager
def _repeatable() -> Iterator[None]:
    """Seed what rliable draws from, which is NumPy's global generator and no other, and leave it as it was."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


# Of one run.


def mean_over(x: np.ndarray, y: np.ndarray) -> float:
    """Mean of a curve over its range: the area below it, by straight lines between its points, by that range's length.

    Of one point, its value.
    """
    return float(np.trapezoid(y, x) / (x[-1] - x[0])) if x[-1] > x[0] else float(y[-1])


def by_labels(queried: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve against the number of asked pairs, skipped ones too: with each counts the first evaluation that had so
    many. Returns the numbers, each once, and the scores there."""
    numbers, first = np.unique(queried, return_index=True)
    return numbers, score[first]


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Pearson's; NaN for fewer than three points or where one of the two does not vary."""
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan")
    return float(np.corrcoef(x, y)[0, 1])


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's; NaN where `correlation` is."""
    return correlation(_ranks(x), _ranks(y))


def _ranks(values: np.ndarray) -> np.ndarray:
    """From 1; equal values share the mean of their ranks."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[place]
