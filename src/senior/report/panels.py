"""A grid of small drawings of one plane: a row per thing that is compared, with its name above it. Imports no JAX.

All of a figure is one pair of axes whose unit is an inch, and a panel is a rectangle on it. Axes of their own for each
panel would take most of a report's time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator, NullFormatter

from senior.report.looks import wrapped
from senior.report.plane import Plane

RED = "#e8000b"
"""Of the object, and of nothing else."""
UNVISITED = "#1d0b2e"
"""Where there is nothing."""
SIDE = 1.6
"""Inches of a panel's longer side."""
LEFT, RIGHT, BOTTOM, GAP = 0.62, 0.85, 0.44, 0.1
LINE = 0.17
"""Of a line of text, and"""
LETTER = 0.068
"""of a letter in it, all in inches."""
TICK = 0.03


@dataclass(frozen=True)
class Panel:
    """A rectangle that shows a plane."""

    axis: Axes
    """Of the whole figure."""
    plane: Plane
    corner: np.ndarray
    """``[2]``: its lower left, in inches."""
    scale: float
    """Inches of a unit of the plane."""

    def at(self, points: np.ndarray) -> np.ndarray:
        """Points of the plane ``[..., 2]`` as places of the figure."""
        return self.corner + (points - self.plane.low) * self.scale

    def frame(self, colour: str = "black", width: float = 0.8) -> None:
        """Draw its border."""
        sides = (self.plane.high - self.plane.low) * self.scale
        border = Rectangle((self.corner[0], self.corner[1]), *sides, fill=False, edgecolor=colour, linewidth=width)
        self.axis.add_patch(border).set_zorder(4)

    def line(self, points: np.ndarray, **how: Any) -> None:
        """Draw a line through points ``[n, 2]``, or their markers."""
        self.axis.plot(*self.at(points).T, **how)

    def title(self, text: str) -> None:
        """Write small above it."""
        top = self.at(np.array([self.plane.low[0] / 2 + self.plane.high[0] / 2, self.plane.high[1]]))
        self.axis.text(top[0], top[1] + 0.04, text, ha="center", va="bottom", fontsize=7, linespacing=1.1)

    def note(self, text: str) -> None:
        """Write small in its upper left corner."""
        place = self.at(np.array([self.plane.low[0], self.plane.high[1]]))
        self.axis.text(place[0] + 0.05, place[1] - 0.05, text, ha="left", va="top", fontsize=7, color="white")

    def picture(
        self, values: np.ndarray, edges: tuple[np.ndarray, np.ndarray], colours: Colormap, norm: Normalize
    ) -> None:
        """Fill it with cells ``[second, first]`` of the plane; those that are masked stay empty."""
        first, second = edges
        ends = self.at(np.array([[first[0], second[0]], [first[-1], second[-1]]]))
        extent = (ends[0, 0], ends[1, 0], ends[0, 1], ends[1, 1])
        how: dict[str, Any] = {"origin": "lower", "interpolation": "none", "aspect": "auto"}
        self.axis.imshow(values, cmap=colours, norm=norm, extent=extent, **how)

    def mark(self) -> None:
        """Mark the object, where its place is known: the median, and lines from its 10th to its 90th percentile."""
        if self.plane.object is not None:
            low, middle, high = self.plane.object
            self.line(np.array([[low[0], middle[1]], [high[0], middle[1]]]), color=RED, linewidth=1, zorder=5)
            self.line(np.array([[middle[0], low[1]], [middle[0], high[1]]]), color=RED, linewidth=1, zorder=5)
            self.dots(middle[None], 5, "white")

    def dots(self, points: np.ndarray, size: float, edge: str = RED) -> None:
        """Red dots at points ``[n, 2]``."""
        how: dict[str, Any] = {"color": RED, "markeredgecolor": edge, "zorder": 6}
        self.line(points, linestyle="", marker="o", markersize=size, **how)


@dataclass(frozen=True)
class Panels:
    """A figure of panels, by row and column."""

    figure: Figure
    rows: list[list[Panel]]

    def bar(self, first: int, last: int, colours: ScalarMappable, label: str) -> None:
        """A colour scale to the right of some rows, from the first to the last."""
        size = self.figure.get_size_inches()
        above, below = self.rows[first][-1], self.rows[last][-1]
        right, top = above.at(above.plane.high)
        place = (right + 0.1, below.corner[1], 0.1, top - below.corner[1])
        axis = self.figure.add_axes((place[0] / size[0], place[1] / size[1], place[2] / size[0], place[3] / size[1]))
        scale = self.figure.colorbar(colours, cax=axis, format="%g")
        scale.minorformatter = NullFormatter()
        scale.set_label(label, fontsize=8)
        scale.ax.tick_params(labelsize=8)


def panels(
    plane: Plane,
    heads: Sequence[str],
    titles: Sequence[str],
    side: float = SIDE,
    room: float = 0.0,
    right: float = RIGHT,
) -> Panels:
    """A figure with a row of panels per head and a column per title.

    heads: what stands above each row. titles: above each column of the first row. side: inches of a panel's longer
    side. room: inches above every panel for a title of its own. right: inches to the right of all, for scales.
    """
    width, height = side * min(1, 1 / plane.aspect), side * min(1, plane.aspect)
    across = len(titles) * (width + GAP) - GAP
    shown = [wrapped(head, max(20, int(across / LETTER))) for head in heads]
    above = [LINE * len(head.splitlines()) + 0.1 for head in shown]
    over = LINE * max(len(title.splitlines()) for title in titles) + 0.12
    total = LEFT + across + right, over + BOTTOM + sum(above) + len(heads) * (room + height + GAP) - GAP
    figure = Figure(figsize=total, dpi=150)
    axis = figure.add_axes((0, 0, 1, 1), xlim=(0, total[0]), ylim=(0, total[1]), autoscale_on=False)
    axis.axis("off")
    scale = width / float(plane.high[0] - plane.low[0])
    rows: list[list[Panel]] = []
    top = total[1] - over
    for head, space in zip(shown, above, strict=True):
        axis.text(LEFT, top - 0.02, head, va="top", ha="left", weight="bold", fontsize=9)
        top -= space + room + height
        left = [LEFT + column * (width + GAP) for column in range(len(titles))]
        rows.append([Panel(axis, plane, np.array([x, top]), scale) for x in left])
        _scale(rows[-1][0], 1)
        top -= GAP
    for panel, title in zip(rows[-1], titles, strict=True):
        _scale(panel, 0)
        axis.text(panel.corner[0] + width / 2, total[1] - 0.06, title, va="top", ha="center", fontsize=9)
    return Panels(figure, rows)


def _scale(panel: Panel, which: int) -> None:
    """Numbers and a name below a panel (0) or to the left of it (1)."""
    low, high = float(panel.plane.low[which]), float(panel.plane.high[which])
    values = [value for value in MaxNLocator(4).tick_values(low, high) if low <= value <= high]
    for value in values:
        point = panel.plane.low.copy()
        point[which] = value
        x, y = panel.at(point)
        end = (x, y - TICK) if which == 0 else (x - TICK, y)
        panel.axis.plot([x, end[0]], [y, end[1]], color="black", linewidth=0.8)
        how: dict[str, Any] = {"ha": "center", "va": "top"} if which == 0 else {"ha": "right", "va": "center"}
        shift = (0, -0.03) if which == 0 else (-0.03, 0)
        panel.axis.text(end[0] + shift[0], end[1] + shift[1], f"{value:g}", fontsize=8, **how)
    middle = panel.at((panel.plane.low + panel.plane.high) / 2)
    if which == 0:
        panel.axis.text(middle[0], 0.05, panel.plane.labels[0], ha="center", va="bottom", fontsize=9)
    else:
        how = {"ha": "left", "va": "center", "rotation": 90}
        panel.axis.text(0.08, middle[1], panel.plane.labels[1], fontsize=9, **how)


def colormap() -> Colormap:
    """From dark, where there is nothing, to yellow."""
    return matplotlib.colormaps["viridis"].with_extremes(bad=UNVISITED)
