"""Teachers that read the true reward (Lee et al. 2021, B-Pref). They see it because they stand in for people."""

from __future__ import annotations

from senior.types import Answers, Preferred, Query


class Oracle:
    """Always prefers the segment with the higher sum of true rewards; an exact tie goes to the first."""

    def __init__(self) -> None:
        self._answers = Answers([], [])

    def ask(self, ids: list[int], query: Query) -> None:
        """Answer at once."""
        total = query.pairs.reward.sum(axis=-1, dtype="float64")
        labels = [int(Preferred.SECOND if first < second else Preferred.FIRST) for first, second in total]
        self._answers = Answers(self._answers.ids + ids, self._answers.labels + labels)

    def collect(self) -> Answers:
        """All answers since the last call."""
        answers, self._answers = self._answers, Answers([], [])
        return answers
