"""A configuration so small that a whole run takes seconds; networks, batch and segments are alike in every test,
so that what one test compiles serves the others."""

from __future__ import annotations

import csv
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from senior.config import SAC, Bilevel, Config, Evaluation, Networks, PreferenceGuided, Pretraining, Queries
from senior.presets import preset

NETWORKS = Networks(layers=1, width=32, reward_layers=1, reward_width=32)


def small(method: str = "m-senior", task: str = "point", **changes: Any) -> Config:
    config = preset("paper", task, method)
    learns = config.method.learns_reward
    windows = {"snippet_min": 7, "snippet_max": 9} if config.reward.snippets else {}
    config = replace(
        config,
        steps=2000,
        networks=NETWORKS,
        sac=SAC(batch=64, actor_rate=3e-3, critic_rate=3e-3, alpha_rate=3e-3, tau=0.02, discount=0.9, reset_updates=20),
        pretraining=Pretraining(random_steps=100, until=400 if learns else 0),
        queries=Queries(budget=35, per_session=10, every=200, segment=10, episodes=20, pool=10),
        reward=replace(config.reward, epochs=50, rate=3e-3, batch=16, **windows),
        pge=PreferenceGuided(capacity=100, every=100),
        bilevel=Bilevel(every=200),
        evaluation=Evaluation(every=500, episodes=5),
        checkpoint_every=500,
        snapshot_every=1000,
    )
    return replace(config, **changes)


def rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def preferences_dump(run: Path) -> list[tuple[Any, ...]]:
    """All that was asked, a row a pair with its answers at the end, but for what a clock said; of plain SAC nothing."""
    if not (run / "preferences.sqlite").exists():
        return []
    with closing(sqlite3.connect(run / "preferences.sqlite")) as db:
        names = [row[1] for row in db.execute("PRAGMA table_info(answers)")]
        told = ", ".join(name for name in names if name not in ("pair", "answered_at", "seconds"))
        answers: dict[int, list[tuple[Any, ...]]] = {}
        for pair, *answer in db.execute(f"SELECT pair, {told} FROM answers ORDER BY id"):
            answers.setdefault(pair, []).append(tuple(answer))
        pairs = db.execute("SELECT id, * FROM pairs ORDER BY id").fetchall()
    return [(*row, answers.get(number, [])) for number, *row in pairs]
