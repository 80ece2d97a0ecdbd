"""The reward ensemble and its Bradley-Terry fit (Eq. 1 and 2; PEBBLE).

Each member is a perceptron on (observation, action) with LeakyReLU and a tanh at its end; the learned reward
is the mean over the members, in [-1, 1]. The logit of a segment is the plain sum of its rewards.
Observations enter as they come (the papers), or standardised (ours: `Scaling`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from senior.agent.networks import MLP, adam, apply_mlp, descend, fan_in_uniform, init_mlp

PART = 32
"""Pairs whose gradient is computed at a time; those of a mini-batch are added up. A fit costs what its labels cost."""

EQUAL = 0.5
"""P(second preferred) of a pair called equal. Such a pair counts in the loss and not in the accuracy."""

FARTHEST = 10.0
"""Deviations beyond which a standardised entry is cut off: what hardly moved so far may move at last."""


class Scaling(NamedTuple):
    """What standardises observations before they enter the members (not in the papers)."""

    mean: Float[Array, " o"]
    deviation: Float[Array, " o"]

    @classmethod
    def of(cls, mean: Float[Array, " o"], variance: Float[Array, " o"]) -> Scaling:
        """By those moments. An entry that deviates less than a thousandth of what the most varied one does counts as
        if it did that much, so that the noise of what stands still remains small."""
        deviation = jnp.sqrt(variance)
        return cls(mean, jnp.maximum(deviation, jnp.maximum(1e-3 * deviation.max(), 1e-8)))

    def standardise(self, observation: Float[Array, "*b o"]) -> Float[Array, "*b o"]:
        """Every entry in deviations from its mean, within ``FARTHEST``."""
        return jnp.clip((observation - self.mean) / self.deviation, -FARTHEST, FARTHEST)


class RewardModel(NamedTuple):
    """Members (leading axis) with one Adam over all of them, and the outer step's own Adam where it has one."""

    members: MLP
    adam: optax.OptState
    outer_adam: optax.OptState
    scaling: Scaling | None = None  # None: observations enter as they come


class Labelled(NamedTuple):
    """Labelled pairs in arrays of fixed capacity ``n``; the first ``count`` rows hold labels."""

    observation: Float[Array, "n 2 H o"]
    action: Float[Array, "n 2 H a"]
    second: Float[Array, " n"]  # P(second preferred)
    count: Int[Array, ""]


class FitNumbers(NamedTuple):
    """Numeric settings of a fit, traced."""

    rate: Float[Array, ""] | float
    epochs: Int[Array, ""] | int
    stop_accuracy: Float[Array, ""] | float


class Snippets(NamedTuple):
    """QPA's augmentation: random windows that stand for each pair (Hu et al. 2024)."""

    copies: int  # tau
    shortest: int  # steps
    longest: int


def window_sums(rewards: Float[Array, "b 2 H"], snippets: Snippets, key: PRNGKeyArray) -> Float[Array, "b copies 2"]:
    """Sums of rewards within random windows: one length per copy for both segments, a start for each.

    The rewards are computed once and summed under masks, instead of computing every copy anew.
    """
    pairs, _, steps = rewards.shape
    key_length, key_start = jax.random.split(key)
    length = jax.random.randint(key_length, (pairs, snippets.copies, 1), snippets.shortest, snippets.longest + 1)
    start = jax.random.randint(key_start, (pairs, snippets.copies, 2), 0, steps - length + 1)
    step = jnp.arange(steps)
    inside = (step >= start[..., None]) & (step < (start + length)[..., None])  # [b, copies, 2, H]
    return jnp.einsum("bch,bkch->bkc", rewards, inside.astype(rewards.dtype))


def init(key: PRNGKeyArray, members: int, size_in: int, layers: int, width: int) -> RewardModel:
    """A new ensemble; every member from its own key."""
    made = jax.vmap(lambda k: init_mlp(k, size_in, layers, width, 1, fan_in_uniform))(jax.random.split(key, members))
    return RewardModel(made, adam.init(made), adam.init(made))  # pyright: ignore[reportArgumentType]


def member_reward(
    member: MLP, observation: Float[Array, "*b o"], action: Float[Array, "*b a"], scaling: Scaling | None
) -> Float[Array, "*b"]:
    """Reward of one member, in [-1, 1]. ``scaling`` None: observations enter as they come."""
    if scaling is not None:
        observation = scaling.standardise(observation)
    x = jnp.concatenate([observation, action], axis=-1)
    return jnp.tanh(apply_mlp(member, x, jax.nn.leaky_relu)[..., 0])


def rewards(
    members: MLP, observation: Float[Array, "*b o"], action: Float[Array, "*b a"], scaling: Scaling | None
) -> Float[Array, "members ..."]:
    """Reward of every member; ``scaling`` as in `member_reward`."""
    return jax.vmap(member_reward, in_axes=(0, None, None, None))(members, observation, action, scaling)


def targets(second: Float[Array, " n"]) -> Float[Array, "n 2"]:
    """(1, 0) where the first is preferred, (0, 1) where the second is, (0.5, 0.5) where they are equal."""
    return jnp.stack([1 - second, second], axis=-1)


def cross_entropy(logits: Float[Array, "*n 2"], target: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Bradley-Terry's loss of each pair (Eq. 2)."""
    return -jnp.sum(target * jax.nn.log_softmax(logits), axis=-1)


def fit(
    model: RewardModel,
    labelled: Labelled,
    key: PRNGKeyArray,
    batch: int,
    numbers: FitNumbers,
    snippets: Snippets | None = None,
) -> tuple[RewardModel, dict[str, Array]]:
    """Fit all members to all labels: up to ``epochs`` passes in mini-batches of ``batch`` pairs.

    snippets: fit to random windows of the segments instead of whole ones; every window counts like a pair, in the
    loss and in the accuracy.

    Every member sees the labels in an order of its own; the members' losses are summed and one Adam step is
    taken per mini-batch. The fit ends after an epoch whose accuracy, measured while it was trained, exceeds
    ``stop_accuracy``. With no label nothing changes. Shapes do not depend on the number of labels.
    """
    capacity = labelled.second.shape[0]
    batch = min(batch, capacity)
    part = min(PART, batch)
    count = labelled.count
    n_members = model.members.weights[0].shape[0]
    scaling = model.scaling
    target = targets(labelled.second)
    decided = jnp.sum((labelled.second != EQUAL) & (jnp.arange(capacity) < count))

    def loss_of(
        members: MLP, rows: Int[Array, "m b"], weight: Float[Array, " b"], key: PRNGKeyArray
    ) -> tuple[Array, Array]:
        """Summed over members, weighted over pairs; and how many predictions were right."""

        def of_member(member: MLP, own: Int[Array, " b"], key: PRNGKeyArray) -> tuple[Array, Array]:
            reward = member_reward(member, labelled.observation[own], labelled.action[own], scaling)
            logits = window_sums(reward, snippets, key) if snippets else reward.sum(axis=-1)[:, None]  # [b, copies, 2]
            right = (logits[..., 1] > logits[..., 0]) == (labelled.second[own] > EQUAL)[:, None]
            counted = right.mean(axis=1) * ((weight > 0) & (labelled.second[own] != EQUAL))
            losses = cross_entropy(logits, target[own][:, None]).mean(axis=1)
            return jnp.sum(losses * weight), counted.sum()

        losses, right = jax.vmap(of_member)(members, rows, jax.random.split(key, n_members))
        return losses.sum(), right.sum()

    def epoch(carry: tuple[RewardModel, Array, Array]) -> tuple[RewardModel, Array, Array]:
        model, done, _ = carry
        key_epoch = jax.random.fold_in(key, done)
        draw = jax.random.uniform(key_epoch, (n_members, capacity))
        order = jnp.argsort(jnp.where(jnp.arange(capacity) < count, draw, jnp.inf), axis=1)
        order = jnp.pad(order, ((0, 0), (0, batch + part)))

        def minibatch(i: Array, carry: tuple[RewardModel, Array]) -> tuple[RewardModel, Array]:
            model, right = carry
            size = jnp.minimum(batch, count - i * batch)

            def add(j: Array, carry: tuple[MLP, Array]) -> tuple[MLP, Array]:
                gradient, right = carry
                rows = jax.lax.dynamic_slice_in_dim(order, i * batch + j * part, part, axis=1)
                weight = (j * part + jnp.arange(part) < size) / size
                key_part = jax.random.fold_in(key_epoch, 1 + i * batch + j * part)
                (_, hits), more = jax.value_and_grad(loss_of, has_aux=True)(model.members, rows, weight, key_part)
                return jax.tree.map(jnp.add, gradient, more), right + hits

            nothing = jax.tree.map(jnp.zeros_like, model.members)
            gradient, right = jax.lax.fori_loop(0, (size + part - 1) // part, add, (nothing, right))
            members, state = descend(model.members, gradient, model.adam, numbers.rate)
            return model._replace(members=members, adam=state), right

        batches = (count + batch - 1) // batch
        model, right = jax.lax.fori_loop(0, batches, minibatch, (model, jnp.zeros(())))
        return model, done + 1, right / (n_members * jnp.maximum(decided, 1))

    def wanted(carry: tuple[RewardModel, Array, Array]) -> Array:
        _, done, accuracy = carry
        return (count > 0) & (done < numbers.epochs) & (accuracy <= numbers.stop_accuracy)

    start = (model, jnp.zeros((), jnp.int32), jnp.zeros(()))
    model, epochs, accuracy = jax.lax.while_loop(wanted, epoch, start)
    return model, {"fit_epochs": epochs, "fit_accuracy": accuracy}
