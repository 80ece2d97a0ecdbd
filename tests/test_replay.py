"""The replay buffer as a ring, its segments and candidates, its mixing and its relabelling."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import parts, replay
from senior.config import Config, Networks, Pretraining, Queries
from senior.envs import point
from senior.envs.episodes import Step
from senior.learner import Learner
from senior.replay import Fact
from senior.trainee import Trainee
from senior.types import Source

CAPACITY = 7
store = jax.jit(replay.store)


def fact(i: int, terminated: bool = False, truncated: bool = False, episode: int = 0) -> Fact:
    """The ``i``-th fact of a run: every number in it tells ``i``."""
    return Fact(
        observation=np.array([i, -i, i / 2], np.float32),
        action=np.array([i / 100, -i / 100], np.float32),
        reward=np.float32(10 * i),
        next_observation=np.array([i + 1, -i - 1, (i + 1) / 2], np.float32),
        terminated=np.bool_(terminated),
        truncated=np.bool_(truncated),
        episode=np.int32(episode),
    )


def filled_with(facts: int, capacity: int = CAPACITY) -> replay.Replay:
    """A replay after that many facts; fact ``i`` has the learned reward i and the spread 2i."""
    held = replay.init(capacity, 3, 2)
    for i in range(facts):
        held = store(held, fact(i), np.float32(i), np.float32(2 * i))
    return held


# The ring.


@pytest.mark.parametrize("facts", [0, 3, 7, 8, 20])
def test_the_ring_holds_the_latest_facts_in_rows_by_their_number(facts: int):
    held = filled_with(facts)
    assert int(held.count) == facts
    assert int(held.filled) == min(facts, CAPACITY)
    for i in range(max(0, facts - CAPACITY), facts):
        row = i % CAPACITY
        stored = jax.tree.map(lambda column, row=row: np.asarray(column[row]), held.facts)
        for name, value in fact(i)._asdict().items():
            assert np.array_equal(getattr(stored, name), value), name
        assert (held.learned_reward[row], held.spread[row]) == (i, 2 * i)


@pytest.mark.parametrize("facts", [1, 4, 7, 11])
def test_samples_are_uniform_over_the_filled_rows_and_over_no_others(facts: int):
    held, size = filled_with(facts), 7000
    drawn = jax.jit(replay.sample, static_argnums=2)(held, jax.random.key(0), size)
    filled = min(facts, CAPACITY)
    counts = np.bincount(drawn.row, minlength=CAPACITY)
    assert not counts[filled:].any()
    expected = size / filled
    np.testing.assert_allclose(counts[:filled], expected, atol=5 * np.sqrt(expected))
    assert np.array_equal(drawn.source, np.full(size, Source.REPLAY))
    assert np.array_equal(drawn.learned_reward, held.learned_reward[drawn.row])


@pytest.mark.parametrize(
    ("terminated", "truncated", "bootstrap"),
    [(False, False, 1), (False, True, 1), (True, False, 0), (True, True, 0)],
)
def test_only_a_real_end_stops_the_bootstrap_and_a_time_limit_does_not(
    terminated: bool, truncated: bool, bootstrap: int
):
    held = store(replay.init(2, 3, 2), fact(5, terminated, truncated), np.float32(1), np.float32(2))
    batch = replay.gather(held, jnp.array([0]))
    assert batch.bootstrap.tolist() == [bootstrap]


def test_gather_returns_whole_rows_in_the_order_asked_for():
    rows = np.array([4, 0, 4, 2])
    batch = replay.gather(filled_with(10), rows, Source.RECENT)  # rows 0, 1, 2 hold facts 7, 8, 9
    number = np.array([4, 7, 4, 9], np.float32)
    assert np.array_equal(batch.observation, np.stack([number, -number, number / 2], axis=1))
    assert np.array_equal(batch.next_observation[:, 0], number + 1)
    np.testing.assert_allclose(batch.action[:, 0], number / 100)
    assert np.array_equal(batch.reward, 10 * number)
    assert np.array_equal(batch.learned_reward, number)
    assert np.array_equal(batch.spread, 2 * number)
    assert np.array_equal(batch.source, np.full(4, Source.RECENT))
    assert np.array_equal(batch.row, rows)


@pytest.mark.parametrize("other", [0, 3, 8])
def test_mixing_replaces_as_many_rows_as_the_other_batch_has_or_none(other: int):
    held = filled_with(7)
    first = replay.gather(held, jnp.arange(8) % 3)
    second = replay.gather(held, 3 + jnp.arange(other) % 4, Source.CURIOSITY)
    mix = jax.jit(replay.mix)
    mixed, unmixed = mix(first, second, True), mix(first, second, False)
    for name in first._fields:
        one, two = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
        assert np.array_equal(getattr(unmixed, name), one)
        assert np.array_equal(getattr(mixed, name), np.concatenate([one[: 8 - other], two]))


# Relabelling.


@pytest.mark.parametrize("chunk", [1, 3, 4, 7, 100])
@pytest.mark.parametrize("facts", [0, 1, 3, 4, 6, 7, 16])
def test_relabelling_in_chunks_rewrites_exactly_the_filled_rows(
    monkeypatch: pytest.MonkeyPatch, chunk: int, facts: int
):
    """Whatever the chunk, the result is that of one pass over everything that is stored, and of nothing else."""
    monkeypatch.setattr(replay, "RELABEL_CHUNK", chunk)
    held = filled_with(facts)._replace(learned_reward=jnp.full(CAPACITY, -5.0), spread=jnp.full(CAPACITY, -6.0))

    def score(observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        return observation[:, 0] ** 2 + 1, 100 * action[:, 1]

    fresh = replay.relabel(held, score)
    filled = np.arange(CAPACITY) < min(facts, CAPACITY)
    number = np.asarray(held.facts.observation[:, 0])
    np.testing.assert_allclose(fresh.learned_reward, np.where(filled, number**2 + 1, -5), rtol=1e-6)
    np.testing.assert_allclose(fresh.spread, np.where(filled, -number, -6), rtol=1e-5)
    assert all(map(np.array_equal, jax.tree.leaves(fresh.facts), jax.tree.leaves(held.facts)))
    assert int(fresh.count) == facts


# Segments.


@pytest.mark.parametrize("facts", [7, 10, 18])
def test_segments_run_on_across_the_wrap_of_the_ring(facts: int):
    held, length = filled_with(facts), 3
    starts = np.array([[facts - 7, facts - 5], [facts - 4, facts - 3]])
    observation, action, reward = replay.segments(held, starts, length)
    number = starts[..., None] + np.arange(length)
    assert observation.shape == (2, 2, length, 3) and action.shape == (2, 2, length, 2)
    assert np.array_equal(observation[..., 0], number)
    np.testing.assert_allclose(action[..., 0], number / 100, rtol=1e-6)
    assert np.array_equal(reward, 10 * number)


SEGMENT = 4


MakeTrainee = Callable[..., Trainee]


@pytest.fixture
def make_trainee(tmp_path: Path) -> Iterator[MakeTrainee]:
    """Makes trainees on the toy; `candidate_starts` looks at their configuration and at their list of episodes."""

    def made(capacity: int | None = None, per_session: int = 40) -> Trainee:
        config = replace(
            Config(task="point"),
            steps=500,
            replay_capacity=capacity,
            queries=Queries(budget=per_session, per_session=per_session, segment=SEGMENT, episodes=6, pool=10),
            networks=Networks(1, 4, 1, 4),
            pretraining=Pretraining(10, 30, 5),
        )
        spec = point.make()[1]
        trainee = Trainee(config, tmp_path, Learner(config, spec, parts.bonus(config, spec)), spec)
        opened.callback(trainee.close)
        return trainee

    with ExitStack() as opened:
        yield made


def episodes_of(lengths: list[int]) -> list[list[int]]:
    """[episode, first row, length] of episodes that follow one another from row 0."""
    first = np.cumsum([0, *lengths])[:-1]
    return [[i, int(f), n] for i, (f, n) in enumerate(zip(first, lengths, strict=True))]


def live(trainee: Trainee, lengths: list[int]) -> None:
    """Let the trainee record episodes of those lengths, one after the other."""
    nothing, step = np.zeros(3, np.float32), trainee.progress.elapsed
    for length in lengths:
        for t in range(length):
            ended = t == length - 1
            trainee.record(step, Step(nothing, nothing[:2], 0.0, nothing, False, ended, None), 0.0, {})
            step += 1


def test_candidates_are_uniform_over_the_episodes_longer_than_a_segment_and_over_their_starts(
    make_trainee: MakeTrainee,
):
    """Lengths vary: 4 is too short for a segment of 4, 5 leaves one start, the last step is never included."""
    trainee = make_trainee(per_session=400)
    lengths = [9, 4, 5, 6, 3]
    live(trainee, lengths)
    candidates = trainee.candidate_starts(sum(lengths))
    assert candidates is not None
    rows, episode, start = candidates
    assert rows.shape == episode.shape == start.shape == (4000, 2)
    first = np.array([row[1] for row in episodes_of(lengths)])
    assert np.array_equal(rows, first[episode] + start)
    for number, starts in ((0, range(5)), (2, range(1)), (3, range(2))):
        own = start[episode == number]
        np.testing.assert_allclose(len(own), 8000 / 3, rtol=0.08)
        assert set(own.tolist()) == set(starts)
        np.testing.assert_allclose(np.bincount(own), len(own) / len(starts), rtol=0.15)
    assert set(episode.ravel().tolist()) == {0, 2, 3}
    same = (episode[:, 0] == episode[:, 1]).mean()
    np.testing.assert_allclose(same, 1 / 3, atol=0.04)  # the two of a pair are drawn independently


def test_a_candidate_lies_inside_one_episode_and_ends_before_its_last_step(make_trainee: MakeTrainee):
    lengths = [7, 12, 4, 5, 30]
    held = replay.init(64, 3, 2)
    for number, _, length in episodes_of(lengths):
        for t in range(length):
            done = t == length - 1
            held = store(held, fact(t, truncated=done, episode=number), np.float32(0), np.float32(0))
    trainee = make_trainee()
    live(trainee, lengths)
    candidates = trainee.candidate_starts(sum(lengths))
    assert candidates is not None
    rows, episode, start = candidates
    inside = rows[..., None] + np.arange(SEGMENT)
    assert np.array_equal(np.asarray(held.facts.episode)[inside], np.repeat(episode[..., None], SEGMENT, axis=-1))
    assert not np.asarray(held.facts.truncated)[inside].any()
    steps = np.asarray(replay.segments(held, rows, SEGMENT)[0])[..., 0]
    assert np.array_equal(steps, start[..., None] + np.arange(SEGMENT))


@pytest.mark.parametrize("lengths", [[], [9], [9, 4, 3]])
def test_fewer_than_two_usable_episodes_give_no_candidates(make_trainee: MakeTrainee, lengths: list[int]):
    trainee = make_trainee()
    live(trainee, lengths)
    assert trainee.candidate_starts(sum(lengths)) is None


def test_short_episodes_do_not_push_usable_ones_out(make_trainee: MakeTrainee):
    trainee = make_trainee()
    live(trainee, [9, 9, 9] + [4] * 20)
    candidates = trainee.candidate_starts(107)
    assert candidates is not None and set(candidates[1].ravel().tolist()) == {0, 1, 2}


def test_an_episode_that_the_ring_has_begun_to_overwrite_is_no_candidate(make_trainee: MakeTrainee):
    trainee = make_trainee(capacity=20)
    live(trainee, [10, 10, 10])  # at step 31 rows 11 to 30 are stored
    candidates = trainee.candidate_starts(30)
    assert candidates is not None and set(candidates[1].ravel().tolist()) == {1, 2}
    assert trainee.candidate_starts(31) is None


def test_candidates_of_a_step_are_always_the_same_and_those_of_another_are_not(make_trainee: MakeTrainee):
    trainee = make_trainee()
    live(trainee, [40, 40])
    one, again, other = (trainee.candidate_starts(step) for step in (80, 80, 85))
    assert one is not None and again is not None and other is not None
    assert np.array_equal(one[0], again[0]) and not np.array_equal(one[0], other[0])
