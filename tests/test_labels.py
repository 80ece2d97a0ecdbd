"""Labels outside of their run: nothing is lost on the way, and whatever is wrong is told with file and line."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from senior import label_file
from senior.config import Asking, Config
from senior.files import pack, unpack
from senior.label.desk import Desk
from senior.label_file import read
from senior.labels import describe, export_labels, import_into, import_labels, pairs_in, stats
from senior.preference_file import ANSWER, PAIR, Rules, connect
from senior.preferences import Preferences
from senior.rundir import RunDirectory
from senior.teachers.recorded import SUFFIX, Recorded
from senior.types import Answers, BadInput, Pairs, Query
from tests.small import small

H, O, A = 3, 4, 2
FIRST, SECOND, EQUAL, SKIP = 0, 1, -1, None
ROOT = Path(__file__).parents[1]


def configured(budget: int = 100, per_session: int = 2, method: str = "p-senior", **changes: Any) -> Config:
    config = small(method, teacher="human", **changes)
    return replace(config, queries=replace(config.queries, budget=budget, per_session=per_session, segment=H))


def made(path: Path, config: Config) -> Path:
    """A run directory, as `senior train` leaves it when it is interrupted at once."""
    directory = RunDirectory(path)
    directory.create(config, {"observation_size": O, "action_size": A})
    directory.close()
    return path


def opened(run: Path, budget: int = 100) -> closing[Preferences]:
    return closing(Preferences(run / "preferences.sqlite", budget, H, O, A))


def query_of(pairs: int, seed: int = 0) -> Query:
    rng = np.random.default_rng(seed)
    numbers = [rng.normal(size=(pairs, 2, H, *last)).astype(np.float32) for last in ((O,), (A,), ())]
    places = [rng.integers(1000, size=(pairs, 2)) for _ in range(2)]
    return Query(Pairs(*numbers, *places), {"m": rng.normal(size=pairs)}, rng.random(pairs))


def asked(run: Path, *sessions: list[Any], reserves: int = 0, overlap: int = 1) -> Path:
    """Ask a run's sessions; of each pair its answers: a number or None, or a list of those of ann, bob and eve.

    All but the last session are trained on. Of every session the last ``reserves`` pairs are in reserve.
    """
    rules = Rules(overlap, replace_skipped=bool(reserves))
    with opened(run) as preferences:
        for number, session in enumerate(sessions):
            ids = preferences.add(
                query_of(len(session), number), number, 100 * number, 7, np.arange(len(session)) % 2, reserves
            )
            for one, said in zip(ids, session, strict=True):
                for name, answer in zip(
                    ("ann", "bob", "eve"), said if isinstance(said, list) else [said], strict=False
                ):
                    preferences.answer(Answers([one], [answer]), name)
            if number < len(sessions) - 1:
                preferences.collect(number, 100 * number + 1, rules)
    return run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two sessions: the first is trained on, of the second the last pair is not answered."""
    made(tmp_path / "run", configured())
    return asked(tmp_path / "run", [FIRST, SKIP], [EQUAL, []])


@pytest.fixture
def file(run: Path, tmp_path: Path) -> Path:
    """The labels of that run."""
    assert export_labels(run, tmp_path / "labels.jsonl") == 4
    return tmp_path / "labels.jsonl"


def lines_of(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def rewritten(file: Path, change: Callable[[list[dict[str, Any]]], Any]) -> Path:
    """The file after a change to its lines."""
    lines = lines_of(file)
    change(lines)
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return file


# Export.


def test_a_line_holds_all_that_was_asked_and_said(run: Path, file: Path):
    header, *pairs = lines_of(file)
    assert {name: header[name] for name in header if name != "sha256"} == {
        "format": "senior-labels",
        "version": 1,
        "pairs": 4,
        "steps": H,
        "observation": O,
        "action": A,
        "environment": "point",
        "overlap": 1,
    }
    with opened(run) as preferences:
        for pair, row in zip(pairs, preferences.asked(), strict=True):
            assert {**row, "scores": json.loads(str(row["scores"]))} == {name: pair[name] for name in PAIR}
            assert pair.keys() == {*PAIR, "answers"}
    assert [[answer["answer"] for answer in pair["answers"]] for pair in pairs] == [[FIRST], [SKIP], [EQUAL], []]
    assert all(answer.keys() == set(ANSWER) for pair in pairs for answer in pair["answers"])
    assert [pair["second"] for pair in pairs] == [0.0, None, None, None]
    assert [pair["collected_step"] for pair in pairs] == [1, 1, None, None]


def test_the_segments_lie_beside_it_bit_for_bit(file: Path):
    found = unpack(file.with_suffix(".npz"))
    first, second = query_of(2, 0).pairs, query_of(2, 1).pairs
    for name in ("observation", "action", "reward"):
        assert found[name].dtype == np.float32
        assert np.array_equal(found[name], np.concatenate([getattr(first, name), getattr(second, name)]))


def test_a_score_that_is_no_number_is_told_as_none(run: Path, tmp_path: Path):
    with closing(connect(run / "preferences.sqlite")) as db:
        db.execute("UPDATE pairs SET scores = ? WHERE id = 2", (json.dumps({"m": float("nan"), "d": -float("inf")}),))
    export_labels(run, tmp_path / "labels.jsonl")
    assert read(tmp_path / "labels.jsonl").pairs[1]["scores"] == {"m": None, "d": None}


def test_a_run_can_be_exported_while_it_is_written_to(run: Path, tmp_path: Path):
    with closing(connect(run / "preferences.sqlite")) as db:
        db.execute("BEGIN IMMEDIATE")
        db.execute("DELETE FROM answers")
        export_labels(run, tmp_path / "labels.jsonl")
        db.execute("COMMIT")
    assert [len(pair["answers"]) for pair in read(tmp_path / "labels.jsonl").pairs] == [1, 1, 1, 0]


@pytest.mark.parametrize("suffix", [".jsonl", ".npz"])
def test_nothing_is_overwritten(run: Path, tmp_path: Path, suffix: str):
    there = tmp_path / f"labels{suffix}"
    there.write_text("precious")
    with pytest.raises(BadInput, match=rf"labels{suffix} exists; choose another --out"):
        export_labels(run, tmp_path / "labels.jsonl")
    assert there.read_text() == "precious"
    assert {path.name for path in tmp_path.iterdir()} == {"run", there.name}


def test_labels_never_lie_there_without_their_segments(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    written: list[str] = []

    def full(path: Path, data: bytes) -> None:
        written.append(path.name)
        if path.suffix == ".jsonl":
            raise OSError("no space left on device")

    monkeypatch.setattr(label_file, "write_atomically", full)
    with pytest.raises(BadInput, match="no space left"):
        export_labels(run, tmp_path / "labels.jsonl")
    assert written == ["labels.npz", "labels.jsonl"]


def test_a_folder_is_made_for_the_files(run: Path, tmp_path: Path):
    export_labels(run, tmp_path / "some" / "where" / "labels.jsonl")
    assert pairs_in(tmp_path / "some" / "where" / "labels.jsonl") == 3


@pytest.mark.parametrize("name", ["labels.json", "labels.npz", "labels"])
def test_a_file_of_labels_is_named_as_one(run: Path, tmp_path: Path, name: str):
    with pytest.raises(BadInput, match=rf"{name} must be named with \.jsonl at its end"):
        export_labels(run, tmp_path / "new" / name)
    assert not (tmp_path / "new").exists()


def test_where_there_are_no_labels_none_are_exported(tmp_path: Path):
    out = tmp_path / "labels.jsonl"
    with pytest.raises(BadInput, match="is not a run directory"):
        export_labels(tmp_path, out)
    run = made(tmp_path / "run", configured())
    with pytest.raises(BadInput, match=r"has no labels: it holds no preferences\.sqlite"):
        export_labels(run, out)
    assert not (run / "preferences.sqlite").exists()
    connect(run / "preferences.sqlite").close()  # as a run that was killed at that very moment leaves it
    with pytest.raises(BadInput, match="has asked nothing yet"):
        export_labels(run, out)
    with opened(run), pytest.raises(BadInput, match="has asked nothing yet"):
        export_labels(run, out)
    assert not out.exists()


def test_a_damaged_preference_file_is_told(run: Path, tmp_path: Path):
    with closing(connect(run / "preferences.sqlite")) as db:
        db.execute("UPDATE pairs SET reward = zeroblob(5) WHERE id = 3")
    with pytest.raises(BadInput, match=r"preferences\.sqlite is damaged"):
        export_labels(run, tmp_path / "labels.jsonl")


# Import.


def test_a_run_finds_its_sessions_asked_and_answered(run: Path, file: Path, tmp_path: Path):
    other = made(tmp_path / "other", configured(budget=3, per_session=2))
    with opened(other, 3) as preferences:
        assert import_labels(file, preferences, per_session=2) == 3
        assert [preferences.session(number) for number in range(3)] == [[1, 2], [3], []]
        assert all(not preferences.unanswered(number, Rules()) for number in range(2))
        assert all(preferences.ready(number, 500, Rules()) for number in range(2))
        assert preferences.arrays.count == 0
        preferences.collect(0, 500, Rules())
        preferences.collect(1, 600, Rules())
        assert preferences.arrays.second[:2].tolist() == [0, 0.5] and preferences.arrays.count == 2
        expected = [query_of(2, 0).pairs.observation[0], query_of(2, 1).pairs.observation[0]]
        assert np.array_equal(preferences.arrays.observation[:2], expected)
        assert [row["collected_step"] for row in preferences.asked()] == [500, 500, 600]
        # of another model's predictions none is told as the run's own
        assert preferences.judged(0) == [(None, 0.0), (None, None)]


def test_imported_answers_are_nobodys_to_undo_here(run: Path, file: Path, tmp_path: Path):
    """The episodes are another run's, so nobody could be shown their pairs again."""
    other = made(tmp_path / "other", configured(budget=3, per_session=2))
    with opened(other, 3) as preferences:
        import_labels(file, preferences, per_session=2)
    with closing(Desk(other / "preferences.sqlite", Rules())) as desk:
        names = [who["name"] for who in desk.annotators()]
        assert names
        for name in names:
            assert not desk.own(name)["undo"]
            assert desk.undo(f"post of {name}", name).refused == "There is no answer of yours to undo."


@pytest.mark.parametrize(
    ("per_session", "budget", "taken", "sessions"),
    [
        (1, 100, 5, [[1], [2, 3], [4], [5], [7, 8]]),
        (2, 100, 4, [[1, 2, 3], [4, 5]]),
        (2, 5, 5, [[1, 2, 3], [4, 5], [7, 8]]),
        (2, 3, 3, [[1, 2, 3], [4]]),
        (5, 100, 5, [[1, 2, 3, 4, 5, 7, 8]]),
        (9, 4, 4, [[1, 2, 3, 4, 5]]),
    ],
)
def test_sessions_are_formed_anew(tmp_path: Path, per_session: int, budget: int, taken: int, sessions: list[list[int]]):
    """Pairs 3, 6 and 8 were in reserve, and 6 is not answered."""
    run = made(tmp_path / "run", configured())
    asked(run, [FIRST, SKIP, SECOND], [SECOND, EQUAL, []], [SKIP, FIRST], reserves=1)
    export_labels(run, tmp_path / "labels.jsonl")
    assert pairs_in(tmp_path / "labels.jsonl") == 5
    other = made(tmp_path / "other", configured())
    with opened(other, budget) as preferences:
        assert import_labels(tmp_path / "labels.jsonl", preferences, per_session) == taken
        assert [preferences.session(number) for number in range(len(sessions) + 1)] == [*sessions, []]
        reserves = [row["id"] for row in preferences.asked() if row["reserve"]]
        assert reserves == [number for session in sessions for number in session if number in (3, 8)]
        rules = Rules(replace_skipped=True)
        assert not any(preferences.unanswered(number, rules) for number in range(len(sessions)))


@pytest.mark.parametrize(("overlap", "taken"), [(1, [1, 2, 4, 6]), (2, [1, 2, 4, 6]), (3, [2])])
def test_taken_is_what_all_who_were_asked_answered(tmp_path: Path, overlap: int, taken: list[int]):
    """Two were asked. Of pair 2 even three answered, of pair 3 one, of pair 5 nobody; of pair 7 one took it back."""
    run = made(tmp_path / "run", configured(asking=Asking(overlap=2)))
    second = [[FIRST], [SKIP, SKIP], [], [SECOND, SECOND], [FIRST, FIRST]]
    asked(run, [[FIRST, EQUAL], [FIRST, SECOND, SKIP]], second, overlap=2)
    with closing(connect(run / "preferences.sqlite")) as db:
        db.execute("UPDATE answers SET withdrawn = 1 WHERE pair = 7 AND annotator = 'ann'")
    export_labels(run, tmp_path / "labels.jsonl")
    assert pairs_in(tmp_path / "labels.jsonl") == 4
    with opened(made(tmp_path / "other", configured())) as preferences:
        assert import_labels(tmp_path / "labels.jsonl", preferences, 1, overlap) == len(taken)
        assert [row["id"] for row in preferences.asked()] == taken
        assert all(preferences.ready(number, 1, Rules(overlap)) for number in range(len(taken)))


def test_what_was_trained_on_counts_as_answered_by_all(tmp_path: Path):
    """Whatever the configuration says of how many are asked."""
    run = made(tmp_path / "run", configured(asking=Asking(overlap=2)))
    asked(run, [FIRST, SECOND], [EQUAL])
    export_labels(run, tmp_path / "labels.jsonl")
    assert pairs_in(tmp_path / "labels.jsonl") == 2


def test_too_few_pairs_for_a_session_are_refused_and_nothing_is_changed(file: Path, tmp_path: Path):
    with opened(made(tmp_path / "other", configured())) as preferences:
        with pytest.raises(BadInput, match="holds 3 answered pairs, fewer than the 4 of a session"):
            import_labels(file, preferences, per_session=4)
        with pytest.raises(BadInput, match="holds 0 answered pairs, fewer than the 2 of a session"):
            import_labels(file, preferences, per_session=2, overlap=2)
        assert preferences.asked() == []
        assert import_labels(file, preferences, per_session=3) == 3


def test_labels_are_put_only_where_nothing_was_asked(file: Path, tmp_path: Path):
    other = asked(made(tmp_path / "other", configured()), [FIRST])
    with opened(other) as preferences:
        before = preferences.asked()
        with pytest.raises(BadInput, match=r"preferences\.sqlite holds pairs already"):
            import_labels(file, preferences, per_session=1)
        assert preferences.asked() == before


@pytest.mark.parametrize("shape", [(H + 1, O, A), (H, O - 1, A), (H, O, A + 1)])
def test_segments_of_another_size_are_refused(file: Path, tmp_path: Path, shape: tuple[int, int, int]):
    assert pairs_in(file, shape=(H, O, A)) == 3
    told = f"holds segments of 3 steps, with 4 numbers of an observation and 2 of an action; the run's have {shape[0]}"
    with pytest.raises(BadInput, match=told):
        pairs_in(file, shape=shape)
    with closing(Preferences(tmp_path / "p.sqlite", 9, *shape)) as preferences, pytest.raises(BadInput, match=told):
        import_labels(file, preferences, 1)


def test_a_recorded_teacher_is_asked_nothing_and_says_nothing():
    teacher = Recorded()
    teacher.ask([1, 2], query_of(2))
    assert teacher.collect() == Answers([], [])
    assert "labels.jsonl".endswith(SUFFIX)


# There and back.

NAME = st.text(st.characters(exclude_categories=("Cc", "Cs")), min_size=1, max_size=8)
NUMBER = st.floats(allow_nan=False, allow_infinity=False, min_value=0, max_value=99e9)
DIGEST = st.text("0123456789abcdef", min_size=64, max_size=64)
SAID = st.fixed_dictionaries(
    {
        "answer": st.sampled_from([FIRST, SECOND, EQUAL, SKIP]),
        "strength": st.sampled_from([None, "slightly", "clearly"]),
        "answered_at": NUMBER,
        "seconds": st.none() | NUMBER,
        "replays": st.none() | st.integers(0, 10**9),
        "shown_left": st.integers(0, 1),
        "clip_0": st.none() | DIGEST,
        "clip_1": st.none() | DIGEST,
        "withdrawn": st.none() | st.integers(0, 50),
    }
)
PAIRS = st.lists(st.lists(st.tuples(st.sampled_from("abc") | NAME, SAID), max_size=3), max_size=3)
SESSION = st.tuples(PAIRS.filter(bool), PAIRS, st.booleans())
"""Pairs by their answers, reserves likewise, and whether the session is trained on."""


def filled(run: Path, sessions: list[Any]) -> None:
    """Ask those sessions, with those answers; of two of one person to one pair, the first stands."""
    with opened(run) as preferences, closing(connect(run / "preferences.sqlite")) as db:
        for number, (chosen, reserves, trained) in enumerate(sessions):
            pairs = [*chosen, *reserves]
            shown = np.arange(len(pairs)) % 2
            ids = preferences.add(query_of(len(pairs), number), number, number, 2**32 - 1, shown, len(reserves))
            db.execute("BEGIN")
            for one, given_ in zip(ids, pairs, strict=True):
                standing: set[str] = set()
                for who, what in given_:
                    row = {"pair": one, "annotator": who, **what}
                    if who in standing and what["withdrawn"] is None:
                        row["withdrawn"] = 0
                    elif what["withdrawn"] is None:
                        standing.add(who)
                    marks = ", ".join("?" * len(row))
                    db.execute(f"INSERT INTO answers ({', '.join(row)}) VALUES ({marks})", list(row.values()))
            db.execute("COMMIT")
            if trained:
                preferences.collect(number, number, Rules(soft=True))


@settings(max_examples=15, deadline=None, database=None, derandomize=True)
@given(sessions=st.lists(SESSION, min_size=1, max_size=3), per_session=st.integers(1, 3))
def test_what_was_exported_and_imported_is_exported_again(sessions: list[Any], per_session: int):
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        first, second, third = (made(place / name, configured()) for name in ("first", "second", "third"))
        filled(first, sessions)
        export_labels(first, place / "1.jsonl")
        header, *pairs = lines_of(place / "1.jsonl")
        kept, numbers, count = [], [], 0
        for i, pair in enumerate(pairs):
            if any(answer["withdrawn"] is None for answer in pair["answers"]):
                count += not pair["reserve"]
                if count:
                    kept.append(i)
                    numbers.append((count - 1) // per_session)
        assert pairs_in(place / "1.jsonl") == count
        with opened(second, max(count, 1)) as preferences:
            if not count:
                with pytest.raises(BadInput, match="holds 0 answered pairs"):
                    import_labels(place / "1.jsonl", preferences, per_session)
                return
            assert import_labels(place / "1.jsonl", preferences, per_session) == count
        export_labels(second, place / "2.jsonl")
        header_2, *pairs_2 = lines_of(place / "2.jsonl")
        own = {"prediction": None, "collected_step": None, "second": None}  # of the run that takes them over
        expected = [{**pairs[i], **own, "session": number} for i, number in zip(kept, numbers, strict=True)]
        assert pairs_2 == expected
        for array, again in zip(read(place / "1.jsonl").segments, read(place / "2.jsonl").segments, strict=True):
            assert np.array_equal(array[kept], again)
        changed = {"pairs", "sha256"} if len(kept) < len(pairs) else set()
        assert {name for name in header if header[name] != header_2[name]} == changed

        # What one run took over another one takes over too, and it is the same to the last byte.
        with opened(third, count) as preferences:
            import_labels(place / "2.jsonl", preferences, per_session)
        export_labels(third, place / "3.jsonl")
        for suffix in (".jsonl", ".npz"):
            assert (place / f"3{suffix}").read_bytes() == (place / f"2{suffix}").read_bytes()


# Damage.

GONE = object()


def at(line: int, *path: Any, value: Any) -> Callable[[list[Any]], None]:
    """Put a value somewhere into a line, counted from 1; `GONE`: take away what is there."""

    def change(lines: list[Any]) -> None:
        place = lines[line - 1]
        for step in path[:-1]:
            place = place[step]
        if value is GONE:
            del place[path[-1]]
        else:
            place[path[-1]] = value

    return change


OTHER_FORMAT = 'line 1: format must be "senior-labels", not'
DAMAGE = {
    "another format": (at(1, "format", value="other"), f'{OTHER_FORMAT} "other"'),
    "no format": (at(1, "format", value=GONE), f"{OTHER_FORMAT} null"),
    "no first line": (lambda lines: lines.pop(0), f"{OTHER_FORMAT} null"),
    "a newer version": (at(1, "version", value=2), "line 1: version must be 1, the version that .* reads, not 2"),
    "a list": (lambda lines: lines.__setitem__(0, []), "line 1: the first line must be a JSON object"),
    "an unknown promise": (at(1, "more", value=1), "line 1: the first line has an unknown 'more'"),
    "no steps": (at(1, "steps", value=0), "line 1: steps must be a whole number from 1 to 1048576, not 0"),
    "a line less": (lambda lines: lines.pop(), r"labels\.jsonl holds 3 pairs, and its first line says 4"),
    "a number for a pair": (lambda lines: lines.__setitem__(2, 7), "line 3: a pair must be a JSON object"),
    "something missing": (at(3, "step", value=GONE), "line 3: a pair lacks 'step'"),
    "something unknown": (at(3, "label", value=1), "line 3: a pair has an unknown 'label'"),
    "a number twice": (at(3, "id", value=1), "line 3: pair 1 comes after pair 1"),
    "another order": (at(2, "id", value=9), "line 3: pair 2 comes after pair 9"),
    "text": (at(3, "step", value="7"), 'line 3: step must be a whole number from 0 to 9007199254740992, not "7"'),
    "a truth": (at(3, "reserve", value=True), "line 3: reserve must be a whole number from 0 to 1, not true"),
    "beyond measure": (at(3, "run_seed", value=2**63), "line 3: run_seed must be a whole number from 0"),
    "a probability above 1": (at(4, "second", value=1.5), "line 4: second must be a number from 0 to 1 or null, not"),
    "no number": (at(4, "prediction", value=float("nan")), "line 4: prediction must be .* or null, not NaN"),
    "an endless score": (at(4, "scores", "m", value=float("inf")), "line 4: scores must be an object of finite num"),
    "answers that are none": (at(2, "answers", value={}), "line 2: answers must be a list"),
    "an unknown answer": (
        at(4, "answers", 0, "answer", value=2),
        r"line 4: answer must be 0 \(first\), 1 \(second\), -1 \(equal\) or null, not 2",
    ),
    "half an answer": (at(4, "answers", 0, "answer", value=0.5), "line 4: answer must be .*not 0.5"),
    "an unknown strength": (at(2, "answers", 0, "strength", value="very"), 'line 2: strength must be .*not "very"'),
    "an endless time": (
        at(2, "answers", 0, "answered_at", value=float("inf")),
        "line 2: answered_at must be a time in",
    ),
    "a time in milliseconds": (at(2, "answers", 0, "answered_at", value=1.8e12), "line 2: answered_at must be a time"),
    "a time beyond measure": (at(2, "answers", 0, "seconds", value=2**70), "line 2: seconds must be a number of seco"),
    "time backwards": (at(2, "answers", 0, "seconds", value=-1), "line 2: seconds must be a number of seconds, 0 or m"),
    "nobody": (at(2, "answers", 0, "annotator", value=""), "line 2: annotator must be a name"),
    "a name that rings": (at(2, "answers", 0, "annotator", value="\a"), "line 2: annotator must be a name"),
    "a name that is no text": (at(2, "answers", 0, "annotator", value="\ud800"), "line 2: annotator must be a name"),
    "half a hash": (at(2, "answers", 0, "clip_0", value="ab"), "line 2: clip_0 must be a SHA-256 or null"),
    "less of an answer": (at(2, "answers", 0, "withdrawn", value=GONE), "line 2: an answer lacks 'withdrawn'"),
    "one answer in two pairs": (at(3, "answers", 0, "id", value=1), "line 3: there are two answers of number 1"),
    "two answers of one": (
        lambda lines: lines[1]["answers"].append({**lines[1]["answers"][0], "id": 99}),
        "line 2: somebody has two answers that stand",
    ),
    "other segments": (at(1, "sha256", value="0" * 64), r"labels\.npz does not belong to labels\.jsonl"),
    "another length": (
        at(1, "steps", value=5),
        r"labels\.npz: observation must be float32 \[4, 2, 5, 4\] .* not float32 \[4, 2, 3, 4\]",
    ),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_what_is_wrong_with_a_line_is_told(file: Path, what: str):
    change, sentence = DAMAGE[what]
    rewritten(file, change)
    with pytest.raises(BadInput, match=sentence) as caught:
        read(file)
    assert str(caught.value).startswith(str(file.with_suffix(""))) and str(caught.value).endswith(".")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", r"labels\.jsonl is empty"),
        (b"{", "line 1: this is not JSON: .* at character 2"),
        (b"\xff\xfe\xfd", "line 1: this is not JSON"),
        (b"[" * 200_000, "line 1: this is not JSON"),
        (b"9" * 10_000, "line 1: this is not JSON"),
        (b"\n", "line 1: this is not JSON"),
    ],
    ids=["nothing", "half", "bytes", "depths", "digits", "line"],
)
def test_what_is_no_json_is_told(file: Path, content: bytes, sentence: str):
    file.write_bytes(content)
    with pytest.raises(BadInput, match=sentence):
        read(file)


def test_a_broken_line_is_named(file: Path):
    lines = file.read_text().splitlines()
    lines[2] = lines[2][:40]
    file.write_text("\n".join(lines))
    with pytest.raises(BadInput, match=r"labels\.jsonl, line 3: this is not JSON: .* at character"):
        read(file)


def test_a_file_that_is_not_there_is_told(tmp_path: Path):
    with pytest.raises(BadInput, match=r"labels\.jsonl cannot be opened: No such file"):
        read(tmp_path / "labels.jsonl")


def change_segments(file: Path, **arrays: np.ndarray | None) -> None:
    """Write segments with other arrays, or without those that are None."""
    held: dict[str, Any] = {**unpack(file.with_suffix(".npz")), **arrays}
    file.with_suffix(".npz").write_bytes(pack({name: array for name, array in held.items() if array is not None}))


def test_segments_that_are_not_there_are_told(file: Path):
    file.with_suffix(".npz").unlink()
    with pytest.raises(BadInput, match=r"labels\.jsonl needs labels\.npz beside it"):
        read(file)


def test_segments_with_arrays_more_or_less_are_told(file: Path):
    change_segments(file, reward=None)
    with pytest.raises(BadInput, match=r"npz must hold observation, action, reward, and holds observation, action\."):
        read(file)
    change_segments(file, reward=np.zeros((4, 2, H), np.float32), more=np.zeros(1))
    with pytest.raises(BadInput, match=r"must hold observation, action, reward, and holds .*more"):
        read(file)


@pytest.mark.parametrize("shape", [(3, 2, H), (4, 2 * H), (4, 2, H, 1)], ids=str)
def test_segments_of_other_shapes_are_told(file: Path, shape: tuple[int, ...]):
    change_segments(file, reward=np.zeros(shape, np.float32))
    with pytest.raises(BadInput, match=r"labels\.npz: reward must be float32 \[4, 2, 3\] by the first line of labels"):
        read(file)


@pytest.mark.parametrize("kind", ["<f8", ">f4", "<i4"])
def test_segments_of_other_types_are_told(file: Path, kind: str):
    change_segments(file, reward=np.zeros((4, 2, H), kind))
    with pytest.raises(BadInput, match=r"labels\.npz: reward must be float32"):
        read(file)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_told(file: Path, value: float):
    action = unpack(file.with_suffix(".npz"))["action"].copy()
    action[2, 1, 0, 1] = value
    change_segments(file, action=action)
    with pytest.raises(
        BadInput, match=r"labels\.npz: action of the pair in line 4 of labels\.jsonl holds a number that"
    ):
        read(file)


def test_the_segments_of_other_labels_are_told(file: Path, tmp_path: Path):
    other = asked(made(tmp_path / "other", configured()), [FIRST, FIRST, FIRST, FIRST])
    export_labels(other, tmp_path / "others.jsonl")
    file.with_suffix(".npz").write_bytes((tmp_path / "others.npz").read_bytes())
    with pytest.raises(BadInput, match=r"labels\.npz does not belong to labels\.jsonl"):
        read(file)


def test_nothing_is_unpickled(file: Path):
    np.savez(file.with_suffix(".npz"), observation=np.array([{}], object), action=np.zeros(1), reward=np.zeros(1))
    with pytest.raises(BadInput, match=r"labels\.npz is damaged .*allow_pickle"):
        read(file)


def test_no_damage_is_told_otherwise_than_in_a_sentence_and_none_reaches_the_segments(file: Path):
    """A flipped bit in a text may leave another that makes sense, for instance another name."""
    whole, rng = read(file), np.random.default_rng(0)
    for path in (file, file.with_suffix(".npz")):
        data, refused = path.read_bytes(), 0
        for _ in range(200):
            where = int(rng.integers(len(data)))
            rest = bytes([data[where] ^ 1 << int(rng.integers(8))]) + data[where + 1 :] if rng.random() < 0.8 else b""
            path.write_bytes(data[:where] + rest)
            try:
                found = read(file)
            except BadInput:
                refused += 1
            else:
                assert all(map(np.array_equal, found.segments, whole.segments))
        path.write_bytes(data)
        assert refused > 120


# Into a run directory.


def test_labels_are_put_into_a_run_of_people_that_has_asked_nothing(file: Path, tmp_path: Path):
    other = made(tmp_path / "other", configured(per_session=3))
    assert import_into(other, file) == 3
    with opened(other) as preferences:
        assert preferences.session(0) == [1, 2, 3] and preferences.ready(0, 9, Rules())
    with pytest.raises(BadInput, match="holds pairs already"):
        import_into(other, file)


def test_labels_of_another_environment_are_refused(file: Path, tmp_path: Path):
    """Tasks of one simulator have observations of one size."""
    held = read(file).header["environment"]
    assert pairs_in(file, held) == 3
    told = rf"labels\.jsonl holds labels of {held}, and the run is on door-open\."
    with pytest.raises(BadInput, match=told):
        pairs_in(file, "door-open")
    other = made(tmp_path / "other", replace(configured(per_session=3), task="door-open"))
    with pytest.raises(BadInput, match=told):
        import_into(other, file)


def test_as_many_people_must_have_answered_as_are_asked(file: Path, tmp_path: Path):
    other = made(tmp_path / "other", configured(asking=Asking(overlap=2)))
    with pytest.raises(BadInput, match="holds 0 answered pairs"):
        import_into(other, file)


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        (replace(configured(), teacher="oracle"), "is answered by oracle, and labels can be put into one of people's"),
        (replace(configured(), teacher="labels.jsonl"), r"is answered by labels\.jsonl, and labels can"),
        (configured(method="sac"), "learns from the true reward, so labels have no use"),
    ],
    ids=["oracle", "recorded", "sac"],
)
def test_a_run_that_is_not_of_people_takes_no_labels(file: Path, tmp_path: Path, config: Config, sentence: str):
    other = made(tmp_path / "other", config)
    with pytest.raises(BadInput, match=sentence):
        import_into(other, file)
    assert not (other / "preferences.sqlite").exists()


def test_a_run_that_is_being_trained_takes_no_labels(file: Path, tmp_path: Path):
    other = made(tmp_path / "other", configured())
    trainer = RunDirectory(other)
    trainer.lock()
    try:
        with pytest.raises(BadInput, match="is being trained by another process"):
            import_into(other, file)
    finally:
        trainer.close()
    assert import_into(other, file) == 2


def test_a_run_whose_sizes_are_not_told_takes_no_labels(file: Path, tmp_path: Path):
    other = made(tmp_path / "other", configured())
    content = json.loads((other / "config.json").read_text())
    del content["protocol"]["action_size"]
    (other / "config.json").write_text(json.dumps(content))
    with pytest.raises(BadInput, match=r"config\.json is damaged: its protocol tells no sizes"):
        import_into(other, file)


# Looking at a run.


def test_who_said_what_is_told(tmp_path: Path):
    """Pair 4 was in reserve and not asked; pair 7 was, in the place of pair 5. Pair 6 lacks an answer."""
    run = made(tmp_path / "run", configured(asking=Asking(overlap=2, replace_skipped=True)))
    first = [[FIRST, FIRST], [SECOND, SECOND], [EQUAL, SKIP], []]
    second = [[SKIP, SKIP], [FIRST], [SECOND, FIRST]]
    asked(run, first, second, reserves=1, overlap=2)
    with closing(connect(run / "preferences.sqlite")) as db:
        db.execute("UPDATE answers SET seconds = pair WHERE annotator = 'ann'")
        db.execute("UPDATE answers SET withdrawn = 1 WHERE pair = 6")
    found = stats(run)
    assert found["pairs"] == {"asked": 6, "answered": 5, "skipped": 1, "equal": 1, "trained_on": 3}
    assert found["annotators"] == [
        {"name": "ann", "answers": 5, "skips": 1, "equals": 1, "median_seconds": 3.0},
        {"name": "bob", "answers": 5, "skips": 2, "equals": 0, "median_seconds": None},
    ]
    # both have an opinion on pairs 1, 2 and 7: ann first, second, second; bob first, second, first
    ((cohen,), fleiss) = found["agreement"]["cohen"], found["agreement"]["fleiss"]
    assert (cohen["one"], cohen["other"], cohen["pairs"], found["agreement"]["pairs"]) == ("ann", "bob", 3, 3)
    assert cohen["kappa"] == pytest.approx((2 / 3 - 4 / 9) / (1 - 4 / 9))
    assert fleiss == pytest.approx((2 / 3 - 1 / 2) / (1 - 1 / 2))
    assert describe(found).splitlines() == [
        "6 pairs asked, 5 answered: 1 of them skipped, 1 equal; 3 trained on.",
        "ann: 5 answers, 1 skips, 1 equal, 3.0 s at the median.",
        "bob: 5 answers, 2 skips, 0 equal.",
        "Fleiss' kappa 0.33 over the 3 pairs that 2 people have an opinion on.",
        "ann and bob: Cohen's kappa 0.40 over 3 pairs.",
    ]


def test_where_one_person_answers_there_is_no_agreement_to_tell(run: Path):
    assert describe(stats(run)).splitlines() == [
        "4 pairs asked, 3 answered: 1 of them skipped, 1 equal; 2 trained on.",
        "ann: 3 answers, 1 skips, 1 equal.",
    ]


def test_agreement_that_is_not_defined_is_told_so(tmp_path: Path):
    run = asked(made(tmp_path / "run", configured()), [[FIRST, FIRST], [FIRST, FIRST]])
    assert "Cohen's kappa not defined (all gave the same answer) over 2 pairs." in describe(stats(run))


def test_a_run_without_labels_has_no_statistics(tmp_path: Path):
    run = made(tmp_path / "run", configured())
    with pytest.raises(BadInput, match=r"it holds no preferences\.sqlite"):
        stats(run)


# The documentation.


def test_every_name_in_the_files_is_documented():
    text = (ROOT / "docs" / "labels.md").read_text()
    tables = re.findall(r"\n\| (?:name|array) \|.*\n\|[-|]+\n((?:\|.*\n)+)", text)
    told = [set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| ([^|]*) \|", table, re.M)))) for table in tables]
    assert told == [
        set(label_file._HEADER),
        {*PAIR, "answers"},
        set(ANSWER),
        set(label_file.SEGMENTS),
    ]


def test_the_code_in_the_documentation_reads_the_files(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    export_labels(run, tmp_path / "door.jsonl")
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "labels.md").read_text(), re.DOTALL)
    printed: list[Any] = []
    monkeypatch.chdir(tmp_path)
    exec(code, {"print": lambda *what: printed.append(what)})
    assert printed == [(1, [0], (2, H, O)), (2, [None], (2, H, O)), (3, [-1], (2, H, O)), (4, [], (2, H, O))]
