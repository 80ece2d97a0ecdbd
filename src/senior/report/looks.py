"""How figures look: one colour for one method everywhere, told apart by the colour-blind too. Imports no JAX."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from senior.methods import METHODS

COLOURS = {
    "m-senior": "#d55e00",
    "p-senior": "#e69f00",
    "mrn": "#0072b2",
    "pebble": "#56b4e9",
    "rune": "#009e73",
    "m-rune": "#cc79a7",
    "qpa": "#8b72d6",
    "sac": "#8a8a8a",
}
"""By method, after Okabe and Ito (2008); all are seen on white and on black."""
MARKERS = ("o", "s", "^", "v", "D", "P", "X", "*")
LINES = ("-", "--", "-.", ":")
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#8a8f96",
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 3.5,
    "text.parse_math": False,  # a dollar sign is one
}
"""For `matplotlib.rc_context`, around all that draws."""
WIDTH = 5.0
"""Inches of a figure that stands beside another one."""
LETTERS = 66
"""Of a legend's text that fit into one line of it."""


class Look(NamedTuple):
    """Of an arm's curve."""

    colour: str
    line: str
    marker: str


def looks(labels: Iterable[str]) -> dict[str, Look]:
    """A look for every label, whatever the order they come in.

    A method's first label, which is the one without options where there is one, has the method's own colour; the
    others take colours of methods that are not there, and then all colours again with another line.
    """
    ordered = in_order(labels)
    names, colours = list(COLOURS), list(COLOURS.values())
    found: dict[str, Look] = {}
    for label in ordered:
        method = label.split(" ")[0]
        if method in COLOURS and not any(look.colour == COLOURS[method] for look in found.values()):
            found[label] = Look(COLOURS[method], LINES[0], MARKERS[names.index(method)])
    used = {look.colour for look in found.values()}
    free = [place for place in range(len(colours)) if colours[place] not in used]
    looks_left = [(place, 1) for place in free]
    looks_left += [(place, line) for line in (2, 3, 1) for place in range(len(colours))]
    for number, label in enumerate(label for label in ordered if label not in found):
        place, line = looks_left[number % len(looks_left)]
        found[label] = Look(colours[place], LINES[line], MARKERS[(place + line) % len(MARKERS)])
    return {label: found[label] for label in ordered}


def in_order(labels: Iterable[str]) -> list[str]:
    """Each label once: by method, SENIOR first, then by options."""
    methods = list(COLOURS) + [name for name in METHODS if name not in COLOURS]

    def place(label: str) -> tuple[int, int, str]:
        method = label.split(" ")[0]
        return methods.index(method) if method in methods else len(methods), len(label.split(" ")), label

    return sorted(set(labels), key=place)


def canvas(labels: Sequence[str], height: float = 3.0) -> tuple[Figure, Axes]:
    """A figure with room below its axes for a legend of those labels (`legend`)."""
    lines = sum(len(wrapped(label).splitlines()) for label in labels)
    figure = Figure(figsize=(WIDTH, height + 0.19 * -(-lines // _columns(labels)) + 0.1), layout="constrained")
    axis = figure.subplots()
    axis.tick_params(labelsize=8)  # ticks are made when they are drawn, in nobody's style
    return figure, axis


def legend(figure: Figure, axis: Axes) -> None:
    """Below the axes; labels that are too long for a line go on in the next."""
    handles, labels = axis.get_legend_handles_labels()
    if labels:
        figure.legend(
            handles,
            [wrapped(label) for label in labels],
            loc="outside lower center",
            ncols=_columns(labels),
            handlelength=2.6,
            columnspacing=1.4,
        )


def _columns(labels: Sequence[str]) -> int:
    longest = max((len(label) for label in labels), default=1)
    return max(1, min(4, LETTERS // (min(longest, LETTERS) + 7)))


def wrapped(label: str, letters: int = LETTERS) -> str:
    """In lines of so many letters at most."""
    return textwrap.fill(label, letters, subsequent_indent="  ", break_on_hyphens=False)
