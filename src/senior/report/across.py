"""Figures over many runs, each with the numbers that it shows. Imports no JAX.

Every figure is a `senior.report.page.Drawing`. Arms are given by label with their runs, all of one task. Points are
evaluations. Where the runs of an arm were not all evaluated at the same steps, they are read off straight lines between
their evaluations, as far as all of them have come.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from senior.report.looks import STYLE, WIDTH, Look, canvas, in_order, legend, wrapped
from senior.report.looks import looks as looks_of
from senior.report.page import Drawing
from senior.report.results import Run
from senior.report.statistics import Interval, Intervals, by_labels, interquartile_means, mean_and_deviation
from senior.report.tables import Cell

Runs = Mapping[str, Sequence[Run]]
"""Runs by the label of their arm."""
Curve = tuple[np.ndarray, np.ndarray]
"""Where ``[points]`` and what ``[points]``, or ``[runs, points]`` of several runs."""
PAIRS = 50
"""Latest asked pairs over which prospective accuracy is taken."""

_BUDGET = re.compile(r" --budget \d+")

P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Draw in the report's style."""

    @wraps(draw)
    def within(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return within


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
    """Step of each session and the share of right predictions among the latest `PAIRS` asked pairs; None of no session.

    A prediction is made before the reward model is fitted to the pair. The first session is left out: nothing was
    learned before it.
    """
    if run.episodes is None:
        return None
    told = run.episodes
    before = np.concatenate([[0.0], told.labels[:-1]])
    asked = np.diff(told.queried, prepend=0.0)
    session = (asked > 0) & (before > 0) & np.isfinite(told.reward_accuracy)
    if not session.any():
        return None
    pairs, right = asked[session], (asked * told.reward_accuracy)[session]
    total, total_right = np.concatenate([[0.0], pairs.cumsum()]), np.concatenate([[0.0], right.cumsum()])
    first = np.searchsorted(total, total[1:] - PAIRS, side="left")
    first = np.minimum(first, np.arange(len(pairs)))
    return told.step[session], (total_right[1:] - total_right[first]) / (total[1:] - total[first])


@styled
def mean_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing:
    """Mean and standard deviation over seeds against steps, as in the paper; where runs are under way, they too."""
    figure, axis = canvas(list(arms))
    rows: list[Sequence[Cell]] = [("task", "arm", "step", "runs", "mean", "deviation")]
    for label, runs in arms.items():
        steps, scores = together([against_steps(run) for run in runs])
        rows += _mean_band(axis, task, label, looks[label], steps, scores, len(arms))
        for run in runs if not all(run.finished for run in runs) else ():
            axis.plot(*against_steps(run), color=looks[label].colour, linewidth=0.7, alpha=0.5)
    _steps(axis, task, arms)
    legend(figure, axis)
    caption = f"{task}: mean over seeds; the shade is one standard deviation to each side."
    return Drawing(f"{task}-steps-mean", caption, figure, rows)


@styled
def interquartile_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing:
    """Interquartile mean and its bootstrap interval against steps."""
    figure, axis = canvas(list(arms))
    curves = {label: together([against_steps(run) for run in runs]) for label, runs in arms.items()}
    found = interquartile_means({label: [scores] for label, (_, scores) in curves.items()})
    rows: list[Sequence[Cell]] = [("task", "arm", "step", "runs", "interquartile_mean", "low", "high")]
    for label, (steps, scores) in curves.items():
        _interval_band(axis, label, looks[label], steps, found[label], len(arms))
        rows += [(task, label, int(x), len(scores), *point) for x, *point in zip(steps, *found[label], strict=True)]
    _steps(axis, task, arms)
    legend(figure, axis)
    caption = f"{task}: interquartile mean over seeds; the shade is its 95 % bootstrap interval."
    return Drawing(f"{task}-steps-iqm", caption, figure, rows)


@styled
def label_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing | None:
    """Mean and standard deviation over seeds against asked pairs; None if no arm asks."""
    asking = {label: runs for label, runs in arms.items() if all(run.asks for run in runs)}
    if not asking:
        return None
    figure, axis = canvas(list(asking))
    rows: list[Sequence[Cell]] = [("task", "arm", "asked", "runs", "mean", "deviation")]
    for label, runs in asking.items():
        asked, scores = together([against_labels(run) for run in runs])
        if len(asked):
            rows += _mean_band(axis, task, label, looks[label], asked, scores, len(asking))
    axis.set(title=task, xlabel="pairs asked, skipped ones too", ylabel=measure(asking))
    axis.set_xlim(left=0)
    _scale(axis, asking)
    legend(figure, axis)
    caption = (
        f"{task}: against pairs asked, each number at the first evaluation that had so many; mean and standard "
        "deviation over seeds."
    )
    return Drawing(f"{task}-labels", caption, figure, rows)


@styled
def budget_curves(task: str, arms: Runs) -> Drawing | None:
    """Scores at the end against the budget, for methods that were run with several; None if there are none."""
    found: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for label, runs in arms.items():
        for run in runs:
            if run.config is not None and run.asks and run.finished:
                found[_BUDGET.sub("", label)][run.config.queries.budget].append(float(run.score[-1]))
    several = {label: found[label] for label in in_order(found) if len(found[label]) > 1}
    if not several:
        return None
    look = looks_of(several)
    figure, axis = canvas(list(several))
    rows: list[Sequence[Cell]] = [("task", "arm", "budget", "runs", "mean", "deviation")]
    for label, by_budget in several.items():
        budgets = sorted(by_budget)
        told = [mean_and_deviation(by_budget[budget]) for budget in budgets]
        rows += [(task, label, at, len(by_budget[at]), *one) for at, one in zip(budgets, told, strict=True)]
        mean, deviation = np.array(told).T
        _curve(axis, label, look[label], np.array(budgets), mean)
        axis.errorbar(budgets, mean, deviation, fmt="none", ecolor=look[label].colour, elinewidth=0.8, capsize=2)
    axis.set(title=task, xlabel="budget", ylabel=f"{measure(arms)} at the end", xlim=(0, None))
    _scale(axis, arms)
    legend(figure, axis)
    caption = f"{task}: at the end of runs with several budgets; mean and standard deviation over seeds."
    return Drawing(f"{task}-budgets", caption, figure, rows)


@styled
def every_run(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing:
    """A panel for each arm with each of its runs, and their mean."""
    across = min(4, len(arms))
    down = -(-len(arms) // across)
    figure = Figure(figsize=(max(WIDTH, 2.2 * across + 0.4), 1.75 * down + 0.7), layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    rows: list[Sequence[Cell]] = [("task", "arm", "seed", "step", "score")]
    for axis, (label, runs) in zip(panels.flat, arms.items(), strict=False):
        for run in runs:
            axis.plot(*against_steps(run), color=looks[label].colour, linewidth=0.8, alpha=0.6)
            rows += [(task, label, run.seed, int(step), score) for step, score in zip(*against_steps(run), strict=True)]
        steps, scores = together([against_steps(run) for run in runs])
        axis.plot(steps, scores.mean(axis=0), color=looks[label].colour, linewidth=2.2)
        axis.set_title(wrapped(f"{label} ({len(runs)})", 30), fontsize=8)
        axis.tick_params(labelsize=7)
        axis.xaxis.set_major_formatter(FuncFormatter(thousands))
        axis.locator_params(axis="x", nbins=4)
        _scale(axis, arms)
    for axis in panels.flat[len(arms) :]:
        axis.set_axis_off()
    for axis in panels.flat[max(0, len(arms) - across) : len(arms)]:
        axis.tick_params(labelbottom=True)  # the lowest of its column
    figure.supxlabel("environment steps", fontsize=9)
    figure.supylabel(measure(arms), fontsize=9)
    caption = f"{task}: every run, and the mean of each arm's (thick). In brackets, how many there are."
    return Drawing(f"{task}-every-run", caption, figure, rows)


@styled
def accuracy_curves(task: str, arms: Runs, looks: Mapping[str, Look]) -> Drawing | None:
    """Prospective accuracy of the reward model over steps; None if nothing is told of it."""
    curves = {label: [curve for run in runs if (curve := prospective(run))] for label, runs in arms.items()}
    curves = {label: own for label, own in curves.items() if own}
    if not curves:
        return None
    figure, axis = canvas(list(curves))
    rows: list[Sequence[Cell]] = [("task", "arm", "step", "runs", "mean", "deviation")]
    for label, own in curves.items():
        steps, accuracy = together(own)
        if len(steps):
            rows += _mean_band(axis, task, label, looks[label], steps, accuracy, len(curves))
    axis.axhline(0.5, color="#8a8f96", linewidth=1, linestyle=(0, (2, 3)))
    axis.set(title=task, xlabel="environment steps", ylabel="prospective accuracy", ylim=(-0.03, 1.03))
    axis.xaxis.set_major_formatter(FuncFormatter(thousands))
    legend(figure, axis)
    caption = (
        f"{task}: share of the latest {PAIRS} asked pairs that the reward model judged rightly before it was fitted to "
        "them; mean and standard deviation over seeds. Dotted: chance."
    )
    return Drawing(f"{task}-accuracy", caption, figure, rows)


@styled
def curves_over_tasks(
    tasks: Sequence[str], steps: np.ndarray, found: Mapping[str, Intervals], looks: Mapping[str, Look]
) -> Drawing:
    """Interquartile mean over the runs of several tasks against steps."""
    figure, axis = canvas(list(found))
    rows: list[Sequence[Cell]] = [("arm", "step", "interquartile_mean", "low", "high")]
    for label, intervals in found.items():
        _interval_band(axis, label, looks[label], steps, intervals, len(found))
        rows += [(label, int(x), *point) for x, *point in zip(steps, *intervals, strict=True)]
    axis.set(title=f"{len(tasks)} tasks", xlabel="environment steps", ylabel="success rate", ylim=(-0.03, 1.03))
    axis.xaxis.set_major_formatter(FuncFormatter(thousands))
    legend(figure, axis)
    caption = "Interquartile mean over all runs of all these tasks, and its 95 % bootstrap interval."
    return Drawing(f"{len(tasks)}-tasks-steps-iqm", caption, figure, rows)


@styled
def aggregates(
    name: str,
    caption: str,
    found: Mapping[str, Mapping[str, Interval]],
    looks: Mapping[str, Look],
) -> Drawing:
    """Estimates and intervals side by side: per statistic a panel, per label a line."""
    labels = list(next(iter(found.values())))
    names, tallest = _beside(labels)
    figure = Figure(figsize=(WIDTH, max(1.6, max(0.24, 0.16 * tallest) * len(labels) + 0.9)), layout="constrained")
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    rows: list[Sequence[Cell]] = [("statistic", "arm", "estimate", "low", "high")]
    for axis, (statistic, by_label) in zip(panels, found.items(), strict=True):
        for place, label in enumerate(labels):
            mean, low, high = by_label[label]
            bar = {"color": looks[label].colour, "linewidth": 5, "alpha": 0.35, "solid_capstyle": "butt"}
            axis.plot([low, high], [place, place], **bar)
            axis.plot([mean], [place], color=looks[label].colour, marker=looks[label].marker, markersize=6)
            rows.append((statistic, label, mean, low, high))
        axis.set(title=statistic, xlim=(-0.03, 1.03), xlabel="success rate")
        axis.set_yticks(range(len(labels)), names, parse_math=False)
        axis.set_ylim(len(labels) - 0.5, -0.5)
        axis.grid(axis="y", visible=False)
    return Drawing(name, caption, figure, rows)


@styled
def improvements(name: str, where: str, found: Mapping[tuple[str, str], Interval], labels: Sequence[str]) -> Drawing:
    """Probability of improvement of every label (rows) over every other (columns, by the rows' numbers)."""
    n = len(labels)
    names, tallest = _beside([f"{number}: {label}" for number, label in enumerate(labels, 1)])
    height = max(0.34, 0.15 * tallest) * n + 0.5
    figure = Figure(figsize=(min(max(WIDTH, 0.5 * n + 2), 11), max(1.6, height)), layout="constrained")
    axis = figure.subplots()
    values = np.full((n, n), np.nan)
    rows: list[Sequence[Cell]] = [("better", "worse", "probability", "low", "high")]
    for (one, other), interval in found.items():
        values[labels.index(one), labels.index(other)] = interval.mean
        rows.append((one, other, *interval))
    axis.imshow(values, cmap="PuOr", vmin=-0.3, vmax=1.3, aspect="auto")  # without the darkest, for what is on it
    size = 8 if n <= 10 else 6
    for (one, other), (mean, low, high) in found.items():
        sure = low > 0.5 or high < 0.5
        axis.text(
            labels.index(other),
            labels.index(one),
            f"{mean:.2f}" + ("*" if sure else ""),
            ha="center",
            va="center",
            fontsize=size,
            fontweight="bold" if sure else "normal",
            color="#111111",
        )
    axis.set_xticks(range(n), [str(number) for number in range(1, n + 1)])
    axis.xaxis.tick_top()
    axis.set_yticks(range(n), names, parse_math=False)
    axis.grid(visible=False)
    caption = (
        f"{where}: probability that a run of the row's method ends above one of the column's, which bears the number "
        "of its row. Bold with a star: the 95 % interval leaves a half out."
    )
    return Drawing(name, caption, figure, rows)


@styled
def profile_curves(
    name: str, thresholds: np.ndarray, found: Mapping[str, Intervals], looks: Mapping[str, Look]
) -> Drawing:
    """Performance profiles: the share of runs that end above each success rate."""
    figure, axis = canvas(list(found))
    rows: list[Sequence[Cell]] = [("arm", "threshold", "share", "low", "high")]
    for label, intervals in found.items():
        _interval_band(axis, label, looks[label], thresholds, intervals, len(found))
        rows += [(label, float(x), *point) for x, *point in zip(thresholds, *intervals, strict=True)]
    axis.set(xlabel="success rate at the end, t", ylabel="share of runs above t", ylim=(-0.03, 1.03), xlim=(0, 1.0))
    legend(figure, axis)
    caption = "Performance profiles: the share of runs that end above a success rate, all tasks weighing the same."
    return Drawing(name, caption, figure, rows)


def _beside(labels: Sequence[str]) -> tuple[list[str], int]:
    """Labels as they stand beside an axis, and the lines of the tallest."""
    names = [wrapped(label, 32) for label in labels]
    return names, max(len(name.splitlines()) for name in names)


def measure(arms: Runs) -> str:
    """What the runs of a task are judged by."""
    told = any(run.evaluation.success is not None for runs in arms.values() for run in runs)
    return "success rate" if told else "true return"


def thousands(value: float, place: int | None = None) -> str:
    """A step as the paper writes it: 500K."""
    if abs(value) < 1000:
        return f"{value:g}"
    return f"{value / 1000:g}K"


def _mean_band(
    axis: Axes, task: str, label: str, look: Look, x: np.ndarray, scores: np.ndarray, bands: int
) -> list[Sequence[Cell]]:
    """Draw, and return as rows, mean and deviation of ``scores`` ``[runs, points]``; one of so many ``bands``."""
    mean = scores.mean(axis=0)
    deviation = scores.std(axis=0, ddof=1) if len(scores) > 1 else np.full(len(x), np.nan)
    _curve(axis, label, look, x, mean)
    if len(scores) > 1:
        _band(axis, look, x, mean - deviation, mean + deviation, bands)
    return [(task, label, int(at), len(scores), *point) for at, *point in zip(x, mean, deviation, strict=True)]


def _interval_band(axis: Axes, label: str, look: Look, x: np.ndarray, found: Intervals, bands: int) -> None:
    _curve(axis, label, look, x, found.mean)
    if np.isfinite(found.low).any():
        _band(axis, look, x, found.low, found.high, bands)


def _band(axis: Axes, look: Look, x: np.ndarray, low: np.ndarray, high: np.ndarray, bands: int) -> None:
    """The more there are, the fainter each."""
    axis.fill_between(x, low, high, color=look.colour, alpha=max(0.05, min(0.18, 0.6 / bands)), linewidth=0)


def _curve(axis: Axes, label: str, look: Look, x: np.ndarray, y: np.ndarray) -> None:
    every = max(1, len(x) // 8)
    # a label that begins with an underscore would not be told
    [line] = axis.plot(x, y, color=look.colour, linestyle=look.line, marker=look.marker, markevery=every)
    line.set_label(label if not label.startswith("_") else f" {label}")


def _steps(axis: Axes, task: str, arms: Runs) -> None:
    axis.set(title=task, xlabel="environment steps", ylabel=measure(arms))
    axis.set_xlim(0, max(run.steps for runs in arms.values() for run in runs))
    axis.xaxis.set_major_formatter(FuncFormatter(thousands))
    _scale(axis, arms)


def _scale(axis: Axes, arms: Runs) -> None:
    if measure(arms) == "success rate":
        axis.set_ylim(-0.03, 1.03)
