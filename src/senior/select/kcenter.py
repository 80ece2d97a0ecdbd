"""Ask about pairs that lie far from all that was asked before (k-center, as in B-Pref).

A pair is the point that its two segments' observations make when they are written one after the other. Greedily, the
candidate whose nearest labelled or already chosen pair is farthest away is chosen. The two mixtures first keep the
``WIDER * n`` candidates that the ensemble is least sure of.
"""

from __future__ import annotations

import numpy as np

from senior.select import Context, Selection, binary_entropy, deviation, highest, probability_second

WIDER = 5
"""Candidates per asked pair that a mixture keeps by its score."""


def kcenter(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """``n`` pairs, farthest first."""
    return _farthest(context, np.arange(len(context.pool)), n)


def kcenter_disagreement(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """The same among the pairs on which the members disagree most."""
    return _among_best(context, deviation(_predicted(context)), n, "disagreement")


def kcenter_entropy(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """The same among the pairs of highest entropy of the prediction."""
    return _among_best(context, binary_entropy(_predicted(context)), n, "entropy")


def _predicted(context: Context) -> np.ndarray:
    return probability_second(context.predict(context.pool.observation, context.pool.action))


def _among_best(context: Context, score: np.ndarray, n: int, name: str) -> Selection:
    chosen = _farthest(context, highest(score, WIDER * n, name).index, n)
    return Selection(chosen.index, {name: score[chosen.index], **chosen.scores})


def _farthest(context: Context, candidates: np.ndarray, n: int) -> Selection:
    """Of the candidates, ``n`` by greedy farthest point; the score is the distance at which each was chosen."""
    points = context.pool.observation[candidates].reshape(len(candidates), -1).astype(np.float64)
    nearest = np.full(len(points), np.inf)
    for pair in context.labelled:
        nearest = np.minimum(nearest, np.linalg.norm(points - pair.ravel(), axis=1))
    chosen: list[int] = []
    distance: list[float] = []
    for _ in range(n):
        best = int(np.argmax(nearest))
        chosen.append(best)
        distance.append(float(nearest[best]))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[best], axis=1))
        nearest[chosen] = -np.inf  # a copy of a chosen pair lies at distance 0, and is still another pair
    return Selection(candidates[chosen], {"distance": np.array(distance)})
