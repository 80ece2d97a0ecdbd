"""Labels outside of their run: export them, put them into another run, look at who said what. Imports no JAX.

A run takes labels over before it has asked anything, and whole sessions of them: it finds its sessions asked and
answered already, and trains on them by its own rules. So does one whose teacher they are (``--teacher NAME.jsonl``).
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from senior import protocol
from senior.config import load
from senior.label import agreement
from senior.label.desk import Desk
from senior.label_file import SEGMENTS, Labels, read, shapes, write
from senior.preference_file import ANSWER, PAIR, asked_of, connect, pairs_of
from senior.preferences import Preferences
from senior.rundir import RunDirectory, told
from senior.types import BadInput, Preferred

# From a run into files.


def export_labels(run: Path, out: Path) -> int:
    """Write all that was asked in a run and said of it to ``out`` and to the ``.npz`` beside it; the number of pairs.

    The run may go on meanwhile. Raises `BadInput` if nothing was asked yet, the run cannot be read, or the files cannot
    be written (`senior.label_file.write`).
    """
    config = load(run / "config.json")
    with _reading(run) as db:
        db.execute("BEGIN")  # all of it as it is at one moment
        steps, o, a = db.execute("SELECT steps, observation, action FROM shape").fetchone()
        pairs = _rows(db, f"SELECT {', '.join(PAIR)} FROM pairs ORDER BY id", PAIR)
        names = ("pair", *ANSWER)
        answers = _rows(db, f"SELECT {', '.join(names)} FROM answers ORDER BY id", names)
        blobs = db.execute(f"SELECT {', '.join(SEGMENTS)} FROM pairs ORDER BY id").fetchall()
        if not pairs:
            raise BadInput(f"The run in {run} has asked nothing yet, so it has no labels.")
        columns = zip(shapes(len(pairs), steps, o, a).values(), zip(*blobs, strict=True), strict=True)
        segments = tuple(np.frombuffer(b"".join(column), "<f4").reshape(shape) for shape, column in columns)
        for pair in pairs:
            scores = json.loads(pair["scores"])
            pair["scores"] = {
                name: None if one is None or not math.isfinite(one) else one for name, one in scores.items()
            }
            pair["answers"] = []
        by_number = {pair["id"]: pair for pair in pairs}
        for answer in answers:
            by_number[answer.pop("pair")]["answers"].append(answer)
    header = {
        "steps": steps,
        "observation": o,
        "action": a,
        "environment": config.environment,
        "overlap": config.asking.overlap,
    }
    write(out, Labels(header, pairs, segments))
    return len(pairs)


@contextmanager
def _reading(run: Path) -> Iterator[sqlite3.Connection]:
    """The preference file of a run; whatever is wrong with it becomes a `BadInput`."""
    path = RunDirectory(run).preferences
    with told(run):
        there = path.exists() and path.stat().st_size
    if not there:
        raise BadInput(f"{run} has no labels: it holds no {path.name}.")
    with closing(connect(path)) as db:
        if not db.execute("PRAGMA user_version").fetchone()[0]:
            raise BadInput(f"The run in {run} has asked nothing yet, so it has no labels.")
        try:
            yield db
        except (sqlite3.Error, ValueError, TypeError, KeyError) as error:
            raise BadInput(f"{path} is damaged: {error}.") from error


def _rows(db: sqlite3.Connection, query: str, names: Sequence[str]) -> list[dict[str, Any]]:
    return [dict(zip(names, row, strict=True)) for row in db.execute(query)]


# From files into a run.


def import_labels(
    file: Path, preferences: Preferences, per_session: int, overlap: int = 1, environment: str | None = None
) -> int:
    """Put labels into a preference file that holds no pair, as sessions of a run that has not asked anything yet.

    Taken are, in the order of asking, the pairs that all who were asked had answered, and ``overlap`` people or more:
    as many as fill sessions of ``per_session`` pairs, up to the budget; only a session at its end may be smaller. A
    reserve belongs to the session of the pair before it, and is not counted. Pairs and answers keep their numbers; what
    is the run's own is left open: when a pair is trained on, towards what, and what the model predicted.

    environment: of the run; None: it was compared already. Returns the number of pairs, reserves aside. Raises
    `BadInput` if the files are damaged, of another environment or of other sizes than the run, if they fill no session,
    or if a pair was asked already; then nothing is changed.
    """
    labels = read(file)
    observation, action, _, _ = preferences.arrays
    budget, _, *sizes = observation.shape
    _check_fit(file, labels, environment, (*sizes, action.shape[-1]))
    taken: list[int] = []
    sessions: list[int] = []
    complete = labels.complete(overlap)
    counting = [row for row in complete if not labels.pairs[row]["reserve"]]
    most = budget if len(counting) >= budget else len(counting) - len(counting) % per_session
    if not most:
        raise BadInput(
            f"{file} holds {len(counting)} answered pairs, fewer than the {min(per_session, budget)} of a session."
        )
    counted = 0
    for row in complete:
        if not labels.pairs[row]["reserve"]:
            if counted == most:
                break
            counted += 1
        if counted:
            taken.append(row)
            sessions.append((counted - 1) // per_session)
    open_ = {"collected_step": None, "second": None, "prediction": None}
    pairs, answers = [], []
    for row, session in zip(taken, sessions, strict=True):
        pair = labels.pairs[row]
        pairs.append({**pair, **open_, "session": session, "scores": json.dumps(pair["scores"])})
        answers += [{**answer, "pair": pair["id"]} for answer in pair["answers"]]
    preferences.take_over(pairs, [array[taken] for array in labels.segments], answers)
    return most


def pairs_in(file: Path, environment: str | None = None, shape: tuple[int, int, int] | None = None) -> int:
    """How many pairs of a file a run with one person's answers can be asked: the largest budget that it serves.

    environment, shape: of that run; steps of a segment, sizes of an observation and of an action. Raises `BadInput` if
    the files are damaged or of others.
    """
    labels = read(file)
    _check_fit(file, labels, environment, shape)
    return sum(not labels.pairs[row]["reserve"] for row in labels.complete(overlap=1))


def import_into(run: Path, file: Path) -> int:
    """Put labels into the directory of a run with people as teachers that has not asked anything yet.

    Its first sessions are then asked and answered already, and people are asked when these are used up. Returns the
    number of pairs, reserves aside. Raises `BadInput` if the run is another's, is being trained, has asked already, or
    if the files do not fit (`import_labels`).
    """
    config = load(run / "config.json")
    if not config.method.learns_reward:
        raise BadInput(f"The run in {run} learns from the true reward, so labels have no use there.")
    if config.teacher != "human":
        raise BadInput(
            f"The run in {run} is answered by {config.teacher}, and labels can be put into one of people's (--teacher "
            f"human) only; to train on nothing else, begin a run with --teacher {file}."
        )
    try:
        held = protocol.read(run)
        sizes = config.queries.segment, held["observation_size"], held["action_size"]
    except (KeyError, TypeError) as error:
        raise BadInput(f"{run / 'config.json'} is damaged: its protocol tells no sizes.") from error
    directory = RunDirectory(run)
    with told(run):
        directory.lock()
    try:
        with closing(Preferences(directory.preferences, config.queries.budget, *sizes)) as preferences:
            return import_labels(
                file, preferences, config.queries.per_session, config.asking.overlap, config.environment
            )
    finally:
        directory.close()


def _check_fit(file: Path, labels: Labels, environment: str | None, shape: tuple[int, ...] | None) -> None:
    """`BadInput` for labels of another environment or of other sizes; what is None is not compared."""
    held = labels.header["environment"]
    if environment not in (None, held):
        raise BadInput(f"{file} holds labels of {held}, and the run is on {environment}.")
    if shape not in (None, labels.shape):
        raise BadInput(
            f"{file} holds segments of {labels.shape[0]} steps, with {labels.shape[1]} numbers of an observation and "
            f"{labels.shape[2]} of an action; the run's have {shape[0]}, {shape[1]} and {shape[2]}."
        )


# Looking at a run.


def stats(run: Path) -> dict[str, Any]:
    """Who said what in a run, as plain data.

    pairs: asked, answered, skipped (nobody could tell) and equal (nobody preferred one) of these, trained_on.
    annotators: per person name, answers, skips, equals, median_seconds (of the answers whose time is known, or None).
    agreement: see `senior.label.agreement.summary`. Raises `BadInput` if the run cannot be read.
    """
    rules = load(run / "config.json").asking.rules
    with _reading(run) as db:
        pairs = pairs_of(db, "1")
    asked = asked_of(pairs, rules)
    answered = [pair for pair in asked if pair.complete(rules)]
    opinions = [{one.answer for one in pair.said} - {None} for pair in answered]
    with closing(Desk(RunDirectory(run).preferences, rules)) as desk:
        return {
            "pairs": {
                "asked": len(asked),
                "answered": len(answered),
                "skipped": sum(pair.skipped(rules) for pair in answered),
                "equal": sum(held == {int(Preferred.EQUAL)} for held in opinions),
                "trained_on": sum(pair.collected_step is not None for pair in asked),
            },
            "annotators": desk.annotators(),
            "agreement": agreement.summary(desk.said()),
        }


def describe(found: Mapping[str, Any]) -> str:
    """`stats` in words, for a terminal."""
    pairs, agreed = found["pairs"], found["agreement"]
    lines = [
        f"{pairs['asked']} pairs asked, {pairs['answered']} answered: {pairs['skipped']} of them skipped, "
        f"{pairs['equal']} equal; {pairs['trained_on']} trained on."
    ]
    for who in found["annotators"]:
        time = "" if who["median_seconds"] is None else f", {who['median_seconds']:.1f} s at the median"
        lines.append(f"{who['name']}: {who['answers']} answers, {who['skips']} skips, {who['equals']} equal{time}.")
    if agreed["pairs"]:
        lines.append(
            f"Fleiss' kappa {_kappa(agreed['fleiss'])} over the {agreed['pairs']} pairs that {agreed['raters']} people "
            "have an opinion on."
        )
    lines += [
        f"{two['one']} and {two['other']}: Cohen's kappa {_kappa(two['kappa'])} over {two['pairs']} pairs."
        for two in agreed["cohen"]
    ]
    return "\n".join(lines)


def _kappa(value: float | None) -> str:
    return "not defined (all gave the same answer)" if value is None else f"{value:.2f}"
