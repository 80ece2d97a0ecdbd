"""Teachers that read the true reward (Lee et al. 2021, B-Pref). They see it because they stand in for people.

One rule with five numbers; the named teachers are rows of these. In this order: a pair whose better segment earns too
little is skipped; a pair whose segments earn about the same is marked; the segments are compared, for certain or by
chance; the answer is turned round by mistake; marked pairs are called equal after all. "Too little" and "about the
same" are shares of what a segment earned on average in the latest ten episodes. The public code multiplies by that
share twice from the second session on; here it counts once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from senior.types import Answers, Preferred, Query

RANDOM = 12
"""Purpose of a teacher's random numbers (`senior.learner.Purpose` lists the others)."""


class Numbers(NamedTuple):
    """What makes a teacher err."""

    rationality: float = -1.0
    """beta: the better segment is preferred with probability sigmoid(beta * advantage); -1: always."""
    foresight: float = 1.0
    """gamma: a step that lies k steps before a segment's last counts gamma^k."""
    mistake: float = 0.0
    """Probability of the opposite answer."""
    skip: float = 0.0
    """Least return of a pair's better segment, as a share of the average."""
    equal: float = 0.0
    """Difference of returns below which segments are equal, as a share of the average."""


TEACHERS: dict[str, Numbers] = {
    "oracle": Numbers(),
    "mistake": Numbers(mistake=0.1),
    "noisy": Numbers(rationality=1.0),
    "skip": Numbers(skip=0.1),
    "equal": Numbers(equal=0.1),
    "myopic": Numbers(foresight=0.9),
}


class Scripted:
    """Answers at once, from the true reward."""

    def __init__(self, numbers: Numbers = TEACHERS["oracle"], seed: int = 0) -> None:
        """``seed``: the run's. What is random in an answer depends on it and on the pair's number alone."""
        self.numbers = numbers
        self.seed = seed
        self._answers = Answers([], [])

    def ask(self, ids: list[int], query: Query) -> None:
        """Answer pairs; ``query.reward_per_step`` tells what the thresholds are shares of."""
        reward = query.pairs.reward.astype(np.float64)  # [P, 2, H]
        average = query.reward_per_step * reward.shape[-1]
        chance = np.array([np.random.default_rng([self.seed, RANDOM, number]).random(2) for number in ids])
        labels = judge(reward, self.numbers, average, chance)
        self._answers = Answers(self._answers.ids + ids, self._answers.labels + labels)

    def collect(self) -> Answers:
        """All answers since the last call."""
        answers, self._answers = self._answers, Answers([], [])
        return answers


def judge(reward: np.ndarray, numbers: Numbers, average: float, chance: np.ndarray) -> list[int | None]:
    """Answers to pairs of segments with those true rewards ``[P, 2, H]``; None: skipped.

    average: what a segment earned in the latest episodes. chance: uniform numbers in [0, 1) ``[P, 2]``, of each
    pair one for the comparison and one for the mistake. A tie goes to the first.
    """
    steps = reward.shape[-1]
    total = reward.sum(axis=-1)
    weighed = (reward * numbers.foresight ** np.arange(steps - 1, -1, -1.0)).sum(axis=-1)
    advantage = weighed[:, 1] - weighed[:, 0]  # of the second
    if numbers.rationality <= 0:
        second = advantage > 0
    else:
        second = chance[:, 0] < 1 / (1 + np.exp(np.clip(-numbers.rationality * advantage, -700, 700)))
    second = second ^ (chance[:, 1] < numbers.mistake)
    labels = np.where(second, Preferred.SECOND, Preferred.FIRST)
    labels[np.abs(total[:, 0] - total[:, 1]) < numbers.equal * average] = Preferred.EQUAL
    least = numbers.skip * average
    skipped = (total.max(axis=1) <= least) & (least > 0)
    return [None if out else int(label) for out, label in zip(skipped, labels, strict=True)]
