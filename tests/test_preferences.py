"""The preference file: nothing said is lost, changed or brought out of order."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from senior.preferences import SCHEMA_VERSION, Preferences
from senior.types import Answers, BadInput, Pairs, Preferred, Query

CAPACITY, H, O, A = 6, 4, 5, 2
FIRST, SECOND, EQUAL = (int(label) for label in (Preferred.FIRST, Preferred.SECOND, Preferred.EQUAL))
Opener = Callable[[], Preferences]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "preferences.sqlite"


@pytest.fixture
def opened(file: Path) -> Iterator[Opener]:
    """Opens the one file of the test, as often as wanted."""
    held: list[Preferences] = []

    def make() -> Preferences:
        held.append(Preferences(file, CAPACITY, H, O, A))
        return held[-1]

    yield make
    for preferences in held:
        preferences.close()


def query_of(pairs: int, seed: int = 0) -> Query:
    """Random pairs with numbers that float32 holds and text would not."""
    rng = np.random.default_rng(seed)
    return Query(
        Pairs(
            rng.normal(size=(pairs, 2, H, O)).astype(np.float32),
            rng.normal(size=(pairs, 2, H, A)).astype(np.float32),
            rng.normal(size=(pairs, 2, H)).astype(np.float32),
            rng.integers(100, size=(pairs, 2)),
            rng.integers(100, size=(pairs, 2)),
        ),
        scores={"m": rng.normal(size=pairs), "d": rng.normal(size=pairs)},
        prediction=rng.random(pairs),
    )


def ask(preferences: Preferences, query: Query, labels: list[int | None] | None = None) -> list[int]:
    """Ask a query at step 1000 and answer it with the labels, if there are any."""
    shown = np.arange(len(query.pairs)) % 2
    ids = preferences.add(query, session=3, step=1000, run_seed=8, shown_left=shown)
    if labels is not None:
        preferences.answer(Answers(ids, labels), "somebody", step=1005)
    return ids


def assert_holds(preferences: Preferences, query: Query, rows: list[int], labels: list[int]) -> None:
    """The labelled arrays are those rows of the query, bit for bit, and zero beyond."""
    observation, action, label, count = preferences.arrays
    assert count == len(rows)
    assert observation.shape == (CAPACITY, 2, H, O) and action.shape == (CAPACITY, 2, H, A)
    assert np.array_equal(observation[:count], query.pairs.observation[rows])
    assert np.array_equal(action[:count], query.pairs.action[rows])
    assert label[:count].tolist() == labels
    assert not observation[count:].any() and not action[count:].any() and not label[count:].any()


def test_a_pair_comes_back_as_it_was_asked_bit_for_bit(opened: Opener):
    preferences, query = opened(), query_of(3)
    assert ask(preferences, query) == [1, 2, 3]
    for i, number in enumerate((1, 2, 3)):
        for name, column in preferences.segments(number)._asdict().items():
            expected = getattr(query.pairs, name)[i : i + 1]
            assert np.array_equal(column, expected), name
            assert column.dtype == np.float32 or name in ("episode", "start")
    with pytest.raises(KeyError):
        preferences.segments(4)


def test_what_was_known_of_a_pair_is_kept_beside_it(opened: Opener):
    preferences, query = opened(), query_of(2)
    ask(preferences, query, [SECOND, None])
    for i, row in enumerate(preferences.asked()):
        assert json.loads(str(row["scores"])) == {name: score[i] for name, score in query.scores.items()}
        assert query.prediction is not None and row["prediction"] == query.prediction[i]
        assert (row["id"], row["session"], row["step"], row["run_seed"]) == (i + 1, 3, 1000, 8)
        assert (row["answered"], row["annotator"], row["answered_step"]) == (1, "somebody", 1005)
        assert row["label"] == (SECOND, None)[i]
        assert row["shown_left"] == i
        for side in (0, 1):
            assert row[f"episode_{side}"] == query.pairs.episode[i, side]
            assert row[f"start_{side}"] == query.pairs.start[i, side]


def test_a_query_without_scores_or_prediction_is_recorded_without_them(opened: Opener):
    preferences = opened()
    ask(preferences, Query(query_of(1).pairs))
    (row,) = preferences.asked()
    assert (row["scores"], row["prediction"], row["answered"], row["label"]) == ("{}", None, 0, None)


def test_only_answered_pairs_are_labelled_and_their_order_is_that_of_asking(opened: Opener):
    preferences, query = opened(), query_of(4)
    ids = ask(preferences, query)
    assert_holds(preferences, query, [], [])
    preferences.answer(Answers([ids[3]], [FIRST]), "a", 1)
    assert_holds(preferences, query, [3], [FIRST])
    preferences.answer(Answers([ids[2], ids[0]], [EQUAL, SECOND]), "b", 2)
    assert_holds(preferences, query, [0, 2, 3], [SECOND, EQUAL, FIRST])


def test_a_skipped_pair_is_asked_but_is_no_label(opened: Opener):
    preferences, query = opened(), query_of(3)
    ask(preferences, query, [None, SECOND, None])
    assert (preferences.last, preferences.skipped) == (3, 2)
    assert_holds(preferences, query, [1], [SECOND])


def test_a_pair_without_an_answer_is_not_a_skipped_one(opened: Opener):
    preferences = opened()
    ask(preferences, query_of(3))
    assert (preferences.last, preferences.skipped, preferences.arrays.count) == (3, 0, 0)


@pytest.mark.parametrize("closed", [True, False])
def test_what_was_said_is_there_when_the_file_is_opened_again(opened: Opener, closed: bool):
    """Also by a second reader while the first has not closed it, as after a crash."""
    first, query = opened(), query_of(3)
    ask(first, query, [SECOND, None, EQUAL])
    if closed:
        first.close()
    second = opened()
    assert_holds(second, query, [0, 2], [SECOND, EQUAL])
    assert (second.last, second.skipped) == (3, 1)
    later = query_of(1, seed=1)
    assert ask(second, later, [FIRST]) == [4]
    assert np.array_equal(second.segments(4).observation, later.pairs.observation)


@pytest.mark.parametrize("last", [0, 2, 3, 4, 99])
def test_truncating_forgets_the_pairs_after_a_number_and_asking_goes_on_from_it(opened: Opener, last: int):
    preferences, query = opened(), query_of(4)
    labels: list[int | None] = [SECOND, None, FIRST, EQUAL]
    ask(preferences, query, labels)
    preferences.truncate(last)
    kept = min(last, 4)
    rows = [i for i in range(kept) if labels[i] is not None]
    assert preferences.last == len(preferences.asked()) == kept
    assert_holds(preferences, query, rows, [label for label in labels[:kept] if label is not None])
    assert_holds(opened(), query, rows, [label for label in labels[:kept] if label is not None])
    assert ask(preferences, query_of(1)) == [kept + 1]


def test_the_whole_budget_fits_and_skips_take_no_room(opened: Opener):
    preferences, query = opened(), query_of(CAPACITY)
    ask(preferences, query, [SECOND, FIRST] * (CAPACITY // 2))
    assert_holds(preferences, query, list(range(CAPACITY)), [SECOND, FIRST] * (CAPACITY // 2))
    ask(preferences, query_of(4, seed=1), [None] * 4)
    assert preferences.arrays.count == CAPACITY and preferences.last == CAPACITY + 4


# Positions of preferred segments.


def preferred(preferences: Preferences) -> np.ndarray:
    """The filled rows; the others must be zero and the shape fixed."""
    positions, count = preferences.preferred_positions(slice(1, 4))
    assert positions.shape == (CAPACITY * H, 3)
    assert not positions[count:].any()
    return positions[:count]


def test_preferred_positions_are_all_steps_of_every_preferred_segment(opened: Opener):
    preferences, query = opened(), query_of(4)
    ask(preferences, query, [SECOND, FIRST, None, SECOND])
    segments = [query.pairs.observation[i, side] for i, side in ((0, 1), (1, 0), (3, 1))]
    assert np.array_equal(preferred(preferences), np.concatenate(segments)[:, 1:4])


def test_equal_pairs_are_left_out_of_the_preferred_positions(opened: Opener):
    preferences, query = opened(), query_of(3)
    ask(preferences, query, [EQUAL, FIRST, EQUAL])
    assert np.array_equal(preferred(preferences), query.pairs.observation[1, 0, :, 1:4])


@pytest.mark.parametrize("equal", [1, CAPACITY // 2])
def test_where_all_pairs_are_equal_both_segments_count(opened: Opener, equal: int):
    preferences, query = opened(), query_of(equal)
    ask(preferences, query, [EQUAL] * equal)
    assert np.array_equal(preferred(preferences), query.pairs.observation[..., 1:4].reshape(-1, 3))


def test_where_all_of_a_whole_budget_is_equal_the_positions_still_fit(opened: Opener):
    preferences, query = opened(), query_of(CAPACITY)
    ask(preferences, query, [EQUAL] * CAPACITY)
    assert len(preferred(preferences)) == CAPACITY * H


@pytest.mark.parametrize("labels", [None, [None, None]])
def test_without_a_label_there_is_no_preferred_position(opened: Opener, labels: list[int | None] | None):
    preferences = opened()
    ask(preferences, query_of(2), labels)
    assert len(preferred(preferences)) == 0


# The file itself.


def test_the_file_is_sound_after_writing_and_truncating(opened: Opener, file: Path):
    preferences = opened()
    ask(preferences, query_of(4), [SECOND, None, FIRST, EQUAL])
    preferences.truncate(2)
    other = sqlite3.connect(file)
    try:
        assert other.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert other.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        assert other.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert other.execute("SELECT COUNT(*) FROM pairs").fetchone() == (2,)
    finally:
        other.close()


def test_closing_leaves_the_one_file(opened: Opener, file: Path):
    preferences = opened()
    ask(preferences, query_of(2), [SECOND, None])
    preferences.close()
    assert [entry.name for entry in file.parent.iterdir()] == [file.name]


def test_a_file_of_a_newer_schema_is_refused(opened: Opener, file: Path):
    opened().close()
    other = sqlite3.connect(file)
    other.execute(f"PRAGMA user_version={SCHEMA_VERSION + 1}")
    other.close()
    with pytest.raises(BadInput, match=f"version {SCHEMA_VERSION + 1}"):
        opened()
