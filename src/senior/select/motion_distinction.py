"""MDS: ask about segments that move, and move differently (Eq. 3 to 5).

Of the pool, keep the share with the highest motion score m, the inverse of the summed density of each segment at
its own positions; of these take the pairs with the smallest d, the cosine between the two principal axes.
Eq. 5 does not say which way an axis points; oriented along the segment's displacement (our default), opposite
strokes get d = -1 and equal strokes d = +1. Ranking uses the sum itself, never its inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from senior.density import own_log_density
from senior.select import Context, Selection

STILL = 1e-12
"""A segment whose largest variance lies below this, in square length scales, has no direction."""


def motion_sum(positions: np.ndarray, bandwidth: float, of: str = "density") -> np.ndarray:
    """1/m of Eq. 3 for pairs ``positions [P, 2, H, d]`` -> ``[P]``; ``of="log"`` sums log densities instead."""
    pairs, _, steps, d = positions.shape
    log_f = np.asarray(own_log_density(jnp.asarray(positions.reshape(-1, steps, d)), bandwidth), np.float64)
    return (log_f if of == "log" else np.exp(log_f)).reshape(pairs, -1).sum(axis=1)


def axes(positions: np.ndarray, sign: str = "oriented", still: float = STILL) -> np.ndarray:
    """First principal axis of every segment ``[..., H, d] -> [..., d]``; zero where nothing moves."""
    positions = np.asarray(positions, np.float64)
    centred = positions - positions.mean(axis=-2, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(centred, -1, -2) @ centred / positions.shape[-2])
    axis = vectors[..., -1]
    if sign == "oriented":
        displacement = positions[..., -1, :] - positions[..., 0, :]
        axis = np.where((axis * displacement).sum(axis=-1, keepdims=True) < 0, -axis, axis)
    return np.where(values[..., -1:] < still, 0.0, axis)


def distinction(positions: np.ndarray, sign: str = "oriented", still: float = STILL) -> np.ndarray:
    """d of Eq. 5 for pairs ``[P, 2, H, d] -> [P]``, in [-1, 1]; ``sign="absolute"`` ignores the direction."""
    axis = axes(positions, sign, still)
    cosine = (axis[:, 0] * axis[:, 1]).sum(axis=-1)
    return np.abs(cosine) if sign == "absolute" else cosine


@dataclass(frozen=True)
class MotionDistinction:
    """The rule. Fields as in `senior.config.MotionDistinction`."""

    keep: float = 0.3
    bandwidth: float = 0.05
    density_sum: str = "density"
    axis: str = "oriented"
    scores: str = "own"

    def __call__(self, rng: np.random.Generator, context: Context, n: int) -> Selection:
        """``n`` pairs of smallest d among the ``keep`` share of the pool with the highest m.

        Mirrored scores are the public code's: in both stages a pair stands for the one at the other end of the list.
        """
        turn = slice(None, None, -1 if self.scores == "mirrored" else 1)
        positions = context.positions
        total = motion_sum(positions, self.bandwidth * context.length_scale, self.density_sum)
        kept = np.argsort(total[turn], kind="stable")[: max(n, int(len(total) * self.keep))]
        d = distinction(positions[kept], self.axis, STILL * context.length_scale**2)
        best = np.argsort(d[turn], kind="stable")[:n]
        # With log densities the sum is not the inverse of anything: the score is then its negative.
        motion = -total if self.density_sum == "log" else 1 / total
        return Selection(kept[best], {"m": motion[kept[best]], "d": d[best]})
