"""No bonus: the methods that explore by the policy's entropy alone."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from senior.explore import Now
from senior.replay import Replay
from senior.types import Batch, EnvSpec


class NoBonus:
    """Pays nothing and remembers nothing."""

    def __init__(self, spec: EnvSpec) -> None:
        pass

    def init(self) -> tuple[()]:
        return ()

    def on_session(
        self, state: tuple[()], key: PRNGKeyArray, preferred: Float[Array, "n d"], count: Int[Array, ""]
    ) -> tuple[()]:
        return state

    def on_refresh(self, state: tuple[()], key: PRNGKeyArray, replay: Replay, now: Now) -> tuple[()]:
        return state

    def value(self, state: tuple[()], batch: Batch, now: Now) -> Float[Array, " b"]:
        return jnp.zeros_like(batch.learned_reward)

    def report(self, state: tuple[()], batch: Batch, now: Now) -> dict[str, Array]:
        return {}
