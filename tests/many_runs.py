"""Run directories that nobody trained, with all files that a report reads, in the shape of Meta-World's.

Success rises along a logistic curve towards a level that the method and the task set, and is counted in episodes; the
rest is random and of plausible size. Equal arguments give equal files.
"""

from __future__ import annotations

import json
import sqlite3
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from senior.config import Config, to_json
from senior.files import pack
from senior.methods import METHODS
from senior.preference_file import SCHEMA, SCHEMA_VERSION
from senior.presets import PAPER, preset
from senior.protocol import PACKAGES
from senior.rundir import EVAL, TIMING, TRAIN

FILES = ("eval.csv", "train.csv", "timing.csv", "preferences.sqlite", "positions.npz", "bonus")
EPISODE, OBSERVATION, ACTION = 500, 39, 4
LEVELS = dict(zip(METHODS, (0.98, 0.55, 0.6, 0.62, 0.72, 0.56, 0.85, 0.97), strict=True))
"""Where success goes, by method."""
SPEED = 100.0
"""Steps per second."""
TASKS = tuple(PAPER)[:6]


def protocol(**changes: Any) -> dict[str, Any]:
    """As `senior.rundir` writes it."""
    versions = dict.fromkeys(PACKAGES, "1.0.0") | {"senior-rl": "0.1.0", "metaworld": "3.1.1", "mujoco": "3.3.0"}
    return {
        "environment": "door-lock",
        "reward_version": "v2",
        "horizon": EPISODE,
        "observation_size": OBSERVATION,
        "action_size": ACTION,
        "position": [0, 3],
        "device": "cpu",
        "threads": 1,
        "machine": "Linux x86_64, some processor",
        "python": "3.11.7",
        "packages": versions,
        "git_commit": None,
        **changes,
    }


def write_run(
    path: Path,
    config: Config,
    told: Mapping[str, Any] | None = None,
    files: Collection[str] = FILES,
    until: int | None = None,
    level: float | None = None,
    success: bool = True,
) -> Path:
    """Write a run directory.

    told: its protocol. files: which it has beside ``config.json``. until: the step at which it stands; left out: its
    last. level: of success; left out: the method's. success: whether the environment tells it.
    """
    path.mkdir(parents=True)
    content = {"config": to_json(config), "protocol": dict(protocol() if told is None else told)}
    (path / "config.json").write_text(json.dumps(content, indent=2) + "\n")
    name = " ".join([config.env or config.task, config.method.name, config.method.select, config.method.explore])
    rng = np.random.default_rng([config.seed, zlib.crc32(name.encode())])
    end = config.steps if until is None else until
    level = LEVELS.get(config.method.name, 0.5) if level is None else level
    if "eval.csv" in files:
        _table(path / "eval.csv", EVAL, _evaluations(rng, config, end, level, success))
    if "train.csv" in files:
        _table(path / "train.csv", TRAIN, _episodes(rng, config, end, level))
    if "timing.csv" in files:
        steps = _every(config.evaluation.every, end)
        _table(path / "timing.csv", TIMING, {"step": steps, "seconds": steps / SPEED, "steps_per_second": SPEED})
    if "preferences.sqlite" in files and config.method.learns_reward:
        _preferences(path / "preferences.sqlite", rng, config, end)
    snapshots = _every(config.snapshot_every, end)
    if "positions.npz" in files:
        arrays = {f"step-{step:010d}": _positions(rng, 2000) for step in snapshots}
        (path / "positions.npz").write_bytes(pack(arrays))
    if "bonus" in files and config.method.explore == "preference_guided":
        (path / "bonus").mkdir()
        for step in snapshots[snapshots > config.pretraining.until]:
            behind = {
                "preferred": _positions(rng, 1000),
                "explored": _positions(rng, config.pge.capacity),
                "intrinsic": rng.random(config.pge.capacity, np.float32),
                "beta": np.float32(0.1 * (1 - 0.01) ** (step / 1000)),
            }
            (path / "bonus" / f"step-{step:010d}.npz").write_bytes(pack(behind))
    return path


def paper_grid(place: Path, seeds: int = 5, steps: int = 1_000_000) -> Iterator[Path]:
    """The paper's study: eight methods on six tasks."""
    for task in TASKS:
        for name in METHODS:
            config = replace(preset("paper", task, name), steps=steps)
            for seed in range(seeds):
                yield write_run(
                    place / f"{task}-{name}" / f"seed-{seed}",
                    replace(config, seed=seed),
                    protocol(environment=task),
                )


def queried_at(config: Config, step: np.ndarray) -> np.ndarray:
    """Asked pairs by a step."""
    if not config.method.learns_reward:
        return np.zeros(len(step), int)
    sessions = np.maximum(0, (step - config.pretraining.until) // config.queries.every + 1)
    return np.minimum(sessions * config.queries.per_session, config.queries.budget)


def _every(step: int, end: int) -> np.ndarray:
    steps = np.arange(step, end + 1, step)
    return steps if len(steps) and steps[-1] == end else np.append(steps, end)


def _rising(rng: np.random.Generator, config: Config, step: np.ndarray, level: float) -> np.ndarray:
    middle, width = config.steps * rng.uniform(0.2, 0.5), config.steps * 0.06
    return level / (1 + np.exp((middle - step) / width))


def _evaluations(
    rng: np.random.Generator, config: Config, end: int, level: float, success: bool
) -> dict[str, np.ndarray | float]:
    step = _every(config.evaluation.every, end)
    episodes, asked = config.evaluation.episodes, queried_at(config, step)
    rate = rng.binomial(episodes, _rising(rng, config, step, level)) / episodes
    return {
        "step": step,
        "labels": asked,
        "queried": asked,
        "episodes": episodes,
        **({"success_rate": rate} if success else {}),
        "return_mean": 4000 * rate + rng.normal(0, 50, len(step)),
        "return_std": 200.0,
    }


def _episodes(rng: np.random.Generator, config: Config, end: int, level: float) -> dict[str, np.ndarray | float]:
    step = _every(EPISODE, end)
    asked = queried_at(config, step)
    true = 4000 * _rising(rng, config, step, level) + rng.normal(0, 300, len(step))
    found: dict[str, np.ndarray | float] = {
        "step": step,
        "episode": np.arange(len(step)),
        "episode_length": EPISODE,
        "episode_return": true,
        "episode_success": (true > 2000).astype(float),
        "queried": asked,
        "labels": asked,
        "q": 10.0,
        "alpha": 0.1,
        "critic_loss": 0.1,
        "actor_loss": -10.0,
    }
    if config.method.learns_reward:
        session = np.where(np.diff(asked, prepend=0) > 0, np.arange(len(step)), 0)
        share = 0.5 + 0.4 * step / config.steps
        right = rng.binomial(config.queries.per_session, share) / config.queries.per_session
        found |= {
            "learned_return": np.where(asked > 0, 0.1 * true + rng.normal(0, 30, len(step)), 0.0),
            "reward_accuracy": np.where(asked > 0, right[np.maximum.accumulate(session)], np.nan),
        }
    return found


def _table(path: Path, head: tuple[str, ...], columns: Mapping[str, np.ndarray | float]) -> None:
    """A CSV file; cells of columns that are not given are empty."""
    count = len(np.atleast_1d(columns["step"]))
    cells = [_texts(columns[name], count) if name in columns else [""] * count for name in head]
    lines = [",".join(row) for row in zip(*cells, strict=True)]
    path.write_text("\n".join([",".join(head), *lines]) + "\n")


def _texts(values: np.ndarray | float, count: int) -> list[str]:
    many = np.broadcast_to(values, count).tolist()
    return ["" if value != value else format(value, ".9g") for value in many]


def _positions(rng: np.random.Generator, count: int) -> np.ndarray:
    """A walk above a table."""
    centre, spread = np.array([0.0, 0.65, 0.15]), np.array([0.15, 0.1, 0.06])
    return (centre + spread * rng.standard_normal((count, 3))).astype(np.float32)


def _preferences(path: Path, rng: np.random.Generator, config: Config, end: int) -> None:
    """Every pair asked by ``end``, with an answer each."""
    segment = config.queries.segment
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA synchronous=OFF")
        db.executescript(SCHEMA)
        db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
        db.execute("INSERT INTO shape VALUES (?, ?, ?)", (segment, OBSERVATION, ACTION))
        count = int(queried_at(config, np.array([end]))[0])
        for number in range(1, count + 1):
            session = (number - 1) // config.queries.per_session
            step = config.pretraining.until + session * config.queries.every
            observation = rng.standard_normal((2, segment, OBSERVATION), np.float32)
            walk = rng.normal(0, 0.01, (2, segment, 3)).cumsum(axis=1)
            observation[:, :, :3] = _positions(rng, 2)[:, None] + walk
            action = rng.uniform(-1, 1, (2, segment, ACTION)).astype("<f4")
            reward = rng.random((2, segment), np.float32)
            second = int(reward[1].sum() > reward[0].sum())
            scores = {}
            if config.method.select == "motion_distinction":
                scores = {"m": float(rng.random()), "d": float(rng.uniform(-1, 1))}
            episode = int(step / EPISODE)
            blobs = (observation.astype("<f4").tobytes(), action.tobytes(), reward.astype("<f4").tobytes())
            row = (number, session, 0, step, config.seed, episode - 1, 0, episode - 2, 10, *blobs)
            row += (json.dumps(scores), float(rng.random()), 0, step, second)
            db.execute(f"INSERT INTO pairs VALUES ({', '.join('?' * len(row))})", row)
            db.execute(
                "INSERT INTO answers (pair, annotator, answer, answered_at, shown_left) VALUES (?, ?, ?, 0, 0)",
                (number, config.teacher, second),
            )
        db.commit()
