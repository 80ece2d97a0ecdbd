"""People. Their answers come through the labelling page (`senior.label`), which writes them into the run's preference
file itself before it says that they are saved; so there is nothing to hand over, and nothing to lose, in between.
"""

from __future__ import annotations

from senior.types import Answers, Query


class Human:
    """Nothing is put to people here, nor taken from them: asking is to be in the file, and so is having answered."""

    def ask(self, ids: list[int], query: Query) -> None:
        """The page finds the pairs in the file."""

    def collect(self) -> Answers:
        """None: what was said is in the file."""
        return Answers([], [])
