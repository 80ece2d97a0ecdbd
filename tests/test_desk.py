"""What people do with pairs: who is given which, what an answer becomes, what can be taken back. Page, database and
trainer agree, whatever is done in which order.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from senior.config import Asking
from senior.label.desk import AHEAD, LEASE_SECONDS, Assignment, Desk, Given, Outcome
from senior.preference_file import Rules
from tests.stand_in import PAPER, StandIn, new_id

FIRST, SECOND, EQUAL = 0, 1, -1
Opener = Callable[..., tuple[StandIn, Desk]]


class Clock:
    """Time that passes when it is told to."""

    now = 1e9

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def opened(tmp_path: Path, clock: Clock) -> Iterator[Opener]:
    """Makes the run of the test, and a desk over it."""
    held: list[tuple[StandIn, Desk]] = []

    def make(asking: Asking = PAPER) -> tuple[StandIn, Desk]:
        run = StandIn(tmp_path / "run", asking)
        held.append((run, Desk(run.file, run.rules, clock)))
        return held[-1]

    yield make
    for run, desk in held:
        desk.close()
        run.close()


def given(desk: Desk, who: str) -> int | None:
    """The pair that somebody is to look at."""
    pair = desk.assign(who).pair
    return pair and pair["pair"]


def ahead(assignment: Assignment) -> list[int]:
    return [pair["pair"] for pair in assignment.ahead]


def answer(desk: Desk, who: str, pair: int, what: Any = "left", strength: str | None = None) -> Outcome:
    return desk.answer(new_id(), who, Given(pair, what, strength))


def undo(desk: Desk, who: str = "ann") -> Outcome:
    return desk.undo(new_id(), who)


def redo(desk: Desk, who: str = "ann") -> Outcome:
    return desk.redo(new_id(), who)


def said(pair: int, what: str = "left", strength: str | None = None) -> Outcome:
    """That something was saved, taken back or given again."""
    return Outcome({"pair": pair, "answer": what, "strength": strength})


def assert_refused(outcome: Outcome, why: str) -> None:
    assert outcome.said is None and outcome.refused is not None
    assert why in outcome.refused and outcome.refused.endswith(".")


def answered(run: StandIn) -> list[tuple[int, str]]:
    """Pair and annotator of the answers that stand."""
    return [(pair, who) for pair, who, _, _ in run.standing()]


def labels(run: StandIn) -> list[float]:
    """P(second preferred) as the trainer has it."""
    second, count = run.preferences.arrays[2:]
    return second[:count].tolist()


# Who is given which pair.


def test_pairs_come_in_the_order_of_asking_and_stay_until_they_are_answered(opened: Opener):
    run, desk = opened()
    ids = run.ask(3)
    for number in ids:
        assert [given(desk, "ann") for _ in range(2)] == [number, number]
        answer(desk, "ann", number)
    assert desk.assign("ann") == Assignment(None, [], "waiting")


def test_a_pair_is_told_as_the_page_shows_it(opened: Opener):
    run, desk = opened()
    run.ask(2, left=[1, 0])
    names = dict(run.sql("SELECT 10 * pair + side, name FROM clips"))
    first, (second,) = desk.assign("ann")[:2]
    rest = {"frames": 4, "fps": 20.0, "speed": 0.25, "session": 1, "step": 1000, "size": 2, "note": None}
    clips = [
        {"left": f"/clips/{names[left]}.mp4", "right": f"/clips/{names[right]}.mp4"}
        for left, right in ((11, 10), (20, 21))
    ]
    assert first == {"pair": 1, "number": 1, **clips[0], **rest}
    assert second == {"pair": 2, "number": 2, **clips[1], **rest}


def test_the_next_three_pairs_are_told_beforehand(opened: Opener):
    run, desk = opened()
    ids = run.ask(6)
    assert AHEAD == 3
    assert ahead(desk.assign("ann")) == ids[1:4]
    assert ahead(desk.assign("bob")) == ids[2:5]  # nor what ann looks at
    for number in (ids[0], ids[2], ids[3]):
        answer(desk, "ann", number)
    assert given(desk, "ann") == ids[4]
    assert ahead(desk.assign("ann")) == ids[5:]


def test_no_pair_is_given_to_two_people(opened: Opener):
    run, desk = opened()
    ids = run.ask(3)
    people = ["ann", "bob", "cem"]
    assert [given(desk, who) for who in people] == ids
    assert [given(desk, who) for who in reversed(people)] == ids[::-1]
    assert desk.assign("dan") == Assignment(None, [], "others")


def test_a_pair_returns_to_the_others_after_two_minutes(opened: Opener, clock: Clock):
    run, desk = opened()
    (number,) = run.ask(1)
    assert LEASE_SECONDS == 120
    given(desk, "ann")
    clock.now += 119
    assert given(desk, "bob") is None
    assert given(desk, "ann") == number  # which does not prolong it
    clock.now += 1
    assert given(desk, "bob") == number
    assert given(desk, "ann") is None


def test_who_answers_first_counts_where_a_pair_was_given_on(opened: Opener, clock: Clock):
    run, desk = opened()
    first, second = run.ask(2)
    given(desk, "ann")
    clock.now += LEASE_SECONDS
    assert given(desk, "bob") == first
    assert answer(desk, "ann", first) == said(first)
    assert_refused(answer(desk, "bob", first, "right"), "answered by somebody else")
    assert answered(run) == [(first, "ann")]
    assert given(desk, "bob") == second


def test_an_undone_pair_is_ones_own_even_if_it_had_been_given_on(opened: Opener, clock: Clock):
    run, desk = opened()
    (number,) = run.ask(1)
    given(desk, "ann")
    clock.now += LEASE_SECONDS
    given(desk, "bob")
    answer(desk, "ann", number)
    undo(desk)
    assert (given(desk, "ann"), given(desk, "bob")) == (number, None)


def test_a_redone_pair_is_nobody_elses(opened: Opener, clock: Clock):
    run, desk = opened()
    (number,) = run.ask(1)
    answer(desk, "ann", number)
    undo(desk)
    clock.now += LEASE_SECONDS
    given(desk, "bob")
    redo(desk)
    undo(desk)
    assert (given(desk, "ann"), given(desk, "bob")) == (number, None)


def test_with_overlap_each_pair_is_given_to_so_many(opened: Opener):
    run, desk = opened(Asking(overlap=2))
    first, second = run.ask(2)
    assert [given(desk, who) for who in ("ann", "bob", "cem", "dan")] == [first, first, second, second]
    assert desk.assign("eve").kind == "others"
    answer(desk, "ann", first)
    answer(desk, "cem", second)
    assert desk.assign("eve").kind == "others"
    assert given(desk, "ann") is None  # bob and dan have the second places
    answer(desk, "bob", first)
    assert_refused(answer(desk, "dan", first), "answered by somebody else")
    answer(desk, "dan", second)
    assert desk.assign("eve").kind == "waiting"


def test_with_overlap_who_has_done_all_waits_for_the_others(opened: Opener):
    run, desk = opened(Asking(overlap=2))
    (number,) = run.ask(1)
    answer(desk, "ann", number)
    assert desk.assign("ann") == Assignment(None, [], "others")
    assert_refused(answer(desk, "ann", number, "right"), "You have answered pair 1 already")
    assert given(desk, "bob") == number


def test_with_overlap_nobody_is_given_a_pair_for_which_there_is_no_room_after_an_undo(opened: Opener, clock: Clock):
    run, desk = opened(Asking(overlap=2))
    (number,) = run.ask(1)
    given(desk, "ann")
    clock.now += LEASE_SECONDS
    assert given(desk, "bob") == number
    clock.now += 1
    assert given(desk, "cem") == number
    answer(desk, "ann", number)
    assert [given(desk, who) for who in ("bob", "cem")] == [number, None]
    undo(desk)
    assert [given(desk, who) for who in ("ann", "bob", "cem")] == [number, number, None]


def test_a_pair_comes_when_its_clips_are_drawn(opened: Opener):
    run, desk = opened()
    first, second = run.ask(2, drawn=False)
    assert desk.assign("ann") == Assignment(None, [], "drawing")
    run.draw([second])
    assert given(desk, "ann") == second
    run.draw([first])
    assert given(desk, "ann") == second  # what one looks at stays
    assert given(desk, "bob") == first
    assert desk.assign("cem").kind == "others"


def test_a_pair_that_cannot_be_drawn_can_only_be_skipped(opened: Opener):
    run, desk = opened()
    for number, side in zip(run.ask(2, drawn=False), (0, 1), strict=True):
        run.fail(number, "No renderer.", side)
        pair = desk.assign("ann").pair
        assert pair and (pair["pair"], pair["note"], pair["left"], pair["right"]) == (
            number,
            "No renderer.",
            None,
            None,
        )
        assert_refused(answer(desk, "ann", number), "only be skipped")
        assert answer(desk, "ann", number, "skip") == said(number, "skip")
    assert desk.progress()["clips"] == {"ready": 2, "wanted": 2, "failure": "No renderer."}


def test_a_pair_that_nobody_can_have_seen_is_not_judged(opened: Opener):
    run, desk = opened()
    (number,) = run.ask(1, drawn=False)
    assert_refused(answer(desk, "ann", number), "only be skipped")
    assert run.standing() == []


@pytest.mark.parametrize("number", [0, 3, 2**53])
def test_a_pair_that_is_not_there_is_refused(opened: Opener, number: int):
    run, desk = opened()
    run.ask(2)
    assert_refused(answer(desk, "ann", number), f"There is no pair {number}")


def test_a_later_session_is_given_too(opened: Opener):
    run, desk = opened()
    first, second = *run.ask(1), *run.ask(1)
    assert (given(desk, "ann"), given(desk, "bob")) == (first, second)
    answer(desk, "ann", first)
    run.collect()
    assert_refused(answer(desk, "bob", first), "trained on already")
    assert answer(desk, "bob", second) == said(second)


# What an answer becomes.


@pytest.mark.parametrize("left", [FIRST, SECOND])
@pytest.mark.parametrize("what", ["left", "right", "equal", "skip"])
def test_an_answer_is_kept_by_segment_whichever_side_that_was_on(opened: Opener, left: int, what: str):
    run, desk = opened()
    (number,) = run.ask(1, left=[left])
    assert answer(desk, "ann", number, what) == said(number, what)
    right = 1 - left
    kept = {"left": left, "right": right, "equal": EQUAL, "skip": None}[what]
    assert run.standing() == [(number, "ann", kept, None)]
    assert undo(desk) == said(number, what)
    assert redo(desk) == said(number, what)
    run.collect()
    assert labels(run) == {FIRST: [0.0], SECOND: [1.0], EQUAL: [0.5], None: []}[kept]


def test_all_that_belongs_to_an_answer_is_kept(opened: Opener, clock: Clock):
    run, desk = opened()
    first, second = run.ask(2, left=[0, 1])
    desk.answer("a-post-id", "ann", Given(second, "right", "slightly", 3.25, 2))
    clock.now += 1
    desk.answer("another-id", "ann", Given(first, "left"))
    columns = "pair, annotator, answer, strength, answered_at, seconds, replays, shown_left, clip_0, clip_1, withdrawn"
    assert run.sql(f"SELECT {columns} FROM answers ORDER BY id") == [
        (second, "ann", FIRST, "slightly", 1e9, 3.25, 2, 1, "sha of 2, 0", "sha of 2, 1", None),
        (first, "ann", FIRST, None, 1e9 + 1, None, None, 0, "sha of 1, 0", "sha of 1, 1", None),
    ]


@pytest.mark.parametrize("what", ["left", "right", "equal", "skip"])
def test_only_a_preference_has_a_strength(opened: Opener, what: str):
    run, desk = opened(Asking(soft_labels=True))
    (number,) = run.ask(1, left=[0])
    strength = "slightly" if what in ("left", "right") else None
    assert answer(desk, "ann", number, what, "slightly") == said(number, what, strength)
    assert run.standing()[0][3] == strength
    assert undo(desk) == said(number, what, strength)
    redo(desk)
    run.collect()
    assert labels(run) == {"left": [0.25], "right": [0.75], "equal": [0.5], "skip": []}[what]


def test_another_pair_is_asked_in_place_of_a_skipped_one_and_not_if_that_is_undone(opened: Opener):
    run, desk = opened(Asking(replace_skipped=True))
    first, second, reserve, last = run.ask(2, reserves=2)
    assert ahead(desk.assign("ann")) == [second]
    assert_refused(answer(desk, "ann", reserve), "not asked")
    answer(desk, "ann", first, "skip")
    assert (given(desk, "ann"), ahead(desk.assign("ann"))) == (second, [reserve])
    undo(desk)
    assert ahead(desk.assign("ann")) == [second]
    redo(desk)
    answer(desk, "ann", second, "equal")
    pair = desk.assign("ann").pair
    assert pair and (pair["pair"], pair["number"], pair["size"]) == (reserve, 3, 3)
    answer(desk, "ann", reserve, "skip")
    assert given(desk, "ann") == last
    answer(desk, "ann", last, "right")
    assert desk.assign("ann").kind == "waiting"
    assert run.ready()
    run.collect()
    assert labels(run) == [0.5, 0.0]  # the last one's second segment was on the left


def test_a_skipped_pair_is_not_replaced_unless_that_is_asked_for(opened: Opener):
    run, desk = opened()
    first, second, _ = run.ask(2, reserves=1)
    answer(desk, "ann", first, "skip")
    answer(desk, "ann", second, "skip")
    assert desk.assign("ann").kind == "waiting"
    assert run.ready()


# Undo and redo.


def test_undo_and_redo_go_back_and_forth_over_ones_answers(opened: Opener):
    run, desk = opened()
    whats = ["left", "skip", "equal"]
    ids = run.ask(3, left=[0, 0, 0])
    for number, what in zip(ids, whats, strict=True):
        answer(desk, "ann", number, what)
    for number, what in reversed(list(zip(ids, whats, strict=True))):
        assert undo(desk) == said(number, what)
        assert given(desk, "ann") == number
    assert_refused(undo(desk), "no answer of yours")
    assert run.standing() == []
    for number, what in zip(ids, whats, strict=True):
        assert redo(desk) == said(number, what)
    assert_refused(redo(desk), "nothing to redo")
    assert run.standing() == [(ids[0], "ann", FIRST, None), (ids[1], "ann", None, None), (ids[2], "ann", EQUAL, None)]


def test_another_answer_ends_what_could_be_redone(opened: Opener):
    run, desk = opened()
    ids = run.ask(2, left=[0, 0])
    for number in ids:
        answer(desk, "ann", number)
    undo(desk)
    undo(desk)
    answer(desk, "ann", ids[0], "right")
    assert not desk.own("ann")["redo"]
    assert_refused(redo(desk), "nothing to redo")
    assert run.standing() == [(ids[0], "ann", SECOND, None)]
    assert undo(desk) == said(ids[0], "right")
    assert redo(desk) == said(ids[0], "right")


def test_people_take_back_only_their_own_answers(opened: Opener):
    run, desk = opened()
    first, second = run.ask(2)
    answer(desk, "ann", first)
    answer(desk, "bob", second)
    assert undo(desk, "ann") == said(first)
    assert_refused(redo(desk, "bob"), "nothing to redo")
    assert undo(desk, "bob") == said(second)
    answer(desk, "bob", second)
    assert redo(desk, "ann") == said(first)


def test_what_was_trained_on_cannot_be_undone_nor_given_again(opened: Opener):
    run, desk = opened()
    first, second = run.ask(2)
    answer(desk, "ann", first)
    answer(desk, "ann", second)
    undo(desk)
    answer(desk, "bob", second)
    run.collect()
    assert desk.own("ann") == {"answers": 1, "undo": False, "redo": False}
    assert_refused(undo(desk), "trained on already")
    assert_refused(redo(desk), "trained on already")
    assert_refused(answer(desk, "cem", first), "trained on already")
    assert answered(run) == [(first, "ann"), (second, "bob")]


def test_an_answer_cannot_be_given_again_where_another_has_been_given(opened: Opener, clock: Clock):
    run, desk = opened()
    (number,) = run.ask(1)
    answer(desk, "ann", number)
    undo(desk)
    assert desk.own("ann")["redo"]
    clock.now += LEASE_SECONDS
    answer(desk, "bob", given(desk, "bob") or 0)
    assert not desk.own("ann")["redo"]
    assert_refused(redo(desk), "answered by somebody else")
    undo(desk, "bob")
    assert redo(desk) == said(number)
    assert_refused(redo(desk, "bob"), "answered by somebody else")


def test_an_answer_in_place_of_a_skipped_pair_can_be_undone_when_it_is_not_asked_for_any_more(opened: Opener):
    run, desk = opened(Asking(replace_skipped=True))
    first, reserve = run.ask(1, reserves=1)
    answer(desk, "ann", first, "skip")
    answer(desk, "bob", reserve)
    undo(desk, "ann")
    assert desk.own("bob")["undo"]
    assert undo(desk, "bob") == said(reserve)
    assert not desk.own("bob")["redo"]
    assert_refused(redo(desk, "bob"), "not asked")
    assert given(desk, "bob") is None  # ann has the one that is


# What is sent again.


def test_what_is_sent_again_hears_the_same_and_changes_nothing(opened: Opener, clock: Clock):
    run, desk = opened()
    first, second = run.ask(2)
    acts: list[tuple[str, Callable[[str], Outcome]]] = [
        ("answers", lambda post: desk.answer(post, "ann", Given(first, "left", "clearly", 1.0, 1))),
        ("refused", lambda post: desk.answer(post, "ann", Given(first, "right"))),
        ("answers", lambda post: desk.answer(post, "ann", Given(second, "skip"))),
        ("undoes", lambda post: desk.undo(post, "ann")),
        ("redoes", lambda post: desk.redo(post, "ann")),
        ("refused", lambda post: desk.redo(post, "ann")),
    ]
    heard = []
    for number, (what, act) in enumerate(acts):
        heard.append(act(f"post-{number}"))
        assert (heard[-1].refused is None) == (what != "refused"), what
        before = run.contents()
        clock.now += 1
        assert act(f"post-{number}") == heard[-1]
        assert run.contents() == before
    before = run.contents()
    assert [act(f"post-{number}") for number, (_, act) in enumerate(acts)] == heard
    assert run.contents() == before


def test_what_is_sent_again_hears_the_same_when_it_would_be_refused_by_now(opened: Opener):
    run, desk = opened()
    (number,) = run.ask(1)
    sent = Given(number, "left")
    assert desk.answer("the-same-id", "ann", sent) == said(number)
    run.collect()
    assert desk.answer("the-same-id", "ann", sent) == said(number)
    assert len(answered(run)) == 1


# What a page is told.


def test_progress_counts_what_is_answered_and_what_is_asked(opened: Opener):
    run, desk = opened(Asking(overlap=2))
    assert desk.progress() == {
        "labels": {"done": 0, "per_hour": None, "session": None},
        "clips": {"ready": 0, "wanted": 0, "failure": None},
    }
    first, second = run.ask(2, drawn=False)
    run.draw([first])
    answer(desk, "ann", first)
    assert desk.progress()["labels"]["done"] == 0
    answer(desk, "bob", first)
    assert desk.progress()["labels"] | {"per_hour": None} == {
        "done": 1,
        "per_hour": None,
        "session": {"number": 1, "done": 1, "size": 2},
    }
    assert desk.progress()["clips"] == {"ready": 1, "wanted": 2, "failure": None}
    for who in ("ann", "bob"):
        answer(desk, who, second, "skip")
    assert desk.progress()["labels"]["done"] == 2
    run.collect()
    assert desk.progress()["labels"]["done"] == 2
    run.ask(3)
    progress = desk.progress()
    assert (progress["labels"]["done"], progress["labels"]["session"]) == (2, {"number": 2, "done": 0, "size": 3})
    assert progress["clips"] == {"ready": 3, "wanted": 3, "failure": None}


def test_progress_does_not_count_what_is_replaced_while_it_can_be(opened: Opener):
    run, desk = opened(Asking(replace_skipped=True))
    ids = run.ask(2, reserves=2)
    done = []
    for number in ids:
        answer(desk, "ann", number, "skip")
        session = desk.progress()["labels"]["session"]
        assert session["size"] == 2
        done.append(session["done"])
    assert done == [0, 0, 1, 2]  # the reserves stand for the first two and are skipped themselves
    assert desk.progress()["labels"]["done"] == 2
    run.collect()
    assert desk.progress()["labels"]["done"] == 2


def test_the_rate_is_that_of_the_work_without_its_pauses(opened: Opener, clock: Clock):
    run, desk = opened()
    ids = run.ask(30)
    for number, gap in zip(ids, [0, 10, 20, 121, *[30] * 2], strict=False):
        clock.now += gap
        answer(desk, "ann", number)
    assert desk.progress()["labels"]["per_hour"] == pytest.approx(3600 * 4 / 90)
    for number in ids[6:]:
        clock.now += 5
        answer(desk, "ann", number)
    assert desk.progress()["labels"]["per_hour"] == pytest.approx(720)  # by the latest twenty


def test_everybody_is_told_of_their_own_answers_and_of_all_who_answered(opened: Opener):
    run, desk = opened()
    ids = run.ask(5)
    for who, number, what, seconds in zip(
        ["bob", "ann", "ann", "ann"], ids, ["skip", "left", "equal", "skip"], [None, 4.0, 2.0, None], strict=False
    ):
        desk.answer(new_id(), who, Given(number, what, None, seconds))
    answer(desk, "ann", ids[4])
    undo(desk, "ann")
    assert desk.own("ann") == {"answers": 3, "undo": True, "redo": True}
    assert desk.own("bob") == {"answers": 1, "undo": True, "redo": False}
    assert desk.own("eve") == {"answers": 0, "undo": False, "redo": False}
    assert desk.annotators() == [
        {"name": "bob", "answers": 1, "skips": 1, "equals": 0, "median_seconds": None},
        {"name": "ann", "answers": 3, "skips": 1, "equals": 1, "median_seconds": 3.0},
    ]
    assert desk.said() == [(1, "bob", None), (2, "ann", SECOND), (3, "ann", EQUAL), (4, "ann", None)]


def test_the_model_is_judged_by_what_it_foretold_of_decided_pairs_after_the_first_fit(opened: Opener):
    run, desk = opened()
    for _ in range(3):
        run.ask(4, left=[0] * 4)
    run.sql("UPDATE pairs SET prediction = CASE id % 4 WHEN 1 THEN 0.9 WHEN 2 THEN 0.2 ELSE 0.6 END")
    for number in range(1, 13):
        answer(desk, "ann", number, "left" if number % 4 in (1, 2) else "skip" if number < 9 else "equal")
    assert desk.foretold() == []
    for _ in range(3):
        run.collect()
    assert desk.foretold() == [(2005, 1, 2), (3005, 1, 2)]


def test_notes_and_names_of_clips_are_found(opened: Opener):
    run, desk = opened()
    run.ask(1)
    assert desk.note("goal") is None
    for text in ("Open the door", "Shut it"):
        desk.write("goal", text)
        assert desk.note("goal") == text
    ((name,),) = run.sql("SELECT name FROM clips WHERE side = 0")
    assert desk.clip(name) and not desk.clip(name[1:])


def test_outcomes_are_kept_as_they_are_told(opened: Opener):
    """What `posts` holds is what a repeated post hears, whatever is in it."""
    run, desk = opened()
    (number,) = run.ask(1)
    outcome = desk.answer("the-same-id", '<b>"ann"', Given(number, "left", "slightly"))
    assert run.sql("SELECT id, outcome FROM posts") == [("the-same-id", json.dumps(outcome))]


# Whatever is done in which order.


@dataclass
class Modelled:
    """A pair as the model has it."""

    reserve: bool
    left: int
    drawn: bool
    said: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    """Answer and strength of everybody whose answer stands."""
    leases: dict[str, float] = field(default_factory=dict)
    """Until when it is kept for whom."""
    trained: bool = False

    def label(self, rules: Rules) -> float | None:
        """P(second preferred)."""
        told = []
        for what, strength in self.said.values():
            if what == "equal":
                told.append(0.5)
            elif what != "skip":
                second = (what == "left") == (self.left == SECOND)
                told.append(abs(second - (0.25 if rules.soft and strength == "slightly" else 0)))
        return sum(told) / len(told) if told else None


class Model:
    """What ought to happen, as lists in memory; one session is asked at a time."""

    def __init__(self, rules: Rules, clock: Clock) -> None:
        self.rules, self.clock = rules, clock
        self.pairs: dict[int, Modelled] = {}
        self.session: list[int] = []
        self.given: dict[str, list[int]] = {who: [] for who in PEOPLE}
        """Pairs whose answer stands, the latest last."""
        self.back: dict[str, list[tuple[int, str, str | None]]] = {who: [] for who in PEOPLE}
        """Answers that were taken back, the latest last."""
        self.answers = self.before = 0
        """Given in all; pairs of former sessions."""
        self.labels: list[float] = []

    def asked(self) -> list[int]:
        reserves = [number for number in self.session if self.pairs[number].reserve]
        chosen = [number for number in self.session if not self.pairs[number].reserve]
        for number in chosen:
            given_up = self.full(number) and all(what == "skip" for what, _ in self.pairs[number].said.values())
            if self.rules.replace_skipped and given_up and reserves:
                chosen.append(reserves.pop(0))
        return chosen

    def full(self, number: int) -> bool:
        return len(self.pairs[number].said) >= self.rules.overlap

    def places(self, who: str, number: int) -> int:
        """How many could be given a pair, without those who have answered it and others who look at it."""
        pair = self.pairs[number]
        others = [one for one, until in pair.leases.items() if one != who and until > self.clock.now]
        return self.rules.overlap - len(pair.said) - len(others)

    def kept(self, who: str, number: int) -> float:
        until = self.pairs[number].leases.get(who, 0.0)
        return until if until > self.clock.now else 0.0

    def assign(self, who: str) -> tuple[int | None, list[int], str | None]:
        unfinished = [number for number in self.asked() if not self.full(number)]
        free = [number for number in unfinished if who not in self.pairs[number].said and self.places(who, number) > 0]
        free.sort(key=lambda number: -self.kept(who, number))
        shown = [number for number in free if self.pairs[number].drawn]
        if not shown:
            return None, [], "drawing" if free else "others" if unfinished else "waiting"
        if not self.kept(who, shown[0]):
            self.pairs[shown[0]].leases[who] = self.clock.now + 120
        return shown[0], shown[1:4], None

    def is_open(self, number: int) -> bool:
        """Whether a pair can be answered by one who has not answered it."""
        return number in self.asked() and not self.pairs[number].trained and not self.full(number)

    def stands(self, who: str, number: int, what: str, strength: str | None) -> Outcome:
        pair = self.pairs[number]
        pair.said[who] = what, strength
        pair.leases.pop(who, None)
        while self.places("", number) < 0:
            del pair.leases[max(pair.leases, key=lambda one: pair.leases[one])]
        self.given[who].append(number)
        return said(number, what, strength)

    def answer(self, who: str, number: int, what: str, strength: str | None) -> Outcome | None:
        """None: refused."""
        if number not in self.pairs or not self.is_open(number) or who in self.pairs[number].said:
            return None
        if what != "skip" and not self.pairs[number].drawn:
            return None
        self.back[who].clear()
        self.answers += 1
        return self.stands(who, number, what, strength if what in ("left", "right") else None)

    def undoable(self, who: str) -> bool:
        return bool(self.given[who]) and not self.pairs[self.given[who][-1]].trained

    def undo(self, who: str) -> Outcome | None:
        if not self.undoable(who):
            return None
        number = self.given[who].pop()
        what, strength = self.pairs[number].said.pop(who)
        self.back[who].append((number, what, strength))
        self.pairs[number].leases[who] = self.clock.now + 120
        return said(number, what, strength)

    def redoable(self, who: str) -> bool:
        return bool(self.back[who]) and self.is_open(self.back[who][-1][0])

    def redo(self, who: str) -> Outcome | None:
        return self.stands(who, *self.back[who].pop()) if self.redoable(who) else None

    def finished(self) -> bool:
        return all(self.full(number) for number in self.asked())

    def collect(self) -> None:
        labels = [self.pairs[number].label(self.rules) for number in sorted(self.asked())]
        self.labels += [label for label in labels if label is not None]
        self.before += sum(not self.pairs[number].reserve for number in self.session)
        for number in self.session:
            self.pairs[number].trained = True
        self.session = []

    def standing(self) -> list[tuple[int, str, int | None, str | None]]:
        kept = {(number, who): told for number, pair in self.pairs.items() for who, told in pair.said.items()}
        found = []
        for (number, who), (what, strength) in sorted(kept.items()):
            left = self.pairs[number].left
            found.append((number, who, {"left": left, "right": 1 - left, "equal": EQUAL, "skip": None}[what], strength))
        return found


PEOPLE = ("ann", "bob")
MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Where a commit is fast, if there is such a place: what is tested here is not the disk."""
people = st.sampled_from(PEOPLE)
whats = st.sampled_from(["left", "right", "equal", "skip", "skip"])
strengths = st.sampled_from([None, "slightly", "clearly"])


class AnyOrder(RuleBasedStateMachine):
    """Two people and a trainer do what they can, in any order; the model says what each is told and what is kept."""

    @initialize(overlap=st.integers(1, 2), replace=st.booleans(), soft=st.booleans())
    def begin(self, overlap: int, replace: bool, soft: bool) -> None:
        self.folder = tempfile.TemporaryDirectory(dir=MEMORY)
        self.run = StandIn(Path(self.folder.name) / "run", Asking(True, overlap, replace, soft))
        self.clock = Clock()
        self.desk = Desk(self.run.file, self.run.rules, self.clock)
        self.model = Model(self.run.rules, self.clock)
        self.page: dict[str, int | None] = dict.fromkeys(PEOPLE)
        self.sent: tuple[Callable[[], Outcome], Outcome] | None = None
        self.ask(2, 1, [0, 1, 0], True)

    def ask(self, pairs: int, reserves: int, left: list[int], drawn: bool) -> None:
        self.model.session = self.run.ask(pairs, reserves, left, drawn)
        for i, number in enumerate(self.model.session):
            self.model.pairs[number] = Modelled(i >= pairs, left[i], drawn)

    def hear(self, act: Callable[[], Outcome], expected: Outcome | None) -> None:
        """Send a post, and see that it hears what it must."""
        outcome = act()
        assert outcome == expected if expected else outcome.said is None and outcome.refused
        self.sent = act, outcome

    @rule(who=people)
    def look(self, who: str) -> None:
        assignment = self.desk.assign(who)
        self.page[who] = assignment.pair and assignment.pair["pair"]
        assert (self.page[who], ahead(assignment), assignment.kind) == self.model.assign(who)

    @rule(who=people, given=st.lists(st.tuples(whats, strengths), min_size=1, max_size=3))
    def answer(self, who: str, given: list[tuple[Any, str | None]]) -> None:
        self.look(who)
        for what, strength in given:
            number = self.page[who]
            if number is not None:
                self.answer_any(who, number, what, strength)
                self.look(who)

    @rule(who=people, what=whats, strength=strengths)
    def answer_late(self, who: str, what: Any, strength: str | None) -> None:
        """What is on one's page may have been given on by now."""
        if (number := self.page[who]) is not None:
            self.answer_any(who, number, what, strength)

    @rule(who=people, back=st.integers(0, 4), what=whats)
    def answer_strange(self, who: str, back: int, what: Any) -> None:
        self.answer_any(who, max(self.model.pairs) + 1 - back, what, None)

    def answer_any(self, who: str, number: int, what: Any, strength: str | None) -> None:
        post, sent = new_id(), Given(number, what, strength)
        self.hear(lambda: self.desk.answer(post, who, sent), self.model.answer(who, number, what, strength))

    @precondition(lambda self: any(self.model.given.values()))
    @rule(who=people, times=st.integers(1, 3))
    def undo(self, who: str, times: int) -> None:
        for _ in range(times):
            post, expected = new_id(), self.model.undo(who)
            self.hear(lambda post=post: self.desk.undo(post, who), expected)
            self.look(who)
            number = expected and expected.said and expected.said["pair"]
            if number and self.model.is_open(number) and self.model.pairs[number].drawn:
                assert self.page[who] == number
            self.time_passes()

    @precondition(lambda self: any(self.model.back.values()))
    @rule(who=people, times=st.integers(1, 3))
    def redo(self, who: str, times: int) -> None:
        for _ in range(times):
            post, expected = new_id(), self.model.redo(who)
            self.hear(lambda post=post: self.desk.redo(post, who), expected)
            self.look(who)

    @rule(what=st.sampled_from(["again", "again", "drawn", "killed", 1.0, 60.0, 120.0]))
    def befall(self, what: str | float) -> None:
        """A post that comes again, clips that are drawn, a server that is killed, time that passes."""
        if what == "again" and self.sent:
            before = self.run.contents()
            act, heard = self.sent
            assert act() == heard
            assert self.run.contents() == before
        elif what == "drawn":
            missing = [number for number, pair in self.model.pairs.items() if not pair.drawn]
            self.run.draw(missing)
            for number in missing:
                self.model.pairs[number].drawn = True
        elif what == "killed":
            self.desk.close()
            self.desk = Desk(self.run.file, self.run.rules, self.clock)
        elif isinstance(what, float):
            self.clock.now += what

    @rule(given=st.lists(whats, min_size=6, max_size=6))
    def finish(self, given: list[Any]) -> None:
        """Each answers what is left for them."""
        self.befall("drawn")
        self.befall(120.0)
        for who, what in zip(3 * PEOPLE, given, strict=True):
            self.answer(who, [(what, None)])

    @precondition(lambda self: self.model.finished())
    @rule(
        pairs=st.integers(1, 2),
        reserves=st.integers(0, 2),
        left=st.lists(st.integers(0, 1), min_size=4, max_size=4),
        drawn=st.booleans(),
    )
    def train(self, pairs: int, reserves: int, left: list[int], drawn: bool) -> None:
        assert self.run.ready()
        self.run.collect()
        self.model.collect()
        assert labels(self.run) == self.model.labels
        self.agree()
        self.ask(pairs, reserves, left[: pairs + reserves], drawn)

    @invariant()
    def time_passes(self) -> None:
        self.clock.now += 0.01

    @invariant()
    def agree(self) -> None:
        model = self.model
        assert self.run.standing() == model.standing()
        assert self.run.sql("SELECT COUNT(*) FROM answers") == [(model.answers,)]
        assert not model.session or self.run.ready() == model.finished()
        for who in PEOPLE:
            own = {"answers": len(model.given[who]), "undo": model.undoable(who), "redo": model.redoable(who)}
            assert self.desk.own(who) == own
        asked = model.asked()
        wanted = sum(not model.pairs[number].reserve for number in asked)
        done = sum(model.full(number) for number in asked) - (len(asked) - wanted)
        told = self.desk.progress()["labels"]
        assert told["done"] == model.before + done
        session = {"number": self.run.sessions, "done": done, "size": wanted}
        assert told["session"] == (session if model.session else None)

    def teardown(self) -> None:
        self.desk.close()
        self.run.close()
        self.folder.cleanup()


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(
    max_examples=300, stateful_step_count=30, derandomize=True, database=None, deadline=None
)
