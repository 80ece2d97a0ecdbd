"""What each function of a run looks at and changes, and the order in which the loop calls them (Algorithm 1)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import checkpoint, loop
from senior.agent.sac import Agent
from senior.files import unpack
from senior.fit import spec_of
from senior.learner import Learner, Run
from senior.methods import METHODS
from senior.preferences import Preferences
from senior.program import Quiet, make_learner, train
from senior.replay import Fact
from senior.reward.bilevel import FirstSteps
from senior.reward.model import EQUAL, Labelled, rewards
from senior.runs import Runs
from senior.schedule import plan
from senior.teachers.scripted import Scripted
from senior.trainee import Trainee
from senior.types import Answers, Pairs, Preferred, Query
from tests.equal import progress_of, short
from tests.small import preferences_dump, rows

CONFIG = short(
    "none",
    env="senior.envs.point:Point",
    position="0:2",
    queries=replace(short().queries, every=50),
    pge=replace(short().pge, every=25),
    bilevel=replace(short().bilevel, every=50),
    device="cpu",
)
"""The toy as anybody's environment: its length scale is taken from the data."""
LEARNER = make_learner(CONFIG)
UNTIL, LAST = CONFIG.pretraining.until, CONFIG.steps
M, SEGMENT = CONFIG.queries.per_session, CONFIG.queries.segment
FACTS, UPDATES = 150, 3


def fact(i: int) -> Fact:
    """The ``i``-th random transition; every seventh really ends its episode."""
    rng = np.random.default_rng(i)
    values: list[Any] = [
        rng.normal(size=4).astype(np.float32),
        rng.uniform(-1, 1, 2).astype(np.float32),
        np.float32(rng.normal()),
        rng.normal(size=4).astype(np.float32),
        np.bool_(i % 7 == 6),
        np.bool_(False),
        np.int32(i // 7),
    ]
    return Fact(*values)


def after(function: Any, run: Run, *arguments: Any) -> tuple[Run, Any]:
    """What a function makes of a run, in NumPy's arrays. The given run stays: `Runs` gets a copy to give away."""
    runs = Runs([jax.tree.map(jnp.array, run)], "loop")
    result = runs.one(0, function, *arguments)
    return jax.device_get(runs[0]), result


@pytest.fixture(scope="module")
def lived() -> Run:
    """A run of M-SENIOR in pre-training, with 150 facts and three updates behind it."""
    runs = Runs([LEARNER.init(replace(CONFIG, seed=3))], "loop")
    for i in range(FACTS):
        runs.one(0, LEARNER.store_pretraining, fact(i))
    for step in range(UPDATES):
        runs.one(0, LEARNER.pretrain, np.int32(step))
    return jax.device_get(runs[0])


@pytest.fixture(scope="module")
def curious(lived: Run) -> Run:
    """The same, with its curiosity buffer filled."""
    preferred = np.random.default_rng(0).normal(size=(CONFIG.queries.budget * SEGMENT, 2)).astype(np.float32)
    run, _ = after(LEARNER.on_session, lived, preferred, np.int32(40), np.int32(UNTIL))
    run, _ = after(LEARNER.refresh, run, np.int32(UNTIL))
    assert run.bonus.ready
    return run


def same(one: Any, other: Any) -> bool:
    """Whether two trees are equal bit for bit."""
    left, right = jax.tree.leaves(one), jax.tree.leaves(other)
    return len(left) == len(right) and all(map(np.array_equal, left, right))


def gap(one: Any, other: Any) -> float:
    """The largest difference between two trees."""
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return max(float(np.abs(left - right).max()) for left, right in leaves)


def with_sac(run: Run, **numbers: float) -> Run:
    """The run with other numbers of SAC."""
    changed = {name: np.float32(value) for name, value in numbers.items()}
    return run._replace(numbers=run.numbers._replace(sac=run.numbers.sac._replace(**changed)))


def with_rate_end(run: Run, value: float) -> Run:
    return run._replace(numbers=run.numbers._replace(rate_end=np.float32(value)))


def with_sac_settings(**settings: int) -> Learner:
    return make_learner(replace(CONFIG, sac=replace(CONFIG.sac, **settings)))


# Target networks.


def moves(function: Any, run: Run, step: int, *more: Any) -> int:
    """How often the targets go a quarter of the way to critics that stand still."""
    run = with_sac(run, critic_rate=0, tau=0.25)
    critics = run.agent.critics
    targets = jax.tree.map(lambda weight: weight + 1, critics)
    agent = after(function, run._replace(agent=run.agent._replace(targets=targets)), np.int32(step), *more)[0].agent
    assert same(agent.critics, critics)
    if same(agent.targets, targets):
        return 0
    left = np.concatenate(
        [np.ravel(leaf) for leaf in jax.tree.leaves(jax.tree.map(np.subtract, agent.targets, critics))]
    )
    times = round(float(np.log(left[0]) / np.log(0.75)))
    np.testing.assert_allclose(left, 0.75**times, atol=1e-5)
    return times


@pytest.mark.parametrize(
    ("updates", "target_every", "expected"), [(1, 2, [1, 0, 1, 0]), (2, 2, [1, 1, 1, 1]), (2, 3, [0, 1, 1, 0])]
)
def test_targets_move_at_updates_whose_number_is_a_multiple(
    lived: Run, updates: int, target_every: int, expected: list[int]
):
    """The numbers go on from step to step: with two updates each, step 500 makes numbers 1000 and 1001."""
    learner = with_sac_settings(updates=updates, target_every=target_every)
    assert [moves(learner.learn, lived, step, np.int32(0)) for step in range(500, 504)] == expected


def test_targets_move_at_every_other_update_of_pre_training(lived: Run):
    assert [moves(LEARNER.pretrain, lived, step) for step in range(200, 204)] == [1, 0, 1, 0]


def test_targets_move_at_the_first_update_of_the_new_critics_and_not_at_the_second(lived: Run):
    """With tau 1 a move puts the targets where the critics are; each update takes these on by about their rate."""

    def begun(updates: int, tau: float) -> Agent:
        learner = with_sac_settings(reset_updates=updates)
        return after(learner.begin, with_sac(lived, tau=tau), np.int32(UNTIL))[0].agent

    one, two, rate = begun(1, 1), begun(2, 1), CONFIG.sac.critic_rate
    assert gap(one.targets, one.critics) < 1e-6
    assert gap(begun(1, 0).targets, one.critics) > 0.5 * rate
    assert gap(two.targets, one.critics) < 0.1 * rate
    assert gap(two.targets, two.critics) > 0.5 * rate


# The end of pre-training, and the rates from there on.


def test_begin_renews_the_critics_and_takes_over_actor_and_temperature(lived: Run):
    """With rates of next to nothing the first updates leave everything as they find it."""
    run = with_sac(lived, actor_rate=1e-12, critic_rate=1e-12, alpha_rate=1e-12)
    old, new = lived.agent, after(LEARNER.begin, run, np.int32(UNTIL))[0].agent
    for before, fresh in zip(old.critics.weights, new.critics.weights, strict=True):
        assert not np.any(before == fresh)
        assert np.abs(before - fresh).mean() > 0.05
    assert all(np.any(bias) for bias in old.critics.biases)
    assert all(np.abs(bias).max() < 1e-9 for bias in new.critics.biases)
    assert gap(new.targets, new.critics) < 1e-6
    assert gap((old.actor, old.log_alpha), (new.actor, new.log_alpha)) < 1e-9
    adams: list[Any] = [new.critic_adam, new.actor_adam, new.alpha_adam]
    counts = [int(adam.count) for adam in adams]
    first = CONFIG.sac.reset_updates
    assert counts == [first, UPDATES + first, UPDATES + first]


def test_rates_of_actor_and_critics_fall_from_the_end_of_pre_training_and_that_of_the_temperature_stays(lived: Run):
    falling, before = with_rate_end(lived, 0), lived.agent
    full, last = (after(LEARNER.learn, falling, np.int32(step), np.int32(0))[0].agent for step in (UNTIL, LAST))
    assert same(full, after(LEARNER.learn, lived, np.int32(UNTIL), np.int32(0))[0].agent)
    assert gap(full.actor, before.actor) > 0.1 * CONFIG.sac.actor_rate
    assert same((last.actor, last.critics), (before.actor, before.critics))
    assert gap(last.log_alpha, before.log_alpha) > 0.1 * CONFIG.sac.alpha_rate


# Which reward an update looks at.


def with_true_reward_changed(run: Run) -> Run:
    facts = run.replay.facts
    return run._replace(replay=run.replay._replace(facts=facts._replace(reward=facts.reward[::-1] - 2)))


def with_learned_reward_changed(run: Run) -> Run:
    return run._replace(replay=run.replay._replace(learned_reward=run.replay.learned_reward[::-1] - 2))


def test_pre_training_looks_at_the_neighbours_and_at_no_reward(lived: Run):
    def learned(run: Run) -> Agent:
        return after(LEARNER.pretrain, run, np.int32(200))[0].agent

    agent, entropy = learned(lived), lived.entropy
    assert not same(agent, lived.agent)
    assert same(learned(with_true_reward_changed(lived)), agent)
    assert same(learned(with_learned_reward_changed(lived)), agent)
    assert entropy is not None
    turned = jnp.concatenate([entropy.nearest[:FACTS][::-1], entropy.nearest[FACTS:]])
    assert not same(learned(lived._replace(entropy=entropy._replace(nearest=turned))).critics, agent.critics)


@pytest.mark.parametrize("method", ["m-senior", "sac"])
def test_plain_sac_learns_from_the_true_reward_and_the_others_from_the_learned_one(curious: Run, method: str):
    learner, run = LEARNER, curious
    if method == "sac":
        pretraining = replace(CONFIG.pretraining, until=0)
        config = replace(CONFIG, method=METHODS[method], pretraining=pretraining)
        learner = make_learner(config)
        run = learner.init(config)._replace(replay=curious.replay)

    def learned(run: Run) -> Agent:
        return after(learner.learn, run, np.int32(500), np.int32(0))[0].agent

    agent = learned(run)
    assert same(learned(with_true_reward_changed(run)), agent) == (method != "sac")
    assert same(learned(with_learned_reward_changed(run)), agent) == (method == "sac")


def test_rows_of_the_curiosity_buffer_carry_their_own_learned_reward(curious: Run):
    held = curious.bonus.curiosity
    changed = curious.bonus._replace(curiosity=held._replace(learned_reward=held.learned_reward - 2))
    other = curious.bonus._replace(curiosity=held._replace(reward=held.reward - 2))
    agents = [
        after(LEARNER.learn, curious._replace(bonus=bonus), np.int32(500), np.int32(0))[0].agent
        for bonus in (curious.bonus, changed, other)
    ]
    assert not same(agents[1].critics, agents[0].critics)
    assert same(agents[2], agents[0])


# The outer step.


def labelled_first_steps() -> FirstSteps:
    rng = np.random.default_rng(1)
    columns: list[Any] = [
        rng.normal(size=(M, 2, 4)).astype(np.float32),
        rng.uniform(-1, 1, (M, 2, 2)).astype(np.float32),
        rng.integers(2, size=M).astype(np.float32),
        np.ones(M, np.float32),
    ]
    return FirstSteps(*columns)


def test_the_outer_step_changes_the_reward_model_relabels_everything_and_leaves_the_agent(curious: Run):
    run, _ = after(LEARNER.outer, curious, labelled_first_steps(), np.int32(600))
    assert run.model is not None and curious.model is not None
    assert gap(run.model.members, curious.model.members) > 0.1 * CONFIG.reward.rate
    assert same(run.agent, curious.agent)
    assert same(run.replay.facts, curious.replay.facts)
    for before, fresh, filled in (
        (curious.replay.facts, run.replay, FACTS),
        (curious.bonus.curiosity, run.bonus.curiosity, CONFIG.pge.capacity),
    ):
        said = np.asarray(rewards(run.model.members, before.observation[:filled], before.action[:filled], None))
        np.testing.assert_allclose(fresh.learned_reward[:filled], said.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(fresh.spread[:filled], said.std(axis=0), atol=1e-6)
        assert not np.any(fresh.learned_reward[filled:])
    assert gap(run.replay.learned_reward, curious.replay.learned_reward) > 1e-3
    assert gap(run.bonus.curiosity.learned_reward, curious.bonus.curiosity.learned_reward) > 1e-3


def test_the_inner_rate_of_the_outer_step_is_the_critics_rate_at_that_step(curious: Run):
    """At a rate of 0 the virtual critics are the live ones, whatever the reward: no gradient, and nothing moves."""

    def outer(step: int, rate: float, rate_end: float) -> tuple[Any, float]:
        run = with_rate_end(with_sac(curious, critic_rate=rate), rate_end)
        run, info = after(LEARNER.outer, run, labelled_first_steps(), np.int32(step))
        return run.model and run.model.members, float(info["outer_loss"])

    before, half_way = curious.model and curious.model.members, (UNTIL + LAST) // 2
    at_end, loss_at_end = outer(LAST, 0.2, rate_end=0)
    assert same(at_end, before)
    np.testing.assert_allclose(loss_at_end, outer(LAST, 1e-12, rate_end=1)[1], rtol=1e-6)
    assert gap(outer(LAST, 0.2, rate_end=1)[0], before) > 0.1 * CONFIG.reward.rate
    whole, half = (outer(half_way, rate, rate_end=1)[1] for rate in (0.2, 0.1))
    np.testing.assert_allclose(outer(half_way, 0.2, rate_end=0)[1], half, rtol=1e-5)
    assert abs(whole - half) > 1e-3 * half
    assert outer(UNTIL, 0.2, rate_end=0)[1] == outer(UNTIL, 0.2, rate_end=1)[1]


# The length scale.


@pytest.mark.parametrize("stored", [1, FACTS, CONFIG.capacity, CONFIG.capacity + 60])
def test_the_length_scale_is_ten_times_the_spread_of_the_positions_that_are_stored(lived: Run, stored: int):
    """Each axis has a spread of its own; rows that hold nothing lie far out, and so do the other coordinates."""
    scales = np.array([0.3, 2, 50, 50])
    observation = np.random.default_rng(2).normal(5, scales, size=(CONFIG.capacity, 4)).astype(np.float32)
    observation[stored:] = 1e4
    facts = lived.replay.facts._replace(observation=observation)
    run = lived._replace(replay=lived.replay._replace(facts=facts, count=np.int32(stored)))
    run, told = after(LEARNER.measure, run)
    position = observation[:stored, :2].astype(np.float64)
    expected = 10 * np.sqrt(position.var(axis=0).mean())
    np.testing.assert_allclose(run.length_scale, max(expected, 1e-6), rtol=1e-4)
    assert told == run.length_scale


# The fit.


def test_every_fit_standardises_by_what_is_stored_and_scores_replay_and_curiosity_buffer_so(curious: Run):
    """Once with 150 facts, and once more with 30 others."""
    config = replace(CONFIG, reward=replace(CONFIG.reward, standardise=True))
    learner = make_learner(config)
    new = learner.init(config)
    assert new.model and new.model.scaling is not None
    rng, capacity = np.random.default_rng(0), CONFIG.queries.budget
    labelled = Labelled(
        rng.normal(size=(capacity, 2, SEGMENT, 4)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        rng.uniform(-1, 1, (capacity, 2, SEGMENT, 2)).astype(np.float32),  # pyright: ignore[reportArgumentType]
        np.zeros(capacity, np.float32),  # pyright: ignore[reportArgumentType]
        np.int32(8),  # pyright: ignore[reportArgumentType]
    )
    run, count = curious._replace(model=new.model), FACTS
    for more in (0, 30):
        for i in range(count, count + more):
            run, _ = after(learner.store, run, fact(i))
        count += more
        run, _ = after(learner.fit, run, labelled, np.int32(UNTIL))
        stored, action = run.replay.facts.observation[:count], run.replay.facts.action[:count]
        mean, deviation = stored.mean(axis=0), stored.std(axis=0)
        np.testing.assert_allclose(run.model.scaling.mean, mean, atol=1e-5)
        np.testing.assert_allclose(run.model.scaling.deviation, deviation, rtol=1e-4)
        expected = np.asarray(rewards(run.model.members, (stored - mean) / deviation, action, None))
        np.testing.assert_allclose(run.replay.learned_reward[:count], expected.mean(axis=0), atol=1e-5)
        held = run.bonus.curiosity
        paid = rewards(run.model.members, (held.observation - mean) / deviation, held.action, None)
        np.testing.assert_allclose(held.learned_reward, paid.mean(axis=0), atol=1e-5)
        _, summed = after(learner.summed_rewards, run, stored[None, None], action[None, None])
        np.testing.assert_allclose(summed[:, 0, 0], expected.sum(axis=-1), rtol=1e-3, atol=1e-3)


# The pairs of the outer step.


def test_the_pairs_are_the_latest_that_were_labelled_and_padded_without_weight(tmp_path: Path):
    rng = np.random.default_rng(4)
    trainee = Trainee(CONFIG, tmp_path, LEARNER, spec_of(CONFIG))
    observation = rng.normal(size=(16, 2, SEGMENT, 4)).astype(np.float32)
    action = rng.uniform(-1, 1, (16, 2, SEGMENT, 2)).astype(np.float32)
    said = [0, None, -1, 1, 1, 0, None, 1, 0, -1, 1, 0, None, 1, 0, 1]
    labels: list[int] = []
    try:
        for session, part in enumerate((slice(0, 0), slice(0, 4), slice(4, 14), slice(14, 16))):
            numbers = np.zeros((len(said[part]), 2), int)
            reward = np.zeros((*numbers.shape, SEGMENT))
            query = Query(Pairs(observation[part], action[part], reward, numbers, numbers))
            ids = trainee.preferences.add(query, session, 0, 0, numbers[:, 0])
            trainee.preferences.answer(Answers(ids, list(said[part])), "test")
            trainee.preferences.collect(session, 0, trainee.rules)
            kept = [i for i, label in enumerate(said[: part.stop]) if label is not None][-M:]
            pairs = FirstSteps(*map(np.asarray, trainee.latest_pairs()))  # pyright: ignore[reportArgumentType]
            assert [len(column) for column in pairs] == [M] * 4
            assert sorted(pairs.weight) == [0] * (M - len(kept)) + [1] * len(kept)
            held = pairs.weight == 1
            assert np.array_equal(pairs.observation[held], observation[kept, :, 0])
            assert np.array_equal(pairs.action[held], action[kept, :, 0])
            assert pairs.second[held].tolist() == [{0: 0.0, 1: 1.0, -1: 0.5}[said[i]] for i in kept]
            labels.append(len(kept))
    finally:
        trainee.close()
    assert labels == [0, 3, M, M]  # the last session has two of its own


# Whole runs: the order within a step, and a teacher that skips.


class Order(Quiet):
    """Notes by step which functions are called, and stops after the step ``last``.

    How often a selection rule asks the reward model is its own matter, so that is noted once.
    """

    def __init__(self, last: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.last, self.step = last, 0
        self.called: dict[int, list[str]] = defaultdict(list)
        for name, place in (("one", 1), ("propose", 0), ("every", 0), ("look", 1)):
            monkeypatch.setattr(Runs, name, self.noting(getattr(Runs, name), place))

    def noting(self, real: Any, place: int) -> Any:
        def call(runs: Runs, *arguments: Any) -> Any:
            name, called = arguments[place].__name__, self.called[self.step]
            if name != "summed_rewards" or called[-1] != name:
                called.append(name)
            return real(runs, *arguments)

        return call

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        self.step = step
        self.stop = step > self.last


def test_a_step_goes_in_the_order_of_algorithm_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """At step 450 session, outer step and refresh coincide. The length scale is taken before pairs are chosen by it."""
    seen = Order(450, monkeypatch)
    train(CONFIG, tmp_path, watcher=seen)
    session = ["cut", "summed_rewards", "fit", "on_session"]
    expected = {step: ["act", "store_pretraining"] for step in range(101)}
    expected |= {step: ["act", "pretrain", "store_pretraining"] for step in range(101, 400)}
    expected |= {step: ["act", "learn", "store"] for step in range(401, 450)}
    expected[400] = ["act", "measure", *session, "refresh", "begin", "store"]
    expected[425] = ["act", "refresh", "learn", "store"]
    expected[450] = ["act", *session, "outer", "refresh", "learn", "store"]
    assert seen.called == expected


class Skipper:
    """Skips all pairs of its first session and two of each that follows, and calls one of these equal."""

    def __init__(self) -> None:
        self.oracle = Scripted()
        self.sessions = 0

    def ask(self, ids: list[int], query: Query) -> None:
        self.sessions += 1
        self.oracle.ask(ids, query)

    def collect(self) -> Answers:
        answers = self.oracle.collect()
        if self.sessions == 1:
            return replace(answers, labels=[None] * len(answers.ids))
        return replace(answers, labels=[None, int(Preferred.EQUAL), None, *answers.labels[3:]])


def test_skipped_pairs_are_spent_and_nothing_is_learned_before_the_first_label(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Sessions of 10, 10 and 5 pairs at 400, 450 and 500; outer steps are due at 425, 450 and 475."""
    config = replace(
        CONFIG,
        steps=551,
        teacher=f"{__name__}:Skipper",
        bilevel=replace(CONFIG.bilevel, every=25),
    )
    monkeypatch.setattr(checkpoint, "KEPT", 9)
    expected = plan(config)
    assert [expected.sessions, expected.queried, expected.outer_steps] == [3, 25, 3]
    (result,) = train(config, tmp_path)
    assert result.finished
    episodes = {int(row["step"]): row for row in rows(result.path / "train.csv")}

    def counted(name: str) -> list[int]:
        return [int(episodes[step][name]) for step in (400, 450, 500, 550)]

    assert counted("queried") == [0, 10, 20, 25]
    assert counted("labels") == [0, 0, 8, 11]
    assert counted("outer_steps") == [0, 0, 2, 2]
    for step, row in episodes.items():
        assert bool(row["fit_epochs"]) == bool(row["outer_loss"]) == (step > 450), step

    learner = make_learner(config)
    new = learner.init(config)
    (unlabelled, _), (fitted, _) = (
        checkpoint.restore(result.path / "checkpoints", step, learner.init(config)) for step in (450, 551)
    )
    assert same(unlabelled.model, new.model)
    assert unlabelled.model is not None and fitted.model is not None
    assert gap(fitted.model.members, unlabelled.model.members) > config.reward.rate

    progress = progress_of(result.path)
    assert [progress["sessions"], progress["queried"], progress["outer_steps"]] == [3, 25, 2]
    preferences = Preferences(result.path / "preferences.sqlite", 25, SEGMENT, 4, 2)
    try:
        preferences.read(3)
        assert preferences.skipped == 14
        assert np.count_nonzero(preferences.arrays.second[: preferences.arrays.count] == EQUAL) == 2
    finally:
        preferences.close()
    assert result.labels == progress["labels"] == 25 - 14


class Dawdler(Scripted):
    """Answers one pair after the other, the last one first, and every other time none."""

    def __init__(self) -> None:
        super().__init__()
        self.held: list[tuple[int, int | None]] = []
        self.calls = 0

    def collect(self) -> Answers:
        answers = super().collect()
        self.held += zip(answers.ids, answers.labels, strict=True)
        self.calls += 1
        if not self.held or self.calls % 2:
            return Answers([], [])
        number, label = self.held.pop()
        return Answers([number], [label])


def test_a_teacher_may_take_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The run waits, and is the same as that of one who answers at once."""
    monkeypatch.setattr(loop, "LISTEN_SECONDS", 0.001)
    config = replace(CONFIG, steps=UNTIL + 60)
    (slow,) = train(replace(config, teacher=f"{__name__}:Dawdler"), tmp_path / "slow")
    (quick,) = train(config, tmp_path / "quick")
    assert slow.finished and quick.finished
    assert slow.labels == quick.labels == 20
    for name in ("eval.csv", "train.csv"):
        assert (slow.path / name).read_bytes() == (quick.path / name).read_bytes()
    one, other = (unpack(result.path / "policy" / "actor.npz") for result in (slow, quick))
    assert all(np.array_equal(one[name], other[name]) for name in other)


class Mumbler(Scripted):
    """Says what is no answer."""

    def collect(self) -> Answers:
        answers = super().collect()
        return replace(answers, labels=[2, *answers.labels[1:]])


class Stranger(Scripted):
    """Answers a pair that it was not asked."""

    def collect(self) -> Answers:
        answers = super().collect()
        return replace(answers, ids=[99, *answers.ids[1:]])


class Stutterer(Scripted):
    """Answers a pair twice."""

    def collect(self) -> Answers:
        answers = super().collect()
        return Answers([*answers.ids, answers.ids[0]], [*answers.labels, answers.labels[0]])


class Swallower(Scripted):
    """Answers fewer pairs than it says."""

    def collect(self) -> Answers:
        answers = super().collect()
        return replace(answers, labels=answers.labels[1:])


class Reckoner(Scripted):
    """Answers in NumPy's numbers."""

    def collect(self) -> Answers:
        answers = super().collect()
        return Answers([*np.array(answers.ids, np.int64)], [*np.array(answers.labels, np.int64)])  # pyright: ignore


def test_numbers_of_numpy_are_answers_like_others(tmp_path: Path):
    (ours,) = train(replace(CONFIG, teacher=f"{__name__}:Scripted"), tmp_path / "ours")
    (theirs,) = train(replace(CONFIG, teacher=f"{__name__}:Reckoner"), tmp_path / "theirs")
    assert ours.finished and theirs.finished

    def said(path: Path) -> list[list[object]]:
        return [[answer[2] for answer in row[-1]] for row in preferences_dump(path)]  # number, who, what

    assert said(theirs.path) == said(ours.path) and {1} < {x for row in said(ours.path) for x in row}


@pytest.mark.parametrize("teacher", ["Mumbler", "Stranger", "Stutterer", "Swallower"])
def test_a_teacher_who_makes_no_sense_stops_its_run_and_nothing_of_what_it_said_stays(teacher: str, tmp_path: Path):
    (result,) = train(replace(CONFIG, teacher=f"{__name__}:{teacher}"), tmp_path)
    assert (result.finished, result.step, result.labels) == (False, UNTIL, 0)
    assert result.failure is not None
    assert f"The teacher {__name__}:{teacher} must answer pairs that it was asked, each once" in result.failure
    assert [row[-1] for row in preferences_dump(result.path)] == [[]] * M  # asked, and not answered
    assert progress_of(result.path)["queried"] == 0
