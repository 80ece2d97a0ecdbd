"""What a command shows while it works and when it is done."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any, Protocol

from tqdm import tqdm


class Stoppable(Protocol):
    """What is told to stop, all saved."""

    stop: bool


def stop_when_asked(told: Stoppable) -> dict[int, Any]:
    """Let the first SIGINT or SIGTERM stop something, and a second one end the program; what they did before."""

    def asked(number: int, frame: FrameType | None) -> None:
        if told.stop:
            raise KeyboardInterrupt
        told.stop = True

    return {number: signal.signal(number, asked) for number in (signal.SIGINT, signal.SIGTERM)}


class Display:
    """A progress bar and a graceful end on SIGINT and SIGTERM; a second signal ends the program at once."""

    def __init__(self) -> None:
        self.stop = False
        self._bar: tqdm[Any] | None = None
        stop_when_asked(self)

    def advance(self, step: int, trainees: Sequence[Any]) -> None:
        """Draw, ten times a second at most."""
        if self._bar is None:
            steps = trainees[0].config.steps
            form = "{l_bar}{bar}| {n_fmt}/{total_fmt} steps {rate_fmt}{postfix} {remaining} left"
            self._bar = tqdm(total=steps, initial=step - 1, unit="step", bar_format=form, dynamic_ncols=True)
        if step % 20 == 0 or step == self._bar.total:
            told = [trainee.progress.success for trainee in trainees if trainee.progress.success is not None]
            labels = sum(trainee.progress.labels for trainee in trainees)
            budget = sum(trainee.config.queries.budget for trainee in trainees)
            success = f"{sum(told) / len(told):.0%}" if told else "-"
            asked = f"labels {labels}/{budget}, " if trainees[0].config.method.learns_reward else ""
            self._bar.set_postfix_str(f"{asked}success {success}", refresh=False)
            self._bar.update(step - self._bar.n)

    def say(self, sentence: str) -> None:
        """A line of its own above the bar."""
        tqdm.write(sentence, file=sys.stderr)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Plain columns."""
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in [head, *rows]]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)
