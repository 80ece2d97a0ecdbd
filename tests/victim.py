"""The command line in a process that sends itself a signal at an exact moment: python -m tests.victim MOMENT ARGUMENTS.

MOMENT is SIGNAL:PLACE. At the place nothing is cleaned up and nothing is caught, as when another process sends it.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from senior import checkpoint, cli, loop
from senior.preferences import Preferences
from senior.trainee import Trainee


def arm(place: str, strike: Callable[[], None], patch: Callable[[Any, str, Any], None] = setattr) -> None:
    """Have ``strike`` called when training comes to that place."""

    def before(owner: Any, name: str, condition: Callable[..., bool]) -> None:
        original = getattr(owner, name)

        def instead(*arguments: Any) -> Any:
            if condition(*arguments):
                strike()
            return original(*arguments)

        patch(owner, name, instead)

    def halfway(path: Path, data: bytes) -> bool:
        if path.name == "step-0000000650.npz":
            path.with_name(path.name + ".tmp").write_bytes(data[: len(data) // 2])
        return path.name == "step-0000000650.npz"

    if place.isdigit():  # while the environment takes the action of that step
        before(loop.Training, "receive", lambda _self, step: step == int(place))
    elif place == "checkpoint":  # half of that of step 650 is in its temporary file, its replay chunk is whole
        before(checkpoint, "write_atomically", halfway)
    elif place == "asked":  # the pairs of the second session are asked, none is answered
        before(Preferences, "answer", lambda _self, answers, *_: max(answers.ids) == 20)
    elif place == "fit":  # the answers of the second session are on the disk, the reward model has not seen them
        before(Trainee, "labelled", lambda self: self.progress.sessions == 2)
    elif place == "saved":  # the last checkpoint is written, and nothing else is done any more
        save = checkpoint.save

        def save_and_strike(directory: Path, step: int, *rest: Any) -> int:
            written = save(directory, step, *rest)
            if step == 1000:
                strike()
            return written

        patch(checkpoint, "save", save_and_strike)
    else:
        raise ValueError(place)


if __name__ == "__main__":
    name, _, where = sys.argv[1].partition(":")
    arm(where, lambda: os.kill(os.getpid(), signal.Signals[name]))
    sys.exit(cli.main(sys.argv[2:]))
