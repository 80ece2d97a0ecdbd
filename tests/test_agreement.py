"""Agreement between people, held to the examples of those who proposed its measures."""

from __future__ import annotations

import builtins
import sys
from typing import Any

import numpy as np
import pytest

from senior.label.agreement import Cohen, Fleiss, Said, cohen, fleiss, summary
from senior.types import BadInput

FIRST, SECOND, EQUAL = 0, 1, -1

# Fleiss (1971), table 1: how many of six psychiatrists gave each of five diagnoses to each of 30 patients.
DIAGNOSES = """
00060 03003 01401 00006 03030 20400 00402 20310 20040 00006 10050 11040 03300 10050 02031
00501 30012 51000 02040 10203 00006 01050 02013 20040 10041 05010 40002 02040 10500 00006
"""


def counted(table: str) -> list[Said]:
    """Answers whose counts per pair and category are the digits of a word each."""
    said: list[Said] = []
    for pair, counts in enumerate(table.split()):
        answers = [category for category, count in enumerate(counts) for _ in range(int(count))]
        said += [(pair, f"rater {i}", answer) for i, answer in enumerate(answers)]
    return said


def crossed(table: list[list[int]]) -> list[Said]:
    """Answers of two people: ``table[i][j]`` pairs of which ann says i and bob j."""
    both = [(i, j) for i, row in enumerate(table) for j, count in enumerate(row) for _ in range(count)]
    return [said for pair, (ann, bob) in enumerate(both) for said in ((pair, "ann", ann), (pair, "bob", bob))]


def test_fleiss_own_example():
    found = fleiss(counted(DIAGNOSES))
    assert (found.pairs, found.raters) == (30, 6)
    assert found.kappa == pytest.approx(0.430, abs=5e-4)


@pytest.mark.parametrize(
    ("table", "kappa"),
    [
        ([[88, 10, 2], [14, 40, 6], [18, 10, 12]], 0.492),  # Cohen (1968), table 1, of 200 patients
        ([[20, 5], [10, 15]], 0.4),  # fifty grants, two readers
        ([[0, 7], [7, 0]], -1.0),
        ([[5, 0, 0], [0, 3, 0], [0, 0, 1]], 1.0),
    ],
    ids=["Cohen", "grants", "never", "always"],
)
def test_cohens_own_example_and_the_ends_of_the_scale(table: list[list[int]], kappa: float):
    (found,) = cohen(crossed(table))
    assert found[:3] == ("ann", "bob", int(np.sum(table)))
    assert found.kappa == pytest.approx(kappa, abs=5e-4)


def test_people_who_answer_by_chance_agree_by_chance():
    rng = np.random.default_rng(0)
    said: list[Said] = [
        (pair, name, int(rng.integers(-1, 2))) for pair in range(3000) for name in ("ann", "bob", "eve")
    ]
    many = fleiss(said)
    assert (many.pairs, many.raters) == (3000, 3)
    assert many.kappa is not None and abs(many.kappa) < 0.05
    assert [two[:3] for two in cohen(said)] == [("ann", "bob", 3000), ("ann", "eve", 3000), ("bob", "eve", 3000)]
    assert all(two.kappa is not None and abs(two.kappa) < 0.05 for two in cohen(said))


def test_a_skip_is_no_opinion():
    """Pair 3 is left with one opinion, pair 4 with none; pair 5 was given to one alone."""
    said: list[Said] = [(1, "ann", FIRST), (1, "bob", FIRST), (2, "ann", SECOND), (2, "bob", EQUAL)]
    more: list[Said] = [(3, "ann", None), (3, "bob", SECOND), (4, "bob", None), (4, "ann", None), (5, "eve", FIRST)]
    assert summary([*more, *said]) == {**summary(said), "cohen": summary([*more, *said])["cohen"]}
    (two,) = cohen(said)
    assert cohen([*more, *said]) == [Cohen("bob", "ann", 2, pytest.approx(two.kappa))]  # pyright: ignore[reportArgumentType]
    assert two.kappa == pytest.approx((0.5 - 0.25) / (1 - 0.25))


def test_fleiss_takes_the_pairs_that_most_have_equally_many_opinions_on():
    three: list[Said] = [(pair, name, pair % 2) for pair in (1, 2) for name in ("ann", "bob", "eve")]
    two: list[Said] = [(pair, name, EQUAL) for pair in (3, 4, 5) for name in ("ann", "eve")]
    assert fleiss(three + two[:4]) == Fleiss(2, 3, 1.0)  # of two numbers as frequent, the larger
    assert fleiss(three + two) == Fleiss(3, 2, None)
    assert fleiss([*two, (6, "bob", FIRST), (6, "eve", SECOND)])[:2] == (4, 2)


@pytest.mark.parametrize("answer", [FIRST, SECOND, EQUAL])
def test_where_all_give_one_answer_throughout_there_is_nothing_to_compare_with_chance(answer: int):
    said: list[Said] = [(pair, name, answer) for pair in range(4) for name in ("ann", "bob")]
    assert cohen(said) == [Cohen("ann", "bob", 4, None)]
    assert fleiss(said) == Fleiss(4, 2, None)


@pytest.mark.parametrize("said", [[], [(1, "ann", FIRST), (2, "bob", SECOND)], [(1, "ann", None), (1, "bob", None)]])
def test_where_nobody_shares_a_pair_there_is_no_agreement(said: list[Said]):
    assert summary(said) == {"pairs": 0, "raters": 0, "fleiss": None, "cohen": []}


def test_the_summary_is_plain_data():
    said = crossed([[2, 1], [0, 3]])
    (two,) = cohen(said)
    found = summary(iter(said))
    assert found == {
        "pairs": 6,
        "raters": 2,
        "fleiss": fleiss(said).kappa,
        "cohen": [{"one": "ann", "other": "bob", "pairs": 6, "kappa": two.kappa}],
    }
    assert type(found["fleiss"]) is type(found["cohen"][0]["kappa"]) is float


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch):
    real = builtins.__import__

    def lacking(name: str, *rest: Any) -> Any:
        if name.startswith("statsmodels"):
            raise ImportError(name)
        return real(name, *rest)

    for name in [name for name in sys.modules if name.startswith("statsmodels")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", lacking)
    assert summary([])["cohen"] == []  # and nothing is needed where there is nothing to tell
    with pytest.raises(BadInput, match="needs statsmodels, which is not installed: pip install"):
        cohen(crossed([[1, 1], [1, 1]]))
