"""What is told of asked pairs, from pairs that were planted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D

from senior.report import pairs
from senior.report.asked import asked
from senior.report.looks import COLOURS
from senior.report.page import Section
from senior.report.panels import RED
from tests.planted import Asking, config_of, run_of, runs_below

H = 6
START = np.array([0.0, 0.6, 0.2])


def stroke(along: Sequence[float], start: np.ndarray = START) -> np.ndarray:
    """A straight path ``[H, 3]`` that ends so far away."""
    return start + np.linspace(0, 1, H)[:, None] * np.asarray(along)


def pair(first: Sequence[float], second: Sequence[float]) -> np.ndarray:
    """Two strokes ``[2, H, 3]``."""
    return np.stack([stroke(first), stroke(second)])


RIGHT, LEFT, UP, STAY = (0.1, 0, 0), (-0.1, 0, 0), (0, 0.3, 0), (0, 0, 0)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [(RIGHT, RIGHT, 0), (RIGHT, LEFT, 180), (RIGHT, UP, 90), ((1, 1, 0), (0, 0.2, 0), 45), (RIGHT, STAY, np.nan)],
)
def test_the_angle_is_that_of_the_displacements(first: Sequence[float], second: Sequence[float], expected: float):
    np.testing.assert_allclose(pairs.angles(pair(first, second)[None]), [expected], atol=1e-5)


def test_the_length_is_that_of_the_path_and_not_of_the_displacement():
    there_and_back = np.concatenate([stroke(UP), stroke(UP)[-2::-1]])
    assert pairs.path_lengths(there_and_back) == pytest.approx(0.6)
    assert pairs.path_lengths(pair(RIGHT, STAY)[None]) == pytest.approx(np.array([[0.1, 0]]))


def table_of(section: Section | None) -> dict[str, dict[str, object]]:
    """Rows of the only table by arm."""
    assert section is not None
    (table,) = section.tables
    return {str(row[0]): dict(zip(table.head, row, strict=True)) for row in table.rows}


def test_the_table_tells_what_the_pairs_after_the_first_session_are_like(tmp_path: Path):
    with Asking(run_of(tmp_path, config_of("mrn"), files=("eval.csv", "train.csv")), H) as asking:
        asking.ask(np.stack([pair(UP, UP)] * 4))  # drawn at random: it does not count
        both = np.stack([pair(RIGHT, LEFT), pair(RIGHT, RIGHT), pair(RIGHT, STAY), pair(LEFT, UP)])
        returns, episodes = np.array([[1, 9], [9, 1], [2, 2], [0, 4]]), np.array([[0, 19], [20, 5], [60, 40], [21, 22]])
        asking.ask(both, [0, -1, None, 1], returns, episodes=episodes)
    with Asking(run_of(tmp_path, config_of("m-senior")), H) as asking:
        asking.ask(np.stack([pair(RIGHT, LEFT)]))
    told = table_of(pairs.section(runs_below(tmp_path)))
    expected = {
        "arm": "mrn",
        "runs": 1,
        "pairs": 4,
        "path length (m)": pytest.approx((7 * 0.1 + 0.3 - 0.1) / 8),
        "angle (degrees)": pytest.approx((180 + 0 + 90) / 3, abs=1e-4),  # what stays has no direction
        "difference of returns": pytest.approx((8 + 8 + 0 + 4) / 4),
        "of pre-training": 3 / 8,  # 20 episodes of 500 steps
        "equal": 0.25,
        "skipped": 0.25,
    }
    assert told["mrn"] == expected
    assert told["m-senior"]["pairs"] == 0 and np.isnan(float(str(told["m-senior"]["equal"])))


def test_at_most_three_runs_of_an_arm_are_read_and_the_first_is_drawn(tmp_path: Path):
    for seed in range(5):
        with Asking(run_of(tmp_path, config_of("mrn", seed=seed)), H) as asking:
            if seed == 0:
                continue  # nothing was asked yet
            asking.ask(np.stack([pair(UP, UP)]))
            asking.ask(np.stack([pair((0.1 * seed, 0, 0), (0.1 * seed, 0, 0))] * 2))
    section = pairs.section(runs_below(tmp_path))
    told = table_of(section)["mrn"]
    assert (told["runs"], told["pairs"]) == (3, 6)
    assert told["path length (m)"] == pytest.approx(0.2)
    assert section is not None
    (drawing,) = section.figures
    assert {row[2] for row in drawing.rows[1:]} == {1}


def test_pairs_are_drawn_by_their_place_in_the_run(tmp_path: Path):
    with Asking(run_of(tmp_path, config_of("mrn")), H) as asking:
        ids = [asking.ask(np.stack([pair(RIGHT, UP)] * n)) for n in (4, 5, 3, 2, 1, 4)]
    (run,) = runs_below(tmp_path)
    found = asked(run)
    assert found is not None
    expected = [ids[1][0], ids[1][-1], ids[3][0], ids[3][-1], ids[5][0], ids[5][-1]]
    assert found.id[pairs.shown(found)].tolist() == expected


def axes_of(section: Section | None) -> Axes:
    assert section is not None
    (drawing,) = section.figures
    return drawing.figure.axes[0]


def paths_of(axis: Axes) -> list[Line2D]:
    """Lines that are paths, in the order of drawing: panel by panel, the one on top last."""
    return [line for line in axis.lines if len(np.asarray(line.get_xdata())) == H]


def test_the_preferred_one_stands_out_and_scores_answer_and_object_are_told(tmp_path: Path):
    with Asking(run_of(tmp_path, config_of("m-senior")), H) as asking:
        both = np.stack([pair(RIGHT, UP)] * 2)
        objects = np.broadcast_to([[0.2, 0.7, 0.1], [0.25, 0.75, 0.1]], (2, 2, 3))
        scores = {"m": [4.7e-5, 1], "d": [-0.97, 0.5]}
        for labels in ([1, 0], [-1, None]):
            asking.ask(both, labels, objects=objects, scores=scores)
        asking.ask(both, None, objects=objects)
    axis = axes_of(pairs.section(runs_below(tmp_path)))
    assert [word for text in axis.texts if (word := text.get_text()).startswith("step")] == [
        "step 15,000, called equal\nm 4.7e-05, d -0.97",
        "step 15,000, skipped\nm 1, d 0.5",
        "step 20,000, not answered yet\n",
        "step 20,000, not answered yet\n",
    ]
    own, grey = to_rgba(COLOURS["m-senior"]), to_rgba(pairs.OTHER)
    assert [to_rgba(line.get_color()) for line in paths_of(axis)] == [own, own, *[grey] * 6]
    dots = [np.asarray(line.get_xydata()) for line in axis.lines if line.get_color() == RED]
    assert len(dots) == 4
    for line, found in zip(paths_of(axis)[::2], dots, strict=True):
        begin, end = np.asarray(line.get_xydata())[[0, -1]]  # from START on, RIGHT by 0.1 or UP by 0.3
        inch = np.linalg.norm(end - begin) / (0.1 if end[0] > begin[0] else 0.3)
        np.testing.assert_allclose((found - begin) / inch, [[0.2, 0.1], [0.25, 0.15]], atol=1e-5)


@pytest.mark.parametrize("better", [0, 1])
def test_the_preferred_path_is_the_thick_one(tmp_path: Path, better: int):
    with Asking(run_of(tmp_path, config_of("m-senior")), H) as asking:
        asking.ask(np.stack([pair(RIGHT, UP)]), [better])
    below, above = paths_of(axes_of(pairs.section(runs_below(tmp_path))))
    assert above.get_linewidth() > below.get_linewidth()
    begin, end = np.asarray(above.get_xydata())[[0, -1]]
    assert (end[0] > begin[0], end[1] > begin[1]) == ((True, False), (False, True))[better]
    assert to_rgba(above.get_color()) == to_rgba(COLOURS["m-senior"])


def test_a_broken_file_is_named_and_what_asks_nothing_is_not_there(tmp_path: Path):
    assert pairs.section([]) is None
    run_of(tmp_path, config_of("sac"))
    broken = run_of(tmp_path, config_of("mrn"))
    (broken / "preferences.sqlite").write_bytes(b"nothing of the kind" * 50)
    assert pairs.section(runs_below(tmp_path)) is None
    with Asking(run_of(tmp_path, config_of("pebble")), H) as asking:
        asking.ask(np.stack([pair(RIGHT, UP)]))
    section = pairs.section(runs_below(tmp_path))
    assert section is not None and list(table_of(section)) == ["pebble"]
    assert section.text[-1].startswith(f"Left out: {broken}: preferences.sqlite is damaged")
