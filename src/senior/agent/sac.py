"""Soft actor-critic (Haarnoja et al. 2018), in the form that PEBBLE and its successors run on Meta-World.

Two critics share one `MLP` with a leading axis of 2. The reward of an update is an argument, not a column of
the batch: what it is made of (true reward, state entropy, learned reward plus bonus) is the caller's matter.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from senior.agent.networks import MLP, Arithmetic, Product, adam, apply_mlp, descend, init_mlp, orthogonal
from senior.types import Batch

LOG_STD_RANGE = (-5.0, 2.0)
FLOAT32 = Arithmetic()


class Agent(NamedTuple):
    """Everything that SAC learns."""

    actor: MLP
    critics: MLP  # leading axis 2
    targets: MLP  # leading axis 2
    log_alpha: Float[Array, ""]
    actor_adam: optax.OptState
    critic_adam: optax.OptState
    alpha_adam: optax.OptState


class Numbers(NamedTuple):
    """Numeric hyper-parameters, traced."""

    actor_rate: Float[Array, ""] | float
    critic_rate: Float[Array, ""] | float
    alpha_rate: Float[Array, ""] | float
    discount: Float[Array, ""] | float
    tau: Float[Array, ""] | float
    target_entropy: Float[Array, ""] | float  # per action dimension


def init(
    key: PRNGKeyArray, observation_size: int, action_size: int, layers: int, width: int, alpha: Array | float
) -> Agent:
    """A new agent; ``alpha`` is the first temperature."""
    key_actor, key_critics = jax.random.split(key)
    actor = init_mlp(key_actor, observation_size, layers, width, 2 * action_size, orthogonal)
    critics = _init_critics(key_critics, observation_size + action_size, layers, width)
    log_alpha = jnp.log(jnp.asarray(alpha, jnp.float32))
    return Agent(
        actor,
        critics,
        jax.tree.map(jnp.copy, critics),
        log_alpha,
        adam.init(actor),  # pyright: ignore[reportArgumentType]
        adam.init(critics),  # pyright: ignore[reportArgumentType]
        adam.init(log_alpha),
    )


def _init_critics(key: PRNGKeyArray, size_in: int, layers: int, width: int) -> MLP:
    return jax.vmap(lambda k: init_mlp(k, size_in, layers, width, 1, orthogonal))(jax.random.split(key))


def renew_critics(agent: Agent, key: PRNGKeyArray) -> Agent:
    """New critics, targets and critic optimiser; the actor and the temperature stay (end of pre-training)."""
    size_in, width = agent.critics.weights[0].shape[-2:]
    critics = _init_critics(key, size_in, len(agent.critics.weights) - 1, width)
    return agent._replace(
        critics=critics,
        targets=jax.tree.map(jnp.copy, critics),
        critic_adam=adam.init(critics),  # pyright: ignore[reportArgumentType]
    )


def distribution(
    actor: MLP, observation: Float[Array, "*b o"], product: Product = jnp.matmul
) -> tuple[Float[Array, "*b a"], Float[Array, "*b a"]]:
    """Mean and log standard deviation of the Gaussian before squashing; the latter is kept in its range by a tanh."""
    mean, raw = jnp.split(apply_mlp(actor, observation, jax.nn.relu, product), 2, axis=-1)
    low, high = LOG_STD_RANGE
    return mean, low + 0.5 * (high - low) * (jnp.tanh(raw) + 1)


def sample(
    actor: MLP, observation: Float[Array, "*b o"], key: PRNGKeyArray, product: Product = jnp.matmul
) -> tuple[Float[Array, "*b a"], Float[Array, "*b"]]:
    """A squashed Gaussian action in [-1, 1] and its log probability."""
    mean, log_std = distribution(actor, observation, product)
    noise = jax.random.normal(key, mean.shape)
    u = mean + jnp.exp(log_std) * noise
    gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    squash = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))  # log of d tanh(u) / du
    return jnp.tanh(u), jnp.sum(gaussian - squash, axis=-1)


def mean_action(actor: MLP, observation: Float[Array, "*b o"]) -> Float[Array, "*b a"]:
    """The action that evaluation takes, in [-1, 1]."""
    return jnp.tanh(distribution(actor, observation)[0])


def values(
    critics: MLP, observation: Float[Array, "b o"], action: Float[Array, "b a"], arithmetic: Arithmetic = FLOAT32
) -> Float[Array, "2 b"]:
    """Q of both critics."""
    x = jnp.concatenate([observation, action], axis=-1)
    return jax.vmap(lambda one: apply_mlp(one, x, *arithmetic)[..., 0])(critics)


def next_value(agent: Agent, batch: Batch, key: PRNGKeyArray, arithmetic: Arithmetic = FLOAT32) -> Float[Array, " b"]:
    """min_j Q_j'(s', a') - alpha log pi(a' | s'), with a' drawn from the policy."""
    action, log_prob = sample(agent.actor, batch.next_observation, key, arithmetic.product)
    target = values(agent.targets, batch.next_observation, action, arithmetic).min(axis=0)
    return target - jnp.exp(agent.log_alpha) * log_prob


def update_critics(
    agent: Agent,
    batch: Batch,
    reward: Float[Array, " b"],
    key: PRNGKeyArray,
    numbers: Numbers,
    arithmetic: Arithmetic = FLOAT32,
) -> tuple[Agent, dict[str, Array]]:
    """One Adam step of both critics towards r + gamma m V(s')."""
    target = reward + numbers.discount * batch.bootstrap * next_value(agent, batch, key, arithmetic)

    def loss_of(critics: MLP) -> tuple[Array, Array]:
        q = values(critics, batch.observation, batch.action, arithmetic)
        return jnp.mean((q - target) ** 2, axis=1).sum(), q.mean()

    (loss, q), gradient = jax.value_and_grad(loss_of, has_aux=True)(agent.critics)
    critics, state = descend(agent.critics, gradient, agent.critic_adam, numbers.critic_rate)
    return agent._replace(critics=critics, critic_adam=state), {"critic_loss": loss, "q": q}


def update_actor(
    agent: Agent, batch: Batch, key: PRNGKeyArray, numbers: Numbers, arithmetic: Arithmetic = FLOAT32
) -> tuple[Agent, dict[str, Array]]:
    """One Adam step of the actor on alpha log pi - min_j Q_j."""

    def loss_of(actor: MLP) -> tuple[Array, Array]:
        action, log_prob = sample(actor, batch.observation, key, arithmetic.product)
        q = values(agent.critics, batch.observation, action, arithmetic).min(axis=0)
        return jnp.mean(jnp.exp(agent.log_alpha) * log_prob - q), -log_prob.mean()

    (loss, entropy), gradient = jax.value_and_grad(loss_of, has_aux=True)(agent.actor)
    actor, state = descend(agent.actor, gradient, agent.actor_adam, numbers.actor_rate)
    return agent._replace(actor=actor, actor_adam=state), {"actor_loss": loss, "entropy": entropy}


def update_temperature(
    agent: Agent, entropy: Float[Array, ""], action_size: int, numbers: Numbers
) -> tuple[Agent, dict[str, Array]]:
    """One Adam step of log alpha that draws the policy's entropy towards its target."""
    gradient = jnp.exp(agent.log_alpha) * (entropy - numbers.target_entropy * action_size)
    log_alpha, state = descend(agent.log_alpha, gradient, agent.alpha_adam, numbers.alpha_rate)
    return agent._replace(log_alpha=log_alpha, alpha_adam=state), {"alpha": jnp.exp(log_alpha)}


def update(
    agent: Agent,
    batch: Batch,
    reward: Float[Array, " b"],
    key: PRNGKeyArray,
    numbers: Numbers,
    move_targets: Array | bool,
    arithmetic: Arithmetic = FLOAT32,
) -> tuple[Agent, dict[str, Array]]:
    """Critics, actor, temperature, and the targets where ``move_targets`` is true, all on one batch."""
    key_critics, key_actor = jax.random.split(key)
    agent, of_critics = update_critics(agent, batch, reward, key_critics, numbers, arithmetic)
    agent, of_actor = update_actor(agent, batch, key_actor, numbers, arithmetic)
    agent, of_alpha = update_temperature(agent, of_actor["entropy"], batch.action.shape[-1], numbers)
    tau = jnp.where(move_targets, numbers.tau, 0.0)
    targets = jax.tree.map(lambda slow, fast: slow + tau * (fast - slow), agent.targets, agent.critics)
    return agent._replace(targets=targets), {**of_critics, **of_actor, **of_alpha}
