"""Exploration: the state entropy of pre-training, and the bonuses of the main phase.

A bonus is a new file here and a line in `BONUSES`; a third party's is named ``module:Name``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from senior.types import Batch

if TYPE_CHECKING:
    from jaxtyping import Array, PRNGKeyArray

    from senior.replay import Replay

BONUSES = {
    "none": "senior.explore.none:NoBonus",
    "disagreement": "senior.explore.disagreement:Disagreement",
    "preference_guided": "senior.explore.preference_guided:PreferenceGuided",
}


def decayed(beta: float, decay: float, ticks: Array) -> Array:
    """beta (1 - decay)^ticks. In float32 1 - decay would lose decay's digits, and a million ticks make that 3 %."""
    import jax.numpy as jnp

    return beta * jnp.exp(ticks * math.log1p(-decay))


class Now(NamedTuple):
    """Where a run stands, traced."""

    step: Any
    since_pretraining: Any
    length_scale: Any  # unit of the bandwidths


class Bonus(Protocol):
    """What is paid on top of the learned reward in the critics' target: pure traced functions of one run.

    Built as ``Name(spec)``. The state is a pytree whose shapes and types never change.
    """

    def init(self) -> Any:
        """The state before anything is known."""
        ...

    def on_session(self, state: Any, key: PRNGKeyArray, preferred: Array, count: Array) -> Any:
        """After a session: ``preferred [n, d]`` holds ``count`` positions of preferred segments."""
        ...

    def on_refresh(self, state: Any, key: PRNGKeyArray, replay: Replay, now: Now) -> Any:
        """Every Q steps."""
        ...

    def value(self, state: Any, batch: Batch, now: Now) -> Array:
        """Bonus of every row of the batch, ``[B]``."""
        ...

    def report(self, state: Any, batch: Batch, now: Now) -> dict[str, Array]:
        """Numbers for the log: ``beta``, its weight, and ``intrinsic_mean``, what it weighs; or nothing."""
        ...
