"""The vocabulary that every part shares. Shapes are told here once; no JAX is imported.

Letters of the shapes: ``B`` batch, ``P`` pairs, ``H`` steps of a segment, ``o`` observation,
``a`` action, ``d`` position (the end-effector's place, a slice of the observation).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

BAD_INPUT = 2
"""Exit code of a process that ends with a `BadInput`."""


class BadInput(Exception):
    """Something the user gave cannot work. Its text is one clear sentence; the program ends with `BAD_INPUT`."""

    @classmethod
    def unknown(cls, kind: str, name: str, known: Iterable[str], otherwise: str | None = None) -> BadInput:
        """That ``name`` is no ``kind`` we know, with the nearest name that is; where none is near, what to do
        ``otherwise``, or all that are known."""
        names = list(known)
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]}?" if near else otherwise or f"known are {', '.join(names)}."
        return cls(f"Unknown {kind} {name!r}; {hint}")


@dataclass(frozen=True)
class EnvSpec:
    """What the library must know of an environment beside its Gymnasium interface.

    ``position`` is what keeps SENIOR free of any one observation order: both densities (Eq. 4) and
    the motion axis are computed on ``observation[position]``.
    """

    name: str
    observation_size: int
    action_size: int
    position: slice = field(hash=False)  # no hash before Python 3.12
    horizon: int
    """The most steps of an episode; reaching it is a truncation, never a termination."""
    length_scale: float | None
    """What one metre is in Meta-World: bandwidths are multiples of it. None: taken from the data."""
    tells_success: bool
    """Whether ``info["success"]`` exists, 0 or 1 at every step; an episode succeeds if any step does."""

    @property
    def position_size(self) -> int:
        return self.position.stop - self.position.start


class Source(IntEnum):
    """Which store a row of a batch was drawn from."""

    REPLAY = 0
    CURIOSITY = 1
    RECENT = 2


class Batch(NamedTuple):
    """Transitions drawn for one update. Every field has leading axis ``B``."""

    observation: Any  # [B, o]
    action: Any  # [B, a], in [-1, 1]
    reward: Any  # [B] true reward: for plain SAC only
    next_observation: Any  # [B, o]
    bootstrap: Any  # [B] 0 where the episode really ended, 1 elsewhere, a time limit included
    learned_reward: Any  # [B] mean over the ensemble, as last relabelled
    spread: Any  # [B] population standard deviation over the ensemble, as last relabelled
    source: Any  # [B] a Source
    row: Any  # [B] row within that source


class Pairs(NamedTuple):
    """Pairs of segments. ``reward`` is the true one: only a scripted teacher may look at it."""

    observation: np.ndarray  # [P, 2, H, o]
    action: np.ndarray  # [P, 2, H, a]
    reward: np.ndarray  # [P, 2, H]
    episode: np.ndarray  # [P, 2] which episode of the run each segment was cut from
    start: np.ndarray  # [P, 2] the step of that episode at which it begins

    def __len__(self) -> int:
        return len(self.observation)

    def take(self, index: np.ndarray) -> Pairs:
        return Pairs(*(column[index] for column in self))


class Preferred(IntEnum):
    """An answer as stored; a skipped pair has none of them."""

    FIRST = 0
    SECOND = 1
    EQUAL = -1


@dataclass(frozen=True)
class Query:
    """Pairs to be asked in one session, with what was known of each when it was chosen."""

    pairs: Pairs
    scores: dict[str, np.ndarray] = field(default_factory=dict)  # name -> [P], for instance m and d
    prediction: np.ndarray | None = None  # [P] P(second preferred) by the model before it is fitted
    reward_per_step: float = 0.0  # mean true reward of the latest ten episodes: only for a scripted teacher


@dataclass(frozen=True)
class Answers:
    """What a teacher said: per pair a `Preferred`, or None where the pair was skipped."""

    ids: list[int]
    labels: list[int | None]
