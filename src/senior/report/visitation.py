"""Where the end-effector was over training, method beside method, as in the paper's exploration figure.

Every snapshot of a run holds 2,000 positions of the steps since the one before. Here those of an arm's seeds are
pooled and counted in square cells of a plane; a panel is an arm at a step. What PGE pays is drawn by
`senior.report.bonus`, in the same plane. Imports no JAX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm

from senior.report import bonus
from senior.report.looks import STYLE, Look, looks
from senior.report.page import Drawing, Section, Table
from senior.report.panels import colormap, panels
from senior.report.plane import Arms, Plane, evenly, firsts, plane_of, usable, visited
from senior.report.records import LeftOut, Run
from senior.report.sections import by_task
from senior.report.tables import Cell

COLUMNS = 5
"""Most steps that are shown."""
CELLS = 60
"""Along the longer side of the plane."""
TEXT = (
    "Where the end-effector was: the positions of a snapshot, of all seeds of an arm together. Yellow is where it "
    "was most often, black where it never was; the scale is logarithmic and the same in all panels of a task. The "
    "two coordinates that vary most over all runs of the task are shown."
)
TEXT_OBJECT = (
    "The red dot marks the task's object: its median place when the compared segments began. It lies elsewhere in "
    "every episode; the red lines reach from the 10th to the 90th percentile."
)


def section(runs: Sequence[Run]) -> Section | None:
    """State visitation of all tasks, and what exploration bonuses pay; None where no run has any of it."""
    left_out: list[LeftOut] = []
    visits: list[Drawing] = []
    maps: list[Drawing] = []
    sizes: list[tuple[Drawing, Table]] = []
    marked = False
    tasks = by_task(runs)
    look = looks(label for arms in tasks.values() for label in arms)
    for task, arms in tasks.items():
        plane = plane_of(arms, firsts(arms, left_out), left_out)
        if plane is not None:
            marked = marked or plane.object is not None
            visits += [drawing] if (drawing := visits_of(task, arms, plane, look, left_out)) else []
            maps += bonus.maps(task, arms, plane, left_out)
        sizes += [size] if (size := bonus.sizes(task, arms, look, left_out)) else []
    if not (visits or maps or sizes):
        return None
    told = ((TEXT, visits), (TEXT_OBJECT, marked and visits), (bonus.MAPS, maps), (bonus.SIZES, sizes))
    text = [paragraph for paragraph, shown in told if shown]
    text += [f"Left out: {entry.path}: {entry.reason}." for entry in left_out]
    figures = (*visits, *maps, *(drawing for drawing, _ in sizes))
    return Section("Where the robot went", tuple(text), tuple(table for _, table in sizes), figures)


def shares(positions: np.ndarray, plane: Plane, most: int = CELLS) -> np.ndarray:
    """Share of positions ``[n, d]`` that lie in each cell of the plane ``[second, first]``; together 1."""
    points, (first, second) = plane.of(positions), plane.edges(most)
    counts, _, _ = np.histogram2d(points[:, 1], points[:, 0], bins=(second, first))
    return counts / len(points)


def visits_of(task: str, arms: Arms, plane: Plane, look: Mapping[str, Look], left_out: list[LeftOut]) -> Drawing | None:
    """One row of panels per arm, one column per step; None if the arms share no step.

    A step can be shown if every arm that has snapshots has one of it; the seeds that have it are pooled.
    """

    def held_by(run: Run) -> dict[int, np.ndarray]:
        snapshots = usable(visited, run, left_out) or {}
        return {step: positions for step, positions in snapshots.items() if positions.shape[1] == plane.size}

    held = {label: [held_by(run) for run in runs] for label, runs in arms.items()}
    steps_of = {label: {step for snapshots in own for step in snapshots} for label, own in held.items()}
    steps_of = {label: steps for label, steps in steps_of.items() if steps}
    steps = evenly(sorted(set.intersection(*steps_of.values())), COLUMNS) if steps_of else []
    if not steps:
        return None
    counted: dict[str, list[np.ndarray]] = {}
    pooled: dict[str, list[int]] = {}
    for label in steps_of:
        snapshots = [[one[step] for one in held[label] if step in one] for step in steps]
        counted[label] = [shares(np.concatenate(one), plane) for one in snapshots]
        pooled[label] = [len(one) for one in snapshots]
    percent = LogNorm(*_range(counted))
    heads = [f"{label} ({_runs(max(pooled[label]))})" for label in counted]
    with matplotlib.rc_context(STYLE):
        drawn = panels(plane, heads, [f"step {step:,}" for step in steps])
        colours, edges = colormap(), plane.edges(CELLS)
        for (label, own), row in zip(counted.items(), drawn.rows, strict=True):
            for share, count, panel in zip(own, pooled[label], row, strict=True):
                panel.picture(np.ma.masked_equal(100 * share, 0), edges, colours, percent)
                panel.frame(look[label].colour, 1.5)
                panel.mark()
                if count < max(pooled[label]):
                    panel.note(_runs(count))
        drawn.bar(0, min(1, len(heads) - 1), ScalarMappable(percent, colours), "% of the positions in a cell")
    caption = f"{task}: where the end-effector was over training."
    return Drawing(f"{task}-visitation", caption, drawn.figure, _rows(task, steps, counted, pooled, plane))


def _range(counted: dict[str, list[np.ndarray]]) -> tuple[float, float]:
    """Least and largest share above 0 of all panels, in percent, not the same."""
    every = np.concatenate([share[share > 0] for own in counted.values() for share in own])
    return 100 * float(every.min()), max(100 * float(every.max()), 101 * float(every.min()))


def _runs(count: int) -> str:
    return f"{count} run{'s' if count > 1 else ''}"


def _rows(
    task: str, steps: list[int], counted: dict[str, list[np.ndarray]], pooled: dict[str, list[int]], plane: Plane
) -> list[Sequence[Cell]]:
    """A row per cell that was visited, named by its middle."""
    first, second = (edges[:-1] + np.diff(edges) / 2 for edges in plane.edges(CELLS))
    rows: list[Sequence[Cell]] = [("task", "arm", "step", "runs", *plane.labels, "share")]
    for label, own in counted.items():
        for step, count, share in zip(steps, pooled[label], own, strict=True):
            for j, i in np.argwhere(share):
                rows.append((task, label, step, count, float(first[i]), float(second[j]), float(share[j, i])))
    return rows
