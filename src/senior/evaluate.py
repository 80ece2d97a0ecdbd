"""Judge a policy on episodes of its own, in an environment of its own, with the mean action."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from senior.envs.episodes import Episodes, Failure

Policies = Callable[[Mapping[int, np.ndarray]], Mapping[int, np.ndarray]]
"""Per run: observation [o] float32 -> action [a] in [-1, 1]."""


class Episode(NamedTuple):
    """One judged episode."""

    total: float  # true return
    success: float | None  # 1 if any step succeeded; None if the environment does not tell
    actions: np.ndarray  # [T, a] float32
    observations: np.ndarray  # [T, o] float32, after each action


class _Judging:
    """One run, on its way through its episodes."""

    def __init__(self, place: Episodes, episodes: Sequence[int]) -> None:
        self.place = place
        self.left = list(episodes)
        self.judged: list[Episode] = []
        self.failure: Failure | None = None
        self._begin()

    @property
    def going_on(self) -> bool:
        return self.failure is None and bool(self.left)

    def _begin(self) -> None:
        self.total, self.success, self.actions, self.observations = 0.0, None, [], []
        if self.left:
            self.failure = self.place.begin(self.left[0])

    def receive(self, action: np.ndarray) -> None:
        """Count what ``action``, sent before, did."""
        step = self.place.receive()
        if isinstance(step, Failure):
            self.failure = step
            return
        self.actions.append(action)
        self.observations.append(step.next_observation)
        self.total += step.reward
        if step.success is not None:
            self.success = max(self.success or 0.0, step.success)
        if step.ended:
            lived = np.stack(self.actions), np.stack(self.observations)
            self.judged.append(Episode(self.total, self.success, *lived))
            del self.left[0]
            self._begin()


def judge(
    policies: Policies, places: Mapping[int, Episodes], episodes: Mapping[int, Sequence[int]]
) -> dict[int, list[Episode] | Failure]:
    """Bring every run's policy through its ``episodes`` in its place, all runs side by side.

    Per run its judged episodes, or what broke its environment.
    """
    runs = {i: _Judging(place, episodes[i]) for i, place in places.items()}
    while going_on := {i: run for i, run in runs.items() if run.going_on}:
        actions = policies({i: run.place.observation for i, run in going_on.items()})
        for i, run in going_on.items():
            run.place.send(actions[i])
        for i, run in going_on.items():
            run.receive(actions[i])
    return {i: run.failure or run.judged for i, run in runs.items()}


def summary(episodes: Sequence[Episode]) -> dict[str, float | int | None]:
    """Success rate in [0, 1] (None if not told), mean and population deviation of the true returns."""
    totals = np.array([episode.total for episode in episodes])
    told = [episode.success for episode in episodes if episode.success is not None]
    return {
        "episodes": len(episodes),
        "success_rate": float(np.mean(told)) if told else None,
        "return_mean": float(totals.mean()),
        "return_std": float(totals.std()),
    }
