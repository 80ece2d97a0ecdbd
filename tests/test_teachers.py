"""Scripted teachers on segments made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from senior.teachers.scripted import Oracle
from senior.types import Pairs, Preferred, Query


def query_of(reward: object) -> Query:
    """A query whose pairs have those true rewards ``[P, 2, H]``; everything else says the opposite."""
    given = np.asarray(reward, np.float32)
    p, _, _ = given.shape
    nothing = np.zeros((p, 2), np.int64)
    return Query(
        Pairs(-given[..., None], -given[..., None], given, nothing, nothing),
        scores={"m": np.zeros(p)},
        prediction=np.full(p, 0.5),
    )


@pytest.mark.parametrize(
    ("first", "second", "label"),
    [
        ([1, 1, 1], [0, 1, 1], Preferred.FIRST),
        ([0, 1, 1], [1, 1, 1], Preferred.SECOND),
        ([3, 0, 0], [0, 0, 2], Preferred.FIRST),  # no step counts more than another
        ([0, 0, 2], [3, 0, 0], Preferred.SECOND),
        ([-1, -1, -1], [-1, -1, -2], Preferred.FIRST),
        ([1, 2, 3], [3, 2, 1], Preferred.FIRST),  # a tie goes to the first
        ([0, 0, 0], [0, 0, 0], Preferred.FIRST),
        ([1e8, 1, 0], [1e8, 2, 0], Preferred.SECOND),  # float32 would see a tie
    ],
)
def test_the_oracle_prefers_the_higher_sum_of_true_rewards(first: list, second: list, label: Preferred):
    oracle = Oracle()
    oracle.ask([7], query_of([[first, second]]))
    answers = oracle.collect()
    assert (answers.ids, answers.labels) == ([7], [label])


def test_answers_come_once_in_the_order_of_asking_under_the_numbers_asked():
    oracle = Oracle()
    assert oracle.collect().ids == []
    oracle.ask([4, 9], query_of([[[1], [2]], [[2], [1]]]))
    oracle.ask([11], query_of([[[0], [5]]]))
    answers = oracle.collect()
    assert answers.ids == [4, 9, 11]
    assert answers.labels == [Preferred.SECOND, Preferred.FIRST, Preferred.SECOND]
    again = oracle.collect()
    assert (again.ids, again.labels) == ([], [])
    oracle.ask([12], query_of([[[3], [1]]]))
    assert oracle.collect().ids == [12]


def test_two_oracles_share_no_answers():
    one, other = Oracle(), Oracle()
    one.ask([1], query_of([[[1], [2]]]))
    assert other.collect().ids == [] and one.collect().ids == [1]
