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


def highest(score: np.ndarray, n: int, name: str) -> Selection:
    """The ``n`` rows of highest score, ties in the order of the pool."""
    index = np.argsort(-score, kind="stable")[:n]
    return Selection(index, {name: score[index]})
