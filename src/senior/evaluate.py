"""Judge a policy on episodes of its own, in environments of its own, with the mean action."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from senior.envs.episodes import Episodes, Failure

Policies = Callable[[Mapping[int, np.ndarray]], Mapping[int, np.ndarray]]
"""Per run: observations [n, o] float32 -> actions [n, a] in [-1, 1], one for each of its n places."""


class Episode(NamedTuple):
    """One judged episode."""

    total: float  # true return
    success: float | None  # 1 if any step succeeded; None if the environment does not tell
    actions: np.ndarray  # [T, a] float32
    observations: np.ndarray  # [T, o] float32, after each action


class _Lived:
    """One place, on its way through an episode."""

    def __init__(self, place: Episodes, episode: int) -> None:
        self.place = place
        self.episode = episode
        self.total, self.success, self.actions, self.observations = 0.0, None, [], []
        self.failure = place.begin(episode)
        self.over = False

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
        self.over = step.ended

    def judged(self) -> Episode:
        return Episode(self.total, self.success, np.stack(self.actions), np.stack(self.observations))


class _Judging:
    """One run, on its way through its episodes, as many at a time as it has places."""

    def __init__(self, places: Sequence[Episodes], episodes: Sequence[int]) -> None:
        self.places = places
        self.left = list(episodes)
        self.judged: dict[int, Episode] = {}
        self.failure: Failure | None = None
        self.lived: dict[int, _Lived] = {}  # by place
        for e in range(len(places)):
            if self.failure is None:
                self._begin(e)

    @property
    def going_on(self) -> bool:
        return self.failure is None and bool(self.lived)

    @property
    def observations(self) -> np.ndarray:
        """[n, o]; of a place that is done, its last."""
        return np.stack([place.observation for place in self.places])

    def _begin(self, e: int) -> None:
        self.lived.pop(e, None)
        if self.left:
            self.lived[e] = _Lived(self.places[e], self.left.pop(0))
            self.failure = self.lived[e].failure

    def send(self, actions: np.ndarray) -> None:
        for e in self.lived:
            self.places[e].send(actions[e])

    def receive(self, actions: np.ndarray) -> None:
        """Count what ``actions``, sent before, did; after a failure nothing is waited for any more."""
        for e, lived in list(self.lived.items()):
            lived.receive(actions[e])
            self.failure = lived.failure
            if lived.over:
                self.judged[lived.episode] = lived.judged()
                self._begin(e)
            if self.failure is not None:
                return

    @property
    def result(self) -> list[Episode] | Failure:
        return self.failure or [self.judged[episode] for episode in sorted(self.judged)]


def judge(
    policies: Policies, places: Mapping[int, Sequence[Episodes]], episodes: Mapping[int, Sequence[int]]
) -> dict[int, list[Episode] | Failure]:
    """Bring every run's policy through its ``episodes``, all runs side by side, each in its places.

    Per run its judged episodes, in the order of their numbers, or what broke one of its environments.
    """
    runs = {i: _Judging(own, episodes[i]) for i, own in places.items()}
    while going_on := {i: run for i, run in runs.items() if run.going_on}:
        actions = policies({i: run.observations for i, run in going_on.items()})
        for i, run in going_on.items():
            run.send(actions[i])
        for i, run in going_on.items():
            run.receive(actions[i])
    return {i: run.result for i, run in runs.items()}


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
