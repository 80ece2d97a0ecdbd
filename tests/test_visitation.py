"""Maps of where the robot was and what PGE pays, from positions that were planted."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from senior.density import log_density as jax_log_density
from senior.explore.preference_guided import intrinsic_reward as jax_intrinsic_reward
from senior.report import bonus, visitation
from senior.report.asked import asked
from senior.report.looks import looks
from senior.report.page import Drawing, Section
from senior.report.plane import Plane, evenly, firsts, plane_of, visited
from senior.report.records import LeftOut, Run, Unusable
from senior.rundir import TRAIN
from tests.planted import Asking, config_of, run_of, runs_below, samples, snapshot

HERE, THERE = np.array([0.1, 0.7, 0.2]), np.array([-0.3, 0.5, 0.2])
STEPS = (10_000, 20_000, 30_000, 40_000)


def cloud(middle: np.ndarray, spread: float | Sequence[float] = 0.01, count: int = 400, seed: int = 0) -> np.ndarray:
    """Positions around a place ``[n, d]``."""
    return middle + np.asarray(spread) * np.random.default_rng(seed).standard_normal((count, len(middle)))


def plane(low: Sequence[float], high: Sequence[float], axes: tuple[int, int] = (0, 1), size: int = 3) -> Plane:
    return Plane(axes, size, True, np.array(low, float), np.array(high, float), None)


def arms_of(runs: Sequence[Run]) -> dict[str, list[Run]]:
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(run.arm.label, []).append(run)
    return found


def plane_below(place: Path) -> Plane | None:
    arms = arms_of(runs_below(place))
    return plane_of(arms, firsts(arms, []), [])


def drawn(section: Section | None, name: str) -> Drawing:
    assert section is not None
    (found,) = [drawing for drawing in section.figures if drawing.name == name]
    return found


def words_of(drawing: Drawing) -> list[str]:
    """All that is written in it."""
    return [text.get_text() for text in drawing.figure.axes[0].texts]


def rows_of(drawing: Drawing) -> list[dict[str, object]]:
    head, *rows = drawing.rows
    return [dict(zip(map(str, head), row, strict=True)) for row in rows]


# The plane, and the object in it.


def test_the_plane_is_that_of_the_two_widest_coordinates_of_all_runs(tmp_path: Path):
    run_of(tmp_path, config_of("mrn"), {10_000: cloud(HERE, (0.2, 0.01, 0.03))})
    run_of(tmp_path, config_of("pebble"), {10_000: cloud(HERE, (0.2, 0.01, 0.01)), 20_000: cloud(HERE, (0, 0.02, 0.1))})
    found = plane_below(tmp_path)
    assert found is not None
    assert found.axes == (0, 2) and found.labels == ("x (m)", "z (m)") and found.object is None
    everything = np.concatenate([one for run in runs_below(tmp_path) for one in visited(run).values()])
    assert (found.of(everything) > found.low).all() and (found.of(everything) < found.high).all()


def test_an_environment_of_ones_own_has_numbered_coordinates_and_no_object(tmp_path: Path):
    config = replace(config_of("mrn"), env="mine:Env", position="0:2")
    path = run_of(tmp_path, config, {10_000: cloud(HERE[:2], 0.1)}, position=[0, 2])
    with Asking(path, 4) as asking:
        asking.ask(np.zeros((1, 2, 4, 2)), objects=np.full((1, 2, 3), 0.3))
    found = plane_below(tmp_path)
    assert found is not None
    assert found.labels == ("coordinate 1", "coordinate 2") and found.object is None


def test_one_coordinate_makes_no_plane(tmp_path: Path):
    config = replace(config_of("mrn"), env="mine:Env", position="0:1")
    run_of(tmp_path, config, {10_000: cloud(HERE[:1])}, position=[0, 1])
    assert plane_below(tmp_path) is None
    assert visitation.section(runs_below(tmp_path)) is None


def test_the_object_is_where_segments_began(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"), {10_000: cloud(HERE, (0.1, 0.1, 0.01))})
    along = np.linspace(0, 1, 11)  # of the line on which the object is found
    objects = np.stack([0.2 + 0.1 * along, 0.8 - 0.2 * along, np.full(11, 0.5)], axis=-1)
    with Asking(path, 4) as asking:
        asking.ask(np.broadcast_to(HERE, (11, 2, 4, 3)), objects=np.stack([objects, objects[::-1]], axis=1))
    found = plane_below(tmp_path)
    assert found is not None and found.object is not None
    np.testing.assert_allclose(found.object[1], [0.25, 0.7], atol=1e-6)
    np.testing.assert_allclose(found.object[[0, 2], 0], [0.21, 0.29], atol=1e-6)
    assert (found.object >= found.low).all() and (found.object <= found.high).all()


def test_without_snapshots_the_plane_is_that_of_asked_segments(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"))
    paths = cloud(HERE, (0.01, 0.2, 0.1), 40).reshape(5, 2, 4, 3)
    with Asking(path, 4) as asking:
        asking.ask(paths)
    found = plane_below(tmp_path)
    assert found is not None and found.axes == (1, 2)


def test_what_never_moves_still_has_a_plane(tmp_path: Path):
    run_of(tmp_path, config_of("mrn"), {10_000: np.tile(HERE, (5, 1))})
    section = visitation.section(runs_below(tmp_path))
    assert [row["share"] for row in rows_of(drawn(section, "door-lock-visitation"))] == [1.0]


# Visits.


def test_shares_are_of_square_cells_and_find_the_planted_place():
    held = np.concatenate([cloud(HERE, 1e-4, 300), cloud(THERE, 1e-4, 100)])
    share = visitation.shares(held, plane((-0.55, 0.35), (0.45, 0.85)), 10)
    assert share.shape == (5, 10)  # [second, first]
    assert share[3, 6] == 0.75 and share[1, 2] == 0.25 and share.sum() == 1


def test_each_arm_has_its_own_row_with_all_its_seeds(tmp_path: Path):
    for seed in range(2):
        positions = {step: cloud(HERE, 1e-4, 100) for step in STEPS}
        positions[40_000] = cloud(THERE, 1e-4, 100) if seed else cloud(HERE, 1e-4, 100)
        run_of(tmp_path, config_of("mrn", seed=seed), positions)
    run_of(tmp_path, config_of("sac"), {step: cloud(THERE, 1e-4, 100) for step in STEPS})
    run_of(tmp_path, config_of("pebble"))  # without snapshots
    drawing = drawn(visitation.section(runs_below(tmp_path)), "door-lock-visitation")
    rows = rows_of(drawing)
    shares = {(row["arm"], row["step"], round(float(str(row["x (m)"])), 1)): 0.0 for row in rows}
    for row in rows:
        shares[row["arm"], row["step"], round(float(str(row["x (m)"])), 1)] += float(str(row["share"]))
    expected = {("mrn", step, 0.1): 1.0 for step in STEPS[:3]} | {("sac", step, -0.3): 1.0 for step in STEPS}
    assert shares == pytest.approx(expected | {("mrn", 40_000, 0.1): 0.5, ("mrn", 40_000, -0.3): 0.5})
    assert {row["arm"]: row["runs"] for row in rows} == {"mrn": 2, "sac": 1}
    assert [word for word in words_of(drawing) if "run" in word or "step" in word] == [
        "mrn (2 runs)",
        "sac (1 run)",
        *(f"step {step:,}" for step in STEPS),
    ]
    images = drawing.figure.axes[0].images
    assert len(images) == 8 and len({image.get_clim() for image in images}) == 1
    seen = [int((~np.ma.getmaskarray(image.get_array())).sum()) for image in images]
    assert seen == [1, 1, 1, 2, 1, 1, 1, 1]  # cells


def test_a_panel_that_pools_fewer_seeds_says_so(tmp_path: Path):
    run_of(tmp_path, config_of("mrn"), {step: cloud(HERE) for step in STEPS})
    run_of(tmp_path, config_of("mrn", seed=1), {step: cloud(HERE) for step in STEPS[:3]}, until=30_000)
    drawing = drawn(visitation.section(runs_below(tmp_path)), "door-lock-visitation")
    assert [word for word in words_of(drawing) if "run" in word] == ["mrn (2 runs)", "1 run"]
    assert {row["step"]: row["runs"] for row in rows_of(drawing)} == dict(zip(STEPS, (2, 2, 2, 1), strict=True))


def test_only_steps_that_all_arms_have_are_shown(tmp_path: Path):
    run_of(tmp_path, config_of("mrn"), {step: cloud(HERE) for step in STEPS})
    run_of(tmp_path, config_of("pebble"), {step: cloud(HERE) for step in STEPS[:2]}, until=20_000)
    rows = rows_of(drawn(visitation.section(runs_below(tmp_path)), "door-lock-visitation"))
    assert {row["step"] for row in rows} == set(STEPS[:2])
    run_of(tmp_path, config_of("qpa"), {5_000: cloud(HERE)})
    assert visitation.section(runs_below(tmp_path)) is None


@pytest.mark.parametrize(
    ("count", "most", "expected"),
    [(3, 5, [0, 1, 2]), (20, 5, [0, 5, 10, 14, 19]), (8, 5, [0, 2, 4, 5, 7]), (9, 2, [0, 8]), (0, 5, [])],
)
def test_steps_are_chosen_evenly_with_both_ends(count: int, most: int, expected: list[int]):
    assert evenly(range(count), most) == expected


def test_the_object_is_marked_in_red_in_every_panel(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"), {step: cloud(HERE, (0.1, 0.1, 0.01)) for step in STEPS})
    with Asking(path, 4) as asking:
        asking.ask(np.broadcast_to(HERE, (3, 2, 4, 3)), objects=np.broadcast_to([0.3, 0.9, 0.1], (3, 2, 3)))
    section = visitation.section(runs_below(tmp_path))
    assert section is not None and "marks the task's object" in " ".join(section.text)
    axis = drawn(section, "door-lock-visitation").figure.axes[0]
    dots = [line for line in axis.lines if line.get_marker() == "o"]
    assert len(dots) == len(axis.images) == 4
    found = plane_below(tmp_path)
    assert found is not None
    for dot, image in zip(dots, axis.images, strict=True):
        assert dot.get_color() == "#e8000b"
        left, right, bottom, top = image.get_extent()
        (place,) = np.asarray(dot.get_xydata())
        share = (place - (left, bottom)) / (right - left, top - bottom)
        np.testing.assert_allclose(found.low + share * (found.high - found.low), [0.3, 0.9], atol=1e-6)


def test_what_was_sampled_in_fewer_dimensions_is_not_drawn_with_the_others(tmp_path: Path):
    run_of(tmp_path, config_of("mrn"), {10_000: cloud(HERE), 20_000: cloud(HERE)})
    run_of(tmp_path, config_of("pebble"), {10_000: cloud(HERE[:2])})
    section = visitation.section(runs_below(tmp_path))
    told = rows_of(drawn(section, "door-lock-visitation"))
    assert {row["arm"] for row in told} == {"mrn"} and {row["step"] for row in told} == {10_000, 20_000}


@pytest.mark.parametrize("damage", [b"PK not an archive", b""])
def test_a_broken_file_is_named_and_the_others_are_drawn(tmp_path: Path, damage: bytes):
    run_of(tmp_path, config_of("mrn"), {10_000: cloud(HERE)})
    broken = run_of(tmp_path, config_of("mrn", seed=1), {10_000: cloud(HERE)})
    (broken / "positions.npz").write_bytes(damage)
    section = visitation.section(runs_below(tmp_path))
    assert {row["runs"] for row in rows_of(drawn(section, "door-lock-visitation"))} == {1}
    assert section is not None
    (told,) = [text for text in section.text if text.startswith("Left out")]
    assert f"Left out: {broken}: positions.npz" in told


def test_positions_that_are_no_numbers_are_damage(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"))
    (run,) = runs_below(tmp_path)
    assert visited(run) == {}
    for wrong in (np.array([[np.nan, 0, 0]]), np.zeros(3), np.zeros((0, 3))):
        snapshot(path, {10_000: wrong})
        with pytest.raises(Unusable, match=r"positions\.npz is damaged"):
            visited(run)


def test_nothing_makes_no_section(tmp_path: Path):
    run_of(tmp_path, config_of("mrn"))
    assert visitation.section(runs_below(tmp_path)) is None
    assert visitation.section([]) is None


# The preference file.


def test_reading_leaves_nothing_beside_a_file_that_nobody_writes(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"))
    with Asking(path, 4) as asking:
        asking.ask(np.broadcast_to(HERE, (3, 2, 4, 3)))
    before = sorted(os.listdir(path))
    assert "preferences.sqlite-wal" not in before
    (run,) = runs_below(tmp_path)
    found = asked(run)
    assert found is not None and len(found.id) == 3
    assert sorted(os.listdir(path)) == before


def test_a_file_that_is_being_written_is_read_as_far_as_it_is(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"))
    (run,) = runs_below(tmp_path)
    assert asked(run) is None
    with Asking(path, 4) as asking:
        assert asked(run) is None
        asking.ask(np.broadcast_to(HERE, (3, 2, 4, 3)), [0, None, -1], reserves=0)
        asking.ask(np.broadcast_to(THERE, (4, 2, 4, 3)), None, reserves=2)
        assert (path / "preferences.sqlite-wal").stat().st_size > 0
        found = asked(run)
        assert found is not None
        np.testing.assert_array_equal(found.second, [0, np.nan, 0.5, np.nan, np.nan])
        np.testing.assert_array_equal(found.collected, [True] * 3 + [False] * 2)  # reserves were not asked
        np.testing.assert_array_equal(found.skipped, [False, True, False, False, False])
        np.testing.assert_array_equal(found.session, [0, 0, 0, 1, 1])
        np.testing.assert_allclose(found.position[4], np.broadcast_to(THERE, (2, 4, 3)), atol=1e-7)


def test_other_versions_and_damage_are_told(tmp_path: Path):
    path = run_of(tmp_path, config_of("mrn"))
    (run,) = runs_below(tmp_path)
    (path / "preferences.sqlite").write_bytes(b"no database at all" * 100)
    with pytest.raises(Unusable, match="damaged"):
        asked(run)
    (path / "preferences.sqlite").write_bytes(b"")
    with pytest.raises(Unusable, match="schema version 0"):
        asked(run)


# PGE.


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("h", [0.05, 0.1, 1.0])
def test_densities_and_intrinsic_reward_are_those_of_training(d: int, h: float):
    explored = np.concatenate([cloud(HERE[:d], 0.05, 150), cloud(THERE[:d], 0.05, 50, seed=1)]).astype(np.float32)
    preferred = cloud(THERE[:d], 0.08, 120, seed=2).astype(np.float32)
    ours = [bonus.log_density(explored.astype(float), one.astype(float), h) for one in (preferred, explored)]
    for found, one in zip(ours, (preferred, explored), strict=True):
        np.testing.assert_allclose(found, jax.jit(jax_log_density)(explored, one, h), rtol=1e-4, atol=1e-3)
    ratio = ours[0] - ours[1]
    expected = np.asarray(jax.jit(jax_intrinsic_reward)(explored, preferred, h))
    found = bonus.intrinsic_reward(ratio, ratio)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert found.min() == 0 and found.max() == 1 and 0.02 < found.mean() < 0.98


def test_no_exponent_overflows_and_a_constant_ratio_pays_nothing():
    own = np.array([-1e6, -10.0, 0.0])
    np.testing.assert_array_equal(bonus.intrinsic_reward(np.array([1e6, -1e9, 0.0]), own), [1, 0, 1])
    np.testing.assert_array_equal(bonus.intrinsic_reward(np.array([5.0, 0.0]), np.zeros(4)), [0, 0])


def test_the_bonus_is_seen_where_people_liked_the_robot_and_it_was_seldom():
    explored = np.concatenate([cloud(HERE, 0.03, 900), cloud(THERE, 0.03, 100, seed=1)])
    held = bonus.Samples(cloud(THERE, 0.03, 500, seed=2), explored, np.zeros(1000), 0.1, 0.05)
    within = plane((-0.5, 0.4), (0.3, 0.8))
    found = bonus.map_of(held, within, 40)
    first, second = (edges[:-1] + np.diff(edges) / 2 for edges in within.edges(40))

    def place(values: np.ndarray) -> np.ndarray:
        j, i = np.unravel_index(values.argmax(), values.shape)
        return np.array([first[i], second[j]])

    assert np.linalg.norm(place(found.preferred) - THERE[:2]) < 0.04
    assert np.linalg.norm(place(found.explored) - HERE[:2]) < 0.04
    at = [(int(np.abs(second - y).argmin()), int(np.abs(first - x).argmin())) for x, y, _ in (HERE, THERE)]
    assert found.intrinsic[at[0]] < 0.01 and found.intrinsic[at[1]] > 0.3
    middle = np.median(explored, axis=0)[2]
    point = np.array([[first[3], second[5], middle]])
    np.testing.assert_allclose(found.preferred[5, 3], np.exp(bonus.log_density(point, held.preferred, 0.05))[0])


def test_maps_are_drawn_of_the_first_run_that_has_samples(tmp_path: Path):
    for seed in range(3):
        path = run_of(tmp_path, config_of("p-senior", seed=seed), {10_000: cloud(HERE, 0.1)})
        if seed:
            for step in STEPS:
                held = cloud(HERE, 0.1, 50, seed=step)
                samples(path, step, preferred=cloud(THERE, 0.1, 60), explored=held, intrinsic=np.ones(50), beta=0.05)
    drawing = drawn(visitation.section(runs_below(tmp_path)), "door-lock-p-senior-bonus")
    rows = rows_of(drawing)
    assert {row["step"] for row in rows} == {STEPS[0], STEPS[2], STEPS[3]} and {row["seed"] for row in rows} == {1}
    assert all(0 <= float(str(row["r_int"])) <= 1 for row in rows)
    assert len(drawing.figure.axes[0].images) == 12
    assert "step 40,000\nbeta 0.05, mean r_int 1" in words_of(drawing)


def test_the_bandwidth_is_in_length_scales(tmp_path: Path):
    arrays = {"preferred": cloud(THERE), "explored": cloud(HERE), "intrinsic": np.zeros(400), "beta": 0.1}
    known = run_of(tmp_path / "known", config_of())
    samples(known, 10_000, **arrays)
    samples(known, 20_000, **arrays, length_scale=np.float32(3))
    (run,) = runs_below(tmp_path / "known")
    files = bonus.steps_of(run)
    assert bonus.samples(run, files[10_000]).bandwidth == 0.1  # Meta-World is in metres
    assert bonus.samples(run, files[20_000]).bandwidth == pytest.approx(0.3)
    assert bonus.samples(run, files[20_000]).beta == pytest.approx(0.1)

    unknown = run_of(tmp_path / "unknown", replace(config_of(), env="mine:Env", position="0:3"), {10_000: cloud(HERE)})
    samples(unknown, 10_000, **arrays)
    section = visitation.section(runs_below(tmp_path / "unknown"))
    assert section is not None and "the length scale is not known" in section.text[-1]
    assert not [drawing for drawing in section.figures if "bonus" in drawing.name]


@pytest.mark.parametrize(
    "change", [{"intrinsic": np.zeros(7)}, {"explored": np.zeros(3)}, {"preferred": np.zeros((0, 3))}, {"beta": None}]
)
def test_samples_that_do_not_fit_together_are_told(tmp_path: Path, change: dict[str, np.ndarray | None]):
    arrays = {"preferred": cloud(THERE), "explored": cloud(HERE), "intrinsic": np.zeros(400), "beta": 0.1}
    path = run_of(tmp_path, config_of(), {10_000: cloud(HERE)})
    samples(path, 10_000, **{name: value for name, value in {**arrays, **change}.items() if value is not None})
    left_out: list[LeftOut] = []
    assert bonus.maps("door-lock", arms_of(runs_below(tmp_path)), plane((0, 0), (1, 1)), left_out) == []
    assert left_out and "bonus/step-0000010000.npz" in left_out[0].reason


def write_train(path: Path, **columns: Sequence[float | str]) -> None:
    with open(path / "train.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, TRAIN, restval="")
        writer.writeheader()
        for values in zip(*columns.values(), strict=True):
            writer.writerow({"episode_return": 0, **dict(zip(columns, values, strict=True))})


def test_the_size_of_the_bonus_stands_beside_that_of_the_learned_reward(tmp_path: Path):
    for seed, paid in ((0, 0.001), (1, 0.003)):
        path = run_of(tmp_path, config_of("m-rune", seed=seed))
        write_train(
            path,
            step=[500, 1000, 1500, 2000],
            episode_length=[500, 500, 500, 250],
            learned_return=[77, -100, 100, 50],
            beta=["", 0.05, 0.04, 0.01],
            bonus_mean=["", 2 * paid, paid, 0],
            queried=[0, 50, 100, 100],
        )
    run_of(tmp_path, config_of("mrn"), files=("eval.csv", "train.csv"))
    runs = runs_below(tmp_path)
    found = bonus.sizes("door-lock", arms_of(runs), looks(["mrn", "m-rune"]), [])
    assert found is not None
    drawing, table = found
    assert [row[0] for row in table.rows] == ["m-rune"]
    expected = ["m-rune", 2, 0.05, 0.01, 0.002, 0.2, 0.01, 0.02]  # the last while 50 of 100 were asked: 0.004 / 0.2
    assert list(table.rows[0]) == [value if isinstance(value, str) else pytest.approx(value) for value in expected]
    assert [row["bonus"] for row in rows_of(drawing)] == pytest.approx([0.004, 0.002, 0])  # and no gaps between them
    (axis,) = drawing.figure.axes
    assert np.asarray(axis.lines[0].get_ydata()).tolist()[:2] == pytest.approx([0.004, 0.002])
    drawing.figure.canvas.draw()
    assert not any("$" in tick.label1.get_text() for tick in (*axis.yaxis.majorTicks, *axis.yaxis.minorTicks))
    section = visitation.section(runs)
    assert section is not None and [drawing.name for drawing in section.figures] == ["door-lock-bonus-size"]


def test_no_drawing_names_a_run_that_another_version_wrote(tmp_path: Path):
    path = run_of(tmp_path, config_of(), {10_000: cloud(HERE)})
    samples(path, 10_000, preferred=cloud(HERE), explored=cloud(HERE), intrinsic=np.zeros(400), beta=0.1)
    content = json.loads((path / "config.json").read_text())
    content["config"]["later"] = 1
    (path / "config.json").write_text(json.dumps(content))
    section = visitation.section(runs_below(tmp_path))
    assert section is not None and [drawing.name for drawing in section.figures] == ["door-lock-visitation"]
    assert "the bandwidth is not known" in section.text[-1]
