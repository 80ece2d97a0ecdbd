"""What preference-guided exploration pays for, as maps, and how much exploration bonuses pay beside the reward.

The formulas are those of `senior.density` (Eq. 4) and `senior.explore.preference_guided` (Eq. 6 and 7), in NumPy: f_P
and f_E are Gaussian kernel densities of unit length^-d, and r_int is f_P / f_E scaled to [0, 1] over the curiosity
buffer. Imports no JAX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.ticker import LogFormatter

from senior.envs.metaworld import TASKS
from senior.files import Damaged, unpack
from senior.report.looks import STYLE, Look, canvas, legend
from senior.report.page import Drawing, Table
from senior.report.panels import colormap, panels
from senior.report.plane import Arms, Plane, evenly, usable
from senior.report.records import LeftOut, Run, Unusable, columns
from senior.report.tables import Cell

COLUMNS = 3
"""Most steps that are shown."""
SIDE = 2.5
"""Inches of a panel's longer side."""
CELLS = 44
"""Along the longer side of a map."""
DECADES = 4
"""Of densities, below the largest, that are told apart."""
POINTS = 60
"""Of a curve over training."""
LEAST = 1e-7
"""What is smaller is not shown."""
MAPS = (
    "What preference-guided exploration (PGE) pays for, in one run of each arm that uses it. f_P is the density "
    "of positions in preferred segments, f_E that of the positions in the curiosity buffer: where f_P / f_E is "
    "large, preferred segments went often and the robot seldom. That ratio, scaled to run from 0 to 1 over the "
    "buffer, is the intrinsic reward r_int; beta times it is the bonus. Maps are cuts through space where the "
    "other coordinates have the median of the buffer's. Only the buffer's own positions are paid, and they lie "
    "before and behind the cut: the last row shows them, with what they were given. Where f_E is near 0 nothing "
    "was visited and nothing paid, and the map of r_int is empty."
)
SIZES = (
    "The bonus beside the learned reward: the mean over a batch of what was added to the learned reward, and the "
    "size of an episode's mean learned reward per step."
)


def log_density(points: np.ndarray, samples: np.ndarray, bandwidth: float) -> np.ndarray:
    """log f_S(p) of points ``[n, d]`` with S the samples ``[m, d]`` -> ``[n]``; as `senior.density.log_density`."""
    size = points.shape[1]
    exponent = np.zeros((len(points), len(samples)))
    for i in range(size):
        exponent += np.subtract.outer(points[:, i], samples[:, i]) ** 2
    exponent *= -0.5 / bandwidth**2
    largest = exponent.max(axis=1)
    exponent -= largest[:, None]
    total = np.exp(exponent, out=exponent).sum(axis=1)  # at least one term is 1
    return largest + np.log(total) - math.log(len(samples)) - size * math.log(bandwidth * math.sqrt(2 * math.pi))


def intrinsic_reward(log_ratio: np.ndarray, own: np.ndarray) -> np.ndarray:
    """r_int by log(f_P / f_E) ``[n]`` on the scale of the curiosity buffer's own ``[E]``, cut to [0, 1] -> ``[n]``.

    Of the buffer itself it is `senior.explore.preference_guided.intrinsic_reward`. All zero if the ratio is the same
    all over the buffer.
    """
    low, high = float(np.exp(own.min() - own.max())), 1.0
    if low >= high:
        return np.zeros(len(log_ratio))
    ratio = np.exp(np.minimum(log_ratio - own.max(), 0))  # more than the buffer's largest is cut off
    return np.clip((ratio - low) / (high - low), 0, 1)


# Maps.


class Samples(NamedTuple):
    """What is behind the bonus at a step."""

    preferred: np.ndarray
    """``[n, d]``"""
    explored: np.ndarray
    """``[E, d]``: the curiosity buffer."""
    intrinsic: np.ndarray
    """``[E]``: as it was paid."""
    beta: float
    bandwidth: float
    """In the unit of positions."""


class Map(NamedTuple):
    """Densities and intrinsic reward on the cells of a plane, each ``[second, first]``."""

    preferred: np.ndarray
    explored: np.ndarray
    intrinsic: np.ndarray


def steps_of(run: Run) -> dict[int, Path]:
    """Files with the samples of a run by step."""
    found = {}
    for path in (run.path / "bonus").glob("step-*.npz"):
        number = path.stem.removeprefix("step-")
        if number.isdecimal():
            found[int(number)] = path
    return {step: path for step, path in sorted(found.items()) if step <= run.steps}


def samples(run: Run, path: Path) -> Samples:
    """Read one file. Raises `Unusable` with the reason."""
    try:
        held = unpack(path)
        preferred, explored, intrinsic = (np.asarray(held[name], float) for name in Samples._fields[:3])
        beta, scale = float(held["beta"]), held.get("length_scale")
    except (Damaged, OSError, KeyError, TypeError, ValueError) as error:
        raise Unusable(f"bonus/{path.name} cannot be used: {error}") from error
    shapes = preferred.ndim == explored.ndim == 2 and preferred.shape[1] == explored.shape[1]
    if not (shapes and len(preferred) and intrinsic.shape == explored.shape[:1] and len(explored)):
        raise Unusable(f"bonus/{path.name} is damaged: its arrays do not fit together")
    if run.config is None:
        raise Unusable("bonus/ cannot be drawn: the bandwidth is not known")
    if scale is None:
        scale = 1.0 if run.arm.task in TASKS else run.config.length_scale
    if scale is None:
        raise Unusable("bonus/ cannot be drawn: the length scale is not known")
    return Samples(preferred, explored, intrinsic, beta, run.config.pge.bandwidth * float(scale))


def map_of(held: Samples, plane: Plane, most: int = CELLS) -> Map:
    """The densities and r_int at the cells' middles; other coordinates are the medians of the explored positions."""
    first, second = (edges[:-1] + np.diff(edges) / 2 for edges in plane.edges(most))
    points = np.tile(np.median(held.explored, axis=0), (len(second), len(first), 1))
    points[..., plane.axes[0]] = first
    points[..., plane.axes[1]] = second[:, None]
    flat = points.reshape(-1, points.shape[-1])

    def densities(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        preferred, explored = (log_density(places, one, held.bandwidth) for one in (held.preferred, held.explored))
        return preferred, explored

    preferred, explored = densities(flat)
    of_buffer = densities(held.explored)
    intrinsic = intrinsic_reward(preferred - explored, of_buffer[0] - of_buffer[1])
    return Map(*(values.reshape(points.shape[:2]) for values in (np.exp(preferred), np.exp(explored), intrinsic)))


def maps(task: str, arms: Arms, plane: Plane, left_out: list[LeftOut]) -> list[Drawing]:
    """For each arm with PGE, its first run that kept samples: f_P, f_E and r_int at a few steps."""

    def chosen(run: Run) -> dict[int, Samples]:
        files = steps_of(run)
        held = {step: samples(run, files[step]) for step in evenly(list(files), COLUMNS)}
        return {step: one for step, one in held.items() if one.explored.shape[1] == plane.size}

    drawings = []
    for label, runs in arms.items():
        for run in runs:
            if held := usable(chosen, run, left_out):
                drawings.append(_draw(task, label, run, held, plane))
                break
    return drawings


def _draw(task: str, label: str, run: Run, held: dict[int, Samples], plane: Plane) -> Drawing:
    found = {step: map_of(one, plane) for step, one in held.items()}
    highest = max(float(max(one.preferred.max(), one.explored.max())) for one in found.values())
    lowest = highest / 10**DECADES
    density, paid = LogNorm(lowest, highest), Normalize(0, 1)
    others = [plane.coordinate(i) for i in range(plane.size) if i not in plane.axes]
    cut = f" (a cut at the buffer's median {' and '.join(others)})" if others else ""
    heads = [
        f"f_P: density of preferred positions{cut}",
        f"f_E: density of the curiosity buffer{cut}",
        f"r_int{cut}",
        "r_int as it was given to the buffer's positions",
    ]
    titles = [
        f"step {step:,}\nbeta {one.beta:.2g}, mean r_int {one.intrinsic.mean():.2g}" for step, one in held.items()
    ]
    edges, colours = plane.edges(CELLS), colormap()
    with matplotlib.rc_context(STYLE):
        drawn = panels(plane, heads, titles, SIDE)
        for column, (step, one) in enumerate(found.items()):
            above, below, paid_for, given = (row[column] for row in drawn.rows)
            above.picture(np.ma.masked_less(one.preferred, lowest), edges, colours, density)
            below.picture(np.ma.masked_less(one.explored, lowest), edges, colours, density)
            paid_for.picture(np.ma.masked_where(one.explored < lowest, one.intrinsic), edges, colours, paid)
            given.picture(np.ma.masked_all(one.intrinsic.shape), edges, colours, paid)
            points, value = plane.of(held[step].explored), held[step].intrinsic
            within = np.asarray(((points >= plane.low) & (points <= plane.high)).all(axis=1))
            order = [i for i in np.argsort(value) if within[i]]  # what was paid most lies on top
            how: dict[str, Any] = {"s": 3, "linewidths": 0, "rasterized": True}
            given.axis.scatter(*given.at(points[order]).T, c=value[order], cmap=colours, norm=paid, **how)
            for panel in (above, below, paid_for, given):
                panel.frame()
                panel.mark()
        unit = f"density (1 / m^{plane.size})" if plane.named else "density"
        drawn.bar(0, 1, ScalarMappable(density, colours), unit)
        drawn.bar(2, 3, ScalarMappable(paid, colours), "r_int")
    caption = f"{task}, {label}, seed {run.seed}: what preference-guided exploration pays for."
    rows: list[Sequence[Cell]] = [("task", "arm", "seed", "step", *plane.labels, "f_P", "f_E", "r_int")]
    first, second = (edge[:-1] + np.diff(edge) / 2 for edge in edges)
    for step, one in found.items():
        for (j, i), value in np.ndenumerate(one.intrinsic):
            densities = float(one.preferred[j, i]), float(one.explored[j, i])
            rows.append((task, label, run.seed, step, float(first[i]), float(second[j]), *densities, float(value)))
    return Drawing(f"{task}-{label}-bonus", caption, drawn.figure, rows)


# Sizes.


class Size(NamedTuple):
    """A bonus over training, per episode ``[n]``."""

    step: np.ndarray
    beta: np.ndarray
    bonus: np.ndarray
    """Mean over a batch of what is added to the learned reward."""
    learned: np.ndarray
    """Size of the episode's mean learned reward per step."""
    asking: np.ndarray
    """Whether it ended before the last session."""


def size_of(run: Run) -> Size:
    """The episodes at whose end a bonus was told, maybe none. Raises `Unusable`."""
    welcome = ("episode_length", "learned_return", "beta", "bonus_mean", "queried")
    told = columns(run.path / "train.csv", ("step",), welcome)
    learned = np.abs(told["learned_return"] / told["episode_length"])
    paid = np.isfinite(told["bonus_mean"]) & np.isfinite(told["beta"]) & np.isfinite(learned)
    paid &= told["step"] <= run.steps
    queried = told["queried"][paid]
    asking = queried < queried.max(initial=-math.inf)
    return Size(told["step"][paid], told["beta"][paid], told["bonus_mean"][paid], learned[paid], asking)


def sizes(task: str, arms: Arms, look: Mapping[str, Look], left_out: list[LeftOut]) -> tuple[Drawing, Table] | None:
    """The bonus and the learned reward over training, of all arms with a bonus; None where there is none."""
    found: dict[str, list[Size]] = {}
    for label, runs in arms.items():
        told = [run for run in runs if run.episodes is not None]  # of others the report says so already
        exploring = [run for run in told if run.config is None or run.config.method.explore != "none"]
        own = [size for run in exploring if (size := usable(size_of, run, left_out)) and len(size.step)]
        if own:
            found[label] = own
    if not found:
        return None
    edges = np.linspace(0, max(size.step[-1] for own in found.values() for size in own), POINTS + 1)
    middle = edges[:-1] + np.diff(edges) / 2
    rows: list[Sequence[Cell]] = [("task", "arm", "step", "runs", "bonus", "learned_reward")]
    with matplotlib.rc_context(STYLE):
        figure, axis = canvas([f"{label}: {what}" for label in found for what in ("learned reward", "bonus")])
        for label, own in found.items():
            paid, learned = _curve(own, "bonus", edges), _curve(own, "learned", edges)
            for curve, line, what in ((paid, "-", "bonus"), (learned, ":", "learned reward")):
                told = np.isfinite(curve)  # episodes may be longer than what lies between two points
                seen = np.ma.masked_less(curve[told], LEAST)
                how: dict[str, Any] = {"color": look[label].colour, "linestyle": line, "marker": ".", "markersize": 3}
                axis.plot(middle[told] / 1000, seen, label=f"{label}: {what}", **how)
            for step, *values in zip(middle, paid, learned, strict=True):
                if all(map(math.isfinite, values)):
                    rows.append((task, label, int(step), len(own), *map(float, values)))
        axis.set(yscale="log", xlabel="thousand environment steps", ylabel="reward per step", title=task)
        axis.yaxis.set_major_formatter(LogFormatter())  # the usual ones write formulas, which the style does not set
        axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.4)))
        legend(figure, axis)
    caption = f"{task}: exploration bonus and size of the learned reward, mean over seeds."
    head = (
        *("arm", "runs", "beta at first", "beta at last", "bonus", "learned reward", "bonus / learned reward"),
        "before the last session",
    )
    about = (
        f"{task}: size of exploration bonuses, mean over the rows of a batch, from the first use to the end and, in "
        "the last column, while there was something left to ask; mean over seeds."
    )
    table = Table(about, head, [_row(label, own) for label, own in found.items()], f"{task}-bonus-size")
    return Drawing(f"{task}-bonus-size", caption, figure, rows), table


def _curve(own: Sequence[Size], name: str, edges: np.ndarray) -> np.ndarray:
    """Mean over runs of their means between the edges ``[POINTS]``; NaN where no run has a value."""
    total, told = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    for size in own:
        place = np.minimum(np.searchsorted(edges, size.step, side="right") - 1, len(total) - 1)
        count = np.bincount(place, minlength=len(total))
        total += np.bincount(place, getattr(size, name), len(total)) / np.maximum(count, 1)
        told += count > 0
    return np.where(told > 0, total / np.maximum(told, 1), math.nan)


def _row(label: str, own: Sequence[Size]) -> Sequence[Cell]:
    first, last = (float(np.mean([size.beta[place] for size in own])) for place in (0, -1))
    paid, learned = _means([(size.bonus, size.learned) for size in own])
    early = _means([(size.bonus[size.asking], size.learned[size.asking]) for size in own if size.asking.any()])
    return label, len(own), first, last, paid, learned, _share(paid, learned), _share(*early)


def _means(told: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Of two columns the means over runs of those over their episodes; NaN of no run."""
    if not told:
        return math.nan, math.nan
    first, second = np.mean([[column.mean() for column in columns] for columns in told], axis=0)
    return float(first), float(second)


def _share(part: float, whole: float) -> float:
    return part / whole if whole else math.nan
