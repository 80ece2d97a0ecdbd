"""Warnings in words, from the histories a run keeps. A silent failure is what most often spoils a run."""

from __future__ import annotations

from collections.abc import Sequence

ENOUGH_ANSWERS = 30
CHANCE = 0.55
FALL = 0.3


def accuracy_at_chance(right: Sequence[int], asked: Sequence[int]) -> str | None:
    """``right`` of ``asked`` new pairs per session were predicted before the fit."""
    total = good = 0
    for hits, pairs in zip(reversed(right), reversed(asked), strict=True):
        total, good = total + pairs, good + hits
        if total >= ENOUGH_ANSWERS:
            if good / total > CHANCE:
                return None
            return (
                f"The reward model predicts new answers no better than chance ({good} of the last {total} right): "
                "it does not learn what the teacher prefers."
            )
    return None


def bonus_zero(beta: float, intrinsic_mean: float) -> str | None:
    """Of the last update of an episode."""
    if beta * intrinsic_mean > 1e-6:
        return None
    return (
        f"The exploration bonus is zero (weight {beta:.2g}, mean intrinsic reward {intrinsic_mean:.2g}): "
        "exploration is not guided by preferences."
    )


def nothing_moves(largest_variance: float, length_scale: float) -> str | None:
    """``largest_variance`` of any candidate segment's positions along its main axis."""
    if largest_variance > (1e-4 * length_scale) ** 2:
        return None
    return "No candidate segment moves at all: the end-effector stands still, or --position points elsewhere."


def success_falls(success: Sequence[float], learned_return: Sequence[float]) -> str | None:
    """Evaluations so far, and the mean learned return of the episodes before each."""
    if len(success) < 3:
        return None
    best = max(range(len(success)), key=lambda i: success[i])
    if success[best] - max(success[-2:]) < FALL - 1e-9 or learned_return[-1] <= learned_return[best]:
        return None
    return (
        f"Success has fallen from {success[best]:.0%} to {success[-1]:.0%} while the learned return rose from "
        f"{learned_return[best]:.3g} to {learned_return[-1]:.3g}: the policy may be exploiting the reward model."
    )
