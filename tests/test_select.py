"""Selection rules held to loops written from the equations, in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from senior.parts import load
from senior.select import (
    RULES,
    Context,
    Selection,
    disagreement,
    entropy,
    kcenter,
    motion_distinction,
    probability_second,
)
from senior.select.motion_distinction import MotionDistinction, axes, distinction, motion_sum
from senior.types import EnvSpec, Pairs

H, O, A = 12, 6, 2
SCALE = 2.0
SPEC = EnvSpec("arm", O, A, slice(1, 4), 50, SCALE, True)
RNG = np.random.default_rng


def context_of(positions: np.ndarray, summed: np.ndarray | None = None) -> Context:
    """A pool with those positions ``[P, 2, H, 3]``; the rest of the observations is far-flung noise."""
    rng, p = RNG(99), len(positions)
    observation = rng.normal(0, 50, (p, 2, positions.shape[2], O)).astype(np.float32)
    observation[..., SPEC.position] = positions
    action = rng.normal(size=(p, 2, positions.shape[2], A)).astype(np.float32)
    nowhere = np.zeros((p, 2), np.int64)
    pool = Pairs(observation, action, observation[..., 0], nowhere, nowhere)

    def predict(o: np.ndarray, a: np.ndarray) -> np.ndarray:
        assert summed is not None
        assert o is pool.observation and a is pool.action
        return summed

    return Context(pool, predict, SPEC, SCALE, observation[:0])


def strokes(seed: int, pairs: int, steps: int = H) -> np.ndarray:
    """Positions of pairs of crooked strokes of all directions and lengths, float32."""
    rng = RNG(seed)
    direction = rng.normal(size=(pairs, 2, 1, 3)) * rng.uniform(0, 0.3, (pairs, 2, 1, 1))
    along = np.linspace(0, 1, steps)[:, None]
    wobble = np.cumsum(rng.normal(0, 0.004, (pairs, 2, steps, 3)), axis=2)
    return (rng.normal(size=(pairs, 2, 1, 3)) + direction * along + wobble).astype(np.float32)


# From the equations.


def density_by_hand(point: np.ndarray, samples: np.ndarray, h: float) -> float:
    total = 0.0
    for sample in samples:
        total += np.exp(-0.5 * np.sum(((point - sample) / h) ** 2)) / (h * np.sqrt(2 * np.pi)) ** 3
    return total / len(samples)


def motion_by_hand(pair: np.ndarray, h: float, log: bool = False) -> float:
    """1/m of Eq. 3, or the sum of logarithms that the public code takes."""
    densities = [density_by_hand(p, own, h) for own in pair.astype(np.float64) for p in own]
    return sum(np.log(densities) if log else densities)


def axis_by_hand(positions: np.ndarray) -> np.ndarray:
    """First principal axis by singular value decomposition, along the displacement."""
    positions = positions.astype(np.float64)
    axis = np.linalg.svd(positions - positions.mean(axis=0))[2][0]
    return axis if axis @ (positions[-1] - positions[0]) >= 0 else -axis


def mds_by_hand(
    positions: np.ndarray, n: int, keep: float = 0.3, h: float = 0.05, sign: str = "oriented", log: bool = False
) -> tuple[list[int], list[float], list[float]]:
    """(chosen rows, their 1/m or log sum, their d)."""
    total = [motion_by_hand(pair, h * SCALE, log) for pair in positions]
    kept = sorted(range(len(positions)), key=lambda i: total[i])[: max(n, int(len(positions) * keep))]
    d = {i: float(axis_by_hand(positions[i, 0]) @ axis_by_hand(positions[i, 1])) for i in kept}
    if sign == "absolute":
        d = {i: abs(value) for i, value in d.items()}
    chosen = sorted(kept, key=lambda i: d[i])[:n]
    return chosen, [total[i] for i in chosen], [d[i] for i in chosen]


# Uniform, entropy, disagreement.


def summed_of(seed: int, pairs: int = 20) -> np.ndarray:
    """Summed rewards of three members, some of them so far apart that exp would overflow."""
    summed = RNG(seed).normal(0, 3, (3, pairs, 2)).astype(np.float32)
    summed[0, 4] = [2000, -2000]
    summed[1, 5] = [-2000, 2000]
    return summed


def test_uniform_takes_the_pool_as_it_was_drawn():
    chosen = load("uniform", RULES, "rule")(RNG(0), context_of(strokes(0, 9)), 4)
    assert chosen.index.tolist() == [0, 1, 2, 3]
    assert chosen.scores == {}


def test_the_probability_of_the_second_is_bradley_terrys():
    summed = np.array([[[0.0, 0.0], [1.0, 3.0], [2000.0, -2000.0], [-2000.0, 2000.0]]])
    expected = [0.5, np.exp(3) / (np.exp(1) + np.exp(3)), 0, 1]
    np.testing.assert_allclose(probability_second(summed)[0], expected, atol=1e-12)


@pytest.mark.parametrize("name", ["entropy", "disagreement"])
@pytest.mark.parametrize("n", [1, 7, 20])
def test_entropy_and_disagreement_take_the_highest_scores(name: str, n: int):
    summed, score = summed_of(1), []
    for i in range(20):
        p = [1 / (1 + np.exp(float(min(700, a - b)))) for a, b in summed[:, i].astype(np.float64)]
        if name == "disagreement":
            score.append(np.sqrt(np.mean([(one - np.mean(p)) ** 2 for one in p])))  # over 3, not over 2
        else:
            terms = [-q * np.log(q) for one in p for q in (one, 1 - one) if 0 < q < 1]
            score.append(sum(terms) / 3)
    expected = sorted(range(20), key=lambda i: -score[i])[:n]
    chosen = load(name, RULES, "rule")(RNG(0), context_of(strokes(0, 20), summed), n)
    assert chosen.index.tolist() == expected
    np.testing.assert_allclose(chosen.scores[name], [score[i] for i in expected], atol=1e-9)


@pytest.mark.parametrize("name", ["entropy", "disagreement"])
def test_equal_scores_are_taken_in_the_order_of_the_pool(name: str):
    chosen = load(name, RULES, "rule")(RNG(0), context_of(strokes(0, 9), np.zeros((3, 9, 2))), 4)
    assert chosen.index.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("n", [1, 5, 20])
def test_every_rule_chooses_n_different_rows_of_the_pool(name: str, n: int):
    rule = load(name, RULES, "rule")
    rule = rule() if name == "motion_distinction" else rule
    chosen = rule(RNG(0), context_of(strokes(2, 20), summed_of(2)), n)
    assert len(set(chosen.index.tolist())) == n
    assert set(chosen.index.tolist()) <= set(range(20))
    assert all(score.shape == (n,) for score in chosen.scores.values())


# MDS.


def mds(positions: np.ndarray, n: int, **options: Any) -> Selection:
    return MotionDistinction(**options)(RNG(0), context_of(positions), n)


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"keep": 0.6, "bandwidth": 0.02},
        {"axis": "absolute"},
        {"density_sum": "log"},
        {"density_sum": "log", "bandwidth": 0.194},
        {"keep": 0.1},
    ],
    ids=str,
)
def test_mds_chooses_what_the_equations_choose(seed: int, options: dict[str, Any]):
    positions, n = strokes(seed, 30), 5
    log = options.get("density_sum") == "log"
    index, total, d = mds_by_hand(
        positions,
        n,
        options.get("keep", 0.3),
        options.get("bandwidth", 0.05),
        options.get("axis", "oriented"),
        log,
    )
    chosen = mds(positions, n, **options)
    assert chosen.index.tolist() == index
    np.testing.assert_allclose(chosen.scores["d"], d, atol=1e-5)
    if options.get("bandwidth") == 0.194:  # sums of both signs: sorting by 1/sum would choose others
        all_sums = motion_sum(positions, 0.194 * SCALE, "log")
        assert all_sums.min() < 0 < all_sums.max()
    m = [-t for t in total] if log else [1 / t for t in total]
    np.testing.assert_allclose(chosen.scores["m"], m, rtol=1e-3)


def test_the_motion_sum_is_that_of_both_segments_or_of_its_logarithms():
    positions = strokes(6, 6)
    for of in ("density", "log"):
        expected = [motion_by_hand(pair, 0.1, of == "log") for pair in positions]
        np.testing.assert_allclose(motion_sum(positions, 0.1, of), expected, rtol=1e-3)


@pytest.mark.parametrize("where", range(10))
@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_the_one_moving_pair_among_still_ones_is_chosen_wherever_it_lies(where: int, jitter: float):
    """A score array built back to front, as in the public release, chooses pair 9 - i in its stead."""
    positions = RNG(7).normal(0, jitter, (10, 2, H, 3)).astype(np.float32)
    positions[where, 0] += np.linspace(0, 0.3, H)[:, None]
    positions[where, 1] += np.linspace(0.3, 0, H)[:, None]
    assert mds(positions, 1).index.tolist() == [where]
    assert mds(positions, 1, keep=0.1).index.tolist() == [where]


@pytest.mark.parametrize("where", range(10))
def test_the_one_pair_of_opposite_strokes_among_equal_ones_is_chosen_wherever_it_lies(where: int):
    along = np.linspace(0, 0.3, H)[:, None] * np.ones(3)
    positions = np.broadcast_to(along, (10, 2, H, 3)).astype(np.float32).copy()
    positions[where, 1] = positions[where, 1, ::-1]
    assert mds(positions, 1, keep=1.0).index.tolist() == [where]


@pytest.mark.parametrize("of", ["density", "log"])
def test_a_constant_factor_on_the_kernel_changes_no_choice(monkeypatch: pytest.MonkeyPatch, of: str):
    positions = strokes(8, 30)
    before = mds(positions, 5, density_sum=of)
    original = motion_distinction.own_log_density
    monkeypatch.setattr(motion_distinction, "own_log_density", lambda p, h: original(p, h) + np.log(37.0))
    after = mds(positions, 5, density_sum=of)
    assert after.index.tolist() == before.index.tolist()
    assert not np.allclose(after.scores["m"], before.scores["m"])


def line(direction: list[float], steps: int = H) -> np.ndarray:
    return np.linspace(0, 1, steps)[:, None] * np.array(direction)


@pytest.mark.parametrize(
    ("first", "second", "d"),
    [
        ([1, 0, 0], [1, 0, 0], 1),
        ([1, 0, 0], [-1, 0, 0], -1),
        ([1, 2, 3], [-0.1, -0.2, -0.3], -1),
        ([1, 2, 3], [10, 20, 30], 1),
        ([1, 0, 0], [0, 1, 0], 0),
        ([1, 0, 0], [1, 1, 0], np.sqrt(0.5)),
        ([1, 0, 0], [0, 0, 0], 0),
        ([0, 0, 0], [0, 0, 0], 0),
        ([1e-8, 0, 0], [1e-8, 0, 0], 0),  # below what counts as motion
    ],
)
def test_d_is_minus_one_for_opposite_strokes_one_for_equal_ones_and_zero_where_nothing_moves(
    first: list[float], second: list[float], d: float
):
    positions = np.stack([line(first), line(second)])[None]
    np.testing.assert_allclose(distinction(positions), d, atol=1e-9)
    np.testing.assert_allclose(distinction(positions, "absolute"), abs(d), atol=1e-9)
    np.testing.assert_allclose(abs(distinction(positions, "raw")), abs(d), atol=1e-9)


def test_what_counts_as_motion_grows_with_the_length_scale():
    faint = np.stack([line([3e-6, 0, 0]), line([-3e-6, 0, 0])])[None]  # largest variance 1e-12
    for scale, moves in ((0.1, True), (10.0, False)):
        d = distinction(faint, "oriented", motion_distinction.STILL * scale**2)
        np.testing.assert_allclose(d, -1.0 if moves else 0.0, atol=1e-9)


@pytest.fixture
def flip(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Lets the eigensolver return every other segment's axes with the other sign."""
    original = np.linalg.eigh

    def flipped(matrix: np.ndarray) -> Any:
        values, vectors = original(matrix)
        signs = np.where(np.arange(vectors.shape[-3]) % 2, -1.0, 1.0)
        return values, vectors * signs[:, None, None]

    return lambda: monkeypatch.setattr(np.linalg, "eigh", flipped)


@pytest.mark.parametrize("sign", ["oriented", "absolute", "raw"])
def test_only_the_raw_axis_depends_on_the_sign_that_the_solver_returns(flip: Callable[[], None], sign: str):
    positions = strokes(9, 30)
    before, d = mds(positions, 8, axis=sign), distinction(positions, sign)
    flip()
    after, flipped = mds(positions, 8, axis=sign), distinction(positions, sign)
    if sign == "raw":
        np.testing.assert_allclose(flipped, -d, atol=1e-12)
    else:
        np.testing.assert_allclose(flipped, d, atol=1e-12)
        assert after.index.tolist() == before.index.tolist()


def test_the_raw_axis_is_the_solvers():
    segment = strokes(10, 4)[:, 0].astype(np.float64)
    centred = segment - segment.mean(axis=1, keepdims=True)
    expected = [np.linalg.eigh(c.T @ c / H)[1][:, -1] for c in centred]
    np.testing.assert_allclose(axes(segment, "raw"), expected, atol=1e-12)


def test_an_oriented_axis_is_a_unit_vector_along_the_displacement():
    segment = strokes(11, 40).reshape(80, H, 3)
    found = axes(segment)
    displacement = (segment[:, -1] - segment[:, 0]).astype(np.float64)
    assert ((found * displacement).sum(axis=1) >= 0).all()
    np.testing.assert_allclose(found, [axis_by_hand(s) for s in segment], atol=1e-4)


# k-center.


def context_with(points: np.ndarray, labelled: np.ndarray, summed: np.ndarray | None = None) -> Context:
    """A pool whose pairs have those observations ``[P, 2, H, o]``, and labelled pairs with theirs."""
    context = context_of(strokes(0, len(points), points.shape[2]), summed)
    pool = Pairs(points, *context.pool[1:])
    return replace(context, pool=pool, labelled=labelled, predict=lambda o, a: summed)


def farthest_by_hand(points: np.ndarray, labelled: np.ndarray, n: int) -> tuple[list[int], list[float]]:
    chosen: list[int] = []
    distances: list[float] = []
    for _ in range(n):
        known = [*labelled, *points[chosen]]
        gaps = [
            min((float(np.linalg.norm((point - other).ravel())) for other in known), default=np.inf)
            if i not in chosen
            else -np.inf
            for i, point in enumerate(points)
        ]
        chosen.append(int(np.argmax(gaps)))
        distances.append(max(gaps))
    return chosen, distances


@pytest.mark.parametrize("seen", [0, 1, 9])
def test_k_center_takes_the_pair_farthest_from_all_that_were_labelled_or_chosen(seen: int):
    points = RNG(1).normal(size=(20, 2, 4, O)).astype(np.float32)
    labelled = RNG(2).normal(size=(seen, 2, 4, O)).astype(np.float32)
    chosen = kcenter.kcenter(RNG(0), context_with(points, labelled), 6)
    index, distance = farthest_by_hand(points.astype(float), labelled.astype(float), 6)
    assert chosen.index.tolist() == index
    np.testing.assert_allclose(chosen.scores["distance"], distance, rtol=1e-6)


def test_k_center_chooses_a_copy_only_when_nothing_else_is_left_and_never_the_same_row():
    points = np.repeat(RNG(3).normal(size=(3, 1, 1, O)), 2, axis=0) * np.ones((6, 2, 4, O))
    chosen = kcenter.kcenter(RNG(0), context_with(points.astype(np.float32), points[:0].astype(np.float32)), 6)
    assert sorted(chosen.index.tolist()) == list(range(6))
    assert sorted(index // 2 for index in chosen.index[:3].tolist()) == [0, 1, 2]


@pytest.mark.parametrize("rule", ["disagreement", "entropy"])
def test_the_mixtures_of_k_center_look_only_at_the_five_times_n_best(rule: str):
    points = RNG(4).normal(size=(30, 2, 4, O)).astype(np.float32)
    summed = RNG(5).normal(0, 2, (3, 30, 2))
    context = context_with(points, points[:2] + 1, summed)
    mixture, alone = {
        "disagreement": (kcenter.kcenter_disagreement, disagreement.disagreement),
        "entropy": (kcenter.kcenter_entropy, entropy.entropy),
    }[rule]
    chosen, single = mixture(RNG(0), context, 3), alone(RNG(0), context, 15)
    best = single.index
    index, _ = farthest_by_hand(points[best].astype(float), context.labelled.astype(float), 3)
    assert chosen.index.tolist() == best[index].tolist()
    scores = dict(zip(best.tolist(), single.scores[rule].tolist(), strict=True))
    np.testing.assert_allclose(chosen.scores[rule], [scores[i] for i in chosen.index.tolist()])
