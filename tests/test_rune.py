"""RUNE's bonus, alone and in a learner."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import replay
from senior.explore import Now
from senior.explore.disagreement import Disagreement
from senior.learner import Run
from senior.program import make_learner
from senior.replay import Fact
from senior.types import Batch, EnvSpec
from tests.small import small

SPEC = EnvSpec("arm", 4, 2, slice(0, 2), 50, 1.0, True)
CONFIG = small("rune")
LEARNER = make_learner(CONFIG)


def now(step: int) -> Now:
    return Now(jnp.int32(step), jnp.int32(step - 400), jnp.float32(1))


def batch_of(spread: list[float]) -> Batch:
    drawn = replay.gather(replay.init(1, 4, 2), jnp.zeros(len(spread), jnp.int32))
    return drawn._replace(spread=jnp.asarray(spread))


@pytest.mark.parametrize("decay", [0.0, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("step", [0, 10_000, 1_000_000])
def test_the_bonus_is_the_deviation_times_a_weight_that_decays_with_the_environment_step(decay: float, step: int):
    bonus, batch = Disagreement(SPEC, 0.05, decay), batch_of([0.0, 0.1, 0.4])
    weight = 0.05 * math.exp(step * math.log1p(-decay))
    np.testing.assert_allclose(
        bonus.value((), batch, now(step)), weight * np.array([0, 0.1, 0.4]), rtol=1e-5, atol=1e-40
    )
    told = bonus.report((), batch, now(step))
    np.testing.assert_allclose([told["beta"], told["intrinsic_mean"]], [weight, 0.5 / 3], rtol=1e-5, atol=1e-40)


def with_facts(store: Callable[..., Any], facts: int, seed: int) -> Run:
    """A run with so many facts, scored by its model."""
    run, rng, store = LEARNER.init(CONFIG), np.random.default_rng(seed), jax.jit(store)
    for i in range(facts):
        vector = [rng.normal(size=n).astype(np.float32) for n in (4, 2, 4)]
        fact = Fact(vector[0], vector[1], np.float32(i), vector[2], np.bool_(False), np.bool_(False), np.int32(0))
        run, _ = store(run, fact)
    return run


@pytest.fixture(scope="module")
def lived() -> Run:
    return with_facts(LEARNER.store, 60, 0)


def test_members_that_agree_pay_nothing_and_others_their_population_deviation(lived: Run):
    learn = jax.jit(LEARNER.learn)
    _, info = learn(lived, jnp.int32(500), jnp.int32(0))
    beta = 0.05 * (1 - 1e-5) ** 500
    np.testing.assert_allclose(info["beta"], beta, rtol=1e-5)
    np.testing.assert_allclose(info["bonus_mean"], beta * info["intrinsic_mean"], rtol=1e-5)
    assert float(info["bonus_mean"]) > 0
    assert lived.model is not None
    alike = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape), lived.model.members)
    agreed, _ = jax.jit(LEARNER.relabel)(lived._replace(model=lived.model._replace(members=alike)))
    assert np.asarray(agreed.replay.spread).max() < 1e-7
    _, info = learn(agreed, jnp.int32(500), jnp.int32(0))
    assert float(info["bonus_mean"]) < 1e-8


def test_the_bonus_enters_the_critics_reward_and_no_stored_one(lived: Run):
    after, info = jax.jit(LEARNER.learn)(lived, jnp.int32(500), jnp.int32(0))
    assert np.array_equal(after.replay.learned_reward, lived.replay.learned_reward)
    unpaid = make_learner(replace(CONFIG, rune=replace(CONFIG.rune, beta=0.0)))
    _, without = jax.jit(unpaid.learn)(lived, jnp.int32(500), jnp.int32(0))
    np.testing.assert_allclose(info["batch_reward"] - without["batch_reward"], info["bonus_mean"], rtol=1e-3)


def test_pretraining_knows_no_bonus_and_the_first_updates_after_it_do():
    """Updates that know the members' disagreement change with it."""
    run = with_facts(LEARNER.store_pretraining, 40, 1)
    agreeing = run._replace(replay=run.replay._replace(spread=jnp.zeros_like(run.replay.spread)))
    assert np.asarray(run.replay.spread[:40]).min() > 0
    pretrain, begin = jax.jit(LEARNER.pretrain), jax.jit(LEARNER.begin)
    pretrained = [jax.tree.leaves(pretrain(one, jnp.int32(40))[0].agent) for one in (run, agreeing)]
    assert all(np.array_equal(one, other) for one, other in zip(*pretrained, strict=True))
    (begun, paid), (unpaid, nothing) = (begin(one, jnp.int32(40)) for one in (run, agreeing))
    assert float(paid["bonus_mean"]) > 0 == float(nothing["bonus_mean"])
    assert not np.array_equal(begun.agent.critics.weights[0], unpaid.agent.critics.weights[0])
