"""One environment and the episodes that it lives through.

Every episode is decided by its number: it begins with a seed made of the run's seed, the purpose and the
episode's number, and continues by its actions alone. So an episode can be lived through again in a fresh
environment, bit for bit, which is how runs are resumed, dead workers replaced and videos made.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np

from senior.envs.numbers import cause, checked, finite, raised_at
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


class Episodes(Protocol):
    """An environment at its own step of its own episode, in this process (`Local`) or in a worker's."""

    observation: np.ndarray
    """float32 [o]: what the next action answers to."""
    notes: list[str]
    """Sentences about what went wrong and was put right, for whoever reads and clears them."""

    def begin(self, episode: int, afresh: bool = False) -> Failure | None:
        """Begin the episode of that number; ``afresh``: in an environment built anew. Mends what was broken."""
        ...

    def send(self, action: np.ndarray) -> None:
        """Have ``action``, float32 [a] in [-1, 1], taken; `receive` tells what it did."""
        ...

    def set_out(self) -> None:
        """Begin what was sent, where that can be done while others work; `receive` does it otherwise."""
        ...

    def receive(self) -> Step | Failure:
        """What the action did. After an episode's end the next one has begun.

        A `Failure` comes back, now and until the next `begin`, where the environment, or the reset after an
        episode's end, raised or gave something that is not finite or not of the promised shape.
        """
        ...

    def close(self) -> None:
        """Close the environment, a broken one too."""
        ...


def restore(place: Episodes, episode: int, actions: np.ndarray) -> list[Step] | Failure:
    """Bring a fresh environment to the step of ``episode`` after ``actions`` [n, a] float32.

    Returns the n steps as they happened again, for comparison with what was stored.
    """
    failed = place.begin(episode, afresh=True)
    if failed is not None:
        return failed
    steps = []
    for action in actions:
        place.send(action)
        step = place.receive()
        if isinstance(step, Failure):
            return step
        steps.append(step)
    return steps


def episode_seed(run_seed: int, purpose: int, episode: int) -> int:
    """The seed of one episode, in [0, 2^31): the range that every kind of environment accepts.

    run_seed, episode: at least 0. purpose: `TRAINING`, `EVALUATION` or `AFTERWARDS`.
    """
    words = np.random.SeedSequence([run_seed, purpose, episode]).generate_state(1)
    return int(words[0]) >> 1


class Local:
    """`Episodes` in this process. ``elapsed``: steps taken in the running episode."""

    def __init__(self, make: Callable[[], tuple[gymnasium.Env[Any, Any], EnvSpec]], seed: int, purpose: int) -> None:
        """``seed``: the run's. ``purpose``: what the episodes are for."""
        self.make = make
        self.seed = seed
        self.purpose = purpose
        self.env, self.spec = make()
        self.observation = np.zeros(self.spec.observation_size, np.float32)
        self.notes: list[str] = []
        self.episode = 0
        self.elapsed = 0
        self.failure: Failure | None = None
        self._action = np.zeros(self.spec.action_size, np.float32)

    def begin(self, episode: int, afresh: bool = False) -> Failure | None:
        """See `Episodes.begin`."""
        if afresh:
            self.close()
            self.env, self.spec = self.make()
        self.episode = episode
        self.failure = None
        return self._reset()

    def send(self, action: np.ndarray) -> None:
        """See `Episodes.send`; it is taken when `receive` is called."""
        self._action = np.array(action, np.float32)

    def set_out(self) -> None:
        """See `Episodes.set_out`."""

    def receive(self) -> Step | Failure:
        """See `Episodes.receive`."""
        if self.failure is not None:
            return self.failure
        spec, action = self.spec, self._action
        try:
            # a copy, because an environment may scale what it is given in place
            raw, reward, terminated, truncated, info = self.env.step(action.copy())
            observation = checked(raw, spec.observation_size)
            reward = finite("reward", reward)
            success = finite("success", info.get("success", 0.0)) if spec.tells_success else None
        except Exception as error:
            return self._fail(error)
        self.elapsed += 1
        terminated = bool(terminated)
        truncated = bool(truncated) or (not terminated and self.elapsed >= spec.horizon)
        step = Step(self.observation, action, reward, observation, terminated, truncated, success)
        self.observation = observation
        if step.ended:
            self.episode += 1
            return self._reset() or step
        return step

    def close(self) -> None:
        """See `Episodes.close`."""
        with contextlib.suppress(Exception):
            self.env.close()

    def _reset(self) -> Failure | None:
        self.elapsed = 0
        try:
            raw, _ = self.env.reset(seed=episode_seed(self.seed, self.purpose, self.episode))
            self.observation = checked(raw, self.spec.observation_size)
        except Exception as error:
            return self._fail(error)
        return None

    def _fail(self, error: Exception) -> Failure:
        self.failure = Failure(
            f"The environment {self.spec.name} of seed {self.seed} failed in episode "
            f"{self.episode} after step {self.elapsed}: {cause(error)}{raised_at(error)}"
        )
        return self.failure
