"""Meta-Reward-Net's outer step (Liu et al. 2022): improve the reward model by what it makes of the critics.

Inner: one plain gradient step of virtual critics on the learned reward of a uniform batch, kept as a function
of the reward model. Outer: the virtual critics' preference loss on the latest labelled pairs, read at the
first step of each segment, is differentiated through that step back into the reward model.
The live agent is only read: the ordinary update of the step follows as always (paper, Algorithm 1), where the
public code folds the two into one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from senior.agent import sac
from senior.agent.networks import MLP, Arithmetic, descend
from senior.reward.model import RewardModel, Scaling, cross_entropy, rewards, targets
from senior.types import Batch


class FirstSteps(NamedTuple):
    """The latest labelled pairs, of which only the first step of each segment is looked at."""

    observation: Float[Array, "m 2 o"]
    action: Float[Array, "m 2 a"]
    second: Float[Array, " m"]  # P(second preferred)
    weight: Float[Array, " m"]  # 1 where the row holds a pair, 0 where it is padding


class OuterNumbers(NamedTuple):
    """Numeric settings of the outer step, traced."""

    inner_rate: Float[Array, ""] | float  # the critics' learning rate at that step
    rate: Float[Array, ""] | float
    weight: Float[Array, ""] | float
    discount: Float[Array, ""] | float


def outer_loss(
    members: MLP,
    critics: MLP,
    batch: Batch,
    next_value: Float[Array, " b"],
    pairs: FirstSteps,
    numbers: OuterNumbers,
    scaling: Scaling | None,
    arithmetic: Arithmetic = sac.FLOAT32,
) -> Float[Array, ""]:
    """Preference loss of critics moved one step by the learned reward; differentiable in ``members``.

    scaling: the reward model's.
    """
    reward = rewards(members, batch.observation, batch.action, scaling).mean(axis=0)
    target = reward + numbers.discount * batch.bootstrap * next_value

    def inner_loss(critics: MLP) -> Array:
        q = sac.values(critics, batch.observation, batch.action, arithmetic)
        return jnp.mean((q - target) ** 2, axis=1).sum()

    gradient = jax.grad(inner_loss)(critics)
    virtual = jax.tree.map(lambda parameter, step: parameter - numbers.inner_rate * step, critics, gradient)
    m = pairs.second.shape[0]
    q = sac.values(virtual, pairs.observation.reshape(2 * m, -1), pairs.action.reshape(2 * m, -1), arithmetic)
    losses = cross_entropy(q.reshape(2, m, 2), targets(pairs.second))  # [critic, pair]
    return numbers.weight * jnp.sum(losses @ pairs.weight) / jnp.maximum(pairs.weight.sum(), 1)


def outer_step(
    model: RewardModel,
    agent: sac.Agent,
    batch: Batch,
    pairs: FirstSteps,
    key: PRNGKeyArray,
    numbers: OuterNumbers,
    separate: bool,
    arithmetic: Arithmetic = sac.FLOAT32,
) -> tuple[RewardModel, dict[str, Array]]:
    """One Adam step of the reward model on the outer loss; ``separate``: with an Adam of its own."""
    next_value = jax.lax.stop_gradient(sac.next_value(agent, batch, key, arithmetic))
    loss, gradient = jax.value_and_grad(outer_loss)(
        model.members, agent.critics, batch, next_value, pairs, numbers, model.scaling, arithmetic
    )
    state = model.outer_adam if separate else model.adam
    members, state = descend(model.members, gradient, state, numbers.rate)
    model = model._replace(members=members, **{"outer_adam" if separate else "adam": state})
    return model, {"outer_loss": loss}
