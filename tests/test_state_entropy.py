"""Pre-training's reward held to a search through all states so far."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior.explore import state_entropy
from senior.explore.state_entropy import Deviation, StateEntropy

K, CAPACITY, O = 3, 30, 2
insert = jax.jit(state_entropy.insert)
reward = jax.jit(state_entropy.reward)


def states_of(seed: int, size: int = CAPACITY) -> np.ndarray:
    """Points of a coarse lattice: many are copies of one another."""
    return np.random.default_rng(seed).integers(-1, 3, (size, O)).astype(np.float32) / 4


def table_of(states: np.ndarray) -> StateEntropy:
    table, _ = state_entropy.init(CAPACITY, O, K)
    for state in states:
        table = insert(table, state)
    return table


def nothing_seen() -> Deviation:
    return state_entropy.init(CAPACITY, O, K)[1]


def kth_distances(states: np.ndarray) -> np.ndarray:
    """Distance of every state to its K-th nearest other one, by looking at all of them."""
    found = []
    for i, state in enumerate(states):
        others = [np.sqrt(np.sum((state - other) ** 2)) for j, other in enumerate(states) if j != i]
        found.append(sorted(others)[K - 1])
    return np.array(found)


@pytest.mark.parametrize("kind", ["lattice", "cloud"])
def test_after_every_insertion_the_table_is_that_of_a_search_through_all_states(kind: str):
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(CAPACITY, O)).astype(np.float32)
    states = states_of(1) if kind == "lattice" else cloud
    table, _ = state_entropy.init(CAPACITY, O, K)
    for n, state in enumerate(states, start=1):
        table = insert(table, state)
        assert int(table.count) == n
        assert np.array_equal(table.states[:n], states[:n])
        apart = np.linalg.norm(states[:n, None] - states[None, :n], axis=-1)
        expected = np.full((n, K + 1), np.inf)
        expected[:, : min(n, K + 1)] = np.sort(apart, axis=1)[:, : K + 1]
        np.testing.assert_allclose(table.nearest[:n], expected, rtol=1e-6)
        if n > K:
            np.testing.assert_allclose(table.nearest[:n, -1], kth_distances(states[:n]), rtol=1e-6)
            assert np.isfinite(table.nearest[:n]).all()


def test_a_state_far_from_the_origin_is_at_distance_zero_from_itself():
    """The product trick for squared distances would leave 1e-3 here."""
    states = (1000 + states_of(2)).astype(np.float32)
    assert not np.any(table_of(states).nearest[:, 0])


def test_the_reward_is_zero_exactly_where_there_are_k_other_copies():
    states = states_of(3)
    _, paid = reward(table_of(states), nothing_seen(), np.arange(CAPACITY))
    copies = np.array([(states == state).all(axis=1).sum() - 1 for state in states])
    assert copies.min() < K <= copies.max()
    assert np.array_equal(np.asarray(paid) == 0, copies >= K)


def test_the_reward_is_the_distance_over_the_deviation_of_all_distances_seen():
    """The batch enters the deviation before it is divided by it; no mean is subtracted."""
    states, rng, seen = states_of(4), np.random.default_rng(5), []
    table, deviation, distance = table_of(states), nothing_seen(), kth_distances(states)
    for _ in range(5):
        rows = rng.integers(CAPACITY, size=8)
        seen.extend(distance[rows])
        deviation, paid = reward(table, deviation, rows)
        np.testing.assert_allclose(paid, distance[rows] / np.std(seen), rtol=1e-4)


def test_the_reward_is_finite_from_the_first_state_that_has_k_others():
    deviation, paid = reward(table_of(states_of(6)[: K + 1]), nothing_seen(), np.arange(K + 1))
    assert np.isfinite(paid).all() and np.isfinite(deviation).all()


def test_equal_distances_have_no_deviation_and_are_paid_as_they_are():
    square = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.float32)
    _, paid = reward(table_of(square), nothing_seen(), np.arange(4))
    np.testing.assert_allclose(paid, np.sqrt(2), rtol=1e-6)


def test_a_state_beyond_the_capacity_changes_nothing():
    table = table_of(states_of(7))
    for state in ([0.0, 0.0], [9.0, 9.0]):
        after = insert(table, jnp.array(state))
        assert all(map(np.array_equal, jax.tree.leaves(table), jax.tree.leaves(after)))
