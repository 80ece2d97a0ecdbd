"""PGE held to NumPy, and its bonus followed from the densities into a batch and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import learner, parts, replay
from senior.config import SAC, Config, Networks, PreferenceGuided, Pretraining, Queries
from senior.envs import point
from senior.explore import Now, preference_guided
from senior.explore.preference_guided import State, intrinsic_reward
from senior.replay import Fact, Replay
from senior.reward.model import Labelled
from senior.types import Batch, EnvSpec, Source

E, O, A, FACTS = 40, 5, 2, 60
SPEC = EnvSpec("arm", O, A, slice(1, 3), 50, 2.0, True)
paid = jax.jit(intrinsic_reward)


class Compiled:
    """A bonus whose functions are compiled once per set of options."""

    def __init__(self, **options: Any) -> None:
        bonus = preference_guided.PreferenceGuided(SPEC, **{"capacity": E, **options})
        self.init, self.report, self.value = bonus.init, bonus.report, bonus.value
        self.on_session, self.on_refresh = jax.jit(bonus.on_session), jax.jit(bonus.on_refresh)


bonus_of = cache(Compiled)


def now(step: int = 0, since: int = 0, scale: float = 2.0) -> Now:
    return Now(jnp.int32(step), jnp.int32(since), jnp.float32(scale))


@cache
def replay_of(facts: int = FACTS, size: int = 80, o: int = O) -> Replay:
    """A replay whose fact ``i`` has the learned reward i."""
    held, rng = replay.init(size, o, A), np.random.default_rng(0)
    store = jax.jit(replay.store)
    for i in range(facts):
        fact = Fact(
            rng.normal(0, 0.2, o).astype(np.float32),
            rng.uniform(-1, 1, A).astype(np.float32),
            np.float32(10 * i),
            rng.normal(0, 0.2, o).astype(np.float32),
            np.bool_(False),
            np.bool_(False),
            np.int32(0),
        )
        held = store(held, fact, np.float32(i), np.float32(2 * i))
    return held


EMPTY = replay.gather(replay.init(1, O, A), jnp.zeros(1, jnp.int32))


def preferred_of(seed: int = 1, n: int = 30) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.1, 0.1, (n, 2)).astype(np.float32)


def refreshed(bonus: Compiled, count: int = 30, times: int = 1) -> State:
    """The state after a session with that many preferred positions and some refreshes."""
    state = bonus.on_session(bonus.init(), jax.random.key(1), jnp.asarray(preferred_of()), jnp.int32(count))
    for i in range(times):
        state = bonus.on_refresh(state, jax.random.key(i), replay_of(), now())
    return state


# The intrinsic reward.


def density_by_hand(point: np.ndarray, samples: np.ndarray, h: float) -> float:
    kernels = [np.exp(-0.5 * np.sum(((point - s) / h) ** 2)) for s in samples.astype(np.float64)]
    return float(np.mean(kernels)) / (h * np.sqrt(2 * np.pi)) ** samples.shape[1]


def intrinsic_by_hand(positions: np.ndarray, preferred: np.ndarray, h: float) -> np.ndarray:
    """min-max of g = f_P / f_E over the positions."""
    g = [density_by_hand(p, preferred, h) / density_by_hand(p, positions, h) for p in positions.astype(np.float64)]
    return (np.array(g) - min(g)) / (max(g) - min(g))


@pytest.mark.parametrize("h", [0.05, 0.1, 1.0])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_intrinsic_reward_is_the_scaled_ratio_of_the_two_densities(h: float, d: int):
    rng = np.random.default_rng(d)
    positions = rng.normal(0, 0.2, (E, d)).astype(np.float32)
    preferred = rng.normal(0.1, 0.1, (25, d)).astype(np.float32)
    found = np.asarray(paid(positions, preferred, h))
    np.testing.assert_allclose(found, intrinsic_by_hand(positions, preferred, h), atol=2e-4)
    assert (found.min(), found.max()) == (0, 1)


def test_it_is_highest_where_preferred_and_seldom_visited():
    """Three places: preferred and crowded, preferred and rare, rare and not preferred."""
    positions = np.array([[0.0]] * 8 + [[1.0]] + [[2.0]], np.float32)
    found = np.asarray(paid(positions, np.array([[0.0], [1.0]], np.float32), 0.1))
    assert found[8] == 1 and found[9] == 0
    np.testing.assert_allclose(found[:8], 1 / 8, rtol=1e-4)


def test_a_constant_factor_on_either_kernel_changes_nothing(monkeypatch: pytest.MonkeyPatch):
    positions, preferred = replay_of().facts.observation[:E, SPEC.position], preferred_of()
    before = paid(positions, preferred, 0.1)
    original, calls = preference_guided.log_density, []

    def scaled(points: jax.Array, samples: jax.Array, h: float) -> jax.Array:
        calls.append(samples is points)
        return original(points, samples, h) + jnp.log(37.0 if samples is points else 0.01)

    monkeypatch.setattr(preference_guided, "log_density", scaled)
    after = jax.jit(lambda *arguments: intrinsic_reward(*arguments))(positions, preferred, 0.1)
    assert sorted(calls) == [False, True]
    np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.parametrize("case", ["one place", "same cloud"])
def test_a_constant_ratio_pays_nothing(case: str):
    cloud = np.random.default_rng(2).normal(size=(E, 2)).astype(np.float32)
    positions = np.full((E, 2), 0.25, np.float32) if case == "one place" else cloud
    assert not np.any(paid(positions, cloud, 0.1))


@pytest.mark.parametrize("apart", [1.0, 10.0, 1000.0])
def test_it_is_finite_and_reaches_both_ends_for_clouds_far_apart_at_a_small_bandwidth(apart: float):
    """At h = .01 every f_P is exp(-5000) or less, which no float holds."""
    rng = np.random.default_rng(3)
    positions = rng.normal(0, 0.02, (E, 3)).astype(np.float32)
    preferred = (apart + rng.normal(0, 0.02, (E, 3))).astype(np.float32)
    found = np.asarray(paid(positions, preferred, 0.01))
    assert np.isfinite(found).all() and (found.min(), found.max()) == (0, 1)


# The state.


def test_the_preference_sample_is_drawn_from_the_filled_rows_alone():
    preferred = np.concatenate([preferred_of(n=3), np.full((50, 2), 1e6, np.float32)])
    state = bonus_of().on_session(bonus_of().init(), jax.random.key(0), preferred, jnp.int32(3))
    drawn = {tuple(row) for row in np.asarray(state.preferred).tolist()}
    assert state.preferred.shape == (E, 2)
    assert drawn == {tuple(row) for row in preferred[:3].tolist()}


def test_a_refresh_copies_rows_of_the_whole_replay_and_pays_them_by_their_positions():
    """The rows are copies: what the ring overwrites later does not reach them."""
    held, state = replay_of(), refreshed(bonus_of(bandwidth=0.07))
    rows = np.asarray(state.curiosity.learned_reward).astype(int)  # fact i has the learned reward i
    assert len(rows) == E and rows.max() < FACTS
    assert np.array_equal(state.curiosity.observation, np.asarray(held.facts.observation)[rows])
    assert np.array_equal(state.curiosity.next_observation, np.asarray(held.facts.next_observation)[rows])
    assert np.array_equal(state.curiosity.action, np.asarray(held.facts.action)[rows])
    assert np.array_equal(state.curiosity.spread, 2.0 * rows)
    assert np.array_equal(state.curiosity.source, np.full(E, Source.CURIOSITY))
    assert np.array_equal(state.curiosity.row, np.arange(E))
    positions = np.asarray(state.curiosity.observation)[:, 1:3]
    expected = intrinsic_by_hand(positions, np.asarray(state.preferred), 0.07 * 2.0)  # bandwidth x length scale
    np.testing.assert_allclose(state.intrinsic, expected, atol=2e-4)


def test_the_curiosity_buffer_is_a_uniform_draw_with_replacement_and_replaced_each_time():
    bonus = bonus_of(capacity=3000)
    one, other = (
        bonus.on_refresh(bonus.init(), jax.random.key(i), replay_of(), now()).curiosity.learned_reward for i in (0, 1)
    )
    counts = np.bincount(np.asarray(one).astype(int), minlength=FACTS)
    np.testing.assert_allclose(counts, 50, atol=35)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(
    ("clock", "exponents"),
    [("refresh", [0, 1, 2, 3]), ("env_step", [1000, 1030, 1060, 1090]), ("since_pretrain", [0, 30, 60, 90])],
)
def test_beta_begins_at_its_first_value_and_decays_with_its_clock(clock: str, exponents: list[int]):
    bonus, betas = bonus_of(beta=0.2, decay=0.01, clock=clock), []
    state = bonus.on_session(bonus.init(), jax.random.key(1), jnp.asarray(preferred_of()), jnp.int32(30))
    for k in range(4):
        state = bonus.on_refresh(state, jax.random.key(k), replay_of(), now(1000 + 30 * k, 30 * k))
        betas.append(float(bonus.report(state, EMPTY, now())["beta"]))
        assert int(state.refreshes) == k + 1
    np.testing.assert_allclose(betas, [0.2 * 0.99**t for t in exponents], rtol=1e-4)


def test_refreshes_that_pay_nothing_for_want_of_preferences_do_not_spend_the_weight():
    bonus = bonus_of(beta=0.2, decay=0.01)
    state = bonus.on_refresh(bonus.init(), jax.random.key(0), replay_of(), now())
    assert not bool(state.ready) and int(state.refreshes) == 0
    state = bonus.on_session(state, jax.random.key(1), jnp.asarray(preferred_of()), jnp.int32(30))
    state = bonus.on_refresh(state, jax.random.key(1), replay_of(), now())
    assert float(bonus.report(state, EMPTY, now())["beta"]) == pytest.approx(0.2)


# What is paid.


def batch_of(source: list[int], row: list[int]) -> Batch:
    drawn = replay.gather(replay_of(), jnp.asarray(row))
    return drawn._replace(source=jnp.asarray(source))


def test_the_bonus_is_beta_times_the_intrinsic_reward_on_curiosity_rows_and_nothing_elsewhere():
    bonus = bonus_of(beta=0.1, decay=0.5)
    state = refreshed(bonus, times=3)
    rows = [0, 7, 7, 39, 39, 50, 5]
    source = [Source.CURIOSITY, Source.CURIOSITY, Source.REPLAY, Source.CURIOSITY, Source.RECENT, Source.REPLAY, 1]
    value = bonus.value(state, batch_of([int(s) for s in source], rows), now())
    r_int = np.asarray(state.intrinsic)
    expected = 0.1 * 0.5**2 * np.array([r_int[0], r_int[7], 0, r_int[39], 0, 0, r_int[5]])
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    np.testing.assert_allclose(bonus.report(state, EMPTY, now())["intrinsic_mean"], r_int.mean(), rtol=1e-5)


@pytest.mark.parametrize("when", ["before anything", "before a session", "after a session without a label"])
def test_while_nothing_is_preferred_nothing_is_ready_and_nothing_paid(when: str):
    bonus = bonus_of()
    state = bonus.init()
    if when == "before a session":
        state = bonus.on_refresh(state, jax.random.key(0), replay_of(), now())
    elif when == "after a session without a label":
        state = refreshed(bonus, count=0)
    assert not state.ready
    everywhere = batch_of([int(Source.CURIOSITY)] * E, list(range(E)))
    assert not np.any(bonus.value(state, everywhere, now()))


def test_a_session_alone_makes_nothing_ready_until_the_next_refresh():
    bonus = bonus_of()
    state = bonus.on_session(bonus.init(), jax.random.key(1), jnp.asarray(preferred_of()), jnp.int32(30))
    assert not state.ready
    assert bonus.on_refresh(state, jax.random.key(0), replay_of(), now()).ready


# In a learner.


def config_of(batch: int = 128, share: float = 0.3) -> Config:
    return replace(
        Config(task="point"),
        steps=200,
        networks=Networks(1, 8, 1, 8),
        sac=SAC(batch=batch),
        pretraining=Pretraining(10, 50, 5),
        queries=Queries(budget=4, per_session=4, segment=5),
        pge=PreferenceGuided(capacity=E, share=share),
    )


@cache
def learner_of(batch: int = 128, share: float = 0.3) -> learner.Learner:
    config, spec = config_of(batch, share), point.make()[1]
    return learner.Learner(config, spec, parts.bonus(config, spec))


@cache
def learn() -> Callable[..., tuple[learner.Run, dict[str, jax.Array]]]:
    return jax.jit(learner_of().learn)


@cache
def begun(preferred: int = 30) -> learner.Run:
    """A run with 60 facts, scored by its model; a session with that many preferred positions; a first refresh."""
    tutor = learner_of()

    @jax.jit
    def begin(held: Replay, count: jax.Array) -> learner.Run:
        run, _ = tutor.relabel(tutor.init(config_of())._replace(replay=held))
        run, _ = tutor.on_session(run, jnp.asarray(preferred_of()), count, jnp.int32(50))
        return tutor.refresh(run, jnp.int32(50))[0]

    return begin(replay_of(size=200, o=4), jnp.int32(preferred))


@pytest.mark.parametrize(("batch", "share", "curious"), [(512, 0.3, 153), (128, 0.3, 38), (10, 0.0, 0), (10, 1.0, 10)])
def test_a_share_of_every_batch_comes_from_the_curiosity_buffer(batch: int, share: float, curious: int):
    run, held = begun(), begun().bonus.curiosity
    drawn = jax.tree.map(np.asarray, jax.jit(learner_of(batch, share)._draw)(run, jax.random.key(0), jnp.int32(0)))
    assert np.bincount(drawn.source, minlength=2).tolist() == [batch - curious, curious]
    of_buffer = drawn.source == Source.CURIOSITY
    assert np.array_equal(drawn.observation[of_buffer], np.asarray(held.observation)[drawn.row[of_buffer]])
    stored = np.asarray(run.replay.facts.observation)[drawn.row[~of_buffer]]
    assert np.array_equal(drawn.observation[~of_buffer], stored)
    assert (drawn.row[~of_buffer] < FACTS).all()
    if curious > 3 * E:
        assert len(np.unique(drawn.row[of_buffer])) > 0.9 * E  # drawn anew from all of it


def test_without_a_preferred_position_the_batch_is_the_replays_alone():
    drawn = jax.jit(learner_of()._draw)(begun(preferred=0), jax.random.key(0), jnp.int32(0))
    assert np.array_equal(drawn.source, np.full(128, Source.REPLAY))
    _, info = learn()(begun(preferred=0), jnp.int32(51), jnp.int32(0))
    assert float(info["bonus_mean"]) == 0


def test_the_bonus_is_paid_from_its_first_use_on_and_enters_the_critics_reward():
    """A silent zero is what happened in the public release."""
    run = begun()
    _, info = learn()(run, jnp.int32(51), jnp.int32(0))
    assert float(info["bonus_mean"]) > 1e-3
    _, unpaid = learn()(run._replace(bonus=run.bonus._replace(beta=jnp.zeros(()))), jnp.int32(51), jnp.int32(0))
    np.testing.assert_allclose(info["batch_reward"] - unpaid["batch_reward"], info["bonus_mean"], rtol=1e-3)
    assert float(info["critic_loss"]) != float(unpaid["critic_loss"])


def test_the_first_updates_after_pretraining_are_hybrid_and_paid():
    _, info = jax.jit(learner_of().begin)(begun(), jnp.int32(50))
    assert float(info["curiosity_share"]) == pytest.approx(38 / 128)
    assert float(info["bonus_mean"]) > 1e-3


def assert_scored(run: learner.Run) -> None:
    """Replay and curiosity buffer hold the present model's mean and population deviation, and no bonus."""
    assert run.model is not None
    half = len(run.model.members.weights)

    def by_hand(observation: np.ndarray, action: np.ndarray) -> np.ndarray:
        all_members = []
        for j in range(3):
            x = np.concatenate([observation, action], axis=-1).astype(np.float64)
            for i, (w, b) in enumerate(zip(run.model.members.weights, run.model.members.biases, strict=True)):  # pyright: ignore
                x = x @ np.asarray(w[j], np.float64) + np.asarray(b[j], np.float64)
                x = np.where(x > 0, x, 0.01 * x) if i < half - 1 else x
            all_members.append(np.tanh(x[..., 0]))
        return np.stack(all_members)

    facts, held = run.replay.facts, run.bonus.curiosity
    stored = by_hand(np.asarray(facts.observation)[:FACTS], np.asarray(facts.action)[:FACTS])
    np.testing.assert_allclose(run.replay.learned_reward[:FACTS], stored.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(run.replay.spread[:FACTS], stored.std(axis=0), atol=1e-6)
    copied = by_hand(np.asarray(held.observation), np.asarray(held.action))
    np.testing.assert_allclose(held.learned_reward, copied.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(held.spread, copied.std(axis=0), atol=1e-6)


def test_the_curiosity_buffer_is_relabelled_with_the_replay_and_no_bonus_is_ever_stored():
    tutor, rng = learner_of(), np.random.default_rng(5)
    before, _ = learn()(begun(), jnp.int32(51), jnp.int32(0))
    assert_scored(before)
    labelled = Labelled(
        rng.normal(size=(4, 2, 5, 4)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        rng.uniform(-1, 1, (4, 2, 5, 2)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        np.array([0, 1, 1, 0], np.float32),  # pyright: ignore[reportArgumentType]
        np.int32(4),  # pyright: ignore[reportArgumentType]
    )
    after, _ = jax.jit(tutor.fit)(before, labelled, jnp.int32(60))
    assert not np.array_equal(after.replay.learned_reward, before.replay.learned_reward)
    assert_scored(after)
    assert np.array_equal(after.bonus.intrinsic, before.bonus.intrinsic)
