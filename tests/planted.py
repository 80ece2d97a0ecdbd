"""Run directories in which the positions and pairs are what a test says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from senior.config import Config
from senior.files import pack
from senior.preference_file import Rules
from senior.preferences import Preferences
from senior.presets import preset
from senior.report.records import Run
from senior.report.results import read
from senior.types import Answers, Pairs, Query
from tests.many_runs import ACTION, OBSERVATION, protocol, write_run

OBJECT = slice(4, 7)


def config_of(method: str = "m-senior", task: str = "door-lock", seed: int = 0, steps: int = 40_000) -> Config:
    """A run of a few evaluations and four snapshots."""
    return replace(preset("paper", task, method), seed=seed, steps=steps, snapshot_every=10_000)


def run_of(
    place: Path,
    config: Config,
    positions: Mapping[int, np.ndarray] | None = None,
    files: Sequence[str] = ("eval.csv",),
    until: int | None = None,
    **changes: Any,
) -> Path:
    """A run directory with snapshots by step, and nothing but the given files besides.

    until: the step at which it stands, if it is under way. changes: of its protocol.
    """
    path = place / f"{config.method.name}-{config.seed}"
    write_run(path, config, protocol(**changes), files, until)
    if positions is not None:
        snapshot(path, positions)
    return path


def snapshot(path: Path, positions: Mapping[int, np.ndarray]) -> None:
    """Positions ``[n, d]`` by step."""
    arrays = {f"step-{step:010d}": held.astype(np.float32) for step, held in positions.items()}
    (path / "positions.npz").write_bytes(pack(arrays))


def samples(path: Path, step: int, **arrays: np.ndarray | float) -> None:
    """What is behind the bonus at a step."""
    (path / "bonus").mkdir(exist_ok=True)
    held = {name: np.asarray(value, np.float32) for name, value in arrays.items()}
    (path / "bonus" / f"step-{step:010d}.npz").write_bytes(pack(held))


class Asking:
    """The trainer's half of a run's preference file, of segments of ``H`` steps."""

    def __init__(self, path: Path, steps: int, observation: int = OBSERVATION) -> None:
        self.steps, self.observation, self.sessions = steps, observation, 0
        self.preferences = Preferences(path / "preferences.sqlite", 1000, steps, observation, ACTION)

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        self.preferences.close()

    def ask(
        self,
        position: np.ndarray,
        labels: Sequence[int | None] | None = (),
        returns: np.ndarray | None = None,
        objects: np.ndarray | None = None,
        scores: Mapping[str, Sequence[float]] | None = None,
        reserves: int = 0,
        episodes: np.ndarray | None = None,
    ) -> list[int]:
        """Ask a session of pairs whose end-effector goes along ``position [P, 2, H, 3]``.

        labels: the answers, by default that all second ones are better; None: nobody has answered. returns: true return
        of each segment ``[P, 2]``. objects: where the object is at the beginning of each ``[P, 2, 3]``; then it goes
        far away. episodes: the numbers of those that the segments are of ``[P, 2]``, by default 0.
        """
        pairs = len(position)
        observation = np.zeros((pairs, 2, self.steps, self.observation), np.float32)
        observation[..., : position.shape[-1]] = position
        if objects is not None:
            observation[:, :, 1:, OBJECT] = 77
            observation[:, :, 0, OBJECT] = objects
        reward = np.zeros((pairs, 2, self.steps), np.float32)
        reward[..., -1] = 0 if returns is None else returns
        action = np.zeros((pairs, 2, self.steps, ACTION), np.float32)
        none = np.zeros((pairs, 2), int)
        held = Pairs(observation, action, reward, none if episodes is None else episodes, none)
        query = Query(held, {name: np.asarray(value, float) for name, value in (scores or {}).items()})
        shown, step = np.zeros(pairs, int), 10_000 + 5000 * self.sessions
        ids = self.preferences.add(query, self.sessions, step, 0, shown, reserves)
        if labels is not None:
            said = [*labels] or [1] * (pairs - reserves)
            self.preferences.answer(Answers(ids[: pairs - reserves], said), "teacher")
            assert self.preferences.collect(self.sessions, step, Rules())
        self.sessions += 1
        return ids


def runs_below(*places: Path) -> tuple[Run, ...]:
    """As a report reads them, those under way too."""
    found = read(places, unfinished=True)
    files = all(entry.path.suffix in (".csv", ".sqlite") for entry in found.left_out)  # and no run
    assert files, found.left_out
    return found.runs
