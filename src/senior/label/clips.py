"""Clips for people to compare: ``python -m senior.label.clips RUN``, beside the run for as long as people answer.

Every segment of an asked pair becomes an MP4 ahead of the person, in the order of asking. Its episode is lived
through again from its seed and actions, in one environment with one camera that serve all clips; where it was filmed
while it happened (`senior.envs.recording`), the clip is cut from that film. Either way the observations must be those
of the segment, bit for bit: nobody is shown what did not happen. What cannot be drawn gets a sentence instead.

A file is complete and on the disk before its row is written, so the process may die at any moment: the next one
removes what has no row. It ends when its standard input does, that is with whoever started it, or on SIGTERM.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from senior.config import load, made_by
from senior.envs.drawing import KEYFRAMES, Film, NoVideo
from senior.envs.recording import film_of
from senior.label.scenes import Segment, Stage, Unlike, film_fps, filmed
from senior.preference_file import OPEN, connect, has_tables, transaction
from senior.types import BadInput

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

SECONDS = 2.5
"""How long a clip lasts, if its environment's own time is not slower..."""
SLOWEST_FPS = 8
"""...and it need not be slower than this."""
PAUSE = 0.2
"""Seconds between looks for something to do."""
ENDING = signal.SIGTERM, signal.SIGINT
"""What ends this process."""
GRACE = 10.0
"""Seconds in which a process that is to end must have ended by itself."""


class Wanted(NamedTuple):
    """A clip that is not there."""

    pair: int
    side: int
    segment: Segment
    observations: bytes  # of both of the pair's segments, which tell it from another of its number


class Store:
    """The clips of a run, as rows of its preference file and files in a folder."""

    def __init__(self, run: Path, overlap: int = 1) -> None:
        """``overlap``: how many people see each pair. Waits until the trainer has made the preference file.

        Raises `BadInput` if it cannot be read.
        """
        path = run / "preferences.sqlite"
        while not has_tables(path):
            time.sleep(PAUSE)
        self.folder = run / "label" / "clips"
        self.live = run / "label" / "live"
        self.db = connect(path)
        self.overlap = overlap
        self._seen = -1

    def tidy(self) -> None:
        """Remove files without a row; draw anew what has no file any more, or failed: the reason may be gone."""
        kept = {f"{name}.mp4" for (name,) in self.db.execute("SELECT name FROM clips WHERE name IS NOT NULL")}
        found = {path.name: path for path in self.folder.iterdir()}
        for name in found.keys() - kept:
            found[name].unlink()
        lost = [(name.removesuffix(".mp4"),) for name in kept - found.keys()]
        still_asked = f"pair IN (SELECT id FROM pairs WHERE {OPEN})"
        with transaction(self.db):
            self.db.executemany(f"DELETE FROM clips WHERE name = ? AND {still_asked}", lost)
            self.db.execute(f"DELETE FROM clips WHERE failure IS NOT NULL AND {still_asked}")

    def wait(self) -> None:
        """Return when somebody else has written to the preference file since this was last called."""
        while (version := self.db.execute("PRAGMA data_version").fetchone()[0]) == self._seen:
            time.sleep(PAUSE)
        self._seen = version

    def next(self, standing: int | None, step: int) -> Wanted | None:
        """The segment to be drawn next, if any.

        Of a pair's two, first the one that lies ahead of ``step`` of the episode ``standing``, where an environment
        stands, then the earlier one.
        """
        row = self.db.execute(
            f"""
            WITH segments AS (
                SELECT id AS pair, side, reserve,
                       iif(side, episode_1, episode_0) AS episode, iif(side, start_1, start_0) AS start
                FROM pairs JOIN (SELECT 0 AS side UNION SELECT 1) WHERE {OPEN}
                AND (SELECT COUNT(*) FROM answers WHERE answers.pair = pairs.id AND withdrawn IS NULL) < ?
            ), chosen AS (
                SELECT * FROM segments
                WHERE NOT EXISTS (SELECT * FROM clips WHERE clips.pair = segments.pair AND clips.side = segments.side)
                ORDER BY reserve, pair, episode IS NOT ? OR start < ?, start LIMIT 1
            )
            SELECT pair, side, chosen.episode, start, pairs.observation, seed, episodes.action,
                   shape.steps, shape.observation, shape.action
            FROM chosen JOIN pairs ON pairs.id = pair JOIN shape LEFT JOIN episodes ON episodes.episode = chosen.episode
            """,
            (self.overlap, standing, step),
        ).fetchone()
        if row is None:
            return None
        pair, side, episode, start, observations, seed, action, steps, o, a = row
        segment = Segment(
            episode,
            start,
            np.frombuffer(observations, "<f4").reshape(2, steps, o)[side],
            seed,
            np.frombuffer(action or b"", "<f4").reshape(-1, a),
        )
        return Wanted(pair, side, segment, observations)

    def new(self) -> Path:
        """A place for another clip, whose name nobody can guess."""
        return self.folder / f"{secrets.token_hex(16)}.mp4"

    def drawn(self, wanted: Wanted, path: Path, fps: Fraction, speed: Fraction) -> None:
        """Record a clip."""
        frames, digest = len(wanted.segment.observation), hashlib.sha256(path.read_bytes()).hexdigest()
        if not self._record(wanted, path.stem, frames, float(fps), float(speed), digest, None):
            path.unlink()

    def failed(self, wanted: Wanted, sentence: str) -> None:
        """Record why there is no clip."""
        self._record(wanted, None, None, None, None, None, sentence)

    def _record(self, wanted: Wanted, *columns: object) -> bool:
        """Whether the pair is still the one that was asked for."""
        written = self.db.execute(
            "INSERT INTO clips (pair, side, name, frames, fps, speed, sha256, failure) "
            "SELECT id, ?, ?, ?, ?, ?, ?, ? FROM pairs WHERE id = ? AND observation = ?",
            (wanted.side, *columns, wanted.pair, wanted.observations),
        )
        return written.rowcount == 1


def draw(store: Store, stage: Stage, wanted: Wanted) -> None:
    """Make one clip, or write down why there is none."""
    path, segment = store.new(), wanted.segment
    film = film_of(store.live, segment.episode)
    try:
        if film.exists():
            own, frames = film_fps(film), filmed(film, segment)
        else:
            own, frames = stage.fps, stage.scenes(segment)
        fps = clip_fps(own, len(segment.observation))
        with Film(path, fps, KEYFRAMES) as clip:
            for frame in frames:
                clip.add(frame)
        store.drawn(wanted, path, fps, fps / own)
    except Exception as error:  # an environment may raise anything
        stage.clear()
        store.failed(wanted, why_not(error, segment))


def draw_all(store: Store, stage: Stage) -> None:
    """Draw until nothing is asked for."""
    while (wanted := store.next(stage.episode, stage.step)) is not None:
        draw(store, stage, wanted)


def clip_fps(own: Fraction, steps: int) -> Fraction:
    """Frames per second of a clip of so many steps; ``own``: of its environment's own time."""
    return max(Fraction(SLOWEST_FPS), min(own, Fraction(steps) / Fraction(SECONDS)))


def why_not(error: Exception, segment: Segment) -> str:
    """A sentence for the person who sees no clip."""
    if isinstance(error, NoVideo):
        return f"The clips cannot be drawn because {error}"
    if isinstance(error, (BadInput, Unlike)):
        return str(error)
    told = " ".join(f"{type(error).__name__}: {error}".split())
    return f"The clip of episode {segment.episode} cannot be drawn: {told}"


def serve(run: Path) -> None:
    """Draw what is asked for, for ever. Raises `BadInput` where ``run`` is no run directory."""
    config = load(run / "config.json")
    stage = Stage(made_by(config))
    folder = run / "label" / "clips"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _alone(folder):
            store = Store(run, config.asking.overlap)
            store.tidy()
            while True:
                store.wait()
                draw_all(store, stage)
    finally:
        stage.clear()


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Begin when no other process draws there; its lock goes with it, however it ends."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


class _Over(BaseException):
    """This process is to end; no environment that is asked something meanwhile takes that for an error of its own."""


def _end(*_: object) -> None:
    for number in ENDING:  # once is enough
        signal.signal(number, signal.SIG_IGN)
    raise _Over


def _end_with_parent() -> None:
    """Have the main thread end when nobody can write to standard input any more."""
    with suppress(OSError):
        while os.read(0, 4096):
            pass
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(1)  # it hangs in an environment


def main(arguments: list[str]) -> int:
    """The process: 0 when it was ended, 2 with a sentence on standard error where there is no run."""
    if len(arguments) != 1:
        print("Usage: python -m senior.label.clips RUN", file=sys.stderr)
        return 2
    try:
        for number in ENDING:
            signal.signal(number, _end)
        threading.Thread(target=_end_with_parent, daemon=True).start()
        serve(Path(arguments[0]))
    except BadInput as error:
        print(error, file=sys.stderr)
        return 2
    except _Over:
        return 0
    return 0


if __name__ == "__main__":
    sys.unraisablehook = lambda _: None  # a half-built renderer, when it is collected, says what we have said
    raise SystemExit(main(sys.argv[1:]))
