"""The preference file: nothing said is lost, changed or brought out of order."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from senior.preference_file import SCHEMA_VERSION, Rules, connect, transaction
from senior.preferences import Preferences
from senior.types import Answers, BadInput, Pairs, Preferred, Query

CAPACITY, H, O, A = 6, 4, 5, 2
FIRST, SECOND, EQUAL = (int(label) for label in (Preferred.FIRST, Preferred.SECOND, Preferred.EQUAL))
SECONDS = {FIRST: 0.0, SECOND: 1.0, EQUAL: 0.5}
"""Of every answer, P(second preferred)."""
ONE = Rules()
TWO = Rules(overlap=2)
STEP = 1005
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


def ask(preferences: Preferences, query: Query, session: int = 0, reserves: int = 0) -> list[int]:
    """Ask a query at step 1000; the segments are shown on alternating sides."""
    shown = np.arange(len(query.pairs)) % 2
    return preferences.add(query, session, 1000, 8, shown, reserves)


def say(
    preferences: Preferences, ids: Sequence[int], labels: Sequence[int | None], annotator: str = "somebody"
) -> None:
    preferences.answer(Answers(list(ids), list(labels)), annotator)


def taught(preferences: Preferences, query: Query, labels: Sequence[int | None], session: int = 0) -> list[int]:
    """Ask a query, answer all of it, and train on it."""
    ids = ask(preferences, query, session)
    say(preferences, ids, labels)
    preferences.collect(session, STEP, ONE)
    return ids


def assert_holds(preferences: Preferences, query: Query, rows: list[int], second: Sequence[float]) -> None:
    """The labelled arrays are those rows of the query, bit for bit, and zero beyond."""
    observation, action, held, count = preferences.arrays
    assert count == len(rows)
    assert observation.shape == (CAPACITY, 2, H, O) and action.shape == (CAPACITY, 2, H, A)
    assert [column.dtype for column in (observation, action, held)] == [np.float32] * 3
    assert np.array_equal(observation[:count], query.pairs.observation[rows])
    assert np.array_equal(action[:count], query.pairs.action[rows])
    assert held[:count].tolist() == list(second)
    assert not observation[count:].any() and not action[count:].any() and not held[count:].any()


def set_times(file: Path, answered_at: float) -> None:
    """Have all answers been given at that time."""
    other = connect(file)
    other.execute("UPDATE answers SET answered_at = ?", (answered_at,))
    other.close()


def sql(file: Path, statement: str, *values: object) -> list[tuple[object, ...]]:
    """What another process would see or change."""
    other = connect(file)
    rows = other.execute(statement, values).fetchall()
    other.close()
    return rows


# Asking.


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
    taught(preferences, query, [SECOND, None], session=3)
    for i, row in enumerate(preferences.asked()):
        assert json.loads(str(row["scores"])) == {name: score[i] for name, score in query.scores.items()}
        assert query.prediction is not None and row["prediction"] == query.prediction[i]
        assert (row["id"], row["session"], row["step"], row["run_seed"]) == (i + 1, 3, 1000, 8)
        assert (row["reserve"], row["shown_left"], row["collected_step"]) == (0, i, STEP)
        assert row["second"] == (1.0, None)[i]
        for side in (0, 1):
            assert row[f"episode_{side}"] == query.pairs.episode[i, side]
            assert row[f"start_{side}"] == query.pairs.start[i, side]


def test_a_query_without_scores_or_prediction_is_recorded_without_them(opened: Opener):
    preferences = opened()
    ids = ask(preferences, Query(query_of(1).pairs))
    (row,) = preferences.asked()
    assert (row["scores"], row["prediction"], row["collected_step"], row["second"]) == ("{}", None, None, None)
    again = preferences.query(ids, 0.0)
    assert (again.scores, again.prediction) == ({}, None)


def test_a_query_is_put_again_as_it_was_whichever_of_its_pairs(opened: Opener):
    preferences, query = opened(), query_of(4)
    ask(preferences, query_of(2, seed=1))
    ids = ask(preferences, query, session=1)
    rows = [1, 3]
    again = preferences.query([ids[row] for row in rows], 0.25)
    for one, other in zip(again.pairs, query.pairs.take(np.array(rows)), strict=True):
        assert np.array_equal(one, other)
    assert {name: score.tolist() for name, score in again.scores.items()} == {
        name: score[rows].tolist() for name, score in query.scores.items()
    }
    assert again.prediction is not None and query.prediction is not None
    assert again.prediction.tolist() == query.prediction[rows].tolist()
    assert again.reward_per_step == 0.25


def test_episodes_are_kept_whole_once_each(opened: Opener, file: Path):
    preferences = opened()
    actions = np.random.default_rng(0).normal(size=(7, A)).astype(np.float32)
    for session, seed in ((0, 11), (1, 12)):  # what is known of an episode does not change
        preferences.add(
            query_of(1), session, 1000, 8, np.zeros(1, int), 0, {3: (seed, actions), 4 + session: (5, actions[:2])}
        )
    held = sql(file, "SELECT episode, seed, action FROM episodes ORDER BY episode")
    assert [row[:2] for row in held] == [(3, 11), (4, 5), (5, 5)]
    assert np.array_equal(np.frombuffer(held[0][2], "<f4").reshape(7, A), actions)  # pyright: ignore[reportArgumentType, reportCallIssue]


def test_a_session_is_the_pairs_that_were_asked_in_it(opened: Opener):
    preferences = opened()
    assert preferences.session(0) == []
    assert (ask(preferences, query_of(2)), ask(preferences, query_of(3), session=1, reserves=1)) == ([1, 2], [3, 4, 5])
    assert (preferences.session(0), preferences.session(1), preferences.session(2)) == ([1, 2], [3, 4, 5], [])
    assert [row["reserve"] for row in preferences.asked()] == [0, 0, 0, 0, 1]


# Answers.


def test_only_what_is_collected_is_labelled_and_the_order_is_that_of_asking(opened: Opener):
    preferences, query = opened(), query_of(4)
    ids = ask(preferences, query)
    say(preferences, [ids[3]], [FIRST])
    say(preferences, [ids[2], ids[0]], [EQUAL, SECOND])
    assert_holds(preferences, query, [], [])
    assert preferences.unanswered(0, ONE) == [ids[1]]
    say(preferences, [ids[1]], [SECOND])
    assert preferences.unanswered(0, ONE) == []
    preferences.collect(0, STEP, ONE)
    assert_holds(preferences, query, [0, 1, 2, 3], [1, 1, 0.5, 0])


def test_a_skipped_pair_is_asked_but_is_no_label(opened: Opener):
    preferences, query = opened(), query_of(3)
    taught(preferences, query, [None, SECOND, None])
    assert (len(preferences.asked()), preferences.skipped) == (3, 2)
    assert_holds(preferences, query, [1], [1])


def test_a_pair_without_an_answer_is_not_a_skipped_one(opened: Opener):
    preferences = opened()
    ask(preferences, query_of(3))
    assert (preferences.unanswered(0, ONE), preferences.skipped, preferences.arrays.count) == ([1, 2, 3], 0, 0)


def test_an_answer_is_kept_with_who_gave_it_and_the_side_that_was_shown(opened: Opener, file: Path):
    preferences = opened()
    say(preferences, ask(preferences, query_of(2)), [SECOND, None], "ann")
    rows = sql(file, "SELECT pair, annotator, answer, strength, shown_left, withdrawn FROM answers ORDER BY id")
    assert rows == [(1, "ann", 1, None, 0, None), (2, "ann", None, None, 1, None)]
    ((at,),) = sql(file, "SELECT DISTINCT answered_at FROM answers")
    assert isinstance(at, float) and 0 <= time.time() - at < 60


def test_nobody_answers_a_pair_twice_and_then_nothing_of_it_is_kept(opened: Opener, file: Path):
    preferences = opened()
    ids = ask(preferences, query_of(2))
    say(preferences, ids[1:], [FIRST])
    with pytest.raises(sqlite3.IntegrityError):
        say(preferences, ids, [SECOND, SECOND])
    assert sql(file, "SELECT pair, answer FROM answers") == [(2, FIRST)]


@pytest.mark.parametrize(
    ("labels", "second"),
    [
        ([SECOND, SECOND], 1.0),
        ([FIRST, SECOND], 0.5),
        ([EQUAL, SECOND], 0.75),
        ([None, FIRST], 0.0),
        ([EQUAL, None], 0.5),
        ([None, None], None),
    ],
    ids=str,
)
def test_where_several_are_asked_a_pair_trains_on_their_mean_answer(
    opened: Opener, labels: list[int | None], second: float | None
):
    """Those who could not tell have no say, unless nobody could."""
    preferences, query = opened(), query_of(2)
    first, other = ask(preferences, query)
    say(preferences, [first, other], [labels[0], SECOND], "ann")
    assert preferences.unanswered(0, TWO) == [first, other] and not preferences.ready(0, STEP, TWO)
    say(preferences, [other], [SECOND], "bob")
    assert preferences.unanswered(0, TWO) == [first] and not preferences.ready(0, STEP, TWO)
    say(preferences, [first], [labels[1]], "bob")
    assert preferences.unanswered(0, TWO) == [] and preferences.ready(0, STEP, TWO)
    preferences.collect(0, STEP, TWO)
    rows = [0, 1] if second is not None else [1]
    assert_holds(preferences, query, rows, [1.0] if second is None else [second, 1.0])
    assert preferences.skipped == (second is None)


def test_a_third_of_the_answers_is_a_third(opened: Opener):
    preferences = opened()
    ids = ask(preferences, query_of(1))
    for name, label in (("ann", FIRST), ("bob", SECOND), ("eve", FIRST)):
        say(preferences, ids, [label], name)
    preferences.collect(0, STEP, Rules(overlap=3))
    assert preferences.arrays.second[0] == np.float32(1 / 3)


@pytest.mark.parametrize("soft", [False, True])
def test_how_sure_an_answer_is_counts_where_labels_are_soft(opened: Opener, file: Path, soft: bool):
    preferences, query = opened(), query_of(6)
    labels = [SECOND, SECOND, SECOND, FIRST, FIRST, EQUAL]
    ids = ask(preferences, query)
    say(preferences, ids, labels)
    for number, strength in zip(ids, ["slightly", "clearly", None, "slightly", "clearly", "slightly"], strict=True):
        sql(file, "UPDATE answers SET strength = ? WHERE pair = ?", strength, number)
    preferences.collect(0, STEP, Rules(soft=soft))
    assert_holds(preferences, query, list(range(6)), [0.75, 1, 1, 0.25, 0, 0.5] if soft else [1, 1, 1, 0, 0, 0.5])


def test_an_answer_that_was_taken_back_is_none(opened: Opener, file: Path):
    preferences, query = opened(), query_of(1)
    ids = ask(preferences, query)
    say(preferences, ids, [FIRST])
    sql(file, "UPDATE answers SET withdrawn = 1")
    assert preferences.unanswered(0, ONE) == ids and not preferences.ready(0, STEP, ONE)
    say(preferences, ids, [SECOND])
    preferences.collect(0, STEP, ONE)
    assert_holds(preferences, query, [0], [1])


# Reserves.


def test_reserves_are_asked_one_for_each_skipped_pair_while_there_are_any(opened: Opener):
    """A skipped reserve is replaced in its turn. Pairs 4 to 6 are reserves."""
    preferences, query, rules = opened(), query_of(6), Rules(replace_skipped=True)
    ids = ask(preferences, query, reserves=3)
    asked: list[list[int]] = []
    for number, label in ((1, None), (2, SECOND), (4, None), (3, None), (5, EQUAL), (6, FIRST)):
        asked.append(preferences.unanswered(0, rules))
        assert not preferences.ready(0, STEP, rules)
        say(preferences, [number], [label])
    assert asked == [[1, 2, 3], [2, 3, 4], [3, 4], [3, 5], [5, 6], [6]]
    assert preferences.unanswered(0, rules) == [] and preferences.ready(0, STEP, rules)
    preferences.collect(0, STEP, rules)
    assert_holds(preferences, query, [1, 4, 5], [1, 0.5, 0])
    assert [row["collected_step"] for row in preferences.asked()] == [STEP] * len(ids)


def test_when_the_reserves_are_used_up_the_session_is_smaller(opened: Opener):
    preferences, query, rules = opened(), query_of(3), Rules(replace_skipped=True)
    ask(preferences, query, reserves=1)
    say(preferences, [1, 2, 3], [None, None, SECOND])
    assert preferences.unanswered(0, rules) == [] and preferences.ready(0, STEP, rules)
    preferences.collect(0, STEP, rules)
    assert_holds(preferences, query, [2], [1])


@pytest.mark.parametrize("replace_skipped", [False, True])
def test_reserves_that_are_not_needed_are_neither_asked_nor_collected(opened: Opener, replace_skipped: bool):
    preferences, query, rules = opened(), query_of(4), Rules(replace_skipped=replace_skipped)
    ask(preferences, query, reserves=2)
    say(preferences, [1, 2], [FIRST, SECOND if replace_skipped else None])
    assert preferences.unanswered(0, rules) == [] and preferences.ready(0, STEP, rules)
    preferences.collect(0, STEP, rules)
    assert preferences.arrays.count == 1 + replace_skipped
    assert [row["collected_step"] for row in preferences.asked()] == [STEP, STEP, None, None]


def test_a_pair_that_one_could_tell_is_not_replaced(opened: Opener):
    preferences, rules = opened(), Rules(overlap=2, replace_skipped=True)
    ids = ask(preferences, query_of(2), reserves=1)
    say(preferences, ids[:1], [None], "ann")
    assert preferences.unanswered(0, rules) == ids[:1]
    say(preferences, ids[:1], [SECOND], "bob")
    assert preferences.unanswered(0, rules) == []


# Collecting.


def test_the_last_answer_can_be_thought_over_before_a_session_is_ready(opened: Opener, file: Path):
    preferences = opened()
    say(preferences, ask(preferences, query_of(2)), [FIRST, SECOND])
    assert preferences.ready(0, STEP, ONE) and not preferences.ready(0, STEP, ONE, settle=60)
    set_times(file, time.time() - 61)
    assert preferences.ready(0, STEP, ONE, settle=60)
    set_times(file, time.time() + 3600)  # of a machine whose clock is ahead
    assert preferences.ready(0, STEP, ONE) and preferences.ready(0, STEP, ONE, settle=60)


RULES: list[dict[str, np.ndarray]] = [{"m": np.ones(1)}, {"disagreement": np.full(1, 2.0)}, {}]


def test_pairs_of_two_rules_can_be_put_together(opened: Opener):
    preferences = opened()
    ids = [ask(preferences, replace(query_of(1), scores=scores), number)[0] for number, scores in enumerate(RULES)]
    found = preferences.query(ids, 0.0).scores
    np.testing.assert_array_equal(found["m"], [1, np.nan, np.nan])
    np.testing.assert_array_equal(found["disagreement"], [np.nan, 2, np.nan])


def test_what_was_undone_in_the_last_moment_is_not_collected(opened: Opener, file: Path):
    """The page undoes an answer after the trainer has found the session ready."""
    preferences, query = opened(), query_of(2)
    ask(preferences, query)
    say(preferences, [1, 2], [FIRST, SECOND])
    assert preferences.ready(0, STEP, ONE)
    sql(file, "UPDATE answers SET withdrawn = 1 WHERE pair = 2")
    assert not preferences.collect(0, STEP, ONE)
    assert_holds(preferences, query, [], [])
    assert [row["collected_step"] for row in preferences.asked()] == [None, None]
    sql(file, "UPDATE answers SET withdrawn = NULL WHERE pair = 2")
    assert preferences.collect(0, STEP, ONE)
    assert_holds(preferences, query, [0, 1], [0, 1])


def test_collecting_twice_changes_nothing(opened: Opener, file: Path):
    """Not even where an answer changed in between, as it cannot by the page, or the rules did."""
    preferences, query = opened(), query_of(4)
    ask(preferences, query, reserves=1)
    say(preferences, [1, 2, 3], [FIRST, None, SECOND])
    preferences.collect(0, STEP, ONE)
    before = preferences.asked()
    sql(file, "UPDATE answers SET answer = 1")
    say(preferences, [4], [SECOND])
    preferences.collect(0, STEP + 10, Rules(replace_skipped=True))
    assert preferences.asked() == before
    assert_holds(preferences, query, [0, 2], [0, 1])


def test_a_session_that_was_collected_in_a_life_before_is_ready_at_its_step_only(opened: Opener):
    first, query = opened(), query_of(3)
    taught(first, query, [SECOND, None, EQUAL])
    ids = ask(first, query_of(1, seed=1), session=1)
    first.close()
    second = opened()
    assert second.arrays.count == 0  # until it is told how many sessions its checkpoint has learned from
    assert [second.ready(0, step, ONE) for step in (STEP - 1, STEP, STEP + 1)] == [False, True, True]
    assert second.session(0) == [1, 2, 3] and second.unanswered(0, ONE) == []
    second.collect(0, STEP, ONE)
    assert_holds(second, query, [0, 2], [1, 0.5])
    assert not second.ready(1, STEP, ONE)
    say(second, ids, [FIRST])
    assert second.ready(1, STEP + 1, ONE)


def test_reading_takes_the_sessions_that_were_learned_from_and_no_others(opened: Opener):
    preferences, queries = opened(), [query_of(2, seed) for seed in range(3)]
    for session, query in enumerate(queries):
        taught(preferences, query, [SECOND, FIRST], session)
    both = replace(queries[0], pairs=Pairs(*map(np.concatenate, zip(*(query.pairs for query in queries), strict=True))))
    for sessions in (3, 1, 0, 2):  # fewer than before leave nothing of what was there
        preferences.read(sessions)
        assert_holds(preferences, both, list(range(2 * sessions)), [1, 0] * sessions)


def test_the_predictions_of_a_session_are_told_beside_its_labels(opened: Opener):
    preferences, query = opened(), query_of(3)
    ids = ask(preferences, query, session=2, reserves=1)
    say(preferences, ids[:2], [SECOND, None])
    assert preferences.judged(2) == []
    preferences.collect(2, STEP, ONE)
    assert query.prediction is not None
    assert preferences.judged(2) == [(query.prediction[0], 1.0), (query.prediction[1], None)]
    assert preferences.judged(0) == []


@pytest.mark.parametrize("closed", [True, False])
def test_what_was_said_is_there_when_the_file_is_opened_again(opened: Opener, closed: bool):
    """Also by a second reader while the first has not closed it, as after a crash."""
    first, query = opened(), query_of(3)
    taught(first, query, [SECOND, None, EQUAL])
    if closed:
        first.close()
    second = opened()
    second.read(1)
    assert_holds(second, query, [0, 2], [1, 0.5])
    assert (len(second.asked()), second.skipped) == (3, 1)
    later = query_of(1, seed=1)
    assert taught(second, later, [FIRST], session=1) == [4]
    assert np.array_equal(second.segments(4).observation, later.pairs.observation)


def test_the_whole_budget_fits_and_skips_take_no_room(opened: Opener):
    preferences, query = opened(), query_of(CAPACITY)
    labels = [SECOND, FIRST] * (CAPACITY // 2)
    taught(preferences, query, labels)
    assert_holds(preferences, query, list(range(CAPACITY)), [SECONDS[label] for label in labels])
    taught(preferences, query_of(4, seed=1), [None] * 4, session=1)
    assert preferences.arrays.count == CAPACITY and len(preferences.asked()) == CAPACITY + 4


# Several processes.


def test_nothing_is_lost_where_trainer_and_people_write_at_once(opened: Opener, file: Path):
    """Two connections in two threads: one asks, the other answers what it finds."""
    preferences, sessions = opened(), 40

    def people() -> None:
        desk, answered = connect(file), 0
        while answered < 2 * sessions and not failed:
            with transaction(desk):
                found = desk.execute("SELECT id FROM pairs WHERE id NOT IN (SELECT pair FROM answers)").fetchall()
                desk.executemany(
                    "INSERT INTO answers (pair, annotator, answer, answered_at, shown_left) VALUES (?, 'ann', 1, 0, 0)",
                    found,
                )
            answered += len(found)
        desk.close()

    failed: list[int] = []
    other = threading.Thread(target=people)
    other.start()
    try:
        for session in range(sessions):
            ask(preferences, query_of(2, seed=session), session)
    except BaseException:
        failed.append(1)
        raise
    finally:
        other.join(60)
    assert not other.is_alive()
    assert all(preferences.ready(session, STEP, ONE) for session in range(sessions))
    assert sql(file, "SELECT COUNT(*), COUNT(DISTINCT pair) FROM answers") == [(2 * sessions, 2 * sessions)]
    assert sql(file, "PRAGMA integrity_check") == [("ok",)]


def test_a_transaction_that_breaks_off_leaves_nothing_and_lets_others_go_on(opened: Opener, file: Path):
    preferences = opened()
    ids = ask(preferences, query_of(1))
    other = connect(file)

    def interrupted() -> None:
        with transaction(other):
            other.execute("DELETE FROM pairs")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    other.close()
    say(preferences, ids, [FIRST])
    assert len(preferences.asked()) == 1


# Positions of preferred segments.


def preferred(preferences: Preferences) -> np.ndarray:
    """The filled rows; the others must be zero and the shape fixed."""
    positions, count = preferences.preferred_positions(slice(1, 4))
    assert positions.shape == (CAPACITY * H, 3)
    assert not positions[count:].any()
    return positions[:count]


def test_preferred_positions_are_all_steps_of_every_preferred_segment(opened: Opener):
    preferences, query = opened(), query_of(4)
    taught(preferences, query, [SECOND, FIRST, None, SECOND])
    segments = [query.pairs.observation[i, side] for i, side in ((0, 1), (1, 0), (3, 1))]
    assert np.array_equal(preferred(preferences), np.concatenate(segments)[:, 1:4])


def test_where_people_differ_the_segment_that_more_prefer_counts(opened: Opener):
    preferences, query = opened(), query_of(3)
    ids = ask(preferences, query)
    for name, labels in (("ann", [SECOND, FIRST, FIRST]), ("bob", [EQUAL, EQUAL, SECOND])):
        say(preferences, ids, labels, name)
    preferences.collect(0, STEP, TWO)
    segments = [query.pairs.observation[0, 1], query.pairs.observation[1, 0]]  # of the third pair, neither
    assert np.array_equal(preferred(preferences), np.concatenate(segments)[:, 1:4])


def test_equal_pairs_are_left_out_of_the_preferred_positions(opened: Opener):
    preferences, query = opened(), query_of(3)
    taught(preferences, query, [EQUAL, FIRST, EQUAL])
    assert np.array_equal(preferred(preferences), query.pairs.observation[1, 0, :, 1:4])


@pytest.mark.parametrize("equal", [1, CAPACITY // 2])
def test_where_all_pairs_are_equal_both_segments_count(opened: Opener, equal: int):
    preferences, query = opened(), query_of(equal)
    taught(preferences, query, [EQUAL] * equal)
    assert np.array_equal(preferred(preferences), query.pairs.observation[..., 1:4].reshape(-1, 3))


def test_where_all_of_a_whole_budget_is_equal_the_positions_still_fit(opened: Opener):
    preferences, query = opened(), query_of(CAPACITY)
    taught(preferences, query, [EQUAL] * CAPACITY)
    assert len(preferred(preferences)) == CAPACITY * H


@pytest.mark.parametrize("labels", [None, [None, None]])
def test_without_a_label_there_is_no_preferred_position(opened: Opener, labels: list[int | None] | None):
    preferences = opened()
    if labels is None:
        ask(preferences, query_of(2))
    else:
        taught(preferences, query_of(2), labels)
    assert len(preferred(preferences)) == 0


# The file itself.


def test_the_file_is_sound_and_every_commit_is_on_the_disk(opened: Opener, file: Path):
    preferences = opened()
    taught(preferences, query_of(4), [SECOND, None, FIRST, EQUAL])
    other = connect(file)
    try:
        assert other.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert other.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        assert other.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert other.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL, for each connection
        assert other.execute("SELECT COUNT(*) FROM pairs").fetchone() == (4,)
    finally:
        other.close()


def test_closing_leaves_the_one_file(opened: Opener, file: Path):
    preferences = opened()
    taught(preferences, query_of(2), [SECOND, None])
    preferences.close()
    assert [entry.name for entry in file.parent.iterdir()] == [file.name]


@pytest.mark.parametrize("version", [SCHEMA_VERSION - 1, SCHEMA_VERSION + 1])
def test_a_file_of_another_schema_is_refused(opened: Opener, file: Path, version: int):
    opened().close()
    sql(file, f"PRAGMA user_version={version}")
    with pytest.raises(BadInput, match=f"version {version}; this program reads {SCHEMA_VERSION}"):
        opened()


@pytest.mark.parametrize("bytes_", [b"not a database" * 100, b"SQLite format 3\0" + bytes(4080)], ids=["text", "zeros"])
def test_a_damaged_file_is_refused_and_left_as_it_is(opened: Opener, file: Path, bytes_: bytes):
    file.write_bytes(bytes_)
    with pytest.raises(BadInput, match=r"preferences\.sqlite cannot be used"):
        opened()
    assert file.read_bytes() == bytes_


def test_a_file_with_segments_of_another_size_is_refused(opened: Opener, file: Path):
    opened().close()
    with pytest.raises(BadInput, match=r"\(4, 5, 2\), not \(4, 5, 3\)"):
        Preferences(file, CAPACITY, H, O, A + 1)
