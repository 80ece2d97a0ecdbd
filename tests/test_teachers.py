"""Scripted teachers, on segments made by hand and against what chance should give."""

from __future__ import annotations

import math

import numpy as np
import pytest

from senior import parts
from senior.config import Answering, Config
from senior.learner import Purpose
from senior.teachers.scripted import RANDOM, TEACHERS, Numbers, Scripted, judge
from senior.types import BadInput, Pairs, Preferred, Query

MANY = 100_000


def query_of(reward: object, reward_per_step: float = 0.0) -> Query:
    """A query whose pairs have those true rewards ``[P, 2, H]``; everything else says the opposite."""
    given = np.asarray(reward, np.float32)
    p, _, _ = given.shape
    nothing = np.zeros((p, 2), np.int64)
    return Query(
        Pairs(-given[..., None], -given[..., None], given, nothing, nothing),
        scores={"m": np.zeros(p)},
        prediction=np.full(p, 0.5),
        reward_per_step=reward_per_step,
    )


def answers_of(name: str, reward: object, reward_per_step: float = 0.0) -> list[int | None]:
    """What a named teacher says to pairs made by hand."""
    teacher = Scripted(TEACHERS[name], seed=3)
    query = query_of(reward, reward_per_step)
    teacher.ask(list(range(1, len(query.pairs) + 1)), query)
    return teacher.collect().labels


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
    assert answers_of("oracle", [[first, second]]) == [label]


def test_the_myopic_teacher_weighs_late_steps_more_and_the_last_one_whole():
    early, late = [3.0, 0, 0], [0, 0, 2.5]
    assert answers_of("oracle", [[early, late]]) == [Preferred.FIRST]
    assert answers_of("myopic", [[early, late]]) == [Preferred.SECOND]  # 3 * 0.81 = 2.43
    assert answers_of("myopic", [[[0, 0, 1.0], [0, 1 / 0.9 - 1e-3, 0]]]) == [Preferred.FIRST]
    assert answers_of("myopic", [[[0, 0, 1.0], [0, 1 / 0.9 + 1e-3, 0]]]) == [Preferred.SECOND]


def test_thresholds_are_shares_of_what_a_segment_earned_on_average_once():
    """Two steps at 5 each make an average of 10; a tenth of it is 1, a hundredth would be the public code's."""
    pairs = [[[0.6, 0.3], [0.2, 0.2]], [[0.6, 0.5], [0.2, 0.2]], [[0.2, 0.0], [0.9, 0.0]]]
    assert answers_of("skip", pairs, 5.0) == [None, Preferred.FIRST, None]
    close = [[[3.0, 0], [3.9, 0]], [[3.0, 0], [4.2, 0]], [[3.9, 0], [3.0, 0]]]
    assert answers_of("equal", close, 5.0) == [Preferred.EQUAL, Preferred.SECOND, Preferred.EQUAL]


def test_nothing_is_skipped_while_nothing_was_earned():
    assert answers_of("skip", [[[0.0, 0.0], [0.0, 0.0]]], 0.0) == [Preferred.FIRST]
    assert answers_of("skip", [[[-9.0, 0.0], [-8.0, 0.0]]], -5.0) == [Preferred.SECOND]


# Against chance: 100,000 queries each, within three standard deviations of what the closed form gives.


def random_pairs(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.5, 0.3, (MANY, 2, 4))


def assert_share(hits: np.ndarray, probability: np.ndarray | float) -> None:
    """``hits`` of independent trials happened as often as their probabilities say."""
    p = np.broadcast_to(probability, hits.shape)
    deviation = math.sqrt(np.sum(p * (1 - p)))
    assert abs(hits.sum() - p.sum()) <= 3 * deviation, (hits.mean(), p.mean())


def normal_below(z: float) -> float:
    return (1 + math.erf(z / math.sqrt(2))) / 2


def judged(reward: np.ndarray, numbers: Numbers, average: float = 2.0) -> np.ndarray:
    """Answers as an array, NaN where a pair was skipped."""
    return np.array(judge(reward, numbers, average, np.random.default_rng(11).random((len(reward), 2))), float)


def truth(reward: np.ndarray, foresight: float = 1.0) -> np.ndarray:
    weights = foresight ** np.array([3.0, 2, 1, 0])
    return np.array([sum(w * r for w, r in zip(weights, one, strict=True)) for one in reward[:, 1] - reward[:, 0]])


def test_the_oracle_and_the_myopic_teacher_never_err():
    reward = random_pairs(0)
    assert np.array_equal(judged(reward, TEACHERS["oracle"]), truth(reward) > 0)
    assert np.array_equal(judged(reward, TEACHERS["myopic"]), truth(reward, 0.9) > 0)


def test_the_mistaken_teacher_errs_at_its_rate_and_no_matter_how_clear_the_case():
    reward = random_pairs(1)
    gap = truth(reward)
    wrong = judged(reward, TEACHERS["mistake"]) != (gap > 0)
    assert_share(wrong, 0.1)
    clear = np.abs(gap) > 1
    assert 1000 < clear.sum() < MANY - 1000
    assert_share(wrong[clear], 0.1)
    assert_share(judged(reward, Numbers(mistake=0.37)) != (gap > 0), 0.37)


def test_the_noisy_teacher_answers_by_the_logistic_of_the_advantage():
    reward = random_pairs(2)
    gap = truth(reward)
    for rationality in (1.0, 4.0):
        second = judged(reward, Numbers(rationality=rationality))
        expected = 1 / (1 + np.exp(-rationality * gap))
        assert_share(second, expected)
        for low, high in ((-9, -0.5), (-0.5, 0), (0, 0.5), (0.5, 9)):
            held = (gap > low) & (gap <= high)
            assert_share(second[held], expected[held])


def test_the_teachers_own_chance_is_as_good_as_any():
    """Through `ask`, whose numbers come from a generator for each pair."""
    reward = random_pairs(4)
    gap = truth(reward.astype(np.float32).astype(float))
    right = gap > 0

    def said(numbers: Numbers) -> np.ndarray:
        teacher = Scripted(numbers, seed=5)
        teacher.ask(list(range(1, MANY + 1)), query_of(reward))
        return np.array(teacher.collect().labels) == Preferred.SECOND

    wrong = said(TEACHERS["mistake"]) != right
    assert_share(wrong, 0.1)
    assert_share(wrong[1:] & wrong[:-1], 0.01)  # of neighbours: seeds that follow each other give nothing alike
    assert_share(said(TEACHERS["noisy"]), 1 / (1 + np.exp(-gap)))


def test_the_skipping_and_the_equal_teacher_leave_out_and_mark_exactly_what_their_thresholds_say():
    reward = random_pairs(3)
    total = reward.sum(axis=-1)
    skipped = np.isnan(judged(reward, Numbers(skip=0.8), average=2.0))
    assert np.array_equal(skipped, total.max(axis=1) <= 1.6)
    assert 1000 < skipped.sum() < MANY - 1000
    # each of the two returns is normal with mean 4 * 0.5 and deviation 0.3 * 2, and both must stay below
    assert_share(skipped, normal_below((1.6 - 2) / 0.6) ** 2)
    equal = judged(reward, TEACHERS["equal"], average=2.0) == Preferred.EQUAL
    assert np.array_equal(equal, np.abs(total[:, 0] - total[:, 1]) < 0.2)
    # the difference of two sums of four normals of deviation 0.3 is normal with deviation 0.3 sqrt(8)
    assert_share(equal, math.erf(0.2 / (0.3 * math.sqrt(8) * math.sqrt(2))))


def test_a_mixture_has_all_five_at_once():
    """Noise and mistakes are independent; equal pairs are equal whatever was said; skipped ones are gone."""
    reward = random_pairs(4)
    total, gap = reward.sum(axis=-1), truth(reward, 0.8)
    label = judged(reward, Numbers(rationality=2.0, foresight=0.8, mistake=0.2, skip=0.6, equal=0.1), average=2.0)
    skipped = total.max(axis=1) <= 1.2
    marked = (np.abs(total[:, 0] - total[:, 1]) < 0.2) & ~skipped
    assert np.array_equal(np.isnan(label), skipped)
    assert np.array_equal(label == Preferred.EQUAL, marked)
    rest = ~skipped & ~marked
    second = 1 / (1 + np.exp(-2 * gap[rest]))
    assert_share(label[rest], 0.8 * second + 0.2 * (1 - second))


# As a teacher.


def test_answers_come_once_in_the_order_of_asking_under_the_numbers_asked():
    oracle = Scripted()
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


def test_two_teachers_share_no_answers():
    one, other = Scripted(), Scripted()
    one.ask([1], query_of([[[1], [2]]]))
    assert other.collect().ids == [] and one.collect().ids == [1]


def test_what_is_random_depends_on_the_run_and_on_the_pairs_number_alone():
    reward = random_pairs(5)[:500]

    def said(seed: int, first: int, together: int) -> list[int | None]:
        teacher = Scripted(TEACHERS["noisy"], seed)
        for start in range(0, 500, together):
            teacher.ask(
                list(range(first + start, first + start + together)), query_of(reward[start : start + together])
            )
        return teacher.collect().labels

    assert said(0, 1, 500) == said(0, 1, 20)
    assert said(0, 1, 500) != said(1, 1, 500)
    assert said(0, 1, 500) != said(0, 501, 500)
    assert RANDOM == Purpose.TEACHER


# From a configuration.


@pytest.mark.parametrize("name", TEACHERS)
def test_a_named_teacher_has_its_own_numbers_and_those_asked_for(name: str):
    teacher = parts.teacher(Config(teacher=name, seed=4))
    assert isinstance(teacher, Scripted)
    assert (teacher.numbers, teacher.seed) == (TEACHERS[name], 4)
    mixed = parts.teacher(Config(teacher=name, answering=Answering(mistake=0.2, equal=0.0)))
    assert isinstance(mixed, Scripted)
    assert mixed.numbers == TEACHERS[name]._replace(mistake=0.2, equal=0.0)


def test_the_numbers_are_resolved_and_resolving_again_changes_nothing():
    config = Config(teacher="mistake", answering=Answering(skip=0.3))
    resolved = parts.answering(config)
    assert resolved == Answering(rationality=-1, foresight=1, mistake=0.1, skip=0.3, equal=0)
    assert parts.answering(Config(teacher="mistake", answering=resolved)) == resolved


def test_numbers_of_a_scripted_teacher_are_refused_for_another():
    own = Config(teacher=f"{__name__}:Scripted", answering=Answering(mistake=0.2))
    with pytest.raises(
        BadInput, match=r"--mistake is a number of scripted teachers, and tests\.test_teachers:Scripted"
    ):
        parts.answering(own)
    assert parts.answering(Config(teacher=f"{__name__}:Scripted")) == Answering()
