"""Labels that were recorded: ``--teacher labels.jsonl`` asks again what people were asked in another run, with the
segments and the answers of then (`senior.labels`). All of it is in the run's preference file from the start.
"""

from __future__ import annotations

from senior.types import Answers, Query

SUFFIX = ".jsonl"
"""How the name of a file of labels ends."""


class Recorded:
    """Nothing is asked here: pairs are taken from the file only with their answers."""

    def ask(self, ids: list[int], query: Query) -> None:
        """There is no such pair."""

    def collect(self) -> Answers:
        """None: what was said is in the file."""
        return Answers([], [])
