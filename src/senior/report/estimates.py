"""Figures of estimates: intervals side by side, and which arm is better than which. Imports no JAX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from senior.report.bands import styled
from senior.report.looks import WIDTH, Look, wrapped
from senior.report.page import Drawing
from senior.report.statistics import Interval
from senior.report.tables import Cell


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


def _beside(labels: Sequence[str]) -> tuple[list[str], int]:
    """Labels as they stand beside an axis, and the lines of the tallest."""
    names = [wrapped(label, 32) for label in labels]
    return names, max(len(name.splitlines()) for name in names)
