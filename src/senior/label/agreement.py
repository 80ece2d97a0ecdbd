"""How far people agree who answered the same pairs, beyond what chance would give.

Conventions. An opinion is one of three categories without an order: the first segment is better, the second is, both
are equal. A skip is no opinion and is left out: one who could not tell neither agrees nor disagrees. Kappa is 1 where
all agree, 0 where they agree as often as chance would have it, and below 0 where less often. It is not defined (None)
where nobody shares a pair, and where chance alone would agree always, because all gave one and the same answer
throughout.

J. Cohen (1960), A coefficient of agreement for nominal scales. J. L. Fleiss (1971), Measuring nominal scale agreement
among many raters. Imports no JAX; statsmodels, which computes both, only when they are asked for.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from senior.types import BadInput

Said = tuple[int, str, int | None]
"""An answer that stands: number of the pair, annotator, and a `senior.types.Preferred` or None where skipped."""


class Cohen(NamedTuple):
    """Agreement of two people."""

    one: str
    other: str
    pairs: int
    """On which both have an opinion; at least one."""
    kappa: float | None


class Fleiss(NamedTuple):
    """Agreement of any people, of whom equally many have an opinion on each pair, not always the same ones."""

    pairs: int
    raters: int
    """Opinions on each of them."""
    kappa: float | None


def cohen(said: Iterable[Said]) -> list[Cohen]:
    """Cohen's kappa of every two people who share a pair, in the order of their first opinions."""
    said = list(said)
    opinions = _opinions(said)
    people = list(dict.fromkeys(name for _, name, answer in said if answer is not None))
    found = []
    for one, other in combinations(people, 2):
        shared = [(held[one], held[other]) for held in opinions.values() if one in held and other in held]
        if not shared:
            continue
        given = sorted({answer for both in shared for answer in both})
        table = np.zeros((len(given), len(given)))
        for both in shared:
            table[given.index(both[0]), given.index(both[1])] += 1
        kappa = float(_rater().cohens_kappa(table, return_results=False)) if len(given) > 1 else None
        found.append(Cohen(one, other, len(shared), kappa))
    return found


def fleiss(said: Iterable[Said]) -> Fleiss:
    """Fleiss' kappa over the pairs on which equally many people, two or more, have an opinion.

    Where the numbers differ from pair to pair, the one that most pairs have is taken, of two such the larger.
    """
    counts = [Counter(held.values()) for held in _opinions(said).values()]
    numbers = Counter(count.total() for count in counts if count.total() >= 2)
    if not numbers:
        return Fleiss(0, 0, None)
    raters = max(numbers, key=lambda number: (numbers[number], number))
    counts = [count for count in counts if count.total() == raters]
    given = sorted(set().union(*counts))
    table = np.array([[count[answer] for answer in given] for count in counts])
    return Fleiss(len(counts), raters, float(_rater().fleiss_kappa(table)) if len(given) > 1 else None)


def summary(said: Iterable[Said]) -> dict[str, Any]:
    """Both, as plain data: pairs, raters, fleiss (of them); cohen: a list of one, other, pairs, kappa."""
    said = list(said)
    many = fleiss(said)
    return {
        "pairs": many.pairs,
        "raters": many.raters,
        "fleiss": many.kappa,
        "cohen": [two._asdict() for two in cohen(said)],
    }


def _opinions(said: Iterable[Said]) -> dict[int, dict[str, int]]:
    """Per pair, who has which opinion."""
    opinions: dict[int, dict[str, int]] = {}
    for pair, name, answer in said:
        if answer is not None:
            opinions.setdefault(pair, {})[name] = answer
    return opinions


def _rater() -> Any:
    """The part of statsmodels that is needed. It takes two seconds to import, and is not installed by default."""
    try:
        from statsmodels.stats import inter_rater
    except ImportError as error:
        raise BadInput(
            "Agreement between people needs statsmodels, which is not installed: pip install 'senior-rl[label]'"
        ) from error
    return inter_rater
