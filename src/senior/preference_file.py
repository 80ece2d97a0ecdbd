"""The preference file of a run: its tables, how it is opened, and what the answers in it amount to. Imports no JAX.

Every asked pair is a row, with both segments copied in, so that nothing said is ever stale or lost: where the
segments came from, the scores they were chosen by, the model's prediction before it was fitted, which side is shown
left. Every answer is a row too: who gave it, when, how surely. `senior.preferences` is the trainer's side of it,
`senior.label.desk` that of the people who answer.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from senior.types import BadInput, Preferred

SCHEMA_VERSION = 2
BUSY_SECONDS = 30.0
"""How long a process waits for another one's transaction."""
SCHEMA = """
CREATE TABLE pairs (
    id             INTEGER PRIMARY KEY,         -- in the order of asking, from 1
    session        INTEGER NOT NULL,
    reserve        INTEGER NOT NULL DEFAULT 0,  -- 1: asked only in place of one that was skipped
    step           INTEGER NOT NULL,            -- environment step at which it was asked
    run_seed       INTEGER NOT NULL,
    episode_0      INTEGER NOT NULL, start_0 INTEGER NOT NULL,
    episode_1      INTEGER NOT NULL, start_1 INTEGER NOT NULL,
    observation    BLOB NOT NULL,               -- float32 little-endian [2, H, o]
    action         BLOB NOT NULL,               -- float32 little-endian [2, H, a]
    reward         BLOB NOT NULL,               -- float32 little-endian [2, H], true reward
    scores         TEXT NOT NULL,               -- JSON object: what selection knew of the pair
    prediction     REAL,                        -- P(second preferred) before the fit
    shown_left     INTEGER NOT NULL,            -- 0 or 1: which segment is shown on the left
    collected_step INTEGER,                     -- environment step at which its answers were taken; NULL: not yet
    second         REAL                         -- P(second preferred) that is trained on; NULL: skipped, or not yet
);
CREATE TABLE answers (
    id          INTEGER PRIMARY KEY,
    pair        INTEGER NOT NULL REFERENCES pairs (id),
    annotator   TEXT NOT NULL,
    answer      INTEGER,                        -- 0 first, 1 second, -1 equal; NULL skipped
    strength    TEXT,                           -- slightly, clearly or NULL: not told
    answered_at REAL NOT NULL,                  -- seconds since 1970
    seconds     REAL,                           -- from the first showing to the answer
    replays     INTEGER,                        -- how often the clips began again
    shown_left  INTEGER NOT NULL,
    clip_0      TEXT, clip_1 TEXT,              -- SHA-256 of the two clips that were shown
    withdrawn   INTEGER                         -- NULL: it stands; n > 0: the n-th to be undone; 0: for good
);
CREATE UNIQUE INDEX standing ON answers (pair, annotator) WHERE withdrawn IS NULL;
CREATE TABLE posts (id TEXT PRIMARY KEY, outcome TEXT NOT NULL);  -- what a page sent, by an id that it made, once
CREATE TABLE leases (
    pair      INTEGER NOT NULL REFERENCES pairs (id),
    annotator TEXT NOT NULL,
    until     REAL NOT NULL,                    -- seconds since 1970
    PRIMARY KEY (pair, annotator)
);
CREATE TABLE episodes (                         -- those that pairs were cut from, whole, to be lived through again
    episode INTEGER PRIMARY KEY,
    seed    INTEGER NOT NULL,
    action  BLOB NOT NULL                       -- float32 little-endian [n, a]
);
CREATE TABLE clips (
    pair    INTEGER NOT NULL REFERENCES pairs (id),
    side    INTEGER NOT NULL,                   -- 0 or 1
    name    TEXT,                               -- of the file, without .mp4; NULL: it could not be drawn
    frames  INTEGER, fps REAL,
    speed   REAL,                               -- as a share of the robot's own
    sha256  TEXT,
    failure TEXT,                               -- why not, in a sentence
    PRIMARY KEY (pair, side)
);
CREATE TABLE notes (                            -- goal: what people are shown; identity: of the run;
    name  TEXT PRIMARY KEY,                     -- imported: the last pair of those that came from a file
    value TEXT NOT NULL
);
CREATE TABLE shape (steps INTEGER, observation INTEGER, action INTEGER);  -- of every segment: H, o, a
"""


OPEN = "session > (SELECT COALESCE(MAX(session), -1) FROM pairs WHERE collected_step IS NOT NULL)"
"""Of pairs: that their session is not trained on yet; sessions are collected in order."""
PAIR = (
    "id",
    "session",
    "reserve",
    "step",
    "run_seed",
    "episode_0",
    "start_0",
    "episode_1",
    "start_1",
    "scores",
    "prediction",
    "shown_left",
    "collected_step",
    "second",
)
"""What is told of a pair beside its segments."""
ANSWER = (
    "id",
    "annotator",
    "answer",
    "strength",
    "answered_at",
    "seconds",
    "replays",
    "shown_left",
    "clip_0",
    "clip_1",
    "withdrawn",
)
"""What is told of an answer beside its pair."""


class Rules(NamedTuple):
    """What answers amount to."""

    overlap: int = 1
    """How many people are asked about each pair."""
    replace_skipped: bool = False
    """Whether another pair is asked in place of a skipped one, while there are any in reserve."""
    soft: bool = False
    """Whether "slightly" means a target of 0.75 instead of 1."""


class Said(NamedTuple):
    """An answer that stands."""

    annotator: str
    answer: int | None
    strength: str | None
    answered_at: float


class Asked(NamedTuple):
    """A pair, without its segments, and what was said of it."""

    id: int
    session: int
    reserve: bool
    step: int
    shown_left: int
    collected_step: int | None
    said: tuple[Said, ...]

    def complete(self, rules: Rules) -> bool:
        """Whether all who are asked have answered."""
        return len(self.said) >= rules.overlap

    def skipped(self, rules: Rules) -> bool:
        """Whether all who were asked could not tell."""
        return self.complete(rules) and all(one.answer is None for one in self.said)

    def second(self, rules: Rules) -> float | None:
        """P(second preferred) by the mean of the answers in [0, 1]; None if all skipped."""
        told = [_second(one, rules.soft) for one in self.said if one.answer is not None]
        return sum(told) / len(told) if told else None


class Foretold(NamedTuple):
    """A session that the reward model judged before it was fitted to it."""

    step: int
    """At which it was trained on."""
    right: int
    decided: int
    """Pairs of which one segment was preferred."""


def _second(said: Said, soft: bool) -> float:
    if said.answer == Preferred.EQUAL:
        return 0.5
    margin = 0.25 if soft and said.strength == "slightly" else 0.0
    return 1 - margin if said.answer == Preferred.SECOND else margin


def asked_of(pairs: Iterable[Asked], rules: Rules) -> list[Asked]:
    """Those of whole sessions' pairs that are asked, session by session: all but the reserves, and a reserve for every
    one that is skipped. ``pairs``: in the order of asking.
    """
    asked: list[Asked] = []
    for _, group in groupby(pairs, key=lambda pair: pair.session):
        session = list(group)
        chosen = [pair for pair in session if not pair.reserve]
        if rules.replace_skipped:
            wanted = len(chosen)
            reserves = (pair for pair in session if pair.reserve)
            while sum(not pair.skipped(rules) for pair in chosen) < wanted and (more := next(reserves, None)):
                chosen.append(more)
        asked += chosen
    return asked


def foretold(db: sqlite3.Connection) -> list[Foretold]:
    """Of every session that was trained on after the first: how often the reward model was right before the fit to it.

    Sessions without a decided pair are left out.
    """
    rows = db.execute(
        "SELECT session, collected_step, (prediction > 0.5) = (second > 0.5) FROM pairs "
        "WHERE session > (SELECT MIN(session) FROM pairs WHERE second IS NOT NULL) "
        "AND second IS NOT NULL AND second != 0.5 AND prediction IS NOT NULL ORDER BY id"
    )
    found: dict[int, Foretold] = {}
    for session, step, right in rows:
        before = found.get(session, Foretold(step, 0, 0))
        found[session] = Foretold(step, before.right + right, before.decided + 1)
    return list(found.values())


def connect(path: Path) -> sqlite3.Connection:
    """Open an existing preference file or make an empty one, without its tables.

    Transactions are explicit (`transaction`); a commit is on the disk. Raises `BadInput` if it cannot be read or is
    of another schema version.
    """
    try:
        # one thread after another uses it
        db = sqlite3.connect(path, timeout=BUSY_SECONDS, isolation_level=None, check_same_thread=False)
        try:
            db.execute("PRAGMA journal_mode=WAL")
            db.execute("PRAGMA synchronous=FULL")
            version = db.execute("PRAGMA user_version").fetchone()[0]
        except sqlite3.Error:
            db.close()
            raise
    except sqlite3.Error as error:
        raise BadInput(f"{path} cannot be used: {error}.") from error
    if version not in (0, SCHEMA_VERSION):
        db.close()
        raise BadInput(f"{path} has schema version {version}; this program reads {SCHEMA_VERSION}.")
    return db


def has_tables(path: Path) -> bool:
    """Whether the trainer has made the preference file. Raises `BadInput` if it cannot be read."""
    if not path.exists() or path.stat().st_size == 0:
        return False
    with closing(connect(path)) as db:
        return db.execute("PRAGMA user_version").fetchone()[0] > 0


@contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
    """All of what is done within, or nothing; on the disk at the end. No other process writes meanwhile."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        db.execute("ROLLBACK")
        raise
    db.execute("COMMIT")


def pairs_of(db: sqlite3.Connection, where: str, *values: object) -> list[Asked]:
    """Pairs that meet an SQL condition, in the order of asking, with the answers that stand, in the order of giving."""
    said: dict[int, list[Said]] = {}
    for number, *rest in db.execute(
        "SELECT pair, annotator, answer, strength, answered_at FROM answers WHERE withdrawn IS NULL "
        f"AND pair IN (SELECT id FROM pairs WHERE {where}) ORDER BY id",
        values,
    ):
        said.setdefault(number, []).append(Said(*rest))
    rows = db.execute(
        f"SELECT id, session, reserve, step, shown_left, collected_step FROM pairs WHERE {where} ORDER BY id", values
    )
    return [
        Asked(number, session, bool(reserve), step, left, collected, tuple(said.get(number, ())))
        for number, session, reserve, step, left, collected in rows.fetchall()
    ]
