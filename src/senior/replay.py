"""What happened: store it, draw from it, cut segments out of it, and relabel it when the reward model changes.

The replay holds facts plus one derived column pair, the learned reward and its spread over the ensemble.
Bonuses are never written here. Row ``i`` of the run lies at ``i % capacity``: a ring, overwritten from the oldest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from senior.types import Batch, Source

RELABEL_CHUNK = 8192


class Fact(NamedTuple):
    """One transition as the environment gave it."""

    observation: Float[Array, " o"]
    action: Float[Array, " a"]
    reward: Float[Array, ""]
    next_observation: Float[Array, " o"]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    episode: Int[Array, ""]


class Replay(NamedTuple):
    """Facts in rows, two derived columns, and how many facts were ever stored."""

    facts: Fact  # every field with leading axis ``capacity``
    learned_reward: Float[Array, " capacity"]
    spread: Float[Array, " capacity"]
    count: Int[Array, ""]

    @property
    def capacity(self) -> int:
        return self.learned_reward.shape[0]

    @property
    def filled(self) -> Array:
        """How many rows hold a fact."""
        return jnp.minimum(self.count, self.capacity)


Scorer = Callable[[Array, Array], tuple[Array, Array]]
"""(observation [n, o], action [n, a]) -> (mean [n], spread [n]) of the ensemble."""


def init(capacity: int, observation_size: int, action_size: int) -> Replay:
    """An empty replay."""

    def column(*shape: int, kind: type = jnp.float32) -> Array:
        return jnp.zeros((capacity, *shape), kind)

    facts = Fact(
        observation=column(observation_size),
        action=column(action_size),
        reward=column(),
        next_observation=column(observation_size),
        terminated=column(kind=jnp.bool_),
        truncated=column(kind=jnp.bool_),
        episode=column(kind=jnp.int32),
    )
    return Replay(facts, column(), column(), jnp.zeros((), jnp.int32))


def store(replay: Replay, fact: Fact, learned_reward: Array, spread: Array) -> Replay:
    """Put one fact into the next row."""
    row = replay.count % replay.capacity
    facts = jax.tree.map(lambda column, value: column.at[row].set(value), replay.facts, fact)
    return Replay(
        facts,
        replay.learned_reward.at[row].set(learned_reward),
        replay.spread.at[row].set(spread),
        replay.count + 1,
    )


def gather(replay: Replay, rows: Int[Array, " b"], source: Source = Source.REPLAY) -> Batch:
    """Those rows as a batch. Only a real end of the episode stops the bootstrap: a time limit does not."""
    facts = jax.tree.map(lambda column: column[rows], replay.facts)
    return Batch(
        observation=facts.observation,
        action=facts.action,
        reward=facts.reward,
        next_observation=facts.next_observation,
        bootstrap=1.0 - facts.terminated.astype(jnp.float32),
        learned_reward=replay.learned_reward[rows],
        spread=replay.spread[rows],
        source=jnp.full(rows.shape, source, jnp.int32),
        row=rows,
    )


def sample(replay: Replay, key: PRNGKeyArray, size: int) -> Batch:
    """Uniform over the filled rows, with replacement."""
    return gather(replay, jax.random.randint(key, (size,), 0, replay.filled))


def latest(replay: Replay, key: PRNGKeyArray, size: int, window: Int[Array, ""]) -> Batch:
    """Uniform over the ``window`` latest rows, with replacement."""
    ago = jax.random.randint(key, (size,), 0, jnp.clip(window, 1, jnp.maximum(replay.filled, 1)))
    return gather(replay, (replay.count - 1 - ago) % replay.capacity, Source.RECENT)


def mix(first: Batch, other: Batch, use_other: Array | bool) -> Batch:
    """Replace the last rows of ``first`` by all of ``other`` where ``use_other`` is true (traced)."""
    keep = first.row.shape[0] - other.row.shape[0]

    def column(one: Array, two: Array) -> Array:
        return jnp.concatenate([one[:keep], jnp.where(use_other, two, one[keep:])])

    return jax.tree.map(column, first, other)


def segments(replay: Replay, starts: Int[Array, "*p"], length: int) -> tuple[Array, Array, Array]:
    """Observations, actions and true rewards ``[*p, length, ...]`` of the segments that begin at those rows.

    ``starts`` count rows since the beginning of the run; the caller keeps segments inside one episode.
    """
    rows = (starts[..., None] + jnp.arange(length)) % replay.capacity
    return replay.facts.observation[rows], replay.facts.action[rows], replay.facts.reward[rows]


def moments(replay: Replay) -> tuple[Float[Array, " o"], Float[Array, " o"]]:
    """Mean and population variance ``[o]`` of every entry of the stored observations; zeros if there is none."""
    filled = (jnp.arange(replay.capacity) < replay.filled)[:, None]
    total = jnp.maximum(replay.filled, 1)
    observation = replay.facts.observation
    mean = jnp.sum(observation * filled, axis=0) / total
    return mean, jnp.sum((observation - mean) ** 2 * filled, axis=0) / total


def relabel(replay: Replay, score: Scorer) -> Replay:
    """Rewrite the derived columns of every filled row, chunk by chunk (PEBBLE's relabelling).

    The last chunk is moved back so that it ends with the replay: some rows are then scored twice, alike.
    """
    chunk = min(RELABEL_CHUNK, replay.capacity)

    def one(i: Array, columns: tuple[Array, Array]) -> tuple[Array, Array]:
        start = jnp.minimum(i * chunk, replay.capacity - chunk)

        def part(column: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(column, start, chunk)

        fresh = score(part(replay.facts.observation), part(replay.facts.action))
        filled = start + jnp.arange(chunk) < replay.filled
        written = [jnp.where(filled, new, part(old)) for new, old in zip(fresh, columns, strict=True)]
        mean, spread = (
            jax.lax.dynamic_update_slice_in_dim(old, new, start, axis=0)
            for old, new in zip(columns, written, strict=True)
        )
        return mean, spread

    chunks = (replay.filled + chunk - 1) // chunk
    mean, spread = jax.lax.fori_loop(0, chunks, one, (replay.learned_reward, replay.spread))
    return replay._replace(learned_reward=mean, spread=spread)
