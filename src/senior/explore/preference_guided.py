"""PGE: pay the agent for states that people like and that it has seldom visited (Eq. 6 to 8).

Every Q steps 1,000 transitions E are drawn from the replay into the curiosity buffer. f_E is the density of
their positions, f_P that of positions from preferred segments; g = f_P / f_E, and the intrinsic reward is g
scaled to [0, 1] over the buffer. A share of every batch comes from the buffer, with beta_t times that reward
added. Readings of what the paper leaves open: ``clock`` (t counts refreshes), ``bandwidth`` (docs/methods.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from senior import replay as replay_
from senior.density import log_density
from senior.explore import Now, decayed
from senior.replay import Replay
from senior.types import Batch, EnvSpec, Source


class State(NamedTuple):
    """The curiosity buffer with its bonus, and the sample behind f_P."""

    curiosity: Batch  # [E] copies of rows: indices would break when the ring wraps
    intrinsic: Float[Array, " E"]
    ready: Bool[Array, ""]  # both densities exist: the buffer may be drawn from
    beta: Float[Array, ""]
    preferred: Float[Array, "E d"]
    any_preferred: Bool[Array, ""]
    refreshes: Int[Array, ""]  # with both densities
    rows: Int[Array, " E"]  # of the replay, ascending, that the buffer was copied from
    filled: Int[Array, ""]  # rows of the replay at that refresh


def draw(state: State, key: PRNGKeyArray, size: int) -> Int[Array, " size"]:
    """Uniform places in the curiosity buffer, with replacement."""
    return jax.random.randint(key, (size,), 0, state.intrinsic.shape[0])


def older(state: State, replay: Replay, key: PRNGKeyArray, size: int, tries: int = 16) -> Batch:
    """Rows that were in the replay at the last refresh and are not in the curiosity buffer, as the public code draws.

    Of ``tries`` uniform draws the first that is not in the buffer; the last where all are, or before the first refresh.
    Rows must keep their place: for a replay that holds the whole run.
    """
    bound = jnp.where(state.ready, state.filled, replay.filled)
    drawn = jax.random.randint(key, (tries, size), 0, jnp.maximum(bound, 1))
    place = jnp.minimum(jnp.searchsorted(state.rows, drawn), state.rows.shape[0] - 1)
    outside = (state.rows[place] != drawn).at[-1].set(True)
    return replay_.gather(replay, drawn[jnp.argmax(outside, axis=0), jnp.arange(size)])


def intrinsic_reward(
    positions: Float[Array, "E d"], preferred: Float[Array, "S d"], bandwidth: Float[Array, ""] | float
) -> Float[Array, " E"]:
    """min-max of f_P / f_E over the positions, which are also the sample of f_E. All zero if g is constant.

    The ratio is formed of logarithms and scaled by its largest value first, so it is finite for clouds that lie
    far apart.
    """
    log_ratio = log_density(positions, preferred, bandwidth) - log_density(positions, positions, bandwidth)
    ratio = jnp.exp(log_ratio - log_ratio.max())
    low, high = ratio.min(), ratio.max()
    return jnp.where(high > low, (ratio - low) / jnp.where(high > low, high - low, 1.0), 0.0)


@dataclass(frozen=True)
class PreferenceGuided:
    """The bonus of P-SENIOR and M-SENIOR. Options as in `senior.config.PreferenceGuided`."""

    spec: EnvSpec
    capacity: int = 1000
    bandwidth: float = 0.1
    beta: float = 0.1
    decay: float = 0.01
    clock: str = "refresh"

    def init(self) -> State:
        """Empty: nothing is paid and no row is drawn from the buffer until both densities exist."""
        empty = replay_.init(1, self.spec.observation_size, self.spec.action_size)
        no = jnp.zeros((), jnp.bool_)
        return State(
            curiosity=replay_.gather(empty, jnp.zeros(self.capacity, jnp.int32), Source.CURIOSITY),
            intrinsic=jnp.zeros(self.capacity),
            ready=no,
            beta=jnp.zeros(()),
            preferred=jnp.zeros((self.capacity, self.spec.position_size)),
            any_preferred=no,
            refreshes=jnp.zeros((), jnp.int32),
            rows=jnp.full(self.capacity, -1, jnp.int32),
            filled=jnp.zeros((), jnp.int32),
        )

    def on_session(
        self, state: State, key: PRNGKeyArray, preferred: Float[Array, "n d"], count: Int[Array, ""]
    ) -> State:
        """Redraw the sample of f_P: ``capacity`` of the first ``count`` positions, with replacement."""
        rows = jax.random.randint(key, (self.capacity,), 0, jnp.maximum(count, 1))
        return state._replace(preferred=preferred[rows], any_preferred=count > 0)

    def on_refresh(self, state: State, key: PRNGKeyArray, replay: Replay, now: Now) -> State:
        """Replace the curiosity buffer and its intrinsic rewards, and move beta_t on."""
        drawn = replay_.sample(replay, key, self.capacity)
        rows = jnp.sort(drawn.row)
        drawn = drawn._replace(
            source=jnp.full(self.capacity, Source.CURIOSITY, jnp.int32), row=jnp.arange(self.capacity)
        )
        positions = drawn.observation[:, self.spec.position]
        value = intrinsic_reward(positions, state.preferred, self.bandwidth * now.length_scale)
        ticks = {
            "refresh": state.refreshes,
            "env_step": now.step,
            "since_pretrain": now.since_pretraining,
        }[self.clock]
        return state._replace(
            curiosity=drawn,
            intrinsic=jnp.where(state.any_preferred, value, 0.0),
            ready=state.any_preferred,
            beta=decayed(self.beta, self.decay, ticks),
            refreshes=state.refreshes + state.any_preferred,
            rows=rows,
            filled=replay.filled,
        )

    def value(self, state: State, batch: Batch, now: Now) -> Float[Array, " b"]:
        """beta_t r_int on rows of the curiosity buffer, 0 elsewhere."""
        paid = batch.source == Source.CURIOSITY
        return jnp.where(paid, state.beta * state.intrinsic[jnp.where(paid, batch.row, 0)], 0.0)

    def report(self, state: State, batch: Batch, now: Now) -> dict[str, Array]:
        """beta_t, and the mean intrinsic reward over the curiosity buffer."""
        return {"beta": state.beta, "intrinsic_mean": state.intrinsic.mean()}
