"""How curves with bands are drawn: a few in one axis, more in a panel each. Imports no JAX."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import NamedTuple, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from senior.report.looks import STYLE, WIDTH, Look, canvas, legend, wrapped
from senior.report.plane import evenly

MOST = 4
"""Bands in one axis; where there are more, nobody can tell them apart."""
ACROSS = 4
"""Panels in a line, at most."""
FEW = 40
"""Points of a grey curve."""
GREY = "#8a8f96"

Curve = tuple[np.ndarray, np.ndarray]
"""Where ``[points]`` and what ``[points]``, or ``[runs, points]`` of several runs."""

P = ParamSpec("P")
R = TypeVar("R")


class Band(NamedTuple):
    """A curve and what is shaded around it, each ``[points]``; bounds are NaN where nothing is."""

    x: np.ndarray
    middle: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Frame:
    """What is around curves."""

    title: str
    x: str
    y: str
    end: float
    """Of the x axis, which begins at 0."""
    rate: bool = True
    """Values are in [0, 1]."""
    level: float | None = None
    """At which a dotted line is drawn."""

    def around(self, axis: Axes) -> None:
        """Limits and ticks."""
        axis.set_xlim(0, self.end)
        axis.xaxis.set_major_formatter(FuncFormatter(thousands))
        if self.rate:
            axis.set_ylim(-0.03, 1.03)
        if self.level is not None:
            axis.axhline(self.level, color=GREY, linewidth=1, linestyle=(0, (2, 3)))


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Draw in the report's style."""

    @wraps(draw)
    def within(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return within


def banded(
    bands: Mapping[str, Band],
    looks: Mapping[str, Look],
    frame: Frame,
    thin: Mapping[str, Sequence[Curve]] | None = None,
) -> Figure:
    """Curves by label; more than `MOST` have a panel each, with the others in grey (`FEW` points). ``thin``: runs."""
    lines = thin or {}
    if len(bands) > MOST:
        told = replace(frame, x=f"{frame.x} (grey: the other panels' curves)")
        figure, panels = grid({label: label for label in bands}, told)
        some = {label: evenly(range(len(band.x)), FEW) for label, band in bands.items()}
        grey = {label: (band.x[some[label]], band.middle[some[label]]) for label, band in bands.items()}
        for label, axis in panels.items():
            for other, (x, y) in grey.items():
                if other != label:
                    axis.plot(x, y, color=GREY, linewidth=0.7, alpha=0.5)
            _draw(axis, label, bands[label], looks[label], lines.get(label, ()))
        return figure
    figure, axis = canvas(list(bands))
    for label, band in bands.items():
        _draw(axis, label, band, looks[label], lines.get(label, ()))
    axis.set(title=frame.title, xlabel=frame.x, ylabel=frame.y)
    frame.around(axis)
    legend(figure, axis)
    return figure


def grid(titles: Mapping[str, str], frame: Frame) -> tuple[Figure, dict[str, Axes]]:
    """A panel for each label, under its title."""
    down = -(-len(titles) // ACROSS)
    across = -(-len(titles) // down)
    figure = Figure(figsize=(max(WIDTH, 2.2 * across + 0.4), 1.75 * down + 0.9), layout="constrained")
    axes = list(figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).flat)
    for axis in axes[len(titles) :]:
        axis.set_axis_off()
    for axis in axes[max(0, len(titles) - across) : len(titles)]:
        axis.tick_params(labelbottom=True)  # the lowest of its column
    panels = dict(zip(titles, axes, strict=False))
    for label, axis in panels.items():
        axis.set_title(wrapped(titles[label], 30), fontsize=8)
        axis.tick_params(labelsize=7)
        axis.locator_params(axis="x", nbins=4)
        frame.around(axis)
    figure.suptitle(frame.title, fontsize=10)
    figure.supxlabel(frame.x, fontsize=9)
    figure.supylabel(frame.y, fontsize=9)
    return figure, panels


def thousands(value: float, place: int | None = None) -> str:
    """A step as the paper writes it: 500K."""
    if abs(value) < 1000:
        return f"{value:g}"
    return f"{value / 1000:g}K"


def _draw(axis: Axes, label: str, band: Band, look: Look, lines: Sequence[Curve]) -> None:
    every = max(1, len(band.x) // 8)
    [line] = axis.plot(band.x, band.middle, color=look.colour, linestyle=look.line, marker=look.marker, markevery=every)
    line.set_label(label if not label.startswith("_") else f" {label}")  # it would not be told
    if np.isfinite(band.low).any():
        axis.fill_between(band.x, band.low, band.high, color=look.colour, alpha=0.18, linewidth=0)
    for x, y in lines:
        axis.plot(x, y, color=look.colour, linewidth=0.7, alpha=0.5)
