"""Judge a policy on episodes of its own, in an environment of its own, with the mean action."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from senior.envs.vector import Environments, Failure

Policy = Callable[[np.ndarray], np.ndarray]
"""observation [o] float32 -> action [a] in [-1, 1]."""


class EpisodeFailed(Exception):
    """The environment broke during an evaluation; the text says how."""


class Episode(NamedTuple):
    """One judged episode."""

    total: float  # true return
    success: float | None  # 1 if any step succeeded; None if the environment does not tell
    actions: np.ndarray  # [T, a] float32


def judge(policy: Policy, environment: Environments, episodes: Sequence[int]) -> list[Episode]:
    """Run the policy through the given episodes of run 0 of ``environment``."""
    judged = []
    for number in episodes:
        failed = environment.begin(0, number)
        if failed:
            raise EpisodeFailed(failed.message)
        total, success, actions = 0.0, None, []
        while True:
            action = policy(environment.observations[0])
            step = environment.step(0, action)
            if isinstance(step, Failure):
                raise EpisodeFailed(step.message)
            actions.append(action)
            total += step.reward
            if step.success is not None:
                success = max(success or 0.0, step.success)
            if step.terminated or step.truncated:
                break
        judged.append(Episode(total, success, np.stack(actions)))
    return judged


def summary(episodes: Sequence[Episode]) -> dict[str, float | int | None]:
    """Success rate in [0, 1] (None if not told), mean and population deviation of the true returns."""
    totals = np.array([episode.total for episode in episodes])
    told = [episode.success for episode in episodes if episode.success is not None]
    return {
        "episodes": len(episodes),
        "success_rate": float(np.mean(told)) if told else None,
        "return_mean": float(totals.mean()),
        "return_std": float(totals.std()),
    }
