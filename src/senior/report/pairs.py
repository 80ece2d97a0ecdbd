"""What was asked: pairs of segments as small drawings of both paths, and what the chosen pairs of a method are like.

The drawings are of pairs chosen by their place in the run, not by their looks. Imports no JAX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np

from senior.report.asked import Asked, asked
from senior.report.looks import STYLE, Look, looks
from senior.report.page import Drawing, Section, Table
from senior.report.panels import Panel, panels
from senior.report.plane import Plane, evenly, plane_of, usable
from senior.report.records import LeftOut, Run
from senior.report.sections import by_task
from senior.report.tables import Cell

SEEDS = 3
"""Most runs of an arm whose pairs are read for the table."""
SESSIONS, OF_SESSION = 3, 2
"""How many sessions are drawn, and how many pairs of each."""
SIDE = 1.75
"""Inches of a drawing's longer side."""
OTHER = "#8a8f96"
STILL = 1e-9
"""A shorter displacement has no direction."""
TEXT = (
    "Pairs that one run of each arm asked about, the one with the lowest seed: the first and the last pair of an "
    "early, a middle and the last session. The first session is passed over where there are others, because in "
    "every method its pairs are drawn at random. A dot is where a segment begins, an arrow where it ends. The "
    "preferred one is thick and in the arm's colour, the other thin and grey; both are coloured where they were "
    "called equal, both grey where nobody could tell. Red dots are where the object was when each of the two "
    "began. Above a pair stands what selection knew of it: m is the motion score, d the cosine between the two "
    "directions (-1: opposite); other methods have scores of their own, or none."
)
TEXT_TABLE = (
    "What the chosen pairs are like, over all pairs but those of the first session. Length is that of the "
    "end-effector's path in a segment. The angle is that between the two displacements, from the beginning of a "
    "segment to its end; it is 90 degrees on average where the two have nothing to do with each other. The "
    "difference is that of the two true returns, without its sign: the smaller it is, the harder the question. Of "
    "pre-training is the share of the segments that are of its episodes, by a policy that knew no reward."
)
HEAD = (
    *("arm", "runs", "pairs", "path length", "angle (degrees)", "difference of returns", "of pre-training"),
    *("equal", "skipped"),
)


def section(runs: Sequence[Run]) -> Section | None:
    """Drawings and a table of asked pairs per task; None where nothing was asked, or no file is there."""
    left_out: list[LeftOut] = []
    drawings: list[Drawing] = []
    tables: list[Table] = []
    tasks = by_task(runs)
    look = looks(label for arms in tasks.values() for label in arms)
    for task, arms in tasks.items():
        told = {label: read for label, own in arms.items() if (read := _read(own, left_out))}
        if not told:
            continue
        plane = plane_of(arms, [next(iter(read.values())) for read in told.values()], left_out)
        if plane:
            told = {label: read for label, read in told.items() if _size(read) == plane.size}
        if plane and told:
            drawings.append(_draw(task, told, plane, look))
            tables.append(_table(task, told, plane))
    if not drawings:
        return None
    text = [TEXT, TEXT_TABLE, *(f"Left out: {entry.path}: {entry.reason}." for entry in left_out)]
    return Section("What was asked", tuple(text), tuple(tables), tuple(drawings))


def _read(runs: Sequence[Run], left_out: list[LeftOut]) -> dict[int, Asked]:
    """What the first `SEEDS` runs of an arm that asked something asked, by seed."""
    found: dict[int, Asked] = {}
    for run in runs:
        if len(found) < SEEDS and (pairs := usable(asked, run, left_out)):
            found[run.seed] = pairs
    return found


def _size(read: Mapping[int, Asked]) -> int:
    """Of a position."""
    return next(iter(read.values())).position.shape[-1]


# Drawings.


def shown(pairs: Asked) -> np.ndarray:
    """Rows of the pairs that are drawn ``[n]``: of an early, a middle and the last session the first and the last."""
    sessions = np.unique(pairs.session)
    sessions = sessions[1:] if len(sessions) > 1 else sessions
    rows_of = [np.flatnonzero(pairs.session == session) for session in evenly(sessions.tolist(), SESSIONS)]
    return np.concatenate([rows[evenly(range(len(rows)), OF_SESSION)] for rows in rows_of])


def _draw(task: str, told: Mapping[str, Mapping[int, Asked]], plane: Plane, look: Mapping[str, Look]) -> Drawing:
    firsts = {label: next(iter(read.items())) for label, read in told.items()}
    heads = [f"{label}, seed {seed}" for label, (seed, _) in firsts.items()]
    rows: list[Sequence[Cell]] = [("task", "arm", "seed", "pair", "segment", "second_preferred", "time", *plane.labels)]
    with matplotlib.rc_context(STYLE):
        chosen = [shown(pairs) for _, pairs in firsts.values()]
        drawn = panels(plane, heads, [""] * max(map(len, chosen)), SIDE, room=0.34, right=0.15)
        for (label, (seed, pairs)), row, own in zip(firsts.items(), drawn.rows, chosen, strict=True):
            for panel, i in zip(row, own, strict=False):
                paths = plane.of(pairs.position[i])
                panel.frame()
                panel.title(_title(pairs, i))
                _paths(panel, paths, float(pairs.second[i]), look[label].colour)
                if pairs.object is not None:
                    panel.dots(plane.of(pairs.object[i]), 3.5)
                for side, path in enumerate(paths):
                    known = task, label, seed, int(pairs.id[i]), side, float(pairs.second[i])
                    rows += [(*known, time, float(x), float(y)) for time, (x, y) in enumerate(path)]
    return Drawing(f"{task}-pairs", f"{task}: some of the pairs that were asked.", drawn.figure, rows)


def _paths(panel: Panel, paths: np.ndarray, second: float, colour: str) -> None:
    """Both paths ``[2, H, 2]``; ``second``: P(second preferred), NaN where there is no answer."""
    for side in sorted((0, 1), key=lambda side: (1 - second, second)[side]):  # the preferred one on top
        path = paths[side]
        good = (1 - second, second)[side] >= 0.5
        how: dict[str, Any] = {"color": colour if good else OTHER, "linewidth": 2.2 if good and second != 0.5 else 1.2}
        panel.line(path, solid_capstyle="round", **how)
        panel.line(path[:1], marker="o", markersize=3.5, color=how["color"])
        moved = np.flatnonzero(np.abs(path - path[-1]).max(axis=1) > STILL)
        if len(moved):
            arrow = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9, **how}
            start, end = panel.at(path[[moved[-1], -1]]).tolist()
            panel.axis.annotate("", end, start, arrowprops=arrow)


def _title(pairs: Asked, row: int) -> str:
    """When it was asked, what came of it if nothing was preferred, and the first scores."""
    second = pairs.second[row]
    if second == 0.5:
        said = ", called equal"
    elif math.isnan(second):
        said = ", skipped" if pairs.collected[row] else ", not answered yet"
    else:
        said = ""
    scores = ", ".join(f"{name} {value:.2g}" for name, value in list(pairs.scores[row].items())[:2])
    return f"step {pairs.step[row]:,}{said}\n{scores}"


# What they are like.


def path_lengths(position: np.ndarray) -> np.ndarray:
    """Of paths ``[..., H, d] -> [...]``."""
    return np.linalg.norm(np.diff(position, axis=-2), axis=-1).sum(axis=-1)


def angles(position: np.ndarray) -> np.ndarray:
    """Between the displacements of pairs ``[P, 2, H, d] -> [P]``, in degrees from 0 to 180; NaN where one is none."""
    displacement = position[:, :, -1] - position[:, :, 0]
    size = np.linalg.norm(displacement, axis=-1)
    moves = (size > STILL).all(axis=1)
    cosine = (displacement[:, 0] * displacement[:, 1]).sum(axis=-1) / np.where(moves, size.prod(axis=1), 1)
    return np.where(moves, np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.nan)


def _table(task: str, told: Mapping[str, Mapping[int, Asked]], plane: Plane) -> Table:
    head = [f"{name} (m)" if name == "path length" and plane.named else name for name in HEAD]
    rows = [(label, len(read), *_likeness(list(read.values()))) for label, read in told.items()]
    caption = f"{task}: the pairs that were asked after the first session, of at most {SEEDS} runs per arm."
    return Table(caption, head, rows, f"{task}-pairs")


def _likeness(read: Sequence[Asked]) -> Sequence[Cell]:
    """Columns of `HEAD` from the pairs on, means over all pairs of some runs."""
    later = [pairs.session > pairs.session.min() for pairs in read]
    count = sum(int(rows.sum()) for rows in later)
    if not count:
        return 0, *[math.nan] * (len(HEAD) - 3)

    def joined(columns: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate([column[rows] for column, rows in zip(columns, later, strict=True)])

    angle = joined([angles(pairs.position) for pairs in read])
    answered = joined([pairs.collected for pairs in read]).sum() or math.nan
    return (
        count,
        float(joined([path_lengths(pairs.position) for pairs in read]).mean()),
        float(np.nanmean(angle)) if np.isfinite(angle).any() else math.nan,
        float(np.abs(joined([np.diff(pairs.returns)[:, 0] for pairs in read])).mean()),
        float(joined([pairs.pretraining for pairs in read]).mean()),
        float(joined([pairs.second == 0.5 for pairs in read]).sum() / answered),
        float(joined([pairs.skipped for pairs in read]).sum() / answered),
    )
