"""What the labelling page's tests stand on: a run directory in which nothing is trained, whose clips show nothing; the
real server of it, in a process of its own; and a client that keeps its cookie. Imports no JAX.
"""

from __future__ import annotations

import fcntl
import http.client
import json
import os
import secrets
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from senior.config import Asking, Config, Queries, to_json
from senior.label.address import Address
from senior.preference_file import connect
from senior.preferences import Preferences
from senior.presets import preset
from senior.types import Pairs, Query

ROOT = Path(__file__).parents[1]
CAPACITY, H, O, A = 400, 4, 5, 2
PAPER = Asking()
LOCAL = Address()
STUB = bytes(range(256)) * 40
"""Stands for an MP4 where nobody looks at it."""


def configured(asking: Asking = PAPER) -> Config:
    """A run whose teacher are people."""
    queries = Queries(budget=CAPACITY, segment=H)
    return replace(preset("paper", "point", "m-senior"), teacher="human", asking=asking, queries=queries)


class StandIn:
    """A run directory, and the trainer's half of its preference file."""

    def __init__(self, path: Path, asking: Asking = PAPER, capacity: int = CAPACITY) -> None:
        self.path = path
        self.config = configured(asking)
        self.rules = asking.rules
        self.clips = path / "label" / "clips"
        self.clips.mkdir(parents=True)
        (path / "config.json").write_text(json.dumps({"config": to_json(self.config), "protocol": {}}))
        self.preferences = Preferences(self.file, capacity, H, O, A)
        self._other = connect(self.file)
        self._lock = os.open(self.clips, os.O_RDONLY)
        fcntl.flock(self._lock, fcntl.LOCK_EX)  # the clip process waits for it, so that only `draw` draws
        self.sessions = 0
        """How many were asked."""
        self.collected = 0

    @property
    def file(self) -> Path:
        return self.path / "preferences.sqlite"

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, and let others draw."""
        os.close(self._lock)
        self._other.close()
        self.preferences.close()

    def ask(self, pairs: int, reserves: int = 0, left: Sequence[int] | None = None, drawn: bool = True) -> list[int]:
        """Ask another session; ``left``: which segment of each pair is shown there, else alternating.

        Returns the pairs' numbers, those of the reserves last.
        """
        number, n = self.sessions, pairs + reserves
        rng = np.random.default_rng(number)
        segments = [rng.normal(size=(n, 2, H, *size)).astype(np.float32) for size in ((O,), (A,), ())]
        places = [rng.integers(100, size=(n, 2)) for _ in range(2)]
        shown = np.arange(n) % 2 if left is None else np.array(left)
        query = Query(Pairs(*segments, *places), {"m": rng.normal(size=n)}, rng.random(n))
        ids = self.preferences.add(query, number, 1000 * (number + 1), 0, shown, reserves)
        self.sessions += 1
        if drawn:
            self.draw(ids)
        return ids

    def draw(self, ids: Sequence[int]) -> None:
        """Have the clips of pairs be there."""
        for number in ids:
            for side in (0, 1):
                name = secrets.token_hex(16)
                (self.clips / f"{name}.mp4").write_bytes(STUB)
                self._clip(number, side, name, H, 20.0, 0.25, f"sha of {number}, {side}", None)

    def fail(self, number: int, sentence: str, side: int = 1) -> None:
        """Have one clip of a pair be there, and the other not, nor ever."""
        self._clip(number, 1 - side, secrets.token_hex(16), H, 20.0, 0.25, f"sha of {number}, {1 - side}", None)
        self._clip(number, side, None, None, None, None, None, sentence)

    def _clip(self, *columns: object) -> None:
        self.sql(f"INSERT INTO clips VALUES ({', '.join('?' * len(columns))})", *columns)

    def ready(self) -> bool:
        """Whether the earliest session that is not collected can be."""
        return self.preferences.ready(self.collected, self.step, self.rules)

    def collect(self) -> None:
        """Train on the earliest session that is not collected, as its answers stand."""
        assert self.preferences.collect(self.collected, self.step, self.rules), "an answer is missing"
        self.collected += 1

    @property
    def step(self) -> int:
        """At which the session is collected that is the next to be."""
        return 1000 * (self.collected + 1) + 5

    def tell(self, phase: str, **more: object) -> None:
        """Write down what the trainer, which is this process, is doing."""
        told = {"phase": phase, "step": 1000, "steps": 2000, "process": os.getpid(), **more}
        new = self.path / "status.json.tmp"
        new.write_text(json.dumps(told))
        os.replace(new, self.path / "status.json")

    def sql(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """What another process would see or change."""
        return self._other.execute(statement, values).fetchall()

    def standing(self) -> list[tuple[int, str, int | None, str | None]]:
        """The answers that stand: pair, annotator, answer and strength, in the order of pairs and people."""
        return self.sql(
            "SELECT pair, annotator, answer, strength FROM answers WHERE withdrawn IS NULL ORDER BY pair, annotator"
        )

    def contents(self) -> dict[str, list[tuple[Any, ...]]]:
        """All that is in the preference file."""
        tables = ("pairs", "answers", "posts", "leases", "clips", "notes")
        return {table: self.sql(f"SELECT * FROM {table} ORDER BY rowid") for table in tables}


class Reply(NamedTuple):
    """An answer of a server."""

    status: int
    headers: dict[str, str]
    """By names in small letters."""
    body: bytes

    @property
    def data(self) -> Any:
        return json.loads(self.body)


class Client:
    """Talks to a server over one connection, as a browser that has opened the printed address; `OSError` or
    `http.client.HTTPException` if it is gone.
    """

    def __init__(self, url: str, enter: bool = True) -> None:
        parts = urlsplit(url)
        self.netloc = parts.netloc
        self.cookie = ""
        self._connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=60)
        if enter:
            reply = self.get(f"{parts.path}?{parts.query}")
            assert reply.status == 200, reply
            self.cookie = reply.headers["set-cookie"].partition(";")[0]

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def send(self, method: str, path: str, body: bytes | Iterator[bytes] | None = None, **headers: str | None) -> Reply:
        """Headers are named with underscores for hyphens; one that is None is left out."""
        given = {"host": self.netloc, "cookie": self.cookie or None} | headers
        try:
            self._connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in given.items():
                if value is not None:
                    self._connection.putheader(name.replace("_", "-"), value)
            if isinstance(body, bytes):
                self._connection.putheader("content-length", str(len(body)))
            elif body is not None:
                self._connection.putheader("transfer-encoding", "chunked")
            self._connection.endheaders(body, encode_chunked=body is not None and not isinstance(body, bytes))
            answer = self._connection.getresponse()
            return Reply(answer.status, {key.lower(): value for key, value in answer.getheaders()}, answer.read())
        except BaseException:
            self._connection.close()
            raise

    def get(self, path: str, **headers: str | None) -> Reply:
        return self.send("GET", path, **headers)

    def post(self, path: str, body: object, **headers: str | None) -> Reply:
        return self.send("POST", path, json.dumps(body).encode(), **({"content_type": "application/json"} | headers))

    def next(self, annotator: str) -> Any:
        """The turn of somebody who opens the page."""
        reply = self.post("/api/next", {"annotator": annotator})
        assert reply.status == 200, reply
        return reply.data

    def answer(self, annotator: str, pair: int, answer: str, post: str | None = None, **more: object) -> Reply:
        sent = {"post": post or new_id(), "annotator": annotator, "pair": pair, "answer": answer, **more}
        return self.post("/api/answer", sent)


def new_id() -> str:
    """Of a post."""
    return secrets.token_hex(16)


class Server:
    """The server of a run, as `senior.label.serving.Serving` starts it. What it complains of is kept."""

    def __init__(self, run: Path, address: Address = LOCAL, owner: str = "user") -> None:
        told = json.dumps({**asdict(address), "owner": owner})
        command = [sys.executable, "-m", "senior.label.server", str(run), told]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdout
        self._said: list[str] = []
        self._hearing = threading.Thread(target=self._hear, daemon=True)
        self._hearing.start()
        self.url = self.process.stdout.readline().strip()
        """Empty if it ended at once."""

    def _hear(self) -> None:
        assert self.process.stderr
        with self.process.stderr as said:
            self._said.extend(said)

    def kill(self) -> None:
        """End it as nobody should, and wait until it has."""
        self.process.kill()
        self._wait()

    def close(self) -> str:
        """End it, wait until its clip process has ended too, and return what they complained of."""
        self.process.terminate()
        self._wait()
        self._hearing.join(20)
        return "".join(self._said)

    def _wait(self) -> None:
        assert self.process.stdout
        self.process.wait(20)
        self.process.stdout.close()


@contextmanager
def serving(run: Path, address: Address = LOCAL, owner: str = "user") -> Iterator[Server]:
    """A server for a while; it must not have complained."""
    server = Server(run, address, owner)
    try:
        yield server
    finally:
        complaints = server.close()
    assert "Traceback" not in complaints, complaints


def raw(url: str, requests: Sequence[bytes], patience: float = 1.0) -> list[bytes]:
    """What comes back to bytes that are sent over connections of their own, all at once, until the server hangs up or
    ``patience`` seconds have passed.
    """
    parts = urlsplit(url)
    sockets = [socket.create_connection((parts.hostname, parts.port), 10) for _ in requests]
    heard = {one: b"" for one in sockets}
    try:
        for one, request in zip(sockets, requests, strict=True):
            one.setblocking(False)
            with suppress(OSError):  # it has heard enough
                one.sendall(request)
        talking, until = set(sockets), time.monotonic() + patience
        while talking and (left := until - time.monotonic()) > 0:
            for one in select.select(list(talking), [], [], left)[0]:
                try:
                    more = one.recv(1 << 16)
                except OSError:
                    more = b""
                heard[one] += more
                if not more:
                    talking.discard(one)
        return [heard[one] for one in sockets]
    finally:
        for one in sockets:
            one.close()
