"""What was asked and said, from the trainer's side: one SQLite file per run, whoever the teacher is. Imports no JAX.

The trainer *collects* a session once all of it is answered: then the label that each pair is trained on, and the step
at which it was, are on the disk before the fit. So a run that goes on after it was killed trains on the same labels at
the same steps, and people may answer at any time (`senior.label.desk`), in other processes.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from senior.preference_file import (
    ANSWER,
    OPEN,
    PAIR,
    SCHEMA,
    SCHEMA_VERSION,
    Rules,
    asked_of,
    connect,
    pairs_of,
    transaction,
)
from senior.types import Answers, BadInput, Pairs, Query


class LabelledArrays(NamedTuple):
    """Labelled pairs in arrays of fixed capacity, in the order of asking; rows from ``count`` on are zero."""

    observation: np.ndarray  # [capacity, 2, H, o] float32
    action: np.ndarray  # [capacity, 2, H, a] float32
    second: np.ndarray  # [capacity] float32: P(second preferred): 0, 1, 0.5 where equal, between where people differ
    count: int


class Preferences:
    """The trainer's side of the file of one run.

    ``capacity`` is the budget: no label is ever dropped. Opening creates the file; one that cannot be read, or is of
    another schema version, is a `BadInput`.
    """

    def __init__(self, path: Path, capacity: int, segment: int, observation_size: int, action_size: int) -> None:
        self.arrays = LabelledArrays(
            np.zeros((capacity, 2, segment, observation_size), np.float32),
            np.zeros((capacity, 2, segment, action_size), np.float32),
            np.zeros(capacity, np.float32),
            0,
        )
        self._path = path
        self._shape = (segment, observation_size, action_size)
        self._db = connect(path)
        try:
            if self._db.execute("PRAGMA user_version").fetchone()[0] == 0:
                row = "INSERT INTO shape VALUES ({:d}, {:d}, {:d});".format(*self._shape)
                self._db.executescript(f"BEGIN IMMEDIATE; {SCHEMA} {row} PRAGMA user_version={SCHEMA_VERSION}; COMMIT")
            held = self._db.execute("SELECT * FROM shape").fetchone()
        except sqlite3.Error as error:
            self._db.close()
            raise BadInput(f"{path} cannot be used: {error}.") from error
        if held != self._shape:
            self._db.close()
            names = "steps of a segment, of an observation and of an action"
            raise BadInput(f"{path} holds other sizes ({names}) than the run has: {held}, not {self._shape}.")

    def close(self) -> None:
        """Write everything back into the one file and close it."""
        self._db.close()

    # Asking.

    def add(
        self,
        query: Query,
        session: int,
        step: int,
        run_seed: int,
        shown_left: np.ndarray,
        reserves: int = 0,
        episodes: Mapping[int, tuple[int, np.ndarray]] | None = None,
    ) -> list[int]:
        """Record pairs as asked; returns their numbers.

        reserves: how many, the last ones, are asked only in place of skipped ones.
        episodes: those the segments were cut from, as (seed, actions [n, a]).
        """
        pairs = query.pairs
        columns = (
            "id, session, reserve, step, run_seed, episode_0, start_0, episode_1, start_1, observation, action, "
            "reward, scores, prediction, shown_left"
        )
        with transaction(self._db):
            first = self._db.execute("SELECT COALESCE(MAX(id), 0) FROM pairs").fetchone()[0] + 1
            ids = list(range(first, first + len(pairs)))
            rows = [
                (
                    number,
                    session,
                    i >= len(pairs) - reserves,
                    step,
                    run_seed,
                    *(int(value) for side in (0, 1) for value in (pairs.episode[i, side], pairs.start[i, side])),
                    _blob(pairs.observation[i]),
                    _blob(pairs.action[i]),
                    _blob(pairs.reward[i]),
                    json.dumps({name: float(score[i]) for name, score in query.scores.items()}),
                    None if query.prediction is None else float(query.prediction[i]),
                    int(shown_left[i]),
                )
                for i, number in enumerate(ids)
            ]
            marks = ", ".join("?" * len(columns.split(", ")))
            self._db.executemany(f"INSERT INTO pairs ({columns}) VALUES ({marks})", rows)
            self._db.executemany(
                "INSERT OR IGNORE INTO episodes VALUES (?, ?, ?)",
                [(number, seed, _blob(action)) for number, (seed, action) in (episodes or {}).items()],
            )
        return ids

    def take_over(
        self,
        pairs: Sequence[Mapping[str, Any]],
        segments: Sequence[np.ndarray],
        answers: Sequence[Mapping[str, Any]],
    ) -> None:
        """Put pairs that were asked elsewhere, and all that was said of them, into a file that holds none.

        pairs: every name of `PAIR`, in the order of asking. segments: their observation [P, 2, H, o], action
        [P, 2, H, a] and true reward [P, 2, H]. answers: every name of `ANSWER`, and pair. Raises `BadInput` if
        something was asked already; then nothing is changed.
        """
        blobs = [[_blob(row) for row in column] for column in segments]
        rows = [[pair[name] for name in PAIR] for pair in pairs]
        columns = (*PAIR, "observation", "action", "reward")
        with transaction(self._db):
            if self._db.execute("SELECT 1 FROM pairs").fetchone():
                raise BadInput(f"{self._path} holds pairs already; labels can be put in only before any is asked.")
            self._db.executemany(
                f"INSERT INTO pairs ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})",
                [(*row, *own) for row, *own in zip(rows, *blobs, strict=True)],
            )
            self._db.executemany(
                f"INSERT INTO answers (pair, {', '.join(ANSWER)}) VALUES (?{', ?' * len(ANSWER)})",
                [[answer[name] for name in ("pair", *ANSWER)] for answer in answers],
            )
            last = max(pair["id"] for pair in pairs)
            self._db.execute("INSERT INTO notes VALUES ('imported', ?)", (str(last),))

    def foretold(self, session: int) -> bool:
        """Whether what the model predicted of all its pairs is recorded."""
        missing = "SELECT 1 FROM pairs WHERE session = ? AND prediction IS NULL LIMIT 1"
        return self._db.execute(missing, (session,)).fetchone() is None

    def foretell(self, ids: Sequence[int], second: np.ndarray) -> None:
        """Record what the model predicts ``[n]`` of pairs that were chosen without it: P(second preferred)."""
        with transaction(self._db):
            rows = [(float(value), number) for value, number in zip(second, ids, strict=True)]
            self._db.executemany("UPDATE pairs SET prediction = ? WHERE id = ?", rows)

    def session(self, number: int) -> list[int]:
        """Numbers of the pairs chosen for a session, reserves included; none if it was not held yet."""
        return [row[0] for row in self._db.execute("SELECT id FROM pairs WHERE session = ? ORDER BY id", (number,))]

    def unanswered(self, session: int, rules: Rules) -> list[int]:
        """Numbers of those pairs of a session that answers are waited for."""
        chosen = asked_of(pairs_of(self._db, "session = ?", session), rules)
        return [pair.id for pair in chosen if not pair.complete(rules)]

    def open_episodes(self) -> set[int]:
        """Numbers of the episodes of all pairs whose session is not collected yet."""
        rows = self._db.execute(f"SELECT episode_0, episode_1 FROM pairs WHERE {OPEN}")
        return {episode for row in rows for episode in row}

    def query(self, ids: Sequence[int], reward_per_step: float) -> Query:
        """Asked pairs as they were put."""
        held = [self.segments(number) for number in ids]
        pairs = Pairs(*(np.concatenate(columns) for columns in zip(*held, strict=True)))
        marks = ", ".join("?" * len(ids))
        rows = self._db.execute(f"SELECT scores, prediction FROM pairs WHERE id IN ({marks}) ORDER BY id", ids)
        scores, prediction = zip(*((json.loads(text), told) for text, told in rows), strict=True)
        names = dict.fromkeys(name for one in scores for name in one)  # pairs of a file may be of several rules
        return Query(
            pairs,
            {name: np.array([one.get(name) for one in scores], float) for name in names},
            None if None in prediction else np.array(prediction),
            reward_per_step,
        )

    # Answers.

    def answer(self, answers: Answers, annotator: str) -> None:
        """Record what one teacher said; it is on the disk when this returns."""
        now = time.time()
        with transaction(self._db):
            self._db.executemany(
                "INSERT INTO answers (pair, annotator, answer, answered_at, shown_left) "
                "SELECT id, ?, ?, ?, shown_left FROM pairs WHERE id = ?",
                [(annotator, label, now, number) for number, label in zip(answers.ids, answers.labels, strict=True)],
            )

    def ready(self, session: int, step: int, rules: Rules, settle: float = 0.0, waited_for: bool = False) -> bool:
        """Whether a session can be collected at ``step``.

        All of it is answered, the last answer at least ``settle`` seconds old, so that it could be undone; or it was
        collected before, in a life of the run that did not last, and its step has come or the run would stand still.
        """
        pairs = pairs_of(self._db, "session = ?", session)
        before = [pair.collected_step for pair in pairs if pair.collected_step is not None]
        if before:
            return waited_for or before[0] <= step
        chosen = asked_of(pairs, rules)
        latest = max((one.answered_at for pair in chosen for one in pair.said), default=0.0)
        settled = not 0 <= time.time() - latest < settle  # a clock may have been ahead
        return all(pair.complete(rules) for pair in chosen) and settled

    def collect(self, session: int, step: int, rules: Rules) -> bool:
        """Take the answers to a session as they stand: from now on they are trained on, and cannot be undone.

        False, and nothing is taken, where one was undone since it was `ready`. A session that was collected before
        stays as it was. The arrays then hold one session more.
        """
        with transaction(self._db):
            pairs = pairs_of(self._db, "session = ?", session)
            if all(pair.collected_step is None for pair in pairs):
                chosen = asked_of(pairs, rules)
                if not all(pair.complete(rules) for pair in chosen):
                    return False
                self._db.executemany(
                    "UPDATE pairs SET collected_step = ?, second = ? WHERE id = ?",
                    [(step, pair.second(rules), pair.id) for pair in chosen],
                )
        self.read(session + 1)
        return True

    def read(self, sessions: int) -> None:
        """Fill the arrays with the labels of so many sessions, from the first one on."""
        steps, o, a = self._shape
        labelled = "SELECT observation, action, second FROM pairs WHERE second IS NOT NULL AND session < ? ORDER BY id"
        count = 0
        for count, (observation, action, second) in enumerate(self._db.execute(labelled, (sessions,)), start=1):
            self.arrays.observation[count - 1] = _array(observation, (2, steps, o))
            self.arrays.action[count - 1] = _array(action, (2, steps, a))
            self.arrays.second[count - 1] = second
        for column in self.arrays[:3]:
            column[count:] = 0
        self.arrays = self.arrays._replace(count=count)

    def judged(self, session: int) -> list[tuple[float | None, float | None]]:
        """Of each asked pair of a session: the model's prediction before the fit, and the label; both P(second)."""
        return self._db.execute(
            "SELECT prediction, second FROM pairs WHERE session = ? AND collected_step IS NOT NULL ORDER BY id",
            (session,),
        ).fetchall()

    def preferred_positions(self, position: slice, equal: str = "left_out") -> tuple[np.ndarray, int]:
        """Positions of all preferred segments, ``[capacity * H, d]`` of which the first ``count`` rows are filled.

        Equal pairs are left out; if there is nothing else, both their segments count, as far as there is room.
        ``equal="second"``: their second segment counts, as by accident in the public code.
        """
        observation, _, second, count = self.arrays
        capacity, _, steps, _ = observation.shape
        second = second[:count]
        decided = (second != 0.5) | (equal == "second")
        chosen = observation[:count][decided, (second[decided] >= 0.5).astype(int)]
        if not decided.any():
            chosen = observation[:count].reshape(-1, steps, observation.shape[-1])[:capacity]
        flat = chosen[..., position].reshape(-1, position.stop - position.start)
        out = np.zeros((capacity * steps, flat.shape[1]), np.float32)
        out[: len(flat)] = flat
        return out, len(flat)

    # Looking at what was asked.

    def asked(self) -> list[dict[str, object]]:
        """Every asked pair without its segments, in the order of asking."""
        rows = self._db.execute(f"SELECT {', '.join(PAIR)} FROM pairs ORDER BY id").fetchall()
        return [dict(zip(PAIR, row, strict=True)) for row in rows]

    @property
    def skipped(self) -> int:
        """Pairs that were answered with a skip and collected."""
        condition = "collected_step IS NOT NULL AND second IS NULL"
        return self._db.execute(f"SELECT COUNT(*) FROM pairs WHERE {condition}").fetchone()[0]

    def segments(self, number: int) -> Pairs:
        """The two segments of one asked pair, as they were when asked; one row."""
        steps, o, a = self._shape
        row = self._db.execute(
            "SELECT observation, action, reward, episode_0, episode_1, start_0, start_1 FROM pairs WHERE id = ?",
            (number,),
        ).fetchone()
        if row is None:
            raise KeyError(f"no pair {number}")
        return Pairs(
            _array(row[0], (1, 2, steps, o)),
            _array(row[1], (1, 2, steps, a)),
            _array(row[2], (1, 2, steps)),
            np.array([row[3:5]]),
            np.array([row[5:7]]),
        )


def _blob(array: np.ndarray) -> bytes:
    return np.ascontiguousarray(array, "<f4").tobytes()


def _array(blob: bytes, shape: tuple[int, ...]) -> np.ndarray:
    return np.frombuffer(blob, "<f4").reshape(shape)
