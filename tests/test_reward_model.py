"""The reward ensemble and its fit, held to NumPy in float64."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior.agent.networks import MLP, apply_mlp, fan_in_uniform
from senior.reward import model
from senior.reward.model import FitNumbers, Labelled, RewardModel, Snippets
from tests.numeric import Arrays, numeric_gradient

O, A, H, CAPACITY, BATCH = 3, 2, 4, 12, 8
FIRST, SECOND, EQUAL = 0.0, 1.0, 0.5
"""P(second preferred)."""
UNSURE = [0.25, 1.0, 2 / 3, 0.5, 0.0]
"""Labels of people who differ, or were not sure."""
RATE = 1e-3
ONE_EPOCH = FitNumbers(rate=RATE, epochs=1, stop_accuracy=0.97)


@cache
def fit(batch: int = BATCH, part: int = model.PART) -> Callable[..., tuple[RewardModel, dict[str, jax.Array]]]:
    """A compiled fit in mini-batches of ``batch`` pairs whose gradient is added up ``part`` pairs at a time."""

    def traced(*arguments: Any) -> tuple[RewardModel, dict[str, jax.Array]]:
        before, labelled, key, numbers = arguments
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(model, "PART", part)
            return model.fit(before, labelled, key, batch, numbers)

    return jax.jit(traced)


def model_of(seed: int = 0, members: int = 3, width: int = 5) -> RewardModel:
    return model.init(jax.random.key(seed), members, O + A, 2, width)


def labelled_of(labels: list[float], seed: int = 0, capacity: int = CAPACITY, garbage: float = 0.0) -> Labelled:
    """Random pairs with those labels; the rows beyond them hold garbage."""
    rng = np.random.default_rng(seed)
    observation = rng.normal(size=(capacity, 2, H, O)).astype(np.float32)
    action = rng.uniform(-1, 1, (capacity, 2, H, A)).astype(np.float32)
    second = np.full(capacity, 1 if garbage else 0, np.float32)
    count = len(labels)
    observation[count:], action[count:] = garbage, garbage
    second[:count] = labels
    return Labelled(observation, action, second, np.int32(count))  # pyright: ignore[reportArgumentType]


def mixed(count: int) -> list[float]:
    return [(FIRST, SECOND, EQUAL, SECOND)[i % 4] for i in range(count)]


def assert_same(one: object, other: object) -> None:
    """Equal bit for bit."""
    assert all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


# The same in NumPy.


def flat(tree: MLP) -> Arrays:
    return [np.asarray(x, np.float64) for x in (*tree.weights, *tree.biases)]


def reward_by_hand(members: Arrays, j: int, observation: np.ndarray, action: np.ndarray) -> np.ndarray:
    half, x = len(members) // 2, np.concatenate([observation, action], axis=-1).astype(np.float64)
    for i in range(half):
        x = x @ members[i][j] + members[half + i][j]
        if i < half - 1:
            x = np.where(x > 0, x, 0.01 * x)
    return np.tanh(x[..., 0])


def logits_by_hand(members: Arrays, j: int, labelled: Labelled) -> np.ndarray:
    """Summed, not averaged, rewards ``[count, 2]`` of both segments."""
    n = int(labelled.count)
    return reward_by_hand(members, j, labelled.observation[:n], labelled.action[:n]).sum(axis=-1)


def loss_by_hand(members: Arrays, labelled: Labelled) -> float:
    """Sum over members of the mean of -log P(answer); an equal pair answers half and half (Eq. 1, 2)."""
    n, total = int(labelled.count), 0.0
    for j in range(len(members[0])):
        for (first, second), label in zip(logits_by_hand(members, j, labelled), labelled.second, strict=False):
            p = np.exp(first) / (np.exp(first) + np.exp(second))
            total -= ((1 - float(label)) * np.log(p) + float(label) * np.log(1 - p)) / n
    return total


# The reward.


def test_every_member_is_a_leaky_perceptron_with_a_tanh_at_its_end():
    members, pairs = model_of(1).members, labelled_of(mixed(12))
    found = model.rewards(members, pairs.observation, pairs.action, None)
    assert found.shape == (3, 12, 2, H)
    for j in range(3):
        expected = reward_by_hand(flat(members), j, pairs.observation, pairs.action)
        np.testing.assert_allclose(found[j], expected, atol=1e-5)


def test_the_slope_below_zero_is_a_hundredth():
    identity = MLP((jnp.eye(2), jnp.eye(2)), (jnp.zeros(2), jnp.zeros(2)))
    assert np.allclose(apply_mlp(identity, jnp.array([-3.0, 2.0]), jax.nn.leaky_relu), [-0.03, 2.0])


def test_the_learned_reward_stays_in_its_range_however_large_the_weights_are():
    members = jax.tree.map(lambda x: 50 * x, model_of(2).members)
    pairs = labelled_of(mixed(12))
    every = np.asarray(model.rewards(members, 10 * pairs.observation, pairs.action, None))
    assert np.abs(every).max() > 0.9
    assert np.abs(every.mean(axis=0)).max() <= 1


def test_standardised_entries_have_mean_0_and_deviation_1_within_ten():
    """An entry that never moved, one that hardly did, and one that is far away now."""
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(500, O)) * [2.0, 0.0, 1e-5] + [5.0, 0.25, 0.0]
    scaling = model.Scaling.of(jnp.asarray(seen.mean(axis=0)), jnp.asarray(seen.var(axis=0)))
    found = np.asarray(scaling.standardise(jnp.asarray(seen, jnp.float32)))
    np.testing.assert_allclose(found[:, 0], (seen[:, 0] - seen[:, 0].mean()) / seen[:, 0].std(), atol=1e-4)
    assert np.all(np.abs(found[:, 1]) < 1e-3) and 0 < np.abs(found[:, 2]).max() < 0.1
    assert scaling.standardise(jnp.array([5.0, 1e6, -1e6])).tolist()[1:] == [10, -10]


def test_a_standardised_model_is_rewarded_and_fitted_as_a_plain_one_on_standardised_observations():
    """Its labels' observations are given as they come."""
    scaling = model.Scaling(jnp.array([0.5, -1.0, 0.0]), jnp.array([2.0, 0.5, 1.0]))
    plain, pairs = model_of(1), labelled_of(mixed(12))
    by_hand = pairs._replace(observation=(np.asarray(pairs.observation) - [0.5, -1, 0]) / np.array([2, 0.5, 1]))
    found = model.rewards(plain.members, pairs.observation, pairs.action, scaling)
    expected = model.rewards(plain.members, by_hand.observation, by_hand.action, None)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    fitted, _ = fit()(plain._replace(scaling=scaling), pairs, jax.random.key(0), ONE_EPOCH._replace(epochs=5))
    other, _ = fit()(plain, by_hand, jax.random.key(0), ONE_EPOCH._replace(epochs=5))
    assert_same(fitted.scaling, scaling)
    for one, two in zip(flat(fitted.members), flat(other.members), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-5)


@pytest.mark.parametrize("size_in", [4, 25])
def test_layers_begin_uniform_within_one_over_the_root_of_their_inputs(size_in: int):
    weight, bias = fan_in_uniform(jax.random.key(0), size_in, 3000)
    bound = 1 / np.sqrt(size_in)
    for drawn in (np.asarray(weight), np.asarray(bias)):
        assert bound * 0.99 < np.abs(drawn).max() <= bound
        np.testing.assert_allclose(drawn.std(), bound / np.sqrt(3), rtol=0.05)
        np.testing.assert_allclose(drawn.mean(), 0, atol=0.05 * bound)


def test_members_begin_different():
    first = np.asarray(model_of(3).members.weights[0])
    assert not np.any(first[0] == first[1]) and not np.any(first[1] == first[2])


def test_targets_are_one_hot_half_and_half_where_equal_and_between_where_people_differ():
    second = jnp.array([FIRST, SECOND, EQUAL, 0.25])
    assert model.targets(second).tolist() == [[1, 0], [0, 1], [0.5, 0.5], [0.75, 0.25]]


def test_cross_entropy_stays_finite_for_logits_far_apart():
    logits = jnp.array([[1000.0, -1000.0], [1000.0, -1000.0], [3.0, 3.0]])
    target = jnp.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])
    np.testing.assert_allclose(model.cross_entropy(logits, target), [0, 2000, np.log(2)], atol=1e-6)


# One mini-batch.


@pytest.mark.parametrize("labels", [[FIRST], [SECOND], [EQUAL], mixed(7), UNSURE], ids=str)
@pytest.mark.parametrize("part", [32, 3])
def test_a_step_follows_the_gradient_of_bradley_terry_on_summed_rewards(labels: list[float], part: int):
    """The gradient is read from Adam's first moment: means in place of sums, or over rows without a label, differ."""
    before, labelled = model_of(4), labelled_of(labels, garbage=3.0)
    after, _ = fit(part=part)(before, labelled, jax.random.key(0), ONE_EPOCH)
    gradient = numeric_gradient(lambda members: loss_by_hand(members, labelled), flat(before.members))
    for old, new, moment, g in zip(
        flat(before.members), flat(after.members), flat(after.adam.mu), gradient, strict=True
    ):
        np.testing.assert_allclose(moment / 0.1, g, rtol=1e-3, atol=1e-5)
        clear = np.abs(g) > 1e-3
        np.testing.assert_allclose((new - old)[clear], -RATE * np.sign(g[clear]), rtol=1e-2)
    assert_same(before.outer_adam, after.outer_adam)


def test_with_windows_the_fit_follows_their_mean_gradient_and_accuracy():
    """Windows of one step each, and so many that nearly all starts of both segments meet: the gradient is the mean over
    all pairs of single steps."""
    before, labelled = model_of(4, members=1), labelled_of([FIRST, SECOND], capacity=2)
    single = Snippets(copies=3000, shortest=1, longest=1)
    after, info = jax.jit(lambda m, l, k: model.fit(m, l, k, BATCH, ONE_EPOCH, single))(
        before, labelled, jax.random.key(0)
    )
    members = flat(before.members)

    def by_hand(members: Arrays) -> tuple[float, float]:
        losses, right = [], []
        reward = reward_by_hand(members, 0, np.asarray(labelled.observation), np.asarray(labelled.action))  # [2, 2, H]
        for pair, label in enumerate([FIRST, SECOND]):
            gap = reward[pair, 0][:, None] - reward[pair, 1][None]  # of every step of the first and of the second
            losses.append(np.log1p(np.exp(-gap if label == FIRST else gap)).mean())
            right.append(((gap < 0) == (label == SECOND)).mean())
        return float(np.mean(losses)), float(np.mean(right))

    gradient = numeric_gradient(lambda at: by_hand(at)[0], members)
    scale = max(np.abs(g).max() for g in gradient)
    for moment, g in zip(flat(after.adam.mu), gradient, strict=True):
        np.testing.assert_allclose(moment / 0.1, g, atol=0.05 * scale)
    np.testing.assert_allclose(info["fit_accuracy"], by_hand(members)[1], atol=0.05)


@pytest.mark.parametrize("count", [1, 7, 8, 9])
@pytest.mark.parametrize("part", [32, 3])
def test_rows_that_hold_no_label_have_no_influence_whatever_they_hold(count: int, part: int):
    numbers = ONE_EPOCH._replace(epochs=3, stop_accuracy=1.0)
    clean, dirty = (
        fit(part=part)(model_of(5), labelled_of(mixed(count), garbage=g), jax.random.key(1), numbers)
        for g in (0.0, 1e3)
    )
    assert_same(clean, dirty)


def test_the_room_for_labels_to_come_changes_no_gradient():
    """One label in a file for 12 and in one for 2 are the same fit."""
    one, other = (
        fit()(model_of(6), labelled_of([SECOND], capacity=12)._replace(), jax.random.key(2), ONE_EPOCH)[0],
        fit()(
            model_of(6),
            Labelled(*(column[:2] for column in labelled_of([SECOND], capacity=12)[:3]), np.int32(1)),
            jax.random.key(2),
            ONE_EPOCH,
        )[0],
    )
    for left, right in zip(jax.tree.leaves(one.adam.mu), jax.tree.leaves(other.adam.mu), strict=True):
        np.testing.assert_allclose(left, right, atol=1e-6)


def test_without_a_label_nothing_changes_at_all():
    before = model_of(7)
    warm, _ = fit()(before, labelled_of(mixed(7)), jax.random.key(3), ONE_EPOCH)  # moments that could echo
    after, info = fit()(warm, labelled_of([], garbage=1.0), jax.random.key(4), ONE_EPOCH)
    assert_same(warm, after)
    assert (int(info["fit_epochs"]), float(info["fit_accuracy"])) == (0, 0)


# Epochs.


@pytest.mark.parametrize("count", [1, 7, 8, 9, 12])
@pytest.mark.parametrize("epochs", [1, 3])
def test_an_epoch_takes_one_step_per_begun_mini_batch(count: int, epochs: int):
    numbers = ONE_EPOCH._replace(epochs=epochs, stop_accuracy=1.0)
    after, info = fit()(model_of(8), labelled_of(mixed(count)), jax.random.key(5), numbers)
    assert int(info["fit_epochs"]) == epochs
    assert int(after.adam.count) == epochs * -(-count // BATCH)
    again, _ = fit()(after, labelled_of(mixed(count)), jax.random.key(6), numbers)
    assert int(again.adam.count) == 2 * int(after.adam.count)  # the moments live on from session to session


@pytest.mark.parametrize("part", [32, 3])
def test_every_label_is_seen_once_an_epoch(part: int):
    """At a rate of nothing Adam's first moment is a weighted sum of the mini-batches' gradients."""
    before, labelled = model_of(9, members=1), labelled_of(mixed(12))
    after, _ = fit(4, part)(before, labelled, jax.random.key(7), ONE_EPOCH._replace(rate=0.0))
    gradients = [  # of every single label
        numeric_gradient(
            lambda members, i=i: loss_by_hand(
                members, Labelled(*(column[i : i + 1] for column in labelled[:3]), np.int32(1))
            ),
            flat(before.members),
        )
        for i in range(12)
    ]
    # The first moment weighs the three mini-batches .081, .09, .1, each over 4 labels: find which are where.
    columns = np.stack([np.concatenate([g.ravel() for g in each]) for each in gradients], axis=1)
    moment = np.concatenate([m.ravel() for m in flat(after.adam.mu)])
    weights = 4 * np.linalg.lstsq(columns, moment, rcond=None)[0]
    np.testing.assert_allclose(np.sort(weights), np.repeat([0.081, 0.09, 0.1], 4), atol=2e-3)


def accuracy_by_hand(members: Arrays, labelled: Labelled) -> float:
    """Mean over members of the share of decided pairs whose preferred segment has the higher sum."""
    label = labelled.second[: int(labelled.count)]
    hits = []
    for j in range(len(members[0])):
        logits = logits_by_hand(members, j, labelled)
        hits += [(b > a) == (y > EQUAL) for (a, b), y in zip(logits, label, strict=True) if y != EQUAL]
    return float(np.mean(hits))


@pytest.mark.parametrize("labels", [mixed(8), [FIRST, EQUAL, EQUAL], [SECOND] * 5, UNSURE], ids=str)
@pytest.mark.parametrize("part", [32, 3])
def test_accuracy_is_measured_before_the_step_and_leaves_equal_pairs_out(labels: list[float], part: int):
    before, labelled = model_of(10), labelled_of(labels, garbage=5.0)
    _, info = fit(part=part)(before, labelled, jax.random.key(8), ONE_EPOCH)
    np.testing.assert_allclose(info["fit_accuracy"], accuracy_by_hand(flat(before.members), labelled), rtol=1e-6)


@pytest.mark.parametrize(
    ("right", "stop", "epochs"), [(8, 0.97, 1), (8, 1.0, 6), (7, 0.97, 6), (7, 0.8, 1), (7, 0.875, 6)]
)
def test_the_fit_ends_after_the_first_epoch_above_the_wanted_accuracy(right: int, stop: float, epochs: int):
    """Labels that the one member answers itself, but for one: at a rate of nothing its accuracy stays."""
    before, labelled = model_of(11, members=1), labelled_of([FIRST] * 8)
    logits = logits_by_hand(flat(before.members), 0, labelled)
    label = np.array(labelled.second)
    label[:8] = logits[:, 1] > logits[:, 0]
    label[right:8] = 1 - label[right:8]
    numbers = FitNumbers(rate=0.0, epochs=6, stop_accuracy=stop)
    _, info = fit()(before, labelled._replace(second=label), jax.random.key(9), numbers)
    assert (float(info["fit_accuracy"]), int(info["fit_epochs"])) == (right / 8, epochs)


def test_members_see_the_labels_in_different_orders():
    """Members that begin alike part ways once an epoch has more than one mini-batch."""
    before = model_of(12)
    twins = before._replace(members=jax.tree.map(lambda x: jnp.stack([x[0]] * 3), before.members))
    together, _ = fit()(twins, labelled_of(mixed(8)), jax.random.key(10), ONE_EPOCH)
    apart, _ = fit()(twins, labelled_of(mixed(12)), jax.random.key(10), ONE_EPOCH)
    for j in (1, 2):
        one, other = (np.asarray(m.members.weights[0]) for m in (together, apart))
        np.testing.assert_allclose(one[j], one[0], atol=1e-5)
        assert np.abs(other[j] - other[0]).max() > 1e-5


def test_a_fit_depends_on_its_key_and_on_nothing_else():
    one, same, other = (
        fit()(model_of(13), labelled_of(mixed(12)), jax.random.key(key), ONE_EPOCH)[0] for key in (0, 0, 1)
    )
    assert_same(one, same)
    assert not np.array_equal(one.members.weights[0], other.members.weights[0])


def test_a_linear_preference_is_learned_and_foretold_for_new_pairs():
    """The steps of a segment are alike, so that sums of a bounded reward can order segments as the linear one does."""
    rng, train, n = np.random.default_rng(14), 400, 800
    place, action = rng.uniform(-1, 1, (n, 2, 1, O)), np.repeat(rng.uniform(-1, 1, (n, 2, 1, A)), H, axis=2)
    observation = place + rng.uniform(-0.1, 0.1, (n, 2, H, O))
    score = (observation @ np.array([1.0, -2.0, 0.5]) + 0.5 * action[..., 0]).sum(axis=-1)
    label = (score[:, 1] > score[:, 0]).astype(np.float32)
    observation, action = observation.astype(np.float32), action.astype(np.float32)
    labelled = Labelled(observation[:train], action[:train], label[:train], np.int32(train))  # pyright: ignore
    numbers = FitNumbers(rate=1e-2, epochs=30, stop_accuracy=0.97)
    fitted, info = fit(64)(model_of(15, width=8), labelled, jax.random.key(11), numbers)
    summed = model.rewards(fitted.members, observation[train:], action[train:], None).mean(axis=0).sum(axis=-1)
    foretold = (np.asarray(summed[:, 1] > summed[:, 0]) == label[train:]).mean()
    assert info["fit_accuracy"] > 0.97 and foretold > 0.9
