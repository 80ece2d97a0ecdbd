"""Query selection: which pairs of segments to ask about.

A rule is a function ``(rng, context, n) -> Selection`` in a new file here and a line in `RULES`; a third party's
is named ``module:Name``. It runs once per session, on the host.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from senior.types import EnvSpec, Pairs

RULES = {
    "uniform": "senior.select.uniform:uniform",
    "entropy": "senior.select.entropy:entropy",
    "disagreement": "senior.select.disagreement:disagreement",
    "kcenter": "senior.select.kcenter:kcenter",
    "kcenter_disagreement": "senior.select.kcenter:kcenter_disagreement",
    "kcenter_entropy": "senior.select.kcenter:kcenter_entropy",
    "policy_aligned": "senior.select.uniform:uniform",  # QPA's rule is its window of episodes (Config.window)
    "motion_distinction": "senior.select.motion_distinction:MotionDistinction",
}


@dataclass(frozen=True)
class Context:
    """What a rule may look at. ``pool.reward`` is the true reward, which is for teachers only."""

    pool: Pairs
    """P candidate pairs, drawn independently; the first ones are as good as any."""
    predict: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(observation [P, 2, H, o], action [P, 2, H, a]) -> summed reward of every member [members, P, 2]."""
    spec: EnvSpec
    length_scale: float
    """Unit of the bandwidths (metres in Meta-World)."""
    labelled: np.ndarray
    """Observations of all labelled pairs so far ``[L, 2, H, o]``."""

    @property
    def positions(self) -> np.ndarray:
        """End-effector positions [P, 2, H, d]."""
        return self.pool.observation[..., self.spec.position]


@dataclass(frozen=True)
class Selection:
    """Chosen rows of the pool ``[n]``, best first, and the scores of exactly these."""

    index: np.ndarray
    scores: dict[str, np.ndarray] = field(default_factory=dict)


class Rule(Protocol):
    """Choose ``n`` different rows of ``context.pool``."""

    def __call__(self, rng: np.random.Generator, context: Context, n: int) -> Selection: ...


def probability_second(summed: np.ndarray) -> np.ndarray:
    """P(second preferred) of every member ``[members, P]`` from summed rewards ``[members, P, 2]`` (Eq. 1)."""
    gap = np.asarray(summed[..., 0] - summed[..., 1], np.float64)
    return 1 / (1 + np.exp(np.clip(gap, -700, 700)))


def deviation(probability: np.ndarray) -> np.ndarray:
    """Population standard deviation over the members ``[members, P] -> [P]``."""
    return probability.std(axis=0)


def binary_entropy(probability: np.ndarray) -> np.ndarray:
    """Mean over the members of the entropy of each prediction, in nats: ``[members, P] -> [P]``."""
    p = np.clip(probability, 1e-12, 1 - 1e-12)
    return -(p * np.log(p) + (1 - p) * np.log1p(-p)).mean(axis=0)


def highest(score: np.ndarray, n: int, name: str) -> Selection:
    """The ``n`` rows of highest score, ties in the order of the pool."""
    index = np.argsort(-score, kind="stable")[:n]
    return Selection(index, {name: score[index]})
