"""RUNE's bonus (Liang et al. 2022): pay the agent where the members of the reward ensemble disagree.

The intrinsic reward of a transition is the population standard deviation of its reward over the members, as last
relabelled; it is paid on every row of a batch with the weight beta_t = beta_0 (1 - rho)^t, where t counts environment
steps. It is added in the critics' target only: the learned reward itself stays the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Float, Int, PRNGKeyArray

from senior.explore import Now, decayed
from senior.replay import Replay
from senior.types import Batch, EnvSpec


@dataclass(frozen=True)
class Disagreement:
    """The bonus of RUNE and M-RUNE. Options as in `senior.config.Disagreement`."""

    spec: EnvSpec
    beta: float = 0.05
    decay: float = 1e-5

    def init(self) -> tuple[()]:
        """The replay holds all there is to know."""
        return ()

    def on_session(
        self, state: tuple[()], key: PRNGKeyArray, preferred: Float[Array, "n d"], count: Int[Array, ""]
    ) -> tuple[()]:
        return state

    def on_refresh(self, state: tuple[()], key: PRNGKeyArray, replay: Replay, now: Now) -> tuple[()]:
        return state

    def value(self, state: tuple[()], batch: Batch, now: Now) -> Float[Array, " b"]:
        """beta_t times the members' deviation, on every row."""
        return self._weight(now) * batch.spread

    def report(self, state: tuple[()], batch: Batch, now: Now) -> dict[str, Array]:
        """beta_t, and the mean deviation over the batch."""
        return {"beta": self._weight(now), "intrinsic_mean": batch.spread.mean()}

    def _weight(self, now: Now) -> Array:
        return decayed(self.beta, self.decay, now.step)
