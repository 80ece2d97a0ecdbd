"""The process behind `senior.envs.workers`: takes orders, one per line, until nobody can give any more.

Orders are ``step`` with places, and ``open``, ``begin`` and ``close`` with a place and details as JSON. Each is
answered by lines (``close`` by none), one per place: its number and, where something failed, why.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from senior import envs
from senior.envs.episodes import Failure, Local
from senior.envs.workers import Shared


class Place:
    """One environment, and the memory that is shared with its user."""

    def __init__(self, made_by: dict[str, Any], seed: int, purpose: int, memory: str) -> None:
        self.local = Local(lambda: envs.make(**made_by), seed, purpose)
        self.shared = Shared(Path(memory), self.local.spec)

    def begin(self, episode: int) -> Failure | None:
        failure = self.local.begin(episode)
        self.shared.observation[:] = self.local.observation
        return failure

    def step(self) -> Failure | None:
        shared = self.shared
        self.local.send(shared.action)
        step = self.local.receive()
        if isinstance(step, Failure):
            return step
        shared.next_observation[:] = step.next_observation
        shared.observation[:] = self.local.observation
        shared.numbers[:] = step.reward, step.success or 0.0
        shared.ends[:] = step.terminated, step.truncated
        return None


def main(orders: int, answers: int) -> None:
    """Serve until the pipe of orders ends."""
    places: dict[int, Place] = {}
    with open(orders, "rb") as read:
        for line in read:
            what, rest = line.decode().split(" ", 1)
            if what == "step":
                failures = [(int(place), places[int(place)].step()) for place in rest.split()]
            else:
                number, details = rest.split(" ", 1)
                place = int(number)
                failures = [(place, _rare(places, what, place, json.loads(details)))]
            if what != "close":
                told = (f"{place} {json.dumps(failure.message) if failure else ''}\n" for place, failure in failures)
                os.write(answers, "".join(told).encode())


def _rare(places: dict[int, Place], what: str, place: int, details: dict[str, Any]) -> Failure | None:
    if what == "begin":
        return places[place].begin(**details)
    if place in places:
        places.pop(place).local.close()
    if what == "open":
        try:
            places[place] = Place(**details)
        except Exception as error:
            return Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
    return None


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
