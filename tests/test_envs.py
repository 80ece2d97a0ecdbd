"""Environments: Meta-World held to its stock bit for bit, a toy, any Gymnasium environment, several."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.wrappers import TimeLimit

from senior import envs
from senior.envs import gymnasium as custom
from senior.envs import metaworld, point
from senior.envs.episodes import (
    EVALUATION,
    TRAINING,
    Episodes,
    Failure,
    Local,
    Step,
    episode_seed,
    restore,
)
from senior.types import BadInput, EnvSpec

HERE = __name__


def wandering(steps: int, size: int, seed: int) -> np.ndarray:
    """Actions that go far enough to touch things: a bounded random walk, float32 [steps, size]."""
    moves = np.random.default_rng(seed).normal(0, 0.4, (steps, size))
    return np.clip(np.cumsum(moves, axis=0), -1, 1).astype(np.float32)


def stock(task: str) -> Any:
    """A stock environment set up by hand, as the papers' code does it."""
    metaworld.MetaWorld(task).close()  # imports Meta-World the way the library does
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    env: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    if task == "box-close":
        env._partially_observable = False
        del env.sawyer_observation_space
    env._freeze_rand_vec = False
    env._set_task_called = True
    env.seeded_rand_vec = True
    return env


@cache
def ours(task: str) -> metaworld.MetaWorld:
    return metaworld.make(task)[0]


def lived(env: gymnasium.Env, seed: int, actions: np.ndarray) -> tuple[np.ndarray, list[float], list[float]]:
    """Observations [T + 1, o], rewards [T] and successes [T] of one episode."""
    observation, _ = env.reset(seed=seed)
    observations, rewards, successes = [observation], [], []
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        observations.append(observation)
        rewards.append(float(reward))
        successes.append(float(info["success"]))
    return np.stack(observations), rewards, successes


@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")  # Meta-World's script, of its own strides
@pytest.mark.parametrize("task", metaworld.TASKS)
def test_a_task_is_the_stock_bit_for_bit(task: str):
    """Two whole episodes after an unfinished one: the first wanders, the second follows Meta-World's own script."""
    reference, env = stock(task), ours(task)
    script = importlib.import_module(f"metaworld.policies.sawyer_{task.replace('-', '_')}_v3_policy")
    (policy,) = (value() for name, value in vars(script).items() if name.endswith("V3Policy"))
    lived(env, 5, wandering(7, 4, seed=2))  # must not matter
    for seed in (11, 12):
        reference.seed(seed)
        before = reference.reset()[0]
        np.testing.assert_array_equal(env.reset(seed=seed)[0], before)
        successes = []
        for wander in wandering(500, 4, seed):
            seen = np.concatenate([before[:36], reference._target_pos])  # scripts may look at the goal
            action = wander if seed == 11 else np.clip(policy.get_action(seen), -1, 1).astype(np.float32)
            before, reward, _, _, info = reference.step(action)
            got, our_reward, _, _, our_info = env.step(action)
            np.testing.assert_array_equal(got, before)
            assert our_reward == reward
            assert our_info == info
            assert 0 <= reward <= 10
            successes.append(our_info["success"])

            assert np.abs(got[36:39]).max() > 0.1 if task == "box-close" else (got[36:39] == 0).all()
            np.testing.assert_array_equal(got[metaworld.POSITION], env.stock.data.body("hand").xpos)
            assert env.observation_space.contains(got)
        assert seed == 11 or max(successes) == 1
    reference.close()


@pytest.mark.parametrize("task", metaworld.TASKS)
def test_seeds_place_the_object(task: str):
    env = ours(task)
    still = np.zeros((1, 4), np.float32)  # the windows show their true place from the first step on
    places = {tuple(lived(env, seed, still)[0][1][4:7].round(6)) for seed in (0, 1, 2, 0)}
    assert len(places) == 3


def test_a_meta_world_episode_is_truncated_at_500():
    env, reference = ours("door-lock"), stock("door-lock")
    reference.seed(3)
    env.reset(seed=3)
    reference.reset()
    for number, action in enumerate(wandering(500, 4, seed=3), start=1):
        got, expected = env.step(action), reference.step(action)
        np.testing.assert_array_equal(got[0], expected[0])
        assert got[1] == expected[1]
        assert got[2:4] == (False, number == 500)
    reference.close()


def test_meta_world_bad_input():
    with pytest.raises(BadInput, match="did you mean door-lock"):
        metaworld.make("door-lok")
    with pytest.raises(BadInput, match="did you mean v2"):
        metaworld.MetaWorld("door-lock", reward_function_version="v1")


def test_training_draws_nothing_and_needs_no_jax(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)  # a test before this one may have drawn
    program = (
        "import sys; sys.modules['jax'] = None\n"
        "import senior.envs.worker, senior.envs.render, senior.envs as envs\n"
        "assert 'mujoco' not in sys.modules and 'metaworld' not in sys.modules\n"
        "env, _ = envs.make('window-open'); env.reset(seed=0)\n"
        "assert not [name for name in sys.modules if name.startswith('OpenGL')]\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_tasks_by_name():
    assert envs.names() == [*metaworld.TASKS, "point"]
    assert [row[0] for row in envs.tasks_table()] == envs.names()
    assert list(metaworld.TASKS)[:3] == ["door-lock", "door-unlock", "door-open"]
    env, spec = envs.make("handle-press", horizon=100)
    env.close()
    assert spec == EnvSpec("handle-press", 39, 4, slice(0, 3), 100, 1.0, True)
    assert envs.make("point", horizon=70)[1].horizon == 70


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "window-opn"}, "did you mean window-open"),
        ({"task": None}, "--task"),
        ({"task": "door-lock", "position": "0:3"}, "belong to --env"),
        ({"task": "door-lock", "horizon": 501}, "500"),
        ({"task": "point", "horizon": 0}, "at least 1"),
        ({"task": None, "env": "Pendulum-v1", "position": "three"}, "0:3"),
    ],
)
def test_bad_tasks(arguments: dict[str, Any], message: str):
    with pytest.raises(BadInput, match=message):
        envs.make(**arguments)


# The toy


def test_point_is_solved_by_going_to_the_goal():
    env, spec = point.make()
    generator = np.random.default_rng(0)

    def success_rate(policy: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
        successes, total = [], 0.0
        for seed in range(40):
            observation, _ = env.reset(seed=seed)
            reached, truncated, steps = False, False, 0
            while not truncated:
                assert env.observation_space.contains(observation)
                observation, reward, terminated, truncated, info = env.step(policy(observation))
                assert 0 < reward <= 10
                assert not terminated
                reached |= info["success"] == 1
                total += reward
                steps += 1
            assert steps == spec.horizon
            successes.append(reached)
        return float(np.mean(successes)), total / 40

    solved, good = success_rate(lambda observation: np.clip(5 * observation[2:], -1, 1))
    by_chance, poor = success_rate(lambda _: generator.uniform(-1, 1, 2))
    assert solved == 1
    assert by_chance < 0.3
    assert good > 3 * poor


def test_point_may_end_early_and_tell_no_success():
    env, spec = point.make(terminate_at_goal=True, tell_success=False)
    observation, _ = env.reset(seed=0)
    terminated = truncated = False
    while not (terminated or truncated):
        observation, _, terminated, truncated, info = env.step(5 * observation[2:])
        assert info == {}
    assert terminated
    assert not truncated
    assert not spec.tells_success


# Any Gymnasium environment


class Lift(gymnasium.Env):
    """Six numbers observed, three acted, in bounds of its own; it insists on them."""

    observation_space = Box(-np.inf, np.inf, (6,), np.float64)
    action_space = Box(np.array([-2, 0, -0.7], np.float32), np.array([2, 3, 1.1], np.float32))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        self.last = np.zeros(3)
        return np.zeros(6), {}

    def step(self, action: np.ndarray):
        assert self.action_space.contains(action), action
        self.last = action
        return np.concatenate([action, action]), 1.0, False, False, {"is_success": True}


class DictSpace(Lift):
    observation_space = Dict({"a": Box(-1, 1, (2,))})


class Image(Lift):
    observation_space = Box(0, 1, (4, 4))


class DiscreteActions(Lift):
    action_space = Discrete(3)


class Unbounded(Lift):
    action_space = Box(-np.inf, np.inf, (3,))


class Broken(Lift):
    def __init__(self):
        raise OSError("no robot\nattached")


class Exits(Lift):
    def __init__(self) -> None:
        sys.exit("no licence")


class Closed(Lift):
    """Ends the program once it was told that its window is closed."""

    closed = False

    def step(self, action: np.ndarray):
        self.leave()
        return super().step(action)

    def reset(self, **options: Any):
        self.leave()
        return super().reset(**options)

    def render(self):
        self.leave()

    def close(self):
        self.leave()

    def leave(self) -> None:
        if self.closed:
            sys.exit("window closed")


class FailsAtOnce(Lift):
    def step(self, action: np.ndarray):
        raise OSError("cable")


class NoObservations(gymnasium.Env):
    action_space = Lift.action_space


class NoActions(gymnasium.Env):
    observation_space = Lift.observation_space


class Returns(Lift):
    """Its reward is an array of one, as a batch of one has it; its `close` raises."""

    reward: Any = np.ones(1)
    told: Any = np.array([True])

    def step(self, action: np.ndarray):
        return np.concatenate([action, action]), self.reward, False, False, self.told and {"success": self.told}

    def close(self):
        raise RuntimeError("no viewer")


class TwoRewards(Returns):
    reward = np.ones(2)


class NoInfo(Returns):
    told = None


class TooMuch(Returns):
    reward = 1e39  # more than float32 holds


def limited() -> gymnasium.Env:
    return TimeLimit(Lift(), 33)


NOT_AN_ENV = 3


def not_an_env() -> int:
    return 3


def test_a_custom_environment():
    env, spec = envs.make(None, f"{HERE}:Lift", "2:5", 0.5, 20)
    assert spec == EnvSpec(f"{HERE}:Lift", 6, 3, slice(2, 5), 20, 0.5, True)
    assert env.action_space == Box(-1, 1, (3,), np.float32)
    env.reset(seed=0)
    for share, action in ((0, -np.ones(3)), (0.5, np.zeros(3)), (1, np.ones(3))):
        observation, _, _, _, info = env.step(action.astype(np.float32))
        assert info["success"] is True
        low, high = Lift.action_space.low, Lift.action_space.high
        np.testing.assert_allclose(observation[:3], low + share * (high - low), rtol=1e-6)


def test_an_array_of_one_is_a_number():
    place = Local(lambda: envs.make(None, f"{HERE}:Returns", "0:3", horizon=20), 0, TRAINING)
    assert place.begin(0) is None
    step = taken(go(place, np.zeros(3, np.float32)))
    assert (step.reward, step.success) == (1.0, 1.0)
    place.close()


def test_no_environment_ends_the_program(monkeypatch: pytest.MonkeyPatch):
    place = Local(lambda: envs.make(None, f"{HERE}:Closed", "0:3", horizon=20), 0, TRAINING)
    assert place.begin(0) is None
    monkeypatch.setattr(Closed, "closed", True)
    failure = go(place, np.zeros(3, np.float32))
    assert isinstance(failure, Failure)
    assert re.search(r"after step 0: ProgramEnded: window closed \(test_envs\.py, line \d+\)$", failure.message)
    assert isinstance(place.begin(1), Failure)
    with pytest.raises(custom.ProgramEnded):
        place.env.render()
    place.env.close()


def test_horizon_of_a_custom_environment():
    where = slice(0, 2)
    assert custom.make(f"{HERE}:limited", where)[1].horizon == 33
    assert custom.make(f"{HERE}:limited", where, horizon=10)[1].horizon == 10
    assert custom.make(f"{HERE}:limited", where, horizon=100)[1].horizon == 33
    env, spec = custom.make("Pendulum-v1", where)
    assert spec == EnvSpec("Pendulum-v1", 3, 1, where, 200, None, False)
    assert env.action_space == Box(-1, 1, (1,), np.float32)


def test_a_users_file_in_the_current_directory(tmp_path, monkeypatch):
    (tmp_path / "my_robot.py").write_text("from senior.envs.point import Point as MyRobot\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "my_robot", raising=False)
    assert custom.make("my_robot:MyRobot", slice(0, 2), horizon=50)[1].tells_success


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module:Env", "cannot be imported.*no_such_module"),
        (f"{HERE}:Lfit", "did you mean Lift"),
        (f"{HERE}:NOT_AN_ENV", "not a class or a function"),
        (f"{HERE}:not_an_env", "gives a int"),
        (f"{HERE}:DictSpace", "observes Dict.*Box of one dimension"),
        (f"{HERE}:Image", "observes Box.*one dimension"),
        (f"{HERE}:DiscreteActions", "acts in Discrete.*bounded Box"),
        (f"{HERE}:Unbounded", "acts in Box.*bounded Box"),
        (f"{HERE}:Broken", "cannot be built: OSError: no robot attached"),
        (f"{HERE}:Exits", "cannot be built: ProgramEnded: no licence"),
        (f"{HERE}:FailsAtOnce", "fails at its first step: OSError: cable"),
        (f"{HERE}:NoObservations", "has no observation_space: AttributeError"),
        (f"{HERE}:NoActions", "has no action_space: AttributeError"),
        (f"{HERE}:TwoRewards", r"at its first step: the reward is an array of shape \(2,\)\.$"),
        (f"{HERE}:NoInfo", r"at its first step: the info of a step is None, not a dict\.$"),
        (f"{HERE}:TooMuch", r"at its first step: the reward is 1e\+39\.$"),
        ("Pendulum-v11", "did you mean Pendulum-v1"),
    ],
)
def test_custom_environments_that_do_not_fit(name: str, message: str):
    with pytest.raises(BadInput, match=message) as caught:
        custom.make(name, slice(0, 3), None, 20)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("position", "length_scale", "horizon", "message"),
    [
        (None, None, 20, "--position"),
        (slice(4, 7), None, 20, "outside the 6 numbers"),
        (slice(2, 2), None, 20, "outside"),
        (slice(0, 3), -1.0, 20, "positive"),
        (slice(0, 3), None, None, "--horizon"),
        (slice(0, 3), None, 0, "at least 1"),
    ],
)
def test_options_that_do_not_fit(position, length_scale, horizon, message: str):
    with pytest.raises(BadInput, match=message):
        custom.make(f"{HERE}:Lift", position, length_scale, horizon)


def test_position_is_parsed():
    assert custom.parse_position("2:5") == slice(2, 5)
    for text in ("", "3", "3:3", "5:2", "-1:2", "a:b", "0:3:1"):
        with pytest.raises(BadInput, match="first:end"):
            custom.parse_position(text)


# Episodes


def test_episode_seeds_differ_and_stay():
    seeds = {
        episode_seed(run, purpose, episode)
        for run in range(5)
        for purpose in (TRAINING, EVALUATION)
        for episode in range(50)
    }
    assert len(seeds) == 500
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert episode_seed(0, TRAINING, 0) == 1484405855  # stored runs depend on it


def taken(step: Step | Failure) -> Step:
    assert isinstance(step, Step), step
    return step


def go(place: Episodes, action: np.ndarray) -> Step | Failure:
    place.send(action)
    return place.receive()


def same(first: list[Step], second: list[Step]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(a, b) for one, other in zip(first, second, strict=True) for a, b in zip(one, other, strict=True)
    )


def test_every_run_goes_its_own_way():
    places = [Local(lambda: point.make(5), 3, TRAINING), Local(lambda: point.make(7), 4, TRAINING)]
    assert [place.begin(0) for place in places] == [None, None]
    actions = wandering(20, 2, seed=0)
    steps: tuple[list[Step], list[Step]] = ([], [])
    for action in actions:
        for run in (1, 0):
            before = places[run].observation.copy()
            step = taken(go(places[run], action))
            np.testing.assert_array_equal(step.observation, before)
            assert step.observation.dtype == step.next_observation.dtype == step.action.dtype == np.float32
            steps[run].append(step)
    assert [place.episode for place in places] == [4, 2]
    assert [place.elapsed for place in places] == [0, 6]
    assert [number for number, step in enumerate(steps[0], 1) if step.truncated] == [5, 10, 15, 20]
    assert not any(step.terminated for step in steps[0])

    env, _ = point.make(7)
    observation, _ = env.reset(seed=episode_seed(4, TRAINING, 1))
    np.testing.assert_array_equal(observation, steps[1][7].observation)
    for number in range(7, 14):
        observation, reward, _, _, info = env.step(actions[number])
        np.testing.assert_array_equal(observation, steps[1][number].next_observation)
        assert (reward, info["success"]) == (steps[1][number].reward, steps[1][number].success)
    assert not np.array_equal(steps[1][13].next_observation, places[1].observation)


def test_meta_world_is_stepped_with_float32_actions():
    place = Local(lambda: envs.make("door-lock"), 2, EVALUATION)
    place.begin(0)
    actions = wandering(60, 4, seed=6)
    steps = [taken(go(place, action)) for action in actions]
    place.close()
    observations, rewards, successes = lived(ours("door-lock"), episode_seed(2, EVALUATION, 0), actions)
    np.testing.assert_array_equal([step.observation for step in steps], observations[:-1].astype(np.float32))
    np.testing.assert_array_equal([step.next_observation for step in steps], observations[1:].astype(np.float32))
    assert [step.reward for step in steps] == rewards
    assert [step.success for step in steps] == successes


def test_the_last_observation_is_the_episodes_own():
    place = Local(lambda: point.make(3), 0, TRAINING)
    place.begin(0)
    steps = [taken(go(place, np.ones(2, np.float32))) for _ in range(4)]
    np.testing.assert_allclose(steps[2].next_observation[:2] - steps[2].observation[:2], 0.1, atol=1e-6)
    assert np.abs(steps[3].observation[:2]).max() <= 0.1  # the next episode starts in the middle
    assert np.abs(steps[2].next_observation[:2]).max() > 0.15


def test_termination_and_time_limit_are_told_apart():
    place = Local(lambda: custom.make(f"{HERE}:Lift", slice(0, 3), None, 4), 0, TRAINING)  # has no limit of its own
    place.begin(0)
    steps = [taken(go(place, np.zeros(3, np.float32))) for _ in range(9)]
    assert [step.truncated for step in steps] == [False, False, False, True] * 2 + [False]
    assert {step.success for step in steps} == {1.0}

    early = Local(lambda: point.make(terminate_at_goal=True, tell_success=False), 0, TRAINING)
    early.begin(0)
    step = taken(go(early, np.zeros(2, np.float32)))
    while not step.ended:
        step = taken(go(early, 5 * early.observation[2:]))
    assert (step.terminated, step.truncated, step.success) == (True, False, None)
    assert early.episode == 1


def test_purposes_and_episodes_can_be_chosen():
    def first(purpose: int, episode: int) -> np.ndarray:
        place = Local(point.make, 0, purpose)
        place.begin(episode)
        return place.observation

    assert np.array_equal(first(TRAINING, 0), first(TRAINING, 0))
    assert not np.array_equal(first(EVALUATION, 0), first(EVALUATION, 7))
    assert not np.array_equal(first(TRAINING, 0), first(EVALUATION, 0))


@pytest.mark.parametrize(
    ("make", "steps", "size"),
    [(point.make, 30, 2), (lambda: envs.make("handle-press"), 60, 4)],
    ids=["point", "handle-press"],
)
def test_restore_continues_bit_for_bit(make, steps: int, size: int):
    actions = wandering(steps + 20, size, seed=4)
    place = Local(make, 9, TRAINING)
    place.begin(3)
    original = [taken(go(place, action)) for action in actions]

    again = restore(place, 3, actions[:steps])
    assert isinstance(again, list)
    assert same(again, original[:steps])
    assert (place.episode, place.elapsed) == (3, steps)
    assert same([taken(go(place, action)) for action in actions[steps:]], original[steps:])
    place.close()


class Faulty(point.Point):
    """Breaks at step 2 in the way it is told to."""

    def __init__(self, fault: str):
        super().__init__(horizon=2)
        self.fault = fault
        self.calls = 0
        self.resets = 0

    def reset(self, **options: Any):
        self.resets += 1
        if self.resets == 2 and self.fault == "reset":
            raise ValueError("stuck")
        return super().reset(**options)

    def step(self, action: np.ndarray):
        self.calls += 1
        observation, reward, terminated, truncated, info = super().step(action)
        if self.elapsed == 2:
            match self.fault:
                case "nan":
                    observation[1] = np.nan
                case "huge":
                    observation = observation.astype(np.float64) + 1e200
                case "reward":
                    reward = float("inf")
                case "shape":
                    observation = observation[:3]
                case "raise":
                    raise RuntimeError("motor\nburnt")
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("nan", "the observation is nan at index 1"),
        ("huge", "the observation is inf at index 0"),
        ("reward", "the reward is inf"),
        ("shape", r"shape \(3,\) instead of \(4,\)"),
        ("raise", "RuntimeError: motor burnt"),
        ("reset", "ValueError: stuck"),
    ],
)
def test_a_broken_environment_is_told_and_left_alone(fault: str, message: str):
    kinds = iter((fault, "none"))
    place = Local(lambda: (Faulty(next(kinds)), point.make(horizon=2)[1]), 0, TRAINING)
    place.begin(0)
    action = np.ones(2, np.float32)
    first = taken(go(place, action))
    failure = go(place, action)
    assert isinstance(failure, Failure)
    with pytest.raises(AssertionError, match=message):
        taken(failure)
    assert "\n" not in failure.message
    assert "seed 0" in failure.message
    broken: Any = place.env
    assert broken.calls == 2
    assert go(place, action) == failure
    assert broken.calls == 2

    again = restore(place, 0, np.stack([action]))
    assert isinstance(again, list)
    assert same(again, [first])
    assert isinstance(go(place, action), Step)
