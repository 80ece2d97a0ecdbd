"""What is said of many runs, against closed forms and against scipy and rliable."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rliable import library, metrics
from scipy import stats

from senior.report.statistics import (
    Interval,
    by_labels,
    correlation,
    difference_interval,
    improvement,
    interquartile_mean,
    interquartile_means,
    mean_and_deviation,
    mean_interval,
    mean_over,
    means,
    profiles,
    rank_correlation,
)

RATES = [0.8, 0.9, 1.0, 0.7, 0.4]
MANY = 10_000  # episodes that leave nothing open


def scores(rng: np.random.Generator, *runs: int) -> list[np.ndarray]:
    return [rng.random(n) for n in runs]


def test_the_mean_s_interval_is_student_s_where_episodes_are_many():
    found = mean_interval(RATES, MANY, 0.9)
    assert found == pytest.approx((np.mean(RATES), *stats.t.interval(0.9, 4, np.mean(RATES), stats.sem(RATES))))
    wide = mean_interval(RATES, MANY, 0.99)
    assert wide.low < found.low < found.mean < found.high < wide.high <= 1


def test_equal_seeds_leave_open_what_their_episodes_do():
    found = mean_interval([1.0] * 5, 10)
    p = 50.5 / 51
    assert found.low == pytest.approx(1 - stats.t.ppf(0.95, 4) * math.sqrt(p * (1 - p) / 10 / 5))
    assert (found.mean, found.high) == (1.0, 1.0)
    assert mean_interval([0.5] * 5, 10).low < mean_interval([0.5] * 5, 40).low < 0.5
    assert mean_interval([0.0] * 5, 10) == pytest.approx(Interval(0, 1 - 1.0, 1 - found.low))


def test_one_seed_tells_nothing_of_others():
    assert mean_interval([0.7], 10) == (0.7, 0, 1)
    assert difference_interval([0.7], [0.1, 0.2], 10) == pytest.approx((0.55, -1, 1))


@pytest.mark.parametrize("rates", [[], [0.5, 1.1], [-0.1, 0.5], [0.5, math.nan]])
def test_rates_that_are_none_are_refused(rates: list[float]):
    with pytest.raises(ValueError, match="between 0 and 1"):
        mean_interval(rates, 10)
    with pytest.raises(ValueError, match="between 0 and 1"):
        difference_interval([0.5, 0.5], rates, 10)


def test_no_episodes_are_refused():
    with pytest.raises(ValueError, match="episode"):
        mean_interval([0.5, 0.6], 0)


def test_the_interval_holds_the_truth_as_often_as_it_says():
    """Seeds whose own rates differ, each judged by ten episodes."""
    rng = np.random.default_rng(0)
    for alpha, beta in ((2.0, 2.0), (9.0, 1.0), (50.0, 1.0)):
        drawn = rng.binomial(10, rng.beta(alpha, beta, (2000, 5))) / 10
        held = [
            low <= alpha / (alpha + beta) <= high for _, low, high in (mean_interval(list(row), 10) for row in drawn)
        ]
        assert np.mean(held) > 0.87


def test_the_difference_is_welch_s_where_episodes_are_many():
    one, other = RATES, [0.1, 0.3, 0.2]
    told = stats.ttest_ind(one, other, equal_var=False)
    expected = told.confidence_interval(0.9)  # pyright: ignore[reportAttributeAccessIssue]
    found = difference_interval(one, other, MANY)
    assert found == pytest.approx((np.mean(one) - np.mean(other), expected.low, expected.high))
    back = difference_interval(other, one, MANY)
    assert back == pytest.approx((-found.mean, -found.high, -found.low))


def test_a_difference_of_equal_seeds_has_a_width_too():
    found = difference_interval([1.0] * 5, [0.5] * 5, 10)
    assert 0 < found.low < 0.5 < found.high < 1
    assert difference_interval([1.0] * 5, [0.5] * 5, 10, other_episodes=1000).low > found.low


def test_mean_and_deviation_of_few():
    assert mean_and_deviation([1.0, 2.0, 6.0]) == pytest.approx((3, np.std([1, 2, 6], ddof=1)))
    assert mean_and_deviation([2.0]) == pytest.approx((2, math.nan), nan_ok=True)
    assert mean_and_deviation([]) == pytest.approx((math.nan, math.nan), nan_ok=True)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11])
def test_the_interquartile_mean_is_scipy_s(count: int):
    values = np.random.default_rng(count).random((count, 3))
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25, axis=0))


def test_estimates_over_tasks_are_rliable_s():
    rng = np.random.default_rng(1)
    even, uneven = scores(rng, 5, 5, 5), scores(rng, 5, 3, 4)
    found, mean = interquartile_means({"even": even, "uneven": uneven}), means({"even": even, "uneven": uneven})
    matrix = np.stack(even, axis=1)
    assert found["even"].mean == pytest.approx([metrics.aggregate_iqm(matrix)])
    assert mean["even"].mean == pytest.approx([metrics.aggregate_mean(matrix)])
    copied = [np.repeat(task, 60 // len(task)) for task in uneven]  # every task weighs the same
    assert found["uneven"].mean == pytest.approx([stats.trim_mean(np.concatenate(copied), 0.25)])
    assert mean["uneven"].mean == pytest.approx([np.mean([task.mean() for task in uneven])])


def test_an_arm_is_no_better_for_having_more_runs_of_an_easy_task():
    easy, hard = np.ones, np.zeros
    found = interquartile_means({"one": [easy(8), hard(2)], "other": [easy(2), hard(8)]})
    assert found["one"].first().mean == found["other"].first().mean == pytest.approx(0.5)


def test_intervals_are_those_of_rliable_s_bootstrap():
    rng = np.random.default_rng(2)
    own = scores(rng, 6, 6)
    np.random.seed(3)  # noqa: NPY002
    _, bounds = library.get_interval_estimates(
        {"one": np.stack(own, axis=1)}, lambda drawn: np.array([metrics.aggregate_iqm(drawn)]), reps=4000
    )
    found = interquartile_means({"one": own})["one"]
    assert (found.low[0], found.high[0]) == pytest.approx(bounds["one"][:, 0], abs=0.02)


def test_methods_side_by_side_do_not_touch_each_other():
    rng = np.random.default_rng(4)
    curves = {name: [rng.random((5, 7)) + shift for _ in range(2)] for name, shift in (("a", 0.0), ("b", 10.0))}
    curves["more runs"] = [rng.random((6, 7)) + 20]
    found = interquartile_means(curves)
    assert list(found) == list(curves)
    for name, own in found.items():
        assert own.mean == pytest.approx(interquartile_mean(np.concatenate(curves[name])))
        assert own.mean.shape == own.low.shape == own.high.shape == (7,)
        assert (own.low < own.mean).all() and (own.mean < own.high).all()
        assert own.high.max() < own.low.min() + 2


def test_the_probability_of_improvement_is_rliable_s():
    rng = np.random.default_rng(5)
    own = {name: [np.round(task, 1) for task in scores(rng, 5, 5, 5)] for name in "abc"}  # with ties
    found = improvement(own)
    assert set(found) == {(x, y) for x in "abc" for y in "abc" if x != y}
    for (x, y), (mean, low, high) in found.items():
        expected = metrics.probability_of_improvement(np.stack(own[x], axis=1), np.stack(own[y], axis=1))
        assert mean == pytest.approx(expected)
        assert 0 <= low <= mean <= high <= 1
        assert found[y, x] == pytest.approx((1 - mean, 1 - high, 1 - low))


def test_improvement_with_unequal_numbers_of_runs_is_mann_and_whitney_s():
    rng = np.random.default_rng(6)
    x, y = scores(rng, 5, 3), scores(rng, 2, 4)
    parts = [stats.mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in zip(x, y, strict=True)]
    assert improvement({"x": x, "y": y})["x", "y"].mean == pytest.approx(np.mean(parts))


def test_who_always_wins_surely_improves_and_equals_do_not():
    high, low = [np.full(5, 0.9)], [np.full(5, 0.1)]
    found = improvement({"high": high, "low": low, "low too": low})
    assert found["high", "low"] == (1, 1, 1)
    assert found["low", "low too"] == (0.5, 0.5, 0.5)


def test_profiles_are_rliable_s():
    own = scores(np.random.default_rng(7), 5, 5)
    thresholds = np.linspace(0, 1, 11)
    found = profiles({"one": own}, thresholds)["one"]
    expected, _ = library.create_performance_profile({"one": np.stack(own, axis=1)}, thresholds, reps=2)
    assert found.mean == pytest.approx(expected["one"])
    assert (found.mean[0], found.mean[-1]) == (1, 0)
    assert (found.low <= found.mean).all() and (found.mean <= found.high).all()


def test_one_run_has_no_interval():
    found = interquartile_means({"one": [np.array([0.4])], "two": [np.array([0.4, 0.6])]})
    assert found["one"].mean == [0.4]
    assert np.isnan([found["one"].low, found["one"].high]).all()
    assert found["two"].low < found["two"].high
    both = improvement({"one": [np.array([0.4])], "two": [np.array([0.3, 0.6])]})["one", "two"]
    assert both.mean == 0.5 and math.isnan(both.low)


def test_the_bootstrap_repeats_itself_and_leaves_the_global_generator_alone():
    own = {"one": scores(np.random.default_rng(8), 5, 5)}
    np.random.seed(9)  # noqa: NPY002
    expected = np.random.random()  # noqa: NPY002
    np.random.seed(9)  # noqa: NPY002
    first, second = interquartile_means(own)["one"], interquartile_means(own)["one"]
    assert np.array_equal(first, second)
    assert np.random.random() == expected  # noqa: NPY002


def test_areas_are_means_over_steps_and_over_labels():
    steps, score = np.array([100.0, 200, 300, 400]), np.array([0.0, 1.0, 0.5, 0.9])
    assert mean_over(steps, score) == pytest.approx((0.5 + 0.75 + 0.7) / 3)
    asked, reached = by_labels(np.array([0, 50, 100, 100]), score)
    assert (list(asked), list(reached)) == ([0, 50, 100], [0.0, 1.0, 0.5])
    assert mean_over(asked, reached) == pytest.approx((0.5 + 0.75) / 2)
    assert mean_over(steps[:1], score[1:2]) == 1.0


def test_correlations_are_scipy_s():
    rng = np.random.default_rng(10)
    x = np.round(rng.random(50), 1)  # with ties
    y = np.exp(x) + rng.normal(0, 0.1, 50)
    assert correlation(x, y) == pytest.approx(stats.pearsonr(x, y)[0])
    assert rank_correlation(x, y) == pytest.approx(stats.spearmanr(x, y)[0])
    assert math.isnan(correlation(x, np.ones(50))) and math.isnan(rank_correlation(x[:2], y[:2]))
