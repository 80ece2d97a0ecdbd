"""What is thrown at a real server of the labelling page: kills in a stream of posts, bytes of all kinds, and whatever
its own description allows or forbids. Short in test_server.py, long in prove_label.py.
"""

from __future__ import annotations

import http.client
import json
import random
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from senior.types import Answers
from tests.stand_in import Client, Reply, Server, StandIn, new_id, raw

# Kills.


class Post(NamedTuple):
    """Something that a page sent, and what it heard; None if nothing."""

    path: str
    body: dict[str, Any]
    reply: Reply | None


class Poster:
    """A person who answers, undoes and redoes as fast as the server lets them, until it is gone.

    ``standing`` and ``taken_back`` are pairs and answers by what the page was told, the latest last.
    """

    def __init__(self, name: str, rng: random.Random) -> None:
        self.name = name
        self.standing: list[tuple[int, str]] = []
        self.taken_back: list[tuple[int, str]] = []
        self.posts: list[Post] = []
        self._rng = rng

    def run(self, url: str) -> None:
        """Post until there is no server any more."""
        try:
            with Client(url) as client:
                pair = client.next(self.name)["pair"]
                while True:
                    path, body = self._choose(pair)
                    self.posts.append(Post(path, body, None))
                    reply = client.post(path, body)
                    self.posts[-1] = Post(path, body, reply)
                    self.hear(path, reply)
                    pair = (reply.data if reply.status == 200 else reply.data["turn"])["pair"]
        except (OSError, http.client.HTTPException):
            return

    def _choose(self, pair: dict[str, Any] | None) -> tuple[str, dict[str, Any]]:
        body = {"post": new_id(), "annotator": self.name}
        if pair and self._rng.random() < 0.7:
            answer = self._rng.choice(["left", "right", "equal", "skip"])
            return "/api/answer", {**body, "pair": pair["pair"], "answer": answer}
        redo = self.taken_back and self._rng.random() < 0.4
        return "/api/redo" if redo else "/api/undo", body

    def hear(self, path: str, reply: Reply) -> None:
        """Believe what the page is told."""
        assert reply.status in (200, 409), reply
        if reply.status == 409:
            return
        told = reply.data["said"]["pair"], reply.data["said"]["answer"]
        if path == "/api/undo":
            assert self.standing.pop() == told
            self.taken_back.append(told)
        else:
            if path == "/api/redo":
                assert self.taken_back.pop() == told
            else:
                self.taken_back.clear()
            self.standing.append(told)


class Killed(NamedTuple):
    """What became of a stream of posts."""

    kills: int
    acknowledged: int
    """Posts that were answered before the kill..."""
    cut_off: int
    """...and those that were not, and were sent again."""
    done: int
    """Of these, how many had been carried out."""


def kill_while_posting(run: StandIn, kills: int, seed: int, say: Callable[[str], None] = lambda _: None) -> Killed:
    """Kill the server of a run at random moments while four people post, and see each time what is kept.

    Every other kill comes as soon as a post is on the disk, that is, mostly before the page has heard that it is.
    What was acknowledged stands as it was told. What was not is sent again, and so are some that were: each is carried
    out once. Then the session is trained on, and another asked.
    """
    rng = random.Random(seed)
    counts = Counter[str]()
    servers = [Server(run.path)]
    try:
        for kill in range(1, kills + 1):
            run.ask(12)
            posters = [Poster(name, random.Random(rng.random())) for name in ("ann", "bob", "cem", "dan")]
            threads = [threading.Thread(target=poster.run, args=(servers[-1].url,)) for poster in posters]
            for thread in threads:
                thread.start()
            while any(thread.is_alive() and not one.posts for thread, one in zip(threads, posters, strict=True)):
                time.sleep(0.001)
            time.sleep(rng.uniform(0, 0.4))
            if kill % 2:
                _wait_for_a_post(run)
            servers[-1].kill()
            for thread in threads:
                thread.join(60)
                assert not thread.is_alive()
            assert run.sql("PRAGMA integrity_check") == [("ok",)]
            servers.append(Server(run.path))
            _see_what_is_kept(run, servers[-1], posters, rng, counts)
            _train(run, posters)
            if kill % 100 == 0:
                say(f"{kill} kills, {dict(counts)}")
    finally:
        complaints = "".join(server.close() for server in servers)
    assert "Traceback" not in complaints, complaints
    return Killed(kills, counts["acknowledged"], counts["cut off"], counts["done"])


def _wait_for_a_post(run: StandIn) -> None:
    """Return when another post has been carried out, or after a second."""
    before, until = run.sql("SELECT COUNT(*) FROM posts"), time.monotonic() + 1
    while run.sql("SELECT COUNT(*) FROM posts") == before and time.monotonic() < until:
        pass


def _see_what_is_kept(
    run: StandIn, server: Server, posters: Sequence[Poster], rng: random.Random, counts: Counter[str]
) -> None:
    """Send again what was cut off, and some of what was not."""
    with Client(server.url) as client:
        for poster in posters:
            for path, body, heard in poster.posts:
                if heard is None:
                    counts["cut off"] += 1
                    counts["done"] += bool(run.sql("SELECT 1 FROM posts WHERE id = ?", body["post"]))
                    heard = client.post(path, body)
                    poster.hear(path, heard)
                else:
                    counts["acknowledged"] += 1
                    if rng.random() < 0.9:
                        continue
                before = run.contents()
                again = client.post(path, body)
                assert again.status == heard.status
                assert [again.data.get(name) for name in ("said", "detail")] == [
                    heard.data.get(name) for name in ("said", "detail")
                ]
                assert {**run.contents(), "leases": None} == {**before, "leases": None}
    assert standing(run, run.sessions - 1) == sorted(
        (pair, poster.name, answer) for poster in posters for pair, answer in poster.standing
    )


def standing(run: StandIn, session: int) -> list[tuple[int, str, str]]:
    """Pair, annotator and answer of every answer to a session that stands, in the page's words."""
    rows = run.sql(
        "SELECT pair, annotator, answer, pairs.shown_left FROM answers JOIN pairs ON pairs.id = pair "
        "WHERE withdrawn IS NULL AND session = ?",
        session,
    )
    words = [{None: "skip", -1: "equal", left: "left", 1 - left: "right"} for *_, left in rows]
    return sorted((pair, who, word[answer]) for (pair, who, answer, _), word in zip(rows, words, strict=True))


def _train(run: StandIn, posters: Sequence[Poster]) -> None:
    """Train on what was answered; the labels are those that the pages were told."""
    second = {"left": 0.0, "right": 1.0, "equal": 0.5}
    left = dict(run.sql("SELECT id, shown_left FROM pairs"))
    said = sorted(told for poster in posters for told in poster.standing if told[1] != "skip")
    before = run.preferences.arrays.count
    left_over = run.preferences.unanswered(run.collected, run.rules)
    run.preferences.answer(Answers(left_over, [None] * len(left_over)), "nobody")
    run.collect()
    _, _, labels, count = run.preferences.arrays
    turned = [second[answer] if answer == "equal" or not left[pair] else 1 - second[answer] for pair, answer in said]
    assert labels[before:count].tolist() == turned


# Bytes.

ODD = [
    *(b"\x00", b"\r\n", b"\n", b"\r\n\r\n", b" ", b"\xff\xfe", b"%", b"%00", b"%2e%2e%2f", b"%ff", b"..", b"/", b"?"),
    *(b"#", b"&", b"=", b'"', b"\\", b"\\ud800", b"{", b"}", b"[" * 2000, b"9" * 400, b"-1", b"1e999", b"NaN", b"null"),
    *(b"A" * 20_000, b"bytes=0-0,-1", b"Content-Length: -1\r\n", b"Content-Length: 99999999999999999999\r\n"),
    *(b"Transfer-Encoding: chunked\r\n", b"Range: bytes=-\r\n", b"Host: evil.example\r\n", b"Origin: null\r\n"),
    *(b"Cookie: \xff\r\n", b"Expect: 100-continue\r\n", b"Upgrade: websocket\r\n", b"Connection: upgrade\r\n"),
    *(b"HTTP/0.9", b"HTTP/2.0", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
]
"""What servers have stumbled over."""


def examples(client: Client, clip: str, pairs: Sequence[int]) -> list[bytes]:
    """A good request of every kind, to be spoilt."""
    found = []

    def add(method: str, path: str, body: dict[str, Any] | None = None, more: str = "") -> None:
        data = b"" if body is None else json.dumps(body).encode()
        length = "" if body is None else f"Content-Type: application/json\r\nContent-Length: {len(data)}\r\n"
        head = f"{method} {path} HTTP/1.1\r\nHost: {client.netloc}\r\nCookie: {client.cookie}\r\n{length}{more}\r\n"
        found.append(head.encode() + data)

    for path in ("/health", "/", "/overview", "/static/page.js", "/openapi.json", "/api/overview", "/nothing"):
        add("GET", path)
    add("GET", "/api/state?annotator=ann")
    add("GET", clip, more="Range: bytes=0-9,20-,-5\r\nIf-Range: x\r\n")
    add("POST", "/api/next", {"annotator": "ann"})
    add("POST", "/api/goal", {"goal": "Open the door"})
    for pair in pairs:
        add("POST", "/api/answer", {"post": new_id(), "annotator": "ann", "pair": pair, "answer": "left"})
    for path in ("/api/undo", "/api/redo"):
        add("POST", path, {"post": new_id(), "annotator": "ann"})
    return found


def spoilt(request: bytes, other: bytes, rng: random.Random) -> bytes:
    """A request after some accidents: bytes changed, lost, doubled, put in, or another request's."""
    for _ in range(rng.choice([1, 1, 2, 4])):
        start = rng.randrange(len(request) + 1)
        end = min(len(request), start + rng.choice([1, 1, 4, 20]))
        kind = rng.randrange(6)
        if kind == 0:
            put = rng.randbytes(end - start)
        elif kind == 1:
            put = b""
        elif kind == 2:
            put = 2 * request[start:end]
        elif kind == 3:
            put = other[start:end]
        else:
            put, end = rng.choice(ODD), start if kind == 4 else end
        request = request[:start] + put + request[end:]
    return request


def thrown(good: Sequence[bytes], rng: random.Random) -> bytes:
    """Bytes that never were a request, or one that is spoilt: anywhere, in its first line, or in its body only."""
    request, other = rng.choice(good), rng.choice(good)
    kind = rng.random()
    if kind < 0.1:
        return rng.randbytes(rng.randrange(1, 400))
    if kind < 0.5:
        return spoilt(request, other, rng)
    if kind < 0.6:
        line, _, rest = request.partition(b"\r\n")
        return spoilt(line, other, rng) + b"\r\n" + rest
    request = rng.choice([one for one in good if one.startswith(b"POST")])
    head, _, body = request.partition(b"\r\n\r\n")
    body = json.dumps(rng.choice(VALUES)).encode() if rng.random() < 0.1 else spoilt(body, other, rng)
    return re.sub(rb"Content-Length: \d+", b"Content-Length: %d" % len(body), head) + b"\r\n\r\n" + body


VALUES: list[Any] = [None, True, 0, -1, 1e308, "", "ann", [], {}, [[]], {"annotator": "a" * 61}, {"annotator": {}}]


def throw_bytes(
    server: Server, client: Client, requests: int, clip: str, pairs: Sequence[int], seed: int
) -> Counter[int]:
    """Send so many spoilt requests, and some that never were one; how often which status came back, 0: none."""
    rng = random.Random(seed)
    good = examples(client, clip, pairs)
    found = Counter[int]()
    for first in range(0, requests, 50):
        sent = [thrown(good, rng) for _ in range(min(50, requests - first))]
        for request, heard in zip(sent, raw(server.url, sent, 0.3), strict=True):
            codes = [int(code) for code in re.findall(rb"HTTP/1\.1 (\d\d\d) ", heard)]
            found.update(codes or [0])
            assert all(code < 500 for code in codes), (request, heard)
    return found


# What the description says.


def follow_description(server: Server, client: Client, requests: int, seed: int) -> Counter[int]:
    """Send so many requests that the server's OpenAPI description allows, or forbids; how often which status came back.

    What never ends (events) is left out.
    """
    import schemathesis  # takes a second
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded
    from hypothesis import strategies as st

    description, url, found = client.get("/openapi.json").data, server.url.partition("/?")[0], Counter[int]()
    del description["paths"]["/api/events"]

    def send(case: schemathesis.Case) -> None:
        status = case.call(base_url=url, headers={"cookie": client.cookie}).status_code
        found[status] += 1
        assert status < 500, case.as_curl_command()

    operations = [told.ok() for told in schemathesis.openapi.from_dict(description).get_all_operations()]
    allowed = [operation.as_strategy() for operation in operations]
    forbidden = [
        operation.as_strategy(generation_mode=schemathesis.GenerationMode.NEGATIVE)
        for operation in operations
        if operation.body or operation.query
    ]
    chosen = settings(
        max_examples=requests,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
        database=None,
        deadline=None,
    )
    seeded(seed)(chosen(given(st.one_of(allowed + forbidden))(send)))()
    return found
