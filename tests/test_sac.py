"""Soft actor-critic held to NumPy in float64, and to tasks whose Q-values are known."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior.agent import sac
from senior.agent.networks import MLP, Arithmetic, normalised_relu
from senior.types import Batch, Source
from tests.numeric import Arrays, numeric_gradient

O, A, B = 3, 2, 6
NUMBERS = sac.Numbers(actor_rate=1e-3, critic_rate=2e-3, alpha_rate=5e-3, discount=0.9, tau=0.25, target_entropy=-1.5)


def agent_of(seed: int, layers: int = 2, width: int = 5, alpha: float = 0.3) -> sac.Agent:
    """A small agent whose targets and biases differ from what they begin as."""
    agent = sac.init(jax.random.key(seed), O, A, layers, width, alpha)
    rng = np.random.default_rng(seed)

    def shaken(tree: MLP) -> MLP:
        return jax.tree.map(lambda x: x + jnp.asarray(0.2 * rng.normal(size=x.shape), jnp.float32), tree)

    return agent._replace(
        actor=shaken(agent.actor),
        critics=shaken(agent.critics),
        targets=shaken(agent.targets),
    )


def batch_of(seed: int, size: int = B) -> Batch:
    """Random transitions, about half of which end their episode."""
    rng = np.random.default_rng(seed)
    nothing = np.zeros(size, np.float32)
    return Batch(
        observation=rng.normal(size=(size, O)).astype(np.float32),
        action=rng.uniform(-1, 1, (size, A)).astype(np.float32),
        reward=rng.normal(size=size).astype(np.float32),
        next_observation=rng.normal(size=(size, O)).astype(np.float32),
        bootstrap=(rng.random(size) < 0.5).astype(np.float32),
        learned_reward=nothing,
        spread=nothing,
        source=np.full(size, Source.REPLAY, np.int32),
        row=np.arange(size),
    )


# The same in NumPy, one net at a time.


def net(parameters: Sequence[np.ndarray], x: np.ndarray, normalised: bool = False) -> np.ndarray:
    """Perceptron of the parameters ``[w0, w1, ..., b0, b1, ...]`` with ReLU, each layer normalised before it or not."""
    half = len(parameters) // 2
    for i, (weight, bias) in enumerate(zip(parameters[:half], parameters[half:], strict=True)):
        x = x @ weight + bias
        if i < half - 1 and normalised:
            x = (x - x.mean(axis=-1, keepdims=True)) / np.sqrt(x.var(axis=-1, keepdims=True) + 1e-5)
        x = np.maximum(x, 0) if i < half - 1 else x
    return x


def flat(tree: MLP) -> Arrays:
    return [np.asarray(x, np.float64) for x in (*tree.weights, *tree.biases)]


def q_values(critics: Arrays, observation: np.ndarray, action: np.ndarray, normalised: bool = False) -> np.ndarray:
    x = np.concatenate([observation, action], axis=-1)
    return np.stack([net([p[j] for p in critics], x, normalised)[:, 0] for j in (0, 1)])


def policy(actor: Arrays, observation: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squashed action and its log probability, by the change of variables."""
    out = net(actor, observation)
    mean, raw = out[..., :A], out[..., A:]
    deviation = np.exp(-5 + 3.5 * (np.tanh(raw) + 1))
    u = mean + deviation * noise
    gaussian = -0.5 * ((u - mean) / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
    return np.tanh(u), (gaussian - np.log(1 - np.tanh(u) ** 2)).sum(axis=-1)


def noise_of(key: jax.Array, size: int = B) -> np.ndarray:
    return np.asarray(jax.random.normal(key, (size, A)), np.float64)


def adam_direction(gradient: np.ndarray) -> np.ndarray:
    """What Adam makes of its very first gradient."""
    return gradient / (np.abs(gradient) + 1e-8)


def assert_first_adam_step(before: MLP, after: MLP, moments: MLP, gradient: Arrays, rate: float) -> None:
    """The gradient is in Adam's first moment, and the parameters moved by the rate against its sign."""
    for old, new, moment, g in zip(flat(before), flat(after), flat(moments), gradient, strict=True):
        np.testing.assert_allclose(moment / 0.1, g, rtol=2e-4, atol=2e-5)
        clear = np.abs(g) > 1e-4
        np.testing.assert_allclose((new - old)[clear], -rate * adam_direction(g)[clear], rtol=1e-2)


# The policy.


def test_log_probability_is_the_change_of_variables_in_numbers():
    """The density of a = tanh(u) is that of u over da/du, taken here by differences."""
    agent, observation = agent_of(0), batch_of(1, 200).observation
    action, log_prob = jax.jit(sac.sample)(agent.actor, observation, jax.random.key(2))
    mean, log_std = (np.asarray(x, np.float64) for x in sac.distribution(agent.actor, observation))
    noise = noise_of(jax.random.key(2), 200)
    u = mean + np.exp(log_std) * noise
    slope = (np.tanh(u + 1e-6) - np.tanh(u - 1e-6)) / 2e-6
    density = np.exp(-0.5 * noise**2) / (np.exp(log_std) * np.sqrt(2 * np.pi)) / slope
    clear = (slope > 1e-4).all(axis=1)
    assert clear.sum() > 100
    np.testing.assert_allclose(np.asarray(action), np.tanh(u), atol=1e-5)
    np.testing.assert_allclose(np.asarray(log_prob)[clear], np.log(density).sum(axis=1)[clear], atol=1e-3)


def test_log_probability_is_finite_where_the_squash_saturates():
    actor = sac.init(jax.random.key(0), O, A, 1, 4, 0.1).actor
    actor = actor._replace(biases=(actor.biases[0], jnp.array([60.0, -60.0, 0.0, 0.0])))
    action, log_prob = sac.sample(actor, jnp.zeros(O), jax.random.key(1))
    assert np.isfinite(log_prob) and np.abs(action).max() <= 1


@pytest.mark.parametrize(
    ("raw", "expected"), [(-100.0, -5.0), (0.0, -1.5), (100.0, 2.0), (0.5, -1.5 + 3.5 * np.tanh(0.5))]
)
def test_log_std_is_kept_in_its_bounds_by_a_tanh(raw: float, expected: float):
    actor = sac.init(jax.random.key(0), O, A, 1, 4, 0.1).actor
    actor = actor._replace(biases=(actor.biases[0], jnp.array([0.0, 0.0, raw, raw])))
    _, log_std = sac.distribution(actor, jnp.zeros(O))
    np.testing.assert_allclose(log_std, expected, atol=1e-5)


def test_the_action_of_evaluation_is_the_squashed_mean():
    agent, observation = agent_of(3), batch_of(4).observation
    expected = np.tanh(net(flat(agent.actor), observation)[:, :A])
    np.testing.assert_allclose(sac.mean_action(agent.actor, observation), expected, atol=1e-5)


# How it begins.


def test_layers_begin_orthogonal_with_zero_biases():
    agent = sac.init(jax.random.key(0), 7, A, 3, 16, 0.1)
    critics = [jax.tree.map(lambda x, j=j: x[j], agent.critics) for j in (0, 1)]
    for mlp in (agent.actor, *critics):
        assert [w.shape[1] for w in mlp.weights[:-1]] == [16, 16, 16]
        assert all(not np.any(bias) for bias in mlp.biases)
        for weight in map(np.asarray, mlp.weights):
            narrow = weight if weight.shape[0] >= weight.shape[1] else weight.T
            np.testing.assert_allclose(narrow.T @ narrow, np.eye(narrow.shape[1]), atol=1e-5)
    assert not np.array_equal(agent.critics.weights[0][0], agent.critics.weights[0][1])
    assert all(map(np.array_equal, jax.tree.leaves(agent.critics), jax.tree.leaves(agent.targets)))
    np.testing.assert_allclose(np.exp(agent.log_alpha), 0.1, rtol=1e-6)


# One update against gradients by finite differences.

NORMALISED = pytest.mark.parametrize("normalised", [False, True])


@NORMALISED
def test_critics_descend_on_the_squared_error_to_the_bootstrapped_target(normalised: bool):
    """y = r + gamma m (min Q'(s', a') - alpha log pi(a'|s')); the loss is the sum of both mean squared errors."""
    agent, batch, key = agent_of(5), batch_of(6), jax.random.key(7)
    assert 0 < batch.bootstrap.sum() < B
    reward = np.linspace(-1, 2, B)
    arithmetic = Arithmetic(normalised_relu if normalised else jax.nn.relu)
    update = jax.jit(sac.update_critics, static_argnums=5)
    after, info = update(agent, batch, jnp.asarray(reward), key, NUMBERS, arithmetic)

    action, log_prob = policy(flat(agent.actor), batch.next_observation, noise_of(key))
    value = q_values(flat(agent.targets), batch.next_observation, action, normalised).min(axis=0)
    target = reward + 0.9 * batch.bootstrap * (value - np.exp(float(agent.log_alpha)) * log_prob)

    def loss(critics: Arrays) -> float:
        return ((q_values(critics, batch.observation, batch.action, normalised) - target) ** 2).mean(axis=1).sum()

    np.testing.assert_allclose(info["critic_loss"], loss(flat(agent.critics)), rtol=1e-4)
    gradient = numeric_gradient(loss, flat(agent.critics))
    assert_first_adam_step(agent.critics, after.critics, after.critic_adam.mu, gradient, NUMBERS.critic_rate)
    assert_same(agent._replace(critics=None, critic_adam=None), after._replace(critics=None, critic_adam=None))


@NORMALISED
def test_actor_descends_on_alpha_log_pi_minus_the_smaller_q(normalised: bool):
    agent, batch, key = agent_of(8), batch_of(9), jax.random.key(10)
    arithmetic = Arithmetic(normalised_relu if normalised else jax.nn.relu)
    after, info = jax.jit(sac.update_actor, static_argnums=4)(agent, batch, key, NUMBERS, arithmetic)
    critics, noise, alpha = flat(agent.critics), noise_of(key), np.exp(float(agent.log_alpha))

    def loss(actor: Arrays) -> float:
        action, log_prob = policy(actor, batch.observation, noise)
        return (alpha * log_prob - q_values(critics, batch.observation, action, normalised).min(axis=0)).mean()

    np.testing.assert_allclose(info["actor_loss"], loss(flat(agent.actor)), rtol=1e-4)
    log_prob = policy(flat(agent.actor), batch.observation, noise)[1]
    np.testing.assert_allclose(info["entropy"], -log_prob.mean(), rtol=1e-4)
    gradient = numeric_gradient(loss, flat(agent.actor))
    assert_first_adam_step(agent.actor, after.actor, after.actor_adam.mu, gradient, NUMBERS.actor_rate)
    others = dict.fromkeys(("actor", "actor_adam"))
    assert_same(agent._replace(**others), after._replace(**others))


@pytest.mark.parametrize("entropy", [-5.0, -2.0, 1.0])
def test_temperature_draws_the_entropy_towards_its_target(entropy: float):
    agent = agent_of(11)
    after, info = sac.update_temperature(agent, jnp.float32(entropy), A, NUMBERS)

    def loss(log_alpha: Arrays) -> float:
        return float(np.exp(log_alpha[0][0]) * (entropy - (-1.5 * A)))  # -log pi is the entropy

    (gradient,) = numeric_gradient(loss, [np.array([float(agent.log_alpha)])])
    np.testing.assert_allclose(after.alpha_adam.mu / 0.1, gradient[0], rtol=1e-4, atol=1e-8)
    moved = float(after.log_alpha - agent.log_alpha)
    np.testing.assert_allclose(moved, -NUMBERS.alpha_rate * np.sign(entropy + 1.5 * A), rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(info["alpha"], np.exp(after.log_alpha), rtol=1e-6)


def test_an_update_is_critics_then_actor_then_temperature_on_one_batch():
    """The actor is judged by the critics just moved; the temperature sees the entropy of the actor's own draw."""
    agent, batch, key = agent_of(12), batch_of(13), jax.random.key(14)
    after, info = jax.jit(sac.update)(agent, batch, batch.reward, key, NUMBERS, True)
    noise, alpha = noise_of(jax.random.split(key)[1]), np.exp(float(agent.log_alpha))

    def loss(actor: Arrays) -> float:
        action, log_prob = policy(actor, batch.observation, noise)
        q = q_values(flat(after.critics), batch.observation, action)
        return (alpha * log_prob - q.min(axis=0)).mean()

    np.testing.assert_allclose(info["actor_loss"], loss(flat(agent.actor)), rtol=1e-4)
    gradient = numeric_gradient(loss, flat(agent.actor))
    assert_first_adam_step(agent.actor, after.actor, after.actor_adam.mu, gradient, NUMBERS.actor_rate)
    entropy = -policy(flat(agent.actor), batch.observation, noise)[1].mean()
    np.testing.assert_allclose(after.alpha_adam.mu / 0.1, alpha * (entropy + 1.5 * A), rtol=1e-3)
    assert [int(s.count) for s in (after.critic_adam, after.actor_adam, after.alpha_adam)] == [1, 1, 1]


# Target networks, renewed critics, the average.


def assert_same(one: object, other: object) -> None:
    """Equal bit for bit."""
    left, right = jax.tree.leaves(one), jax.tree.leaves(other)
    assert len(left) == len(right)
    assert all(np.array_equal(a, b) for a, b in zip(left, right, strict=True))


def test_targets_move_a_share_tau_towards_the_new_critics_and_only_when_told():
    agent, batch, key = agent_of(15), batch_of(16), jax.random.key(17)
    update = jax.jit(sac.update)
    still, _ = update(agent, batch, batch.reward, key, NUMBERS, False)
    moved, _ = update(agent, batch, batch.reward, key, NUMBERS, True)
    assert_same(still.targets, agent.targets)
    assert_same(still._replace(targets=None), moved._replace(targets=None))
    for old, new, critic in zip(flat(agent.targets), flat(moved.targets), flat(moved.critics), strict=True):
        np.testing.assert_allclose(new, 0.75 * old + 0.25 * critic, atol=1e-6)


def test_renewed_critics_take_targets_and_optimiser_along_and_leave_actor_and_temperature():
    agent, batch = agent_of(18), batch_of(19)
    agent, _ = jax.jit(sac.update)(agent, batch, batch.reward, jax.random.key(20), NUMBERS, True)
    new = sac.renew_critics(agent, jax.random.key(21))
    for name in ("actor", "log_alpha", "actor_adam", "alpha_adam"):
        assert_same(getattr(new, name), getattr(agent, name))
    for old, fresh in zip(agent.critics.weights, new.critics.weights, strict=True):
        assert old.shape == fresh.shape and not np.any(old == fresh)
    assert all(not np.any(bias) for bias in new.critics.biases)
    assert_same(new.targets, new.critics)
    assert int(agent.critic_adam.count) == 1
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(new.critic_adam))


# A task with a known Q.


def test_q_of_a_constant_reward_is_the_reward_or_its_geometric_sum():
    """Where every step ends the episode Q is r; where none does it is r / (1 - gamma)."""
    reward, batch = 3.0, batch_of(25, 32)
    numbers = NUMBERS._replace(discount=0.5, critic_rate=1e-2, actor_rate=0.0, alpha_rate=0.0, tau=0.1)

    @jax.jit
    def learned(agent: sac.Agent, bootstrap: jax.Array) -> jax.Array:
        own = batch._replace(bootstrap=jnp.full(32, bootstrap))

        def one(agent: sac.Agent, i: jax.Array) -> tuple[sac.Agent, None]:
            key = jax.random.fold_in(jax.random.key(1), i)
            return sac.update(agent, own, jnp.full(32, reward), key, numbers, i % 2 == 0)[0], None

        agent, _ = jax.lax.scan(one, agent, jnp.arange(2000))
        return sac.values(agent.critics, batch.observation, batch.action)

    agent = agent_of(26)._replace(log_alpha=jnp.log(1e-8))
    for bootstrap, q in ((0.0, reward), (1.0, reward / (1 - 0.5))):
        np.testing.assert_allclose(np.asarray(learned(agent, bootstrap)).mean(axis=1), q, rtol=0.05)


def test_no_layer_is_made_by_a_library_call_that_can_wait_for_ever():
    """JAX's QR can deadlock on a CPU of two cores (`networks.orthogonal`)."""
    text = jax.jit(lambda key: sac.init(key, 7, A, 3, 16, 0.1)).lower(jax.random.key(0)).as_text()
    assert "lapack" not in text
    assert "qr" not in text.lower().replace("sqrt", "")
