"""``--compat release``: what the public code of SENIOR does otherwise, held to what was found in it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior.agent import sac
from senior.checks import check
from senior.config import SAC
from senior.learner import Learner, Purpose, Run
from senior.methods import METHODS
from senior.preference_file import Rules
from senior.preferences import Preferences
from senior.presets import release
from senior.program import make_learner
from senior.replay import Fact
from senior.reward import bilevel
from senior.reward.bilevel import FirstSteps
from senior.select.motion_distinction import motion_sum
from senior.types import Answers, BadInput, Pairs, Query, Source
from tests.small import small
from tests.test_select import mds, strokes

FACTS, AT = 300, 10_000


RELEASE = release(small())
RELEASE = replace(RELEASE, sac=SAC(batch=512), steps=20_000, pge=replace(RELEASE.pge, decay=0.01))
"""Batches of the paper's size, small networks."""


@cache
def learner() -> Learner:
    return make_learner(RELEASE)


@cache
def refreshed() -> Run:
    """A run of 300 facts, refreshed at step 10,000, and then of 30 more."""
    rng, tutor = np.random.default_rng(0), learner()
    store = jax.jit(tutor.store)
    run = tutor.init(RELEASE)

    def live(run: Run, first: int, last: int) -> Run:
        for i in range(first, last):
            vector = [rng.normal(size=n).astype(np.float32) for n in (4, 2, 4)]
            fact = Fact(vector[0], vector[1], np.float32(i), vector[2], np.bool_(False), np.bool_(False), np.int32(0))
            run, _ = store(run, fact)
        return run

    run = live(run, 0, FACTS)
    preferred = jnp.asarray(rng.normal(size=(350, 2)).astype(np.float32))
    run, _ = jax.jit(tutor.on_session)(run, preferred, jnp.int32(100), jnp.int32(AT))
    run, _ = jax.jit(tutor.refresh)(run, jnp.int32(AT))
    return live(run, FACTS, FACTS + 30)


def test_a_pair_is_chosen_by_the_scores_of_the_one_at_the_other_end_in_both_stages():
    """Among still pairs one moves, and its mirror image is chosen; with independent pairs that is a uniform draw."""
    positions = np.zeros((10, 2, 20, 3), np.float32)
    positions[2, 0] += np.linspace(0, 0.3, 20)[:, None]
    positions[2, 1] += np.linspace(0.3, 0, 20)[:, None]
    assert mds(positions, 1, keep=0.1).index.tolist() == [2]
    assert mds(positions, 1, keep=0.1, scores="mirrored").index.tolist() == [7]
    along = np.linspace(0, 0.3, 20)[:, None] * np.ones(3)
    positions = np.broadcast_to(along, (10, 2, 20, 3)).astype(np.float32).copy()
    positions[2, 1] = positions[2, 1, ::-1]
    assert mds(positions, 1, keep=1.0, scores="mirrored").index.tolist() == [7]


def test_the_choice_is_uniform_in_effect():
    """The mean rank by their own motion of the pairs chosen from 400 pools of 30: 14.5 if drawn by lot, and
    each of the 1,200 ranks has a deviation of 8.66."""
    ranks: dict[str, list[float]] = {"own": [], "mirrored": []}
    for pool in range(400):
        positions = strokes(1000 + pool, 30)
        order = np.argsort(np.argsort(motion_sum(positions, 0.05)))
        for scores, found in ranks.items():
            found += order[mds(positions, 3, scores=scores).index].tolist()
    assert abs(np.mean(ranks["mirrored"]) - 14.5) < 4 * 8.66 / np.sqrt(1200)
    assert np.mean(ranks["own"]) < 6


def test_a_batch_has_153_curious_rows_and_358_others_that_are_older_and_not_among_them():
    run = refreshed()
    seen = set()
    for key in range(20):
        batch = jax.tree.map(np.asarray, jax.jit(learner()._draw)(run, jax.random.key(key), jnp.int32(0)))
        assert np.bincount(batch.source).tolist() == [358, 153]
        assert len(batch.row) == 511
        others = batch.row[batch.source == Source.REPLAY]
        assert others.max() < FACTS
        assert not set(others) & set(np.asarray(run.bonus.rows).tolist())
        seen |= set(others)
    assert seen == set(range(FACTS)) - set(np.asarray(run.bonus.rows).tolist())


def test_the_bonus_is_nothing_from_its_first_use_on():
    run = refreshed()
    assert 0 <= float(run.bonus.beta) < 1e-40
    _, info = jax.jit(learner().learn)(run, jnp.int32(AT), jnp.int32(0))
    assert float(info["bonus_mean"]) < 1e-40
    assert float(run.bonus.intrinsic.max()) == 1


def test_the_curiosity_buffer_keeps_the_rewards_it_was_drawn_with():
    run = refreshed()
    assert run.model is not None
    other = jax.tree.map(lambda leaf: leaf + 0.1, run.model.members)
    after, _ = jax.jit(learner().relabel)(run._replace(model=run.model._replace(members=other)))
    assert not np.array_equal(after.replay.learned_reward, run.replay.learned_reward)
    assert np.array_equal(after.bonus.curiosity.learned_reward, run.bonus.curiosity.learned_reward)


def test_the_outer_step_takes_the_batch_and_the_values_of_the_steps_own_update():
    run, tutor = refreshed(), learner()
    assert run.model is not None
    rng, m = np.random.default_rng(1), 10
    pairs = FirstSteps(
        rng.normal(size=(m, 2, 4)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        rng.uniform(-1, 1, (m, 2, 2)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        (np.arange(m) % 2).astype(np.float32),  # pyright: ignore[reportArgumentType]
        np.ones(m, np.float32),  # pyright: ignore[reportArgumentType]
    )
    _, info = jax.jit(tutor.outer)(run, pairs, jnp.int32(AT))
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), Purpose.UPDATE), AT)
    key_batch, key_update = jax.random.split(jax.random.fold_in(key, AT))
    batch = tutor._draw(run, key_batch, jnp.int32(0))
    value = sac.next_value(run.agent, batch, jax.random.split(key_update)[0])
    numbers = run.numbers.outer._replace(inner_rate=tutor._decayed(run, jnp.int32(AT)).critic_rate)
    expected = bilevel.outer_loss(run.model.members, run.agent.critics, batch, value, pairs, numbers, None)
    np.testing.assert_allclose(info["outer_loss"], expected, rtol=1e-5)


def test_an_equal_pair_adds_its_second_segment_to_the_preferred_positions(tmp_path: Path):
    preferences = Preferences(tmp_path / "p.sqlite", 4, 3, 2, 1)
    observation = np.arange(3 * 2 * 3 * 2, dtype=np.float32).reshape(3, 2, 3, 2)
    nothing = np.zeros((3, 2), int)
    pairs = Pairs(observation, np.zeros((3, 2, 3, 1), np.float32), np.zeros((3, 2, 3)), nothing, nothing)
    ids = preferences.add(Query(pairs), 0, 0, 0, nothing[:, 0])
    preferences.answer(Answers(ids, [0, -1, 1]), "test")
    preferences.collect(0, 0, Rules())
    ours, count = preferences.preferred_positions(slice(0, 2))
    assert np.array_equal(ours[:count].reshape(-1, 3, 2), [observation[0, 0], observation[2, 1]])
    theirs, count = preferences.preferred_positions(slice(0, 2), "second")
    assert np.array_equal(theirs[:count].reshape(-1, 3, 2), [observation[0, 0], observation[1, 1], observation[2, 1]])
    preferences.close()


def test_the_label_says_what_it_is():
    config = release(small())
    assert config.compat == "release"
    assert check(config) is config
    with pytest.raises(BadInput, match=r"With pge\.clock refresh this is not what the public code does"):
        check(replace(config, pge=replace(config.pge, clock="refresh")))
    with pytest.raises(BadInput, match="--compat release is about m-senior"):
        check(replace(config, method=METHODS["p-senior"]))
    for mix, others in (("recent", {"explore": "none"}), ("curiosity", {})):
        row = replace(METHODS["m-senior"], mix=mix, **others)
        taken = replace(small(), method=row, bilevel=replace(config.bilevel, batch="update"))
        with pytest.raises(BadInput, match="takes the batch of the step's update, which cannot be known"):
            check(taken)
