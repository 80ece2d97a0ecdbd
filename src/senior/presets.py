"""The papers' numbers per task and method, the quick preset, and what the public code of SENIOR does otherwise.

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
    PreferenceGuided,
    Pretraining,
    Queries,
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
    recent: int = 30  # episodes of QPA's policy-aligned buffer


PAPER: dict[str, TaskNumbers] = {
    "door-lock": TaskNumbers(250, 5, 1000),
    "window-close": TaskNumbers(250, 5, 500),
    "handle-press": TaskNumbers(250, 10, 1000),
    "window-open": TaskNumbers(250, 10, 500),
    "door-open": TaskNumbers(1000, 10, 1000, recent=60),
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
    config = replace(
        config,
        queries=replace(
            config.queries, budget=numbers.budget, per_session=numbers.per_session, segment=numbers.segment
        ),
        pge=replace(config.pge, every=numbers.refresh_every),
        qpa=replace(config.qpa, episodes=numbers.recent),
    )
    return replace(config, reward=_qpa_reward(config.reward, numbers.segment)) if row.name == "qpa" else config


def _qpa_reward(reward: Reward, segment: int) -> Reward:
    """One member, many epochs, windows of 35 to 45 of 50 steps and as much of other segments."""
    shortest, longest = round(0.7 * segment), round(0.9 * segment)
    return replace(reward, members=1, epochs=200, snippets=20, snippet_min=shortest, snippet_max=longest)


def quick(task: str, row: Method) -> Config:
    """For a CPU: one policy in minutes, with the same algorithm and other numbers (docs/methods.md says why)."""
    config = paper(task, row)
    small = Networks(layers=2, width=128, reward_layers=2, reward_width=128, layer_norm=True)
    config = replace(
        config,
        preset="quick",
        steps=80_000,
        networks=small,
        sac=SAC(batch=128, actor_rate=1e-3, critic_rate=1e-3, alpha_rate=3e-4, rate_end=0.0, updates=2),
        snapshot_every=10_000,
        evaluation=Evaluation(every=5000),
    )
    if not row.learns_reward:
        return replace(config, pretraining=Pretraining(random_steps=1000, until=0))
    return replace(
        config,
        queries=replace(config.queries, budget=250, per_session=25, every=2500),
        reward=replace(config.reward, epochs=max(config.reward.epochs, 50), standardise=True),
        pge=replace(config.pge, every=500),
        bilevel=Bilevel(every=5000),
    )


def qpa_original(task: str, row: Method) -> Config:
    """QPA as its authors run it on Meta-World: wide networks, large batches, slow rates, no windows."""
    if row.name != "qpa":
        raise BadInput(f"The preset qpa_original is of QPA's authors; it has no numbers for {row.name}.")
    config = paper(task, row)
    rates = dict.fromkeys(("actor_rate", "critic_rate", "alpha_rate"), 1e-4)
    return replace(
        config,
        preset="qpa_original",
        networks=replace(config.networks, layers=2, width=1024),
        sac=replace(config.sac, batch=1024, **rates),
        reward=replace(config.reward, snippets=0),
        evaluation=replace(config.evaluation, episodes=100),
    )


PRESETS = {"paper": paper, "quick": quick, "qpa_original": qpa_original}


def release(config: Config) -> Config:
    """M-SENIOR as its authors' public code behaves where that differs from the paper (docs/methods.md).

    Its selection is uniform in effect, and its bonus 2e-45 at its first use. What it shares with the paper's reading in
    MDS, PGE, the outer step, the pool and the ensemble is set too, but for sizes and schedules (Q, N, capacities).
    """
    pge = PreferenceGuided(
        every=config.pge.every,
        capacity=config.pge.capacity,
        bandwidth=1.0,
        clock="env_step",
        equal="second",
        relabel=False,
        rest="older",
        refresh_with_outer=False,
    )
    return replace(
        config,
        compat="release",
        queries=replace(config.queries, pool=Queries.pool),
        reward=replace(config.reward, members=Reward.members),
        mds=MotionDistinction(density_sum="log", axis="raw", scores="mirrored"),
        pge=pge,
        bilevel=Bilevel(every=config.bilevel.every, batch="update"),
    )


def with_budget(config: Config, budget: int) -> Config:
    """Another budget, asked in about as many sessions as the preset's: pairs per session grow with it, at least 1.

    The paper does not tell how it spent its budgets of 150 to 1,000; with five pairs per session a million steps hold
    990.
    """
    queries = config.queries
    per_session = max(1, round(queries.per_session * budget / queries.budget))
    return replace(config, queries=replace(queries, budget=budget, per_session=per_session))


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
