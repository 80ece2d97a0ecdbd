"""What a number or a sentence of the paper looks like beside ours: rules that were fixed before anything ran.

A number is *reproduced* if the 90 % interval of our mean lies within 10 points of it, *not reproduced* if it lies
wholly outside of that, and *undecided* otherwise; then the number of seeds is told that would decide if mean and spread
stay as they are. A sentence is a set of comparisons, each an interval of a difference, 90 % too: it is *confirmed* if
all lie above their margins, *refuted* if one lies wholly below, *undecided* otherwise. The intervals are those of
`senior.report.statistics.contrast`. Comparisons are not corrected for their number: of twenty true ones, one is missed
by chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from senior.report.records import Run
from senior.report.statistics import Group, Interval, contrast, mean_over
from senior.reproduce.studies import Claim, Comparison, Quantity, When

TOLERANCE = 0.1
"""How far from the paper's figure a mean may be."""
CONFIDENCE = 0.9
MOST_SEEDS = 1000
"""Up to how many it is told how many would decide."""

Decided = Literal["yes", "no", "open", "missing"]
Runs = Mapping[tuple[str, str], Sequence[Run]]
"""Finished runs by arm and task."""


class Verdict(NamedTuple):
    """A number of the paper beside ours."""

    paper: float
    ours: Interval | None
    """None: no run of it is finished."""
    seeds: int
    verdict: Literal["reproduced", "not reproduced", "undecided", "missing"]
    needed: int | None
    """Seeds that would decide, if it is undecided and `MOST_SEEDS` are enough."""
    hours: float | None
    """Of wall time that all of its runs took; None: not told by one."""


class Judged(NamedTuple):
    """A sentence of the paper, judged."""

    claim: Claim
    verdict: Literal["confirmed", "refuted", "undecided", "missing"]
    holding: int
    failing: int
    open: int
    missing: int
    differences: tuple[tuple[Comparison, Interval | None], ...]
    """Each comparison, and the interval of how much higher the higher quantity is."""


def judge_number(paper: float, runs: Runs, arm: str, tasks: Sequence[str], when: When) -> Verdict:
    """The paper's success rate of an arm, in [0, 1], beside ours; with several tasks, of their average."""
    groups = _groups(Quantity(arm, tuple(tasks), when), runs, 1.0)
    if groups is None:
        return Verdict(paper, None, 0, "missing", None, None)
    seeds = min(len(group.rates) for group in groups)
    ours = contrast(groups, CONFIDENCE)
    decided = _decide(ours, paper)
    needed = _seeds_that_decide(groups, paper) if decided == "undecided" else None
    seconds = [run.seconds for task in tasks for run in runs[arm, task]]
    hours = None if None in seconds else sum(second or 0.0 for second in seconds) / 3600
    return Verdict(paper, ours, seeds, decided, needed, hours)


def _decide(ours: Interval, paper: float) -> Literal["reproduced", "not reproduced", "undecided"]:
    slack = 1e-9
    if paper - TOLERANCE - slack <= ours.low and ours.high <= paper + TOLERANCE + slack:
        return "reproduced"
    if ours.high < paper - TOLERANCE or ours.low > paper + TOLERANCE:
        return "not reproduced"
    return "undecided"


def _seeds_that_decide(groups: Sequence[Group], paper: float) -> int | None:
    """The least number of seeds per task that would decide if mean and spread stayed as they are."""
    if min(len(group.rates) for group in groups) < 2:
        return None

    there = max(len(group.rates) for group in groups)
    return next(
        (n for n in range(there + 1, MOST_SEEDS + 1) if _decide(contrast(groups, CONFIDENCE, n), paper) != "undecided"),
        None,
    )


def judge_claim(claim: Claim, runs: Runs) -> Judged:
    """Whether a sentence of the paper holds in our runs."""
    found = [(comparison, _difference(comparison, runs)) for comparison in claim.comparisons]
    decided = [_holds(comparison, interval) for comparison, interval in found]
    holding, failing, left, missing = (decided.count(kind) for kind in ("yes", "no", "open", "missing"))
    if failing:
        verdict = "refuted"
    elif missing == len(decided):
        verdict = "missing"
    else:
        verdict = "undecided" if left or missing else "confirmed"
    return Judged(claim, verdict, holding, failing, left, missing, tuple(found))


def _holds(comparison: Comparison, interval: Interval | None) -> Decided:
    if interval is None:
        return "missing"
    if interval.low > comparison.margin:
        return "yes"
    return "no" if interval.high < comparison.margin else "open"


def _difference(comparison: Comparison, runs: Runs) -> Interval | None:
    """How much higher the higher quantity is; None if a run of either is missing."""
    higher = _groups(comparison.higher, runs, 1.0)
    if not isinstance(comparison.lower, Quantity):
        if higher is None:
            return None
        found = contrast(higher, CONFIDENCE)
        return Interval(*(bound - comparison.lower for bound in found))
    lower = _groups(comparison.lower, runs, -1.0)
    return None if higher is None or lower is None else contrast([*higher, *lower], CONFIDENCE)


def _groups(quantity: Quantity, runs: Runs, weight: float) -> list[Group] | None:
    """A quantity's rates, a group per task; None if there are none of some task."""
    groups = []
    for task in quantity.tasks:
        own = [run for run in runs.get((quantity.arm, task), ()) if run.evaluation.success is not None]
        if not own:
            return None
        episodes = int(own[0].evaluation.episodes[-1])
        if quantity.when == "curve":
            episodes *= len(own[0].evaluation.step)
        groups.append(Group([score(run, quantity.when) for run in own], episodes, weight / len(quantity.tasks)))
    return groups


def score(run: Run, when: When) -> float:
    """A run's success rate after half of its steps or at its end, or the mean below its curve; in [0, 1]."""
    if when == "curve":
        return mean_over(run.evaluation.step, run.score)
    return run.score_at(run.steps // 2 if when == "half" else run.steps)
