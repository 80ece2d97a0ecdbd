"""Meta-Reward-Net's outer gradient held to central differences through the inner step, all in NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior.agent import sac
from senior.agent.networks import MLP
from senior.reward import bilevel, model
from senior.reward.bilevel import FirstSteps, OuterNumbers
from senior.reward.model import RewardModel, Scaling
from senior.types import Batch, Source
from tests.numeric import Arrays, numeric_gradient

O, A, B, M = 3, 2, 6, 4
FIRST, SECOND, EQUAL = 0.0, 1.0, 0.5
"""P(second preferred)."""
NUMBERS = OuterNumbers(inner_rate=0.05, rate=1e-3, weight=0.1, discount=0.9)
"""The inner rate is large, so that the outer gradient is."""
outer_step = jax.jit(bilevel.outer_step, static_argnums=6)
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def agent() -> sac.Agent:
    return sac.init(jax.random.key(0), O, A, 2, 5, 0.3)


@pytest.fixture(scope="module")
def reward_model() -> RewardModel:
    return model.init(jax.random.key(1), 3, O + A, 2, 4)


def batch_of(seed: int = 0) -> Batch:
    rng = np.random.default_rng(seed)
    nothing = np.zeros(B, np.float32)
    return Batch(
        observation=rng.normal(size=(B, O)).astype(np.float32),
        action=rng.uniform(-1, 1, (B, A)).astype(np.float32),
        reward=np.full(B, 1e3, np.float32),  # neither the true nor the stored reward may matter
        next_observation=rng.normal(size=(B, O)).astype(np.float32),
        bootstrap=np.array([1, 0, 1, 1, 0, 1], np.float32),
        learned_reward=np.full(B, -1e3, np.float32),
        spread=nothing,
        source=np.full(B, Source.REPLAY, np.int32),
        row=np.arange(B),
    )


def pairs_of(labels: list[float], weight: list[float] | None = None, seed: int = 1) -> FirstSteps:
    rng = np.random.default_rng(seed)
    m = len(labels)
    return FirstSteps(
        rng.normal(size=(m, 2, O)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        rng.uniform(-1, 1, (m, 2, A)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        np.array(labels, np.float32),  # pyright: ignore[reportArgumentType]
        np.array(weight or [1.0] * m, np.float32),  # pyright: ignore[reportArgumentType]
    )


def assert_same(one: object, other: object) -> None:
    """Equal bit for bit."""
    assert all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


# The same in NumPy.


def flat(tree: MLP) -> Arrays:
    return [np.asarray(x, np.float64) for x in (*tree.weights, *tree.biases)]


def forward(net: Arrays, x: np.ndarray, slope: float) -> list[np.ndarray]:
    """Inputs of every layer and the output, of one net ``[w0, w1, ..., b0, b1, ...]``."""
    half, held = len(net) // 2, [x]
    for i in range(half):
        x = x @ net[i] + net[half + i]
        if i < half - 1:
            x = np.where(x > 0, x, slope * x)
        held.append(x)
    return held


def critic(net: Arrays, observation: np.ndarray, action: np.ndarray) -> np.ndarray:
    return forward(net, np.concatenate([observation, action], axis=-1), 0.0)[-1][..., 0]


def learned_by_hand(members: Arrays, batch: Batch) -> np.ndarray:
    x = np.concatenate([batch.observation, batch.action], axis=-1)
    each = [np.tanh(forward([p[j] for p in members], x, 0.01)[-1][:, 0]) for j in range(3)]
    return np.mean(each, axis=0)


def moved(net: Arrays, batch: Batch, target: np.ndarray, rate: float) -> Arrays:
    """One plain gradient step on the mean squared error to the target, propagated back by hand."""
    half = len(net) // 2
    held = forward(net, np.concatenate([batch.observation, batch.action], axis=-1).astype(np.float64), 0.0)
    upstream = 2 * (held[-1] - target[:, None]) / B
    stepped = list(net)
    for i in reversed(range(half)):
        stepped[i] = net[i] - rate * held[i].T @ upstream
        stepped[half + i] = net[half + i] - rate * upstream.sum(axis=0)
        upstream = (upstream @ net[i].T) * (held[i] > 0)
    return stepped


def outer_by_hand(
    members: Arrays, critics: Arrays, batch: Batch, value: np.ndarray, pairs: FirstSteps, numbers: OuterNumbers
) -> float:
    """weight x sum over both critics of the mean cross-entropy, of critics moved by the learned reward."""
    target = learned_by_hand(members, batch) + numbers.discount * batch.bootstrap * value
    total = 0.0
    for j in (0, 1):
        virtual = moved([p[j] for p in critics], batch, target, float(numbers.inner_rate))
        for (first, second), label, weight in zip(
            critic(virtual, pairs.observation, pairs.action), pairs.second, pairs.weight, strict=True
        ):
            p = 1 / (1 + np.exp(second - first))
            total -= weight * ((1 - float(label)) * np.log(p) + float(label) * np.log(1 - p))
    return float(numbers.weight) * total / max(float(np.sum(pairs.weight)), 1)


def value_by_hand(agent: sac.Agent, batch: Batch) -> np.ndarray:
    """min Q'(s', a') - alpha log pi(a'|s') at an action drawn by the policy."""
    action, log_prob = (np.asarray(x) for x in sac.sample(agent.actor, batch.next_observation, KEY))
    targets = flat(agent.targets)
    q = np.min([critic([p[j] for p in targets], batch.next_observation, action) for j in (0, 1)], axis=0)
    return q - np.exp(float(agent.log_alpha)) * log_prob


# The gradient.


@pytest.mark.parametrize(
    "labels", [[FIRST, SECOND, SECOND, FIRST], [EQUAL, FIRST, EQUAL, SECOND], [0.25, 1, 2 / 3, 0]], ids=str
)
@pytest.mark.parametrize("discount", [0.9, 0.0])
def test_the_outer_gradient_is_that_of_differences_through_the_inner_step(
    agent: sac.Agent, reward_model: RewardModel, labels: list[float], discount: float
):
    batch, pairs, numbers = batch_of(), pairs_of(labels), NUMBERS._replace(discount=discount)
    after, info = outer_step(reward_model, agent, batch, pairs, KEY, numbers, False)
    value, critics = value_by_hand(agent, batch), flat(agent.critics)

    def loss(members: Arrays) -> float:
        return outer_by_hand(members, critics, batch, value, pairs, numbers)

    np.testing.assert_allclose(info["outer_loss"], loss(flat(reward_model.members)), rtol=1e-4)
    gradient = numeric_gradient(loss, flat(reward_model.members))
    largest = max(np.abs(g).max() for g in gradient)
    assert largest > 1e-5
    for moment, g in zip(flat(after.adam.mu), gradient, strict=True):
        np.testing.assert_allclose(moment / 0.1, g, rtol=1e-2, atol=1e-3 * largest)
    for old, new, g in zip(flat(reward_model.members), flat(after.members), gradient, strict=True):
        clear = np.abs(g) > 0.05 * largest
        np.testing.assert_allclose((new - old)[clear], -1e-3 * np.sign(g[clear]), rtol=2e-2)


def test_a_standardising_model_and_one_with_the_scaling_in_its_first_layer_give_the_same_outer_loss(
    agent: sac.Agent, reward_model: RewardModel
):
    batch, pairs = batch_of(), pairs_of([FIRST, SECOND])
    scaling = Scaling(jnp.full(O, 0.5), jnp.full(O, 2.0))
    members = reward_model.members
    first = members.weights[0]  # [member, O + A, width]
    scaled = first.at[:, :O].divide(2)
    shift = 0.5 * scaled[:, :O].sum(axis=1)
    folded = members._replace(
        weights=(scaled, *members.weights[1:]), biases=(members.biases[0] - shift, *members.biases[1:])
    )
    _, plain = outer_step(reward_model, agent, batch, pairs, KEY, NUMBERS, False)
    _, expected = outer_step(reward_model._replace(members=folded), agent, batch, pairs, KEY, NUMBERS, False)
    after, info = outer_step(reward_model._replace(scaling=scaling), agent, batch, pairs, KEY, NUMBERS, False)
    np.testing.assert_allclose(info["outer_loss"], expected["outer_loss"], rtol=1e-5)
    assert abs(plain["outer_loss"] - expected["outer_loss"]) > 1e-5 * expected["outer_loss"]
    assert_same(after.scaling, scaling)


def test_the_learned_reward_moves_so_that_the_outer_loss_falls(agent: sac.Agent, reward_model: RewardModel):
    batch, pairs, losses = batch_of(), pairs_of([FIRST, SECOND, SECOND, FIRST]), []
    for _ in range(30):
        reward_model, info = outer_step(reward_model, agent, batch, pairs, KEY, NUMBERS._replace(rate=1e-2), True)
        losses.append(float(info["outer_loss"]))
    assert losses[-1] < losses[0] and np.all(np.diff(losses) < 1e-6)


def test_the_loss_is_weighted_and_the_inner_rate_is_what_lets_the_gradient_through(
    agent: sac.Agent, reward_model: RewardModel
):
    batch, pairs = batch_of(), pairs_of([FIRST, SECOND])

    def step(numbers: OuterNumbers) -> tuple[float, np.ndarray]:
        after, info = outer_step(reward_model, agent, batch, pairs, KEY, numbers, False)
        return float(info["outer_loss"]), np.asarray(after.adam.mu.weights[0])

    loss, gradient = step(NUMBERS)
    loss_ten, gradient_ten = step(NUMBERS._replace(weight=1.0))
    np.testing.assert_allclose(loss_ten, 10 * loss, rtol=1e-5)
    np.testing.assert_allclose(gradient_ten, 10 * gradient, rtol=1e-3, atol=1e-9)
    assert np.abs(gradient).max() > 0 and not np.any(step(NUMBERS._replace(inner_rate=0.0))[1])


# What it must not touch.


def test_the_live_agent_gets_no_gradient_and_is_not_returned(agent: sac.Agent, reward_model: RewardModel):
    """The value of the next state is a constant of the step: no gradient flows through it either."""
    before = jax.tree.map(np.array, agent)
    after, info = outer_step(reward_model, agent, batch_of(), pairs_of([FIRST, SECOND]), KEY, NUMBERS, False)
    assert isinstance(after, RewardModel) and set(info) == {"outer_loss"}
    assert_same(before, agent)


@pytest.mark.parametrize("real", [1, 2, 4])
def test_padded_pairs_have_no_influence(agent: sac.Agent, reward_model: RewardModel, real: int):
    labels, weight = [FIRST, SECOND, EQUAL, SECOND], [0.0] * (M - real) + [1.0] * real
    pairs, batch = pairs_of(labels, weight), batch_of()
    garbage = pairs._replace(
        observation=np.where(pairs.weight[:, None, None] > 0, pairs.observation, 1e3).astype(np.float32),
        second=np.where(pairs.weight > 0, pairs.second, FIRST).astype(np.float32),
    )
    clean = outer_step(reward_model, agent, batch, pairs, KEY, NUMBERS, False)
    assert_same(clean, outer_step(reward_model, agent, batch, garbage, KEY, NUMBERS, False))
    alone = FirstSteps(*(column[M - real :] for column in pairs))
    shorter, info = outer_step(reward_model, agent, batch, alone, KEY, NUMBERS, False)
    np.testing.assert_allclose(clean[1]["outer_loss"], info["outer_loss"], rtol=1e-5)
    for one, other in zip(flat(clean[0].adam.mu), flat(shorter.adam.mu), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-9)


def test_without_any_pair_the_gradient_is_nothing(agent: sac.Agent, reward_model: RewardModel):
    pairs = pairs_of([FIRST, SECOND], [0.0, 0.0])
    after, info = outer_step(reward_model, agent, batch_of(), pairs, KEY, NUMBERS, False)
    assert float(info["outer_loss"]) == 0
    assert_same(after.members, reward_model.members)


@pytest.mark.parametrize("separate", [False, True])
def test_the_outer_step_moves_the_moments_of_its_own_adam_or_of_the_fits(
    agent: sac.Agent, reward_model: RewardModel, separate: bool
):
    after, _ = outer_step(reward_model, agent, batch_of(), pairs_of([FIRST, SECOND]), KEY, NUMBERS, separate)
    used, unused = ("outer_adam", "adam") if separate else ("adam", "outer_adam")
    assert_same(getattr(after, unused), getattr(reward_model, unused))
    assert int(getattr(after, used).count) == 1 and np.any(getattr(after, used).mu.weights[0])


def test_the_shared_adam_carries_the_fits_momentum_into_the_outer_step_and_a_separate_one_does_not(
    agent: sac.Agent, reward_model: RewardModel
):
    """With no pair at all the gradient is nothing, so whatever still moves is left-over momentum."""
    warm = reward_model._replace(adam=reward_model.adam._replace(mu=jax.tree.map(jnp.ones_like, reward_model.adam.mu)))
    pairs = pairs_of([FIRST], [0.0])
    shared, _ = outer_step(warm, agent, batch_of(), pairs, KEY, NUMBERS, False)
    separate, _ = outer_step(warm, agent, batch_of(), pairs, KEY, NUMBERS, True)
    assert not np.array_equal(shared.members.weights[0], warm.members.weights[0])
    assert_same(separate.members, warm.members)
