"""QPA: what its batches, its candidates and its windows are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import replay
from senior.fit import spec_of
from senior.loop import Training
from senior.program import make_learner, train
from senior.reward.model import Snippets, window_sums
from senior.runs import Given, Proposal, Runs
from senior.schedule import Due
from senior.trainee import Trainee
from senior.types import Source
from tests.small import small
from tests.test_replay import CAPACITY, filled_with

COPIES, SHORTEST, LONGEST, H = 20, 35, 45, 50


@pytest.mark.parametrize(("facts", "window"), [(5, 2), (7, 7), (11, 3), (11, 7), (11, 100), (3, 0)])
def test_the_latest_rows_are_the_latest_wherever_the_ring_stands(facts: int, window: int):
    held, size = filled_with(facts), 4000
    drawn = jax.jit(replay.latest, static_argnums=2)(held, jax.random.key(0), size, jnp.int32(window))
    allowed = range(max(facts - max(window, 1), facts - CAPACITY, 0), facts)
    counts = {number: int((np.asarray(drawn.learned_reward) == number).sum()) for number in allowed}
    assert sum(counts.values()) == size
    expected = size / len(counts)
    np.testing.assert_allclose(list(counts.values()), expected, atol=5 * np.sqrt(expected))
    assert np.array_equal(drawn.source, np.full(size, Source.RECENT))


def test_half_a_batch_is_recent_while_there_is_budget():
    config = small("qpa")
    learner = make_learner(config)
    run = learner.init(config)
    run = run._replace(replay=run.replay._replace(count=jnp.int32(1500)))
    draw = jax.jit(learner._draw)
    mixed, plain = (draw(run, jax.random.key(1), jnp.int32(window)) for window in (200, 0))
    assert np.bincount(mixed.source, minlength=3).tolist() == [32, 0, 32]
    recent = np.asarray(mixed.row)[np.asarray(mixed.source) == Source.RECENT]
    assert recent.min() >= 1300 and recent.max() < 1500
    assert np.asarray(mixed.row)[:32].min() < 1300
    assert np.bincount(plain.source, minlength=3).tolist() == [64, 0, 0]


def test_the_first_updates_after_pretraining_are_not_mixed():
    config = small("qpa")
    learner = make_learner(config)
    run = learner.init(config)
    run = run._replace(replay=run.replay._replace(count=jnp.int32(1500)))
    _, info = jax.jit(learner.begin)(run, jnp.int32(400))
    assert float(info["recent_share"]) == 0
    _, info = jax.jit(learner.learn)(run, jnp.int32(401), jnp.int32(200))
    assert float(info["recent_share"]) == 0.5


def test_the_window_is_the_latest_episodes_long_and_closes_with_the_budget(tmp_path: Path):
    config = replace(small("qpa"), qpa=replace(small("qpa").qpa, episodes=3))
    trainee = Trainee(config, tmp_path, make_learner(config), spec_of(config))
    progress = trainee.progress
    try:
        for episode, rows in ((0, 0), (1, 50), (2, 100), (3, 150), (40, 150)):
            progress.episode = episode
            assert trainee.recent_rows() == rows
        progress.queried = config.queries.budget - 1
        assert trainee.recent_rows() == 150
        progress.queried += 1
        assert trainee.recent_rows() == 0
    finally:
        trainee.close()
    for method in ("m-senior", "pebble"):
        other = small(method)
        trainee = Trainee(other, tmp_path, make_learner(other), spec_of(other))
        trainee.progress.episode = 9
        assert trainee.recent_rows() == 0
        trainee.close()


def test_every_update_draws_from_the_window_as_it_is_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It is handed over a step before; an episode's end and the last session change it in between."""
    drawn: list[tuple[int, int]] = []
    update = Training.update

    def noted(training: Training, plans: Sequence[Due], given: Given) -> Proposal | None:
        proposed = update(training, plans, given)
        if plans[0].update:
            drawn.append((used[-1], training.trainees[0].recent_rows()))
        return proposed

    used: list[int] = []
    propose = Runs.propose

    def seen(runs: Runs, of_one: Any, changes: Any, active: Any, given: Given, *names: str) -> Proposal:
        used.append(int(given.columns["recent"][0]))
        return propose(runs, of_one, changes, active, given, *names)

    monkeypatch.setattr(Training, "update", noted)
    monkeypatch.setattr(Runs, "propose", seen)
    config = small("qpa", steps=900)
    config = replace(config, qpa=replace(config.qpa, episodes=12), queries=replace(config.queries, budget=25))
    train(config, tmp_path)
    assert [used for used, _ in drawn] == [now for _, now in drawn]
    assert {now for _, now in drawn} == {0, *range(400, 601, 50)}  # growing, full, and closed with the budget


def test_candidates_come_from_its_own_episodes_alone(tmp_path: Path):
    config = replace(small("qpa"), qpa=replace(small("qpa").qpa, episodes=3))
    assert config.window == 3
    trainee = Trainee(config, tmp_path, make_learner(config), spec_of(config))
    try:
        trainee.progress.recent = [[number, 50 * number, 50] for number in range(5, 8)]
        found = trainee.candidate_starts(400)
        assert found is not None
        assert set(np.unique(found[1])) == {5, 6, 7}
    finally:
        trainee.close()


# Windows.


def sums_of(rewards: np.ndarray, seed: int = 0) -> np.ndarray:
    snippets = Snippets(COPIES, SHORTEST, LONGEST)
    return np.asarray(jax.jit(lambda r, k: window_sums(r, snippets, k))(jnp.asarray(rewards), jax.random.key(seed)))


def test_windows_have_one_length_for_both_segments_and_starts_of_their_own():
    """With rewards of one the sum is the length; with rewards of 1000^t it tells first and last step."""
    pairs = 400
    lengths = sums_of(np.ones((pairs, 2, H), np.float32))
    assert np.array_equal(lengths[..., 0], lengths[..., 1])
    counts = np.bincount(lengths[..., 0].astype(int).ravel(), minlength=LONGEST + 1)
    assert not counts[:SHORTEST].any()
    expected = pairs * COPIES / (LONGEST - SHORTEST + 1)
    np.testing.assert_allclose(counts[SHORTEST:], expected, atol=5 * np.sqrt(expected))

    ramp = np.broadcast_to(np.arange(H, dtype=np.float32), (pairs, 2, H))
    length = lengths
    start = sums_of(ramp) / length - (length - 1) / 2  # the mean of start .. start + length - 1
    np.testing.assert_allclose(start, np.round(start), atol=1e-3)
    start = np.round(start).astype(int)
    assert start.min() == 0 and (start + length.astype(int)).max() == H
    assert np.mean(start[..., 0] == start[..., 1]) < 0.2
    widest = start[length[..., 0] == SHORTEST].ravel()
    counts = np.bincount(widest, minlength=H - SHORTEST + 1)
    np.testing.assert_allclose(counts, len(widest) / 16, atol=5 * np.sqrt(len(widest) / 16))


def test_windows_sum_what_lies_in_them_and_differ_from_draw_to_draw():
    rewards = np.random.default_rng(0).normal(size=(3, 2, H)).astype(np.float32)
    length, ramp = sums_of(np.ones_like(rewards)), sums_of(np.broadcast_to(np.arange(H, dtype=np.float32), (3, 2, H)))
    start = np.round(ramp / length - (length - 1) / 2).astype(int)
    for pair, copy, side in np.ndindex(3, COPIES, 2):
        first = start[pair, copy, side]
        inside = rewards[pair, side, first : first + int(length[pair, copy, side])]
        np.testing.assert_allclose(sums_of(rewards)[pair, copy, side], inside.sum(dtype=float), atol=1e-4)
    assert not np.array_equal(sums_of(rewards), sums_of(rewards, seed=1))
