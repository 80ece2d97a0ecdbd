"""Judging a policy: which episode is lived where, in how many rounds, and what a broken environment stops."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from senior.envs.episodes import Failure, Step
from senior.evaluate import judge

LENGTHS = (3, 1, 4, 2, 2)


class Place:
    """An environment whose episode n pays n a step, for `LENGTHS[n]` steps; it breaks in one of them, if told so."""

    def __init__(self, breaks: int | None = None) -> None:
        self.breaks = breaks
        self.observation = np.zeros(2, np.float32)
        self.notes: list[str] = []
        self.asked = 0

    def begin(self, episode: int, afresh: bool = False) -> Failure | None:
        self.observation = np.array([episode, 0], np.float32)
        return None

    def send(self, action: np.ndarray) -> None:
        assert action.tolist() == self.observation.tolist()  # the policy says back what it sees

    def set_out(self) -> None:
        pass

    def receive(self) -> Step | Failure:
        self.asked += 1
        before, (episode, elapsed) = self.observation, self.observation.astype(int).tolist()
        if episode == self.breaks:
            return Failure("motor burnt")
        self.observation = np.array([episode, elapsed + 1], np.float32)
        over = elapsed + 1 == LENGTHS[episode]
        return Step(before, before, float(episode), self.observation, over, False, float(episode == 2))

    def close(self) -> None:
        pass


class Echo:
    """A policy, and how often it was asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, observations: Mapping[int, np.ndarray]) -> Mapping[int, np.ndarray]:
        self.calls += 1
        return observations


@pytest.mark.parametrize(("places", "rounds"), [(1, 12), (2, 7), (3, 5), (5, 4)])
def test_an_episode_begins_as_soon_as_a_place_is_free(places: int, rounds: int):
    policy = Echo()
    found = judge(policy, {7: [Place() for _ in range(places)]}, {7: range(5)})[7]
    assert not isinstance(found, Failure)
    assert policy.calls == rounds
    assert [len(episode.actions) for episode in found] == list(LENGTHS)
    assert [episode.total for episode in found] == [n * length for n, length in enumerate(LENGTHS)]
    assert [episode.success for episode in found] == [0, 0, 1, 0, 0]
    for n, episode in enumerate(found):
        assert episode.actions.tolist() == [[n, t] for t in range(LENGTHS[n])]
        assert episode.observations.tolist() == [[n, t + 1] for t in range(LENGTHS[n])]


def test_where_one_place_breaks_the_others_are_not_waited_for():
    places = [Place(), Place(breaks=1), Place()]
    found = judge(Echo(), {0: places, 1: [Place()]}, {0: range(5), 1: range(5)})
    assert found[0] == Failure("motor burnt")
    assert [place.asked for place in places] == [1, 1, 0]
    assert isinstance(found[1], list) and len(found[1]) == 5
