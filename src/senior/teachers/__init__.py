"""Who answers. A teacher is asked pairs and may answer later: ``ask`` and ``collect`` are two calls.

A scripted teacher is a new file here and a line in `TEACHERS`; a third party's is named ``module:Name``.
"""

from __future__ import annotations

from typing import Protocol

from senior.types import Answers, Query

TEACHERS = {"oracle": "senior.teachers.scripted:Oracle"}


class Teacher(Protocol):
    """Answers pairs of segments."""

    def ask(self, ids: list[int], query: Query) -> None:
        """Put pairs to the teacher; ``ids`` are their numbers in the run's preference file."""
        ...

    def collect(self) -> Answers:
        """Answers that have come in since the last call, perhaps none yet."""
        ...
