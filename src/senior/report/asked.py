"""The pairs that a run asked, as arrays, from its preference file. Imports no JAX."""

from __future__ import annotations

import json
import math
import sqlite3
from typing import NamedTuple

import numpy as np

from senior.envs.metaworld import POSITION, TASKS
from senior.report.records import PREFERENCES, Run, Unusable, preferences_in

OBJECT = slice(4, 7)
"""Where Meta-World's observation holds the place of the object, in metres."""


class Asked(NamedTuple):
    """The pairs of a run, in the order of asking. Reserves that were not needed are left out."""

    id: np.ndarray
    """``[P]``"""
    session: np.ndarray
    """``[P]``"""
    step: np.ndarray
    """``[P]`` at which it was asked."""
    position: np.ndarray
    """``[P, 2, H, d]``: the end-effector's path in both segments."""
    object: np.ndarray | None
    """``[P, 2, 3]``: where the object was when each segment began; None where it is not known."""
    pretraining: np.ndarray
    """``[P, 2]``: 1 where the segment is from before the end of pre-training, else 0; NaN without ``train.csv``."""
    returns: np.ndarray
    """``[P, 2]``: true return of each segment."""
    scores: list[dict[str, float]]
    """Per pair, what selection knew of it."""
    second: np.ndarray
    """``[P]``: P(second preferred) that is trained on; NaN where skipped or not answered yet."""
    collected: np.ndarray
    """``[P]``: whether its answer was taken."""

    @property
    def skipped(self) -> np.ndarray:
        """``[P]``: whether nobody could tell."""
        return self.collected & np.isnan(self.second)


def place_of(run: Run) -> slice | None:
    """Where the end-effector's position lies in the observation; None where nothing says so."""
    told = run.protocol.get("position")
    if isinstance(told, list) and len(told) == 2:
        return slice(*told)
    return POSITION if run.arm.task in TASKS else None


def asked(run: Run) -> Asked | None:
    """What a run asked; None if it asks nothing or has not begun to. Raises `Unusable` with the reason.

    The file is only read, and nothing is left beside it.
    """
    path = run.path / PREFERENCES
    if not run.asks or not path.exists():
        return None
    where = place_of(run)
    if where is None:
        raise Unusable(f"{PREFERENCES} cannot be used: config.json does not say where the position lies")
    with preferences_in(path) as db:
        steps, size, _ = db.execute("SELECT * FROM shape").fetchone()
        rows = db.execute(
            "SELECT id, session, step, episode_0, episode_1, observation, reward, scores, "
            "CASE WHEN collected_step < :end THEN second END, CASE WHEN collected_step < :end THEN collected_step END "
            "FROM pairs WHERE (reserve = 0 OR collected_step < :end) AND step < :end ORDER BY id",
            {"end": run.steps},  # where a run ends it asks no more
        )
        return _arrays(rows, (2, steps, size), where, run.arm.task in TASKS, _first_episodes(run))


def _first_episodes(run: Run) -> int | None:
    """How many episodes had ended when pre-training did; None without ``train.csv``."""
    return None if run.episodes is None else int((run.episodes.step <= run.main_phase).sum())


def _arrays(
    rows: sqlite3.Cursor, shape: tuple[int, int, int], where: slice, object_told: bool, first_episodes: int | None
) -> Asked | None:
    numbers, position, objects, returns, scores, second, collected = [], [], [], [], [], [], []
    for *number, observation, reward, score, label, step in rows:
        seen = np.frombuffer(observation, "<f4").reshape(shape)
        numbers.append(number)
        position.append(seen[..., where].copy())  # the rest is let go of
        objects.append(seen[:, 0, OBJECT].copy())
        returns.append(np.frombuffer(reward, "<f4").reshape(shape[:2]).sum(axis=1, dtype=float))
        told = json.loads(score).items()
        scores.append({str(name): math.nan if value is None else float(value) for name, value in told})
        second.append(np.nan if label is None else float(label))
        collected.append(step is not None)
    if not numbers:
        return None
    ids, sessions, steps, *episodes = np.array(numbers).T
    episode = np.stack(episodes, axis=1)
    return Asked(
        ids,
        sessions,
        steps,
        np.array(position, float),
        np.array(objects, float) if object_told else None,
        np.full(episode.shape, np.nan) if first_episodes is None else (episode < first_episodes).astype(float),
        np.array(returns),
        scores,
        np.array(second),
        np.array(collected),
    )
