"""Curves over many runs: against steps, labels, budgets and success rates. Imports no JAX.

Every figure is a `senior.report.page.Drawing` with the numbers that it shows. Arms are given by label with their runs,
all of one task. Points are evaluations. Where the runs of an arm were not all evaluated at the same steps, they are
read off straight lines between their evaluations, as far as all of them have come.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from senior.report.bands import Band, Curve, Frame, banded, grid, styled
from senior.report.cells import tells_success
from senior.report.looks import Look, in_order
from senior.report.looks import looks as looks_of
from senior.report.page import Drawing
from senior.report.records import Fingerprint, Run
from senior.report.statistics import Intervals, by_labels, interquartile_means, mean_and_deviation
from senior.report.tables import Cell

Runs = Mapping[str, Sequence[Run]]
"""Runs by the label of their arm."""
PAIRS = 50
"""Latest decided pairs over which prospective accuracy is taken."""
STEPS = "environment steps"

WITH_BUDGET = ("--budget", "--per-session")
"""Options that differ between the budgets of one line."""

_BUDGET = re.compile(r" --budget \d+")


def together(curves: Sequence[Curve]) -> Curve:
    """Curves of several runs at places that all have: places ``[points]``, values ``[runs, points]``."""
    first = curves[0][0]
    if all(np.array_equal(first, x) for x, _ in curves):
        return first, np.stack([y for _, y in curves])
    start, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    places = np.unique(np.concatenate([x for x, _ in curves]))
    places = places[(places >= start) & (places <= end)]
    return places, np.stack([np.interp(places, x, y) for x, y in curves])


def against_steps(run: Run) -> Curve:
    """Scores at the steps of the evaluations."""
    return run.evaluation.step, run.score


def against_labels(run: Run) -> Curve:
    """Scores against asked pairs."""
    return by_labels(run.evaluation.queried, run.score)


def prospective(run: Run) -> Curve | None:
    """Step of each session, and the share of the latest `PAIRS` decided pairs predicted rightly; None of no session.

    A prediction is made before the reward model is fitted to the pair. The first session is left out: nothing was
    learned before it.
    """
    if not run.foretold:
        return None
    step, right, decided = np.array(run.foretold, float).T
    total, total_right = np.concatenate([[0.0], decided.cumsum()]), np.concatenate([[0.0], right.cumsum()])
    first = np.searchsorted(total, total[1:] - PAIRS, side="right") - 1
    first = np.clip(first, 0, np.arange(len(decided)))
    return step, (total_right[1:] - total_right[first]) / (total[1:] - total[first])


@styled
def mean_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing:
    """Mean and standard deviation over seeds against steps, as in the paper; where runs are under way, they too."""
    curves = {label: together([against_steps(run) for run in runs]) for label, runs in arms.items()}
    thin = {
        label: [against_steps(run) for run in runs]
        for label, runs in arms.items()
        if not all(run.finished for run in runs)
    }
    figure = banded(_deviations(curves), looks, _over_steps(task, arms), thin)
    caption = f"{task}: mean over seeds; the shade is one standard deviation to each side."
    return Drawing(f"{task}-steps-mean", caption, figure, _mean_rows("step", task, curves))


@styled
def interquartile_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing:
    """Interquartile mean and its bootstrap interval against steps."""
    curves = {label: together([against_steps(run) for run in runs]) for label, runs in arms.items()}
    found = interquartile_means({label: [scores] for label, (_, scores) in curves.items()})
    bands = {label: Band(steps, *found[label]) for label, (steps, _) in curves.items()}
    rows: list[Sequence[Cell]] = [("task", "arm", "step", "runs", "interquartile_mean", "low", "high")]
    for label, (steps, scores) in curves.items():
        rows += [(task, label, int(x), len(scores), *point) for x, *point in zip(steps, *found[label], strict=True)]
    caption = f"{task}: interquartile mean over seeds; the shade is its 95 % bootstrap interval."
    return Drawing(f"{task}-steps-iqm", caption, banded(bands, looks, _over_steps(task, arms)), rows)


@styled
def label_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing | None:
    """Mean and standard deviation over seeds against asked pairs; None if no arm asks."""
    asking = {label: runs for label, runs in arms.items() if all(run.asks for run in runs)}
    curves = {label: together([against_labels(run) for run in runs]) for label, runs in asking.items()}
    curves = {label: found for label, found in curves.items() if len(found[0])}
    if not curves:
        return None
    most = float(max(asked[-1] for asked, _ in curves.values()))
    frame = Frame(task, "pairs asked, skipped ones too", measure(asking), most, tells_success(asking))
    caption = (
        f"{task}: against pairs asked, each number at the first evaluation that had so many; mean and standard "
        "deviation over seeds."
    )
    return Drawing(
        f"{task}-labels", caption, banded(_deviations(curves), looks, frame), _mean_rows("asked", task, curves)
    )


@styled
def budget_curves(task: str, arms: Runs) -> Drawing | None:
    """Scores at the end against the budget, for methods that were run with several; None if there are none."""
    found: dict[tuple[str, Fingerprint], dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for runs in arms.values():
        for run in runs:
            if run.config is not None and run.asks and run.finished:
                rest = tuple(entry for entry in run.arm.fingerprint if entry[0] not in WITH_BUDGET)
                found[_BUDGET.sub("", run.arm.name), rest][run.config.queries.budget].append(float(run.score[-1]))
    lines: dict[str, dict[int, list[float]]] = {}
    seen: Counter[str] = Counter()
    for (name, _), by_budget in found.items():
        if len(by_budget) > 1:
            seen[name] += 1
            lines[name if seen[name] == 1 else f"{name} [{seen[name]}]"] = by_budget
    several = {label: lines[label] for label in in_order(lines)}
    if not several:
        return None
    rows: list[Sequence[Cell]] = [("task", "arm", "budget", "runs", "mean", "deviation")]
    bands = {}
    for label, by_budget in several.items():
        budgets = sorted(by_budget)
        told = [mean_and_deviation(by_budget[budget]) for budget in budgets]
        rows += [(task, label, at, len(by_budget[at]), *one) for at, one in zip(budgets, told, strict=True)]
        mean, deviation = np.array(told).T
        bands[label] = Band(np.array(budgets), mean, mean - deviation, mean + deviation)
    most = max(band.x[-1] for band in bands.values())
    frame = Frame(task, "budget", f"{measure(arms)} at the end", 1.02 * most, tells_success(arms))
    caption = (
        f"{task}: at the end of runs with several budgets; mean and standard deviation over seeds. Arms of one name "
        "that differ in more than the budget are lines of their own, with a number."
    )
    return Drawing(f"{task}-budgets", caption, banded(bands, looks_of(several), frame), rows)


@styled
def every_run(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing:
    """A panel for each arm with each of its runs, and their mean."""
    figure, panels = grid({label: f"{label} ({len(runs)})" for label, runs in arms.items()}, _over_steps(task, arms))
    rows: list[Sequence[Cell]] = [("task", "arm", "seed", "step", "score")]
    for label, runs in arms.items():
        axis, colour = panels[label], looks[label].colour
        for run in runs:
            axis.plot(*against_steps(run), color=colour, linewidth=0.8, alpha=0.6)
            rows += [(task, label, run.seed, int(step), score) for step, score in zip(*against_steps(run), strict=True)]
        steps, scores = together([against_steps(run) for run in runs])
        axis.plot(steps, scores.mean(axis=0), color=colour, linewidth=2.2)
    caption = f"{task}: every run, and the mean of each arm's (thick). In brackets, how many there are."
    return Drawing(f"{task}-every-run", caption, figure, rows)


@styled
def accuracy_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing | None:
    """Prospective accuracy of the reward model over steps; None if nothing is told of it."""
    told = {label: [found for run in runs if (found := prospective(run))] for label, runs in arms.items()}
    curves = {label: together(own) for label, own in told.items() if own}
    curves = {label: found for label, found in curves.items() if len(found[0])}
    if not curves:
        return None
    frame = Frame(task, STEPS, "prospective accuracy", 1.02 * max(steps[-1] for steps, _ in curves.values()), level=0.5)
    caption = (
        f"{task}: share of pairs that the reward model judged rightly before it was fitted to them, over the latest "
        f"sessions that have {PAIRS} decided ones together, or all there are; mean and standard deviation over seeds. "
        "Dotted: chance."
    )
    return Drawing(
        f"{task}-accuracy", caption, banded(_deviations(curves), looks, frame), _mean_rows("step", task, curves)
    )


@styled
def curves_over_tasks(
    tasks: Sequence[str], steps: np.ndarray, found: Mapping[str, Intervals], looks: Mapping[str, Look]
) -> Drawing:
    """Interquartile mean over the runs of several tasks against steps."""
    rows: list[Sequence[Cell]] = [("arm", "step", "interquartile_mean", "low", "high")]
    for label, intervals in found.items():
        rows += [(label, int(x), *point) for x, *point in zip(steps, *intervals, strict=True)]
    frame = Frame(f"{len(tasks)} tasks", STEPS, "success rate", float(steps[-1]))
    caption = "Interquartile mean over all runs of all these tasks, and its 95 % bootstrap interval."
    return Drawing(f"{len(tasks)}-tasks-steps-iqm", caption, _intervals(steps, found, looks, frame), rows)


@styled
def profile_curves(
    name: str, thresholds: np.ndarray, found: Mapping[str, Intervals], looks: Mapping[str, Look]
) -> Drawing:
    """Performance profiles: the share of runs that end above each success rate."""
    rows: list[Sequence[Cell]] = [("arm", "threshold", "share", "low", "high")]
    for label, intervals in found.items():
        rows += [(label, float(x), *point) for x, *point in zip(thresholds, *intervals, strict=True)]
    frame = Frame("", "success rate at the end, t", "share of runs above t", 1.0)
    caption = "Performance profiles: the share of runs that end above a success rate, all tasks weighing the same."
    return Drawing(name, caption, _intervals(thresholds, found, looks, frame), rows)


def measure(arms: Runs) -> str:
    """What the runs of a task are judged by."""
    return "success rate" if tells_success(arms) else "true return"


def _over_steps(task: str, arms: Runs) -> Frame:
    last = max(run.steps for runs in arms.values() for run in runs)
    return Frame(task, STEPS, measure(arms), last, tells_success(arms))


def _deviations(curves: Mapping[str, Curve]) -> dict[str, Band]:
    """Mean and a standard deviation to each side of curves ``[runs, points]``; of one run, no band."""
    bands = {}
    for label, (x, scores) in curves.items():
        mean, deviation = _moments(scores)
        bands[label] = Band(x, mean, mean - deviation, mean + deviation)
    return bands


def _moments(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sample standard deviation over runs, each ``[points]``."""
    unknown = np.full(scores.shape[1], np.nan)
    return scores.mean(axis=0), scores.std(axis=0, ddof=1) if len(scores) > 1 else unknown


def _mean_rows(place: str, task: str, curves: Mapping[str, Curve]) -> list[Sequence[Cell]]:
    rows: list[Sequence[Cell]] = [("task", "arm", place, "runs", "mean", "deviation")]
    for label, (x, scores) in curves.items():
        rows += [(task, label, int(at), len(scores), *point) for at, *point in zip(x, *_moments(scores), strict=True)]
    return rows


def _intervals(x: np.ndarray, found: Mapping[str, Intervals], looks: Mapping[str, Look], frame: Frame) -> Figure:
    return banded({label: Band(x, *intervals) for label, intervals in found.items()}, looks, frame)
