"""What people do with the pairs of a run: take one, answer it, take an answer back. Imports no JAX.

The other half of `senior.preferences`: the trainer asks and collects, people answer in between, each in a transaction
of its own. A pair that is being looked at is *leased*, so that nobody else is given it meanwhile. What a page sends
carries an id that it made: sent again, it changes nothing and hears the same.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from itertools import islice, pairwise
from pathlib import Path
from secrets import token_hex
from statistics import median
from threading import Lock
from typing import Any, Literal, NamedTuple

from senior.preference_file import OPEN, Asked, Foretold, Rules, asked_of, connect, foretold, pairs_of, transaction
from senior.types import Preferred

LEASE_SECONDS = 120.0
"""How long a pair is kept for one who looks at it."""
AHEAD = 3
"""Pairs that a page is told of beforehand, so that their clips are there when it comes to them."""
PAUSE_SECONDS = 120.0
"""Between answers, what is longer is no work and does not count in the rate."""

Side = Literal["left", "right", "equal", "skip"]


class Given(NamedTuple):
    """An answer as a page gives it."""

    pair: int
    answer: Side
    strength: str | None = None
    seconds: float | None = None
    replays: int | None = None


class Outcome(NamedTuple):
    """What became of something that a page sent."""

    said: dict[str, Any] | None = None
    """The answer that was saved, taken back or given again: pair, answer, strength."""
    refused: str | None = None
    """Why nothing was changed, in a sentence."""


class Assignment(NamedTuple):
    """What one person is to look at."""

    pair: dict[str, Any] | None
    ahead: list[dict[str, Any]]
    kind: str | None = None
    """Why there is no pair: drawing (its clips), others (must do the rest), waiting (for the trainer)."""


class Desk:
    """The annotators' side of the file of one run, for any number of threads.

    ``clock``: seconds since 1970. Raises `senior.types.BadInput` if the file cannot be used.
    """

    def __init__(self, path: Path, rules: Rules, clock: Callable[[], float] = time.time) -> None:
        self.rules = rules
        self._clock = clock
        self._db = connect(path)
        self._lock = Lock()
        self._identity = ""

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    # What a page sends.

    def answer(self, post: str, annotator: str, given: Given) -> Outcome:
        """Save an answer; it is on the disk when this returns."""
        return self._once(post, lambda: self._answer(annotator, given))

    def undo(self, post: str, annotator: str) -> Outcome:
        """Take one's latest answer back that is not trained on; its pair is then leased to oneself again."""
        return self._once(post, lambda: self._undo(annotator))

    def redo(self, post: str, annotator: str) -> Outcome:
        """Give the answer again that was taken back last, unless one has given another since."""
        return self._once(post, lambda: self._redo(annotator))

    def _once(self, post: str, act: Callable[[], Outcome]) -> Outcome:
        with self._lock, transaction(self._db):
            before = self._db.execute("SELECT outcome FROM posts WHERE id = ?", (post,)).fetchone()
            if before:
                return Outcome(*json.loads(before[0]))
            outcome = act()
            self._db.execute("INSERT INTO posts VALUES (?, ?)", (post, json.dumps(outcome)))
            return outcome

    def _answer(self, annotator: str, given: Given) -> Outcome:
        pair = self._asked(given.pair)
        if isinstance(pair, Outcome):
            return pair
        if annotator in (one.annotator for one in pair.said):
            return Outcome(refused=f"You have answered pair {pair.id} already; undo that answer to change it.")
        if pair.complete(self.rules):
            return Outcome(refused=f"Pair {pair.id} has been answered by somebody else meanwhile.")
        answers = {"left": pair.shown_left, "right": 1 - pair.shown_left, "equal": int(Preferred.EQUAL), "skip": None}
        clips = dict(self._db.execute("SELECT side, sha256 FROM clips WHERE pair = ?", (pair.id,)).fetchall())
        if given.answer != "skip" and None in (clips.get(0), clips.get(1)):
            return Outcome(refused=f"The clips of pair {pair.id} are not there; it can only be skipped.")
        strength = given.strength if given.answer in ("left", "right") else None
        self._db.execute("UPDATE answers SET withdrawn = 0 WHERE annotator = ? AND withdrawn > 0", (annotator,))
        self._db.execute(
            "INSERT INTO answers (pair, annotator, answer, strength, answered_at, seconds, replays, shown_left, "
            "clip_0, clip_1) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                pair.id,
                annotator,
                answers[given.answer],
                strength,
                self._clock(),
                given.seconds,
                given.replays,
                pair.shown_left,
                clips.get(0),
                clips.get(1),
            ),
        )
        self._release(pair, annotator)
        return Outcome({"pair": pair.id, "answer": given.answer, "strength": strength})

    def _undo(self, annotator: str) -> Outcome:
        latest = self._latest(annotator, "withdrawn IS NULL", "id")
        if latest is None:
            return Outcome(refused="There is no answer of yours to undo.")
        number, pair, said = latest
        if not self._is_open(pair):
            return Outcome(refused="Your last answer belongs to what has been trained on already; it cannot be undone.")
        self._db.execute(
            "UPDATE answers SET withdrawn = 1 + (SELECT COALESCE(MAX(withdrawn), 0) FROM answers WHERE annotator = ?) "
            "WHERE id = ?",
            (annotator, number),
        )
        self._lease(pair, annotator)
        return Outcome(said)

    def _redo(self, annotator: str) -> Outcome:
        latest = self._latest(annotator, "withdrawn > 0", "withdrawn")
        if latest is None:
            return Outcome(refused="There is nothing to redo.")
        number, pair, said = latest
        asked = self._redone(pair)
        if isinstance(asked, Outcome):
            return asked
        self._db.execute("UPDATE answers SET withdrawn = NULL WHERE id = ?", (number,))
        self._release(asked, annotator)
        return Outcome(said)

    def _redone(self, number: int) -> Asked | Outcome:
        """The pair, if an answer to it can be given again."""
        pair = self._asked(number)
        if isinstance(pair, Asked) and pair.complete(self.rules):
            return Outcome(refused=f"Pair {number} has been answered by somebody else meanwhile.")
        return pair

    def _latest(self, annotator: str, condition: str, order: str) -> tuple[int, int, dict[str, Any]] | None:
        """Number, pair and content of one's latest answer that meets a condition.

        Imported ones are left out: their episodes are another run's, so nobody could be shown the pair again.
        """
        here = "pair > COALESCE((SELECT CAST(value AS INTEGER) FROM notes WHERE name = 'imported'), 0)"
        row = self._db.execute(
            "SELECT id, pair, answer, strength, shown_left FROM answers "
            f"WHERE annotator = ? AND {condition} AND {here} ORDER BY {order} DESC LIMIT 1",
            (annotator,),
        ).fetchone()
        if row is None:
            return None
        number, pair, answer, strength, left = row
        sides = {None: "skip", int(Preferred.EQUAL): "equal", left: "left", 1 - left: "right"}
        return number, pair, {"pair": pair, "answer": sides[answer], "strength": strength}

    def _is_open(self, number: int) -> bool:
        """Whether a pair is not trained on yet."""
        return self._db.execute(f"SELECT 1 FROM pairs WHERE id = ? AND {OPEN}", (number,)).fetchone() is not None

    def _asked(self, number: int) -> Asked | Outcome:
        """The pair, if it is being asked."""
        row = self._db.execute(f"SELECT session, {OPEN} FROM pairs WHERE id = ?", (number,)).fetchone()
        if row is None:
            return Outcome(refused=f"There is no pair {number}.")
        session, is_open = row
        if not is_open:
            return Outcome(refused=f"Pair {number} has been trained on already.")
        chosen = asked_of(pairs_of(self._db, "session = ?", session), self.rules)
        return next((pair for pair in chosen if pair.id == number), Outcome(refused=f"Pair {number} is not asked."))

    def _lease(self, pair: int, annotator: str) -> None:
        self._db.execute(
            "INSERT OR REPLACE INTO leases VALUES (?, ?, ?)", (pair, annotator, self._clock() + LEASE_SECONDS)
        )

    def _release(self, pair: Asked, annotator: str) -> None:
        """End the lease of one who has just answered, and others' for which there is no room any more.

        ``pair``: as it was before. There is none where one's own lease had run out and the pair was given on.
        """
        room = self.rules.overlap - len(pair.said) - 1
        self._db.execute(
            "DELETE FROM leases WHERE pair = ? AND annotator NOT IN (SELECT annotator FROM leases "
            "WHERE pair = ? AND annotator != ? AND until > ? ORDER BY until LIMIT ?)",
            (pair.id, pair.id, annotator, self._clock(), room),
        )

    # What a page is told.

    def assign(self, annotator: str) -> Assignment:
        """Lease to one the next pair whose clips are drawn: what is leased to them already, else the first free one."""
        with self._lock, transaction(self._db):
            now = self._clock()
            leases = self._db.execute("SELECT pair, annotator, until FROM leases WHERE until > ?", (now,)).fetchall()
            own = {pair: until for pair, who, until in leases if who == annotator}
            asked = self._open()
            unfinished = [pair for pair in asked if not pair.complete(self.rules)]
            mine = [pair for pair in unfinished if annotator not in (one.annotator for one in pair.said)]
            taken = {pair.id: sum(who != annotator for number, who, _ in leases if number == pair.id) for pair in mine}
            free = [pair for pair in mine if len(pair.said) + taken[pair.id] < self.rules.overlap]
            free.sort(key=lambda pair: -own.get(pair.id, 0.0))  # stable: the rest stays in the order of asking
            shown = list(islice((told for pair in free if (told := self._shown(pair, asked))), 1 + AHEAD))
            if not shown:
                return Assignment(None, [], "drawing" if free else "others" if unfinished else "waiting")
            if shown[0]["pair"] not in own:
                self._lease(shown[0]["pair"], annotator)
            return Assignment(shown[0], shown[1:])

    def _open(self) -> list[Asked]:
        """The pairs that are asked and not trained on."""
        return asked_of(pairs_of(self._db, OPEN), self.rules)

    def _shown(self, pair: Asked, asked: Sequence[Asked]) -> dict[str, Any] | None:
        """A pair, of those that are ``asked``, as a page shows it; None if its clips are not drawn yet."""
        clips = self._db.execute(
            "SELECT name, frames, fps, speed, failure FROM clips WHERE pair = ? ORDER BY side", (pair.id,)
        ).fetchall()
        if len(clips) < 2:
            return None
        failure = next((clip[4] for clip in clips if clip[0] is None), None)
        left, right = clips[pair.shown_left], clips[1 - pair.shown_left]
        session = [one.id for one in asked if one.session == pair.session]
        return {
            "pair": pair.id,
            "left": None if failure else f"/clips/{left[0]}.mp4",
            "right": None if failure else f"/clips/{right[0]}.mp4",
            "frames": left[1],
            "fps": left[2],
            "speed": left[3],
            "session": pair.session + 1,
            "step": pair.step,
            "number": session.index(pair.id) + 1,
            "size": len(session),
            "note": failure,
        }

    def progress(self) -> dict[str, Any]:
        """How far the labels are, as the page shows it: done, per_hour, session; and clips: ready, wanted, failure."""
        with self._lock, transaction(self._db):  # the trainer may collect meanwhile
            pairs = self._open()
            done = self._done(pairs)
            (before,) = self._db.execute(f"SELECT COUNT(*) FROM pairs WHERE NOT reserve AND NOT ({OPEN})").fetchone()
            session = None
            if pairs:
                first = [pair for pair in pairs if pair.session == pairs[0].session]
                size = sum(not pair.reserve for pair in first)
                session = {"number": pairs[0].session + 1, "done": self._done(first), "size": size}
            (ready, failure) = self._db.execute(
                "SELECT COUNT(*), MAX(failure) FROM (SELECT pair, MAX(failure) AS failure FROM clips "
                f"WHERE pair IN (SELECT id FROM pairs WHERE NOT reserve AND {OPEN}) GROUP BY pair HAVING COUNT(*) = 2)"
            ).fetchone()
            wanted = sum(not pair.reserve for pair in pairs)
            return {
                "labels": {"done": before + done, "per_hour": self._rate(), "session": session},
                "clips": {"ready": ready, "wanted": wanted, "failure": failure},
            }

    def _done(self, pairs: Sequence[Asked]) -> int:
        """How many of those that are asked count as answered: not the skipped ones that reserves stand for."""
        return sum(pair.complete(self.rules) for pair in pairs) - sum(pair.reserve for pair in pairs)

    def _rate(self) -> float | None:
        """Answers per hour of work, by the latest twenty."""
        rows = self._db.execute(
            "SELECT answered_at FROM answers WHERE withdrawn IS NULL AND clip_0 IS NOT NULL ORDER BY id DESC LIMIT 21"
        ).fetchall()
        times = [row[0] for row in rows]
        gaps = [late - early for late, early in pairwise(times) if 0 < late - early < PAUSE_SECONDS]
        return 3600 * len(gaps) / sum(gaps) if gaps else None

    def own(self, annotator: str) -> dict[str, Any]:
        """What one person did and can take back: answers, undo, redo."""
        with self._lock:
            (count,) = self._db.execute(
                "SELECT COUNT(*) FROM answers WHERE annotator = ? AND withdrawn IS NULL", (annotator,)
            ).fetchone()
            latest = self._latest(annotator, "withdrawn IS NULL", "id")
            taken_back = self._latest(annotator, "withdrawn > 0", "withdrawn")
            return {
                "answers": count,
                "undo": latest is not None and self._is_open(latest[1]),
                "redo": taken_back is not None and isinstance(self._redone(taken_back[1]), Asked),
            }

    def annotators(self) -> list[dict[str, Any]]:
        """Who answered: name, answers, skips, equals, median_seconds; in the order of their first answers."""
        with self._lock:
            rows = self._db.execute(
                "SELECT annotator, answer, seconds FROM answers WHERE withdrawn IS NULL ORDER BY id"
            ).fetchall()
        told = []
        for name in dict.fromkeys(row[0] for row in rows):
            answers = [(answer, seconds) for who, answer, seconds in rows if who == name]
            times = [seconds for _, seconds in answers if seconds is not None]
            told.append(
                {
                    "name": name,
                    "answers": len(answers),
                    "skips": sum(answer is None for answer, _ in answers),
                    "equals": sum(answer == Preferred.EQUAL for answer, _ in answers),
                    "median_seconds": median(times) if times else None,
                }
            )
        return told

    def said(self) -> list[tuple[int, str, int | None]]:
        """Every answer that stands: pair, annotator, 0 first, 1 second, -1 equal or None skipped."""
        with self._lock:
            return self._db.execute(
                "SELECT pair, annotator, answer FROM answers WHERE withdrawn IS NULL ORDER BY id"
            ).fetchall()

    def foretold(self) -> list[Foretold]:
        """`senior.preference_file.foretold` of this run."""
        with self._lock:
            return foretold(self._db)

    # Words.

    def note(self, name: str) -> str | None:
        """A note that somebody wrote."""
        with self._lock:
            row = self._db.execute("SELECT value FROM notes WHERE name = ?", (name,)).fetchone()
        return row[0] if row else None

    def write(self, name: str, value: str) -> None:
        """Write a note; it is on the disk when this returns."""
        with self._lock, transaction(self._db):
            self._db.execute("INSERT OR REPLACE INTO notes VALUES (?, ?)", (name, value))

    def identity(self) -> str:
        """What tells this run from all others, made up when it is first asked for."""
        if not self._identity:
            with self._lock, transaction(self._db):
                self._db.execute("INSERT OR IGNORE INTO notes VALUES ('identity', ?)", (token_hex(8),))
            self._identity = self.note("identity") or ""
        return self._identity

    def clip(self, name: str) -> bool:
        """Whether there is a clip of that name."""
        with self._lock:
            return self._db.execute("SELECT 1 FROM clips WHERE name = ?", (name,)).fetchone() is not None
