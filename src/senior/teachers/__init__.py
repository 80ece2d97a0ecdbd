"""Who answers. ``ask`` and ``collect`` are two calls, for people take their time.

A teacher is a new file here and a line in `TEACHERS`; a third party's is named ``module:Name`` and built without
arguments.
"""

from __future__ import annotations

from typing import Protocol

from senior.teachers import scripted
from senior.types import Answers, Query

TEACHERS = {
    **dict.fromkeys(scripted.TEACHERS, "senior.teachers.scripted:Scripted"),
    "human": "senior.teachers.human:Human",
}


class Teacher(Protocol):
    """Answers pairs of segments."""

    def ask(self, ids: list[int], query: Query) -> None:
        """Put pairs to the teacher; ``ids`` are their numbers in the run's preference file."""
        ...

    def collect(self) -> Answers:
        """What was answered since the last call, perhaps nothing yet; it is called again until all is."""
        ...
