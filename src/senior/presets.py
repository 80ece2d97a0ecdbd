"""The paper's numbers per task and method, and the quick preset.

``PAPER`` holds the paper's tables (docs/methods.md); rows of tasks that the paper does not train in simulation are
ours and say so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from senior.config import (
    SAC,
    Bilevel,
    Config,
    Evaluation,
    MotionDistinction,
    Networks,
    Pretraining,
    Reward,
    differences,
)
from senior.methods import METHODS, Method, method
from senior.types import BadInput


class TaskNumbers(NamedTuple):
    """What the paper sets per task."""

    budget: int
    per_session: int
    refresh_every: int
    ours: bool = False
    segment: int = 50


PAPER: dict[str, TaskNumbers] = {
    "door-lock": TaskNumbers(250, 5, 1000),
    "window-close": TaskNumbers(250, 5, 500),
    "handle-press": TaskNumbers(250, 10, 1000),
    "window-open": TaskNumbers(250, 10, 500),
    "door-open": TaskNumbers(1000, 10, 1000),
    "door-unlock": TaskNumbers(1000, 20, 500),
    "door-close": TaskNumbers(250, 5, 1000, ours=True),
    "box-close": TaskNumbers(1000, 10, 1000, ours=True),
    "point": TaskNumbers(250, 5, 1000, ours=True, segment=10),  # its episodes have 50 steps
}
OTHERS = TaskNumbers(250, 5, 1000, ours=True)
"""For environments that are no task of the table."""


def paper(task: str, row: Method) -> Config:
    """The paper's configuration of that method on that task."""
    numbers = PAPER.get(task, OTHERS)
    config = Config(task=task, method=row)
    if not row.learns_reward:
        # Plain SAC on the true reward: 5,000 random steps and no pre-training, as B-Pref runs it.
        return replace(config, pretraining=Pretraining(random_steps=5000, until=0))
    return replace(
        config,
        queries=replace(
            config.queries, budget=numbers.budget, per_session=numbers.per_session, segment=numbers.segment
        ),
        pge=replace(config.pge, every=numbers.refresh_every),
    )


def quick(task: str, row: Method) -> Config:
    """For a CPU: one policy in minutes, with the same algorithm and other numbers (docs/methods.md says why)."""
    config = paper(task, row)
    small = Networks(layers=2, width=128, reward_layers=2, reward_width=128)
    config = replace(
        config,
        preset="quick",
        steps=80_000,
        networks=small,
        sac=SAC(batch=128, critic_rate=1e-3, alpha_rate=3e-4, rate_end=0.0, updates=2),
        snapshot_every=10_000,
        evaluation=Evaluation(every=5000),
    )
    if not row.learns_reward:
        return replace(config, pretraining=Pretraining(random_steps=1000, until=0))
    return replace(
        config,
        pretraining=Pretraining(until=20_000),
        queries=replace(config.queries, budget=250, per_session=25, every=2500),
        reward=Reward(epochs=50),
        mds=MotionDistinction(keep=1.0),
        pge=replace(config.pge, every=500),
        bilevel=Bilevel(every=5000),
    )


PRESETS = {"paper": paper, "quick": quick}


def preset(name: str, task: str, method_name: str) -> Config:
    """The configuration of a method on a task; `BadInput` for an unknown method or preset."""
    if name not in PRESETS:
        raise BadInput.unknown("preset", name, PRESETS)
    return PRESETS[name](task, method(method_name))


def quick_changes() -> str:
    """What the quick preset changes, from the data itself, as one line per number."""
    row = METHODS["m-senior"]
    found = differences(paper("door-close", row), quick("door-close", row))
    return "\n".join(f"{name}: {old} -> {new}" for name, old, new in found if name != "preset")
