"""Stepping the environments of several runs in this process.

Every episode is decided by its number: it begins with a seed made of the run's seed, the purpose and the
episode's number, and continues by its actions alone. So an episode can be lived through again in a fresh
environment, bit for bit, which is how runs are resumed and videos made.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from senior.types import EnvSpec

TRAINING = 0
EVALUATION = 1
AFTERWARDS = 2
"""Purposes of episodes: training, evaluation within it and `senior eval` never share one."""


class Step(NamedTuple):
    """One transition as it happened."""

    observation: np.ndarray  # float32 [o], before the action
    action: np.ndarray  # float32 [a], in [-1, 1]
    reward: float
    next_observation: np.ndarray  # float32 [o]; at an episode's end its last one, never the next episode's first
    terminated: bool  # the episode really ended: nothing follows, no bootstrapping
    truncated: bool  # the time limit
    success: float | None  # 0 or 1; None where the environment tells no success

    @property
    def ended(self) -> bool:
        return self.terminated or self.truncated


@dataclass(frozen=True)
class Failure:
    """An environment broke; the message is one sentence that tells the cause."""

    message: str


def episode_seed(run_seed: int, purpose: int, episode: int) -> int:
    """The seed of one episode, in [0, 2^31): the range that every kind of environment accepts.

    run_seed, episode: at least 0. purpose: `TRAINING`, `EVALUATION` or `AFTERWARDS`.
    """
    words = np.random.SeedSequence([run_seed, purpose, episode]).generate_state(1)
    return int(words[0]) >> 1


class Environments:
    """One environment per run, each at its own step of its own episode.

    ``observations``: per run float32 [o], what the next action answers to. ``episodes``: per run the number
    of the running episode; set it before `reset_all` to begin elsewhere than at 0. ``elapsed``: per run the
    steps already taken in it. ``failures``: per run None or what broke it; such a run is not stepped again.
    """

    def __init__(
        self,
        make: Callable[[], tuple[gymnasium.Env[Any, Any], EnvSpec]],
        seeds: Sequence[int],
        purpose: int,
    ) -> None:
        """``make``: called once per run. ``seeds``: the runs'. ``purpose``: what the episodes are for."""
        built = [make() for _ in seeds]
        self.make = make
        self.seeds = list(seeds)
        self.purpose = purpose
        self.envs = [env for env, _ in built]
        self.specs = [spec for _, spec in built]
        self.observations = [np.zeros(spec.observation_size, np.float32) for spec in self.specs]
        self.episodes = [0] * len(built)
        self.elapsed = [0] * len(built)
        self.failures: list[Failure | None] = [None] * len(built)

    def reset_all(self) -> list[Failure | None]:
        """Begin, in every run not broken, the episode that ``episodes`` names. Returns ``failures``."""
        for run in range(len(self.envs)):
            if self.failures[run] is None:
                self._reset(run)
        return self.failures

    def begin(self, run: int, episode: int) -> Failure | None:
        """Begin that episode in one run, in the environment it has."""
        self.episodes[run] = episode
        self.failures[run] = None
        return self._reset(run)

    def step(self, run: int, action: np.ndarray) -> Step | Failure:
        """Take ``action``, float32 [a] in [-1, 1], in one run; after an episode's end begin its next episode.

        A `Failure` comes back where the environment, or the reset after an episode's end, raised or gave
        something that is not finite or not of the promised shape.
        """
        broken = self.failures[run]
        if broken is not None:
            return broken
        spec = self.specs[run]
        action = np.array(action, np.float32)
        try:
            # a copy, because an environment may scale what it is given in place
            raw, reward, terminated, truncated, info = self.envs[run].step(action.copy())
            observation = _checked(raw, spec)
            reward = _finite("reward", reward)
            success = _finite("success", info.get("success", 0.0)) if spec.tells_success else None
        except Exception as error:
            return self._fail(run, error)
        self.elapsed[run] += 1
        terminated = bool(terminated)
        truncated = bool(truncated) or (not terminated and self.elapsed[run] >= spec.horizon)
        step = Step(self.observations[run], action, reward, observation, terminated, truncated, success)
        self.observations[run] = observation
        if step.ended:
            self.episodes[run] += 1
            return self._reset(run) or step
        return step

    def restore(self, run: int, episode: int, actions: np.ndarray) -> list[Step] | Failure:
        """Rebuild a run's environment afresh, at the step of ``episode`` after ``actions`` [n, a] float32.

        Returns the n steps as they happened again, for comparison with what was stored.
        """
        with contextlib.suppress(Exception):  # the one that is thrown away may be broken
            self.envs[run].close()
        self.envs[run], self.specs[run] = self.make()
        self.episodes[run] = episode
        self.failures[run] = None
        failed = self._reset(run)
        if failed is not None:
            return failed
        steps = []
        for action in actions:
            step = self.step(run, action)
            if isinstance(step, Failure):
                return step
            steps.append(step)
        return steps

    def close(self) -> None:
        """Close every environment, broken ones included."""
        for env in self.envs:
            with contextlib.suppress(Exception):
                env.close()

    def _reset(self, run: int) -> Failure | None:
        self.elapsed[run] = 0
        seed = episode_seed(self.seeds[run], self.purpose, self.episodes[run])
        try:
            raw, _ = self.envs[run].reset(seed=seed)
            self.observations[run] = _checked(raw, self.specs[run])
        except Exception as error:
            return self._fail(run, error)
        return None

    def _fail(self, run: int, error: Exception) -> Failure:
        cause = str(error) if isinstance(error, _BadNumber) else f"{type(error).__name__}: {error}"
        failure = Failure(
            f"The environment {self.specs[run].name} of seed {self.seeds[run]} failed in episode "
            f"{self.episodes[run]} after step {self.elapsed[run]}: {' '.join(cause.split())}"
        )
        self.failures[run] = failure
        return failure


class _BadNumber(Exception):
    """The environment gave a number or a shape that no learner can use."""


def _checked(observation: Any, spec: EnvSpec) -> np.ndarray:
    """A float32 copy of an observation, checked: [o] and finite."""
    with np.errstate(over="ignore"):  # beyond float32 becomes infinite, and is told below
        copy = np.array(observation, np.float32)
    if copy.shape != (spec.observation_size,):
        raise _BadNumber(f"the observation has shape {copy.shape} instead of ({spec.observation_size},).")
    if not np.isfinite(copy).all():
        where = int(np.flatnonzero(~np.isfinite(copy))[0])
        raise _BadNumber(f"the observation is {copy[where]} at index {where}.")
    return copy


def _finite(what: str, value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise _BadNumber(f"the {what} is {number}.")
    return number
