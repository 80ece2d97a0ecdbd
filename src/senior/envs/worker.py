"""The process behind `senior.envs.workers`: takes orders, one per line, until nobody can give any more.

Orders are ``open``, ``begin``, ``step`` and ``close``, with a place and details as JSON. Each is answered by a line
with the place, and after it, where something failed, the sentence that tells why.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from typing import Any

import numpy as np

from senior import envs
from senior.envs.episodes import Failure, Local
from senior.envs.workers import layout


class Place:
    """One environment, and the memory that is shared with its user."""

    def __init__(self, made_by: dict[str, Any], seed: int, purpose: int, memory: str) -> None:
        self.local = Local(lambda: envs.make(**made_by), seed, purpose)
        self.shared = np.memmap(memory, dtype=layout(self.local.spec), mode="r+", shape=1)[0]

    def begin(self, episode: int) -> Failure | None:
        failure = self.local.begin(episode)
        self.shared["observation"] = self.local.observation
        return failure

    def step(self) -> Failure | None:
        self.local.send(self.shared["action"])
        step = self.local.receive()
        if isinstance(step, Failure):
            return step
        self.shared["next_observation"] = step.next_observation
        self.shared["observation"] = self.local.observation
        self.shared["reward"] = step.reward
        self.shared["success"] = step.success or 0.0
        self.shared["terminated"] = step.terminated
        self.shared["truncated"] = step.truncated
        return None


def main(orders: int, answers: int) -> None:
    """Serve until the pipe of orders ends. An interrupt is for the process that gives them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    places: dict[int, Place] = {}
    with open(orders, "rb") as read:
        for line in read:
            what, number, details = line.decode().split(" ", 2)
            place, failure = int(number), None
            match what:
                case "step":
                    failure = places[place].step()
                case "begin":
                    failure = places[place].begin(**json.loads(details))
                case "open":
                    if place in places:
                        places.pop(place).local.close()
                    try:
                        places[place] = Place(**json.loads(details))
                    except Exception as error:
                        failure = Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
                case "close":
                    places.pop(place).local.close()
                    continue
            told = f" {json.dumps(failure.message)}" if failure else ""
            os.write(answers, f"{place}{told}\n".encode())


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
