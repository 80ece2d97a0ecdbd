"""What was said: one SQLite file per run, whoever the teacher is. Imports no JAX.

Every asked pair is a row, with both segments copied in, so that nothing said is ever stale or lost: where the
segments came from, the scores they were chosen by, the model's prediction before it was fitted, the answer, who
gave it, when, at which step, and which side was shown left. An answer is on the disk before it is used.
"""

from __future__ import annotations

import json
import sqlite3
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from senior.types import Answers, BadInput, Pairs, Preferred, Query

SCHEMA_VERSION = 1
_SCHEMA = """
CREATE TABLE pairs (
    id            INTEGER PRIMARY KEY,  -- in the order of asking, from 1
    session       INTEGER NOT NULL,
    step          INTEGER NOT NULL,     -- environment step at which it was asked
    run_seed      INTEGER NOT NULL,
    episode_0     INTEGER NOT NULL, start_0 INTEGER NOT NULL,
    episode_1     INTEGER NOT NULL, start_1 INTEGER NOT NULL,
    observation   BLOB NOT NULL,        -- float32 little-endian [2, H, o]
    action        BLOB NOT NULL,        -- float32 little-endian [2, H, a]
    reward        BLOB NOT NULL,        -- float32 little-endian [2, H], true reward
    scores        TEXT NOT NULL,        -- JSON object: what selection knew of the pair
    prediction    REAL,                 -- P(second preferred) before the fit
    answered      INTEGER NOT NULL DEFAULT 0,
    label         INTEGER,              -- 0 first, 1 second, -1 equal; NULL where skipped or not answered
    annotator     TEXT,
    answered_at   REAL,                 -- seconds since 1970
    answered_step INTEGER,              -- environment step at which the answer was collected
    shown_left    INTEGER NOT NULL      -- 0 or 1: which segment was shown on the left
);
CREATE TABLE shape (steps INTEGER, observation INTEGER, action INTEGER);  -- of every segment: H, o, a
"""


class LabelledArrays(NamedTuple):
    """Labelled pairs in arrays of fixed capacity, in the order of asking; rows from ``count`` on are zero."""

    observation: np.ndarray  # [capacity, 2, H, o] float32
    action: np.ndarray  # [capacity, 2, H, a] float32
    label: np.ndarray  # [capacity] int32, a Preferred
    count: int


class Preferences:
    """The file of one run, opened for reading and writing.

    ``capacity`` is the budget: no label is ever dropped. Opening creates the file; one that cannot be read, or is of
    another schema version, is a `BadInput`.
    """

    def __init__(self, path: Path, capacity: int, segment: int, observation_size: int, action_size: int) -> None:
        self.arrays = LabelledArrays(
            np.zeros((capacity, 2, segment, observation_size), np.float32),
            np.zeros((capacity, 2, segment, action_size), np.float32),
            np.zeros(capacity, np.int32),
            0,
        )
        self._shape = (segment, observation_size, action_size)
        try:
            self._db = sqlite3.connect(path, check_same_thread=False)  # one thread after another uses it
            self._open(path)
        except sqlite3.Error as error:
            raise BadInput(f"{path} cannot be used: {error}.") from error

    def _open(self, path: Path) -> None:
        self._db.execute("PRAGMA journal_mode=WAL")
        self._db.execute("PRAGMA synchronous=FULL")
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if version == 0:
            row = "INSERT INTO shape VALUES ({:d}, {:d}, {:d});".format(*self._shape)
            self._db.executescript(f"BEGIN; {_SCHEMA} {row} PRAGMA user_version={SCHEMA_VERSION}; COMMIT;")
        elif version != SCHEMA_VERSION:
            raise BadInput(f"{path} has schema version {version}; this program reads {SCHEMA_VERSION}.")
        self._read()

    def close(self) -> None:
        """Write everything back into the one file and close it."""
        self._db.close()

    @property
    def last(self) -> int:
        """Number of the last pair asked, 0 if none: a checkpoint remembers it."""
        return self._db.execute("SELECT COALESCE(MAX(id), 0) FROM pairs").fetchone()[0]

    @property
    def skipped(self) -> int:
        """Pairs that were answered with a skip."""
        return self._db.execute("SELECT COUNT(*) FROM pairs WHERE answered AND label IS NULL").fetchone()[0]

    def truncate(self, last: int) -> None:
        """Forget pairs after number ``last``: a resumed run asks them again, alike."""
        with self._db:
            self._db.execute("DELETE FROM pairs WHERE id > ?", (last,))
        self._read()

    def add(self, query: Query, session: int, step: int, run_seed: int, shown_left: np.ndarray) -> list[int]:
        """Record pairs as asked; returns their numbers."""
        pairs, first = query.pairs, self.last + 1
        ids = list(range(first, first + len(pairs)))
        rows = [
            (
                number,
                session,
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
        columns = (
            "id, session, step, run_seed, episode_0, start_0, episode_1, start_1, observation, action, reward, "
            "scores, prediction, shown_left"
        )
        with self._db:
            marks = ", ".join("?" * len(columns.split(", ")))
            self._db.executemany(f"INSERT INTO pairs ({columns}) VALUES ({marks})", rows)
        return ids

    def answer(self, answers: Answers, annotator: str, step: int) -> None:
        """Record answers; they are on the disk when this returns."""
        now = time.time()
        with self._db:
            self._db.executemany(
                "UPDATE pairs SET answered = 1, label = ?, annotator = ?, answered_at = ?, answered_step = ? "
                "WHERE id = ?",
                [
                    (label, annotator, now, step, number)
                    for number, label in zip(answers.ids, answers.labels, strict=True)
                ],
            )
        self._read()

    def preferred_positions(self, position: slice, equal: str = "left_out") -> tuple[np.ndarray, int]:
        """Positions of all preferred segments, ``[capacity * H, d]`` of which the first ``count`` rows are filled.

        Equal pairs are left out; if there is nothing else, both their segments count. ``equal="second"``: their second
        segment counts, as by accident in the public code.
        """
        observation, _, label, count = self.arrays
        capacity, _, steps, _ = observation.shape
        label = label[:count]
        decided = (label != Preferred.EQUAL) | (equal == "second")
        chosen = observation[:count][decided, label[decided]]
        if not decided.any():
            chosen = observation[:count].reshape(-1, steps, observation.shape[-1])[:capacity]
        flat = chosen[..., position].reshape(-1, position.stop - position.start)
        out = np.zeros((capacity * steps, flat.shape[1]), np.float32)
        out[: len(flat)] = flat
        return out, len(flat)

    def asked(self) -> list[dict[str, object]]:
        """Every asked pair without its segments, in the order of asking."""
        names = (
            "id, session, step, run_seed, episode_0, start_0, episode_1, start_1, scores, prediction, answered, "
            "label, annotator, answered_step, shown_left"
        )
        rows = self._db.execute(f"SELECT {names} FROM pairs ORDER BY id").fetchall()
        return [dict(zip(names.split(", "), row, strict=True)) for row in rows]

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

    def _read(self) -> None:
        """Fill the arrays from the file."""
        steps, o, a = self._shape
        labelled = "SELECT observation, action, label FROM pairs WHERE label IS NOT NULL ORDER BY id"
        count = 0
        for count, (observation, action, label) in enumerate(self._db.execute(labelled), start=1):
            self.arrays.observation[count - 1] = _array(observation, (2, steps, o))
            self.arrays.action[count - 1] = _array(action, (2, steps, a))
            self.arrays.label[count - 1] = label
        for column in self.arrays[:3]:
            column[count:] = 0
        self.arrays = self.arrays._replace(count=count)


def _blob(array: np.ndarray) -> bytes:
    return np.ascontiguousarray(array, "<f4").tobytes()


def _array(blob: bytes, shape: tuple[int, ...]) -> np.ndarray:
    return np.frombuffer(blob, "<f4").reshape(shape)
