"""Pre-training's reward: how far a state lies from its k-th nearest neighbour among all states so far (PEBBLE).

Instead of comparing a batch with the whole buffer at every update, the k+1 smallest distances of every stored
state are kept and brought up to date when a state is stored: one new state against all. The numbers are the
same. Distances are differences of coordinates, not of squared norms, so a state is at distance 0 from itself.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class StateEntropy(NamedTuple):
    """The ``k+1`` smallest distances of each of the first ``n`` states, ascending."""

    states: Float[Array, "n o"]
    nearest: Float[Array, "n k+1"]  # infinite where fewer states are known
    count: Int[Array, ""]


class Deviation(NamedTuple):
    """The running deviation of all distances that batches have looked up."""

    mean: Float[Array, ""]
    square: Float[Array, ""]  # sum of squared deviations from the mean
    seen: Float[Array, ""]


def init(capacity: int, observation_size: int, neighbours: int) -> tuple[StateEntropy, Deviation]:
    """No state yet. ``capacity`` is the number of pre-training steps."""
    table = StateEntropy(
        states=jnp.zeros((capacity, observation_size)),
        nearest=jnp.full((capacity, neighbours + 1), jnp.inf),
        count=jnp.zeros((), jnp.int32),
    )
    return table, Deviation(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))


def insert(entropy: StateEntropy, state: Float[Array, " o"]) -> StateEntropy:
    """Add a state. Beyond the capacity nothing changes (pre-training is over)."""
    capacity, keep = entropy.nearest.shape
    row = entropy.count
    states = entropy.states.at[row].set(state, mode="drop")
    known = jnp.arange(capacity) <= row
    distance = jnp.sqrt(jnp.sum((states - state) ** 2, axis=-1))
    distance = jnp.where(known, distance, jnp.inf)
    before = jnp.concatenate([jnp.full((capacity, 1), -jnp.inf), entropy.nearest[:, :-1]], axis=1)
    nearest = jnp.maximum(before, jnp.minimum(entropy.nearest, distance[:, None]))
    nearest = nearest.at[row].set(-jax.lax.top_k(-distance, keep)[0], mode="drop")
    full = row >= capacity
    return entropy._replace(
        states=states,
        nearest=jnp.where(full, entropy.nearest, nearest),
        count=jnp.minimum(row + 1, capacity),
    )


def reward(entropy: StateEntropy, deviation: Deviation, rows: Int[Array, " b"]) -> tuple[Deviation, Float[Array, " b"]]:
    """Distance of each row to its k-th neighbour over the running deviation, which the batch enters first."""
    distance = entropy.nearest[rows, -1]
    size = distance.shape[0]
    seen = deviation.seen + size
    gap = distance.mean() - deviation.mean
    mean = deviation.mean + gap * size / seen
    square = deviation.square + jnp.sum((distance - distance.mean()) ** 2) + gap**2 * deviation.seen * size / seen
    scale = jnp.sqrt(square / seen)
    return Deviation(mean, square, seen), distance / jnp.where(scale > 0, scale, 1.0)
