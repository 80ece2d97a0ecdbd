"""The labelling page's server, in a process of its own: who is let in, what is refused and how, what survives."""

from __future__ import annotations

import asyncio
import csv
import json
import os
import signal
import socket
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser
from http.client import HTTPConnection
from pathlib import Path
from queue import Queue
from typing import Any

import pytest
from fastapi.routing import APIRoute
from starlette.routing import Route
from starlette.types import Message, Receive, Scope, Send

from senior import methods
from senior.config import to_json
from senior.label import server as served
from senior.label.address import Address
from senior.label.app import application
from senior.label.desk import Desk
from senior.label.guard import MOST_BYTES, Access, Guard
from senior.label.serving import SERVED, Served, Serving
from senior.label.standing import Standing, trainer
from senior.types import BAD_INPUT, BadInput
from tests.siege import follow_description, kill_while_posting, throw_bytes
from tests.stand_in import LOCAL, STUB, Client, Reply, Server, StandIn, new_id, raw, serving

KILLS = 20
BYTES, DESCRIBED = 750, 250
"""Requests."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; "
    "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
SCRIPT = "<script>alert('1')</script>\"><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StandIn]:
    """A run with pairs, whose server is not restarted."""
    with StandIn(tmp_path_factory.mktemp("served") / "run") as run:
        run.ask(30)
        yield run


@pytest.fixture(scope="module")
def server(run: StandIn) -> Iterator[Server]:
    with serving(run.path) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    with Client(server.url) as client:
        yield client


@pytest.fixture
def stranger(server: Server) -> Iterator[Client]:
    """One who has not the token."""
    with Client(server.url, enter=False) as client:
        yield client


@pytest.fixture
def clip(run: StandIn) -> str:
    """A clip's address."""
    return f"/clips/{run.sql('SELECT name FROM clips WHERE name IS NOT NULL')[0][0]}.mp4"


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[StandIn]:
    """A run of the test's own."""
    with StandIn(tmp_path / "run") as run:
        yield run


def token_of(server: Server) -> str:
    return server.url.partition("token=")[2]


def assert_refused(reply: Reply, status: int, why: str = "") -> None:
    """In a sentence, which holds ``why``."""
    assert reply.status == status, reply
    assert reply.headers["content-type"] == "application/json"
    assert isinstance(reply.data["detail"], str) and why in reply.data["detail"]


# Who is let in.


def routes(run: StandIn, clip: str) -> list[tuple[str, str]]:
    """Method and address of everything that the application answers."""
    desk = Desk(run.file, run.rules)
    try:
        app = application(Standing(run.path, run.config, desk), Access("x", "y", frozenset(), False), clips=False)
    finally:
        desk.close()
    filled = {"/static/{name}": "/static/page.js", "/clips/{name}.mp4": clip}
    found = []
    for route in app.routes:
        assert isinstance(route, Route | APIRoute)  # and nothing is mounted
        found += [(method, filled.get(route.path, route.path)) for method in route.methods or ()]
    assert len(found) > 12 and not any("{" in path for _, path in found)
    return found


def test_everything_but_health_needs_the_token(run: StandIn, server: Server, clip: str, stranger: Client):
    with Client(server.url) as client:
        name, token = client.cookie.split("=")
    for method, path in routes(run, clip):
        for cookie in (None, f"{name}=", f"{name}=wrong", f"{name}={token}x", f"other={token}", f"senior-1={token}"):
            reply = stranger.send(method, path, cookie=cookie)
            if path == "/health":
                assert (reply.status, reply.data) == (200, {"status": "ok"})
            elif method == "HEAD":
                assert reply.status == 401
            else:
                assert_refused(reply, 401, "it holds the token")
            assert "set-cookie" not in reply.headers
        if path != "/api/events":
            assert stranger.send(method, path, cookie=f"{name}={token}").status in (200, 422)


def test_no_address_lets_one_in_without_the_token(server: Server, stranger: Client):
    for path in [
        "/nothing",
        "/health/",
        "//health",
        "/api/state;/health",
        "/health/../api/state",
        "/he%0aalth",
        "/%68ealth/x",
    ]:
        assert stranger.get(path).status == 401
    for host in ("/health?", "/health#", "\\health?", "@/health"):
        assert stranger.get("/api/state", host=f"{stranger.netloc}{host}").status in (401, 403)


def test_the_token_of_the_address_becomes_a_strict_cookie(server: Server, stranger: Client):
    for page in ("/", "/overview"):
        assert_refused(stranger.get(page), 401)
        assert_refused(stranger.get(f"{page}?token={token_of(server)[:-1]}"), 401)
        reply = stranger.get(f"{page}?token={token_of(server)}")
        assert reply.status == 200 and reply.headers["content-type"] == "text/html; charset=utf-8"
        value, *attributes = reply.headers["set-cookie"].split("; ")
        port = stranger.netloc.partition(":")[2]
        assert value == f"senior-{port}={token_of(server)}"
        assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(attributes)
        assert not any(attribute.lower().startswith("domain") for attribute in attributes)
        assert stranger.get(page, cookie=value).status == 200


def test_only_pages_take_the_token_from_the_address(server: Server, stranger: Client, clip: str):
    for path in ("/api/state", "/static/page.js", "/openapi.json", clip):
        assert_refused(stranger.get(f"{path}?token={token_of(server)}"), 401)
    assert_refused(stranger.post(f"/api/next?token={token_of(server)}", {"annotator": "ann"}), 401)
    assert_refused(stranger.post(f"/?token={token_of(server)}", {}), 401)


FOREIGN_HOSTS = [
    "",
    "evil.example",
    "evil.example:{port}",
    "127.0.0.1.evil.example",
    "[::1",
    "127.0.0.2",
    "x@evil.example",
]
OWN_HOSTS = ["127.0.0.1:{port}", "localhost:{port}", "LOCALHOST", "[::1]:{port}"]
FOREIGN_ORIGINS = [
    "",
    "null",
    "http://evil.example",
    "http://localhost:1",
    "http://127.0.0.1",
    "http://127.0.0.1:{port}.evil.example",
    "http://[",
    "ftp://127.0.0.1:{port}",
    "//127.0.0.1:{port}",
    "http://x@127.0.0.1:{port}",
]


def with_port(text: str, client: Client) -> str:
    return text.format(port=client.netloc.partition(":")[2])


@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_a_foreign_host_is_refused(client: Client, host: str):
    """A name that another site made lead here (DNS rebinding)."""
    assert_refused(client.get("/", host=with_port(host, client)), 403, "--allowed-host")


@pytest.mark.parametrize("host", OWN_HOSTS)
def test_this_machine_has_several_names(client: Client, host: str):
    assert client.get("/api/state", host=with_port(host, client)).status == 200


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
def test_a_foreign_origin_is_refused(run: StandIn, client: Client, origin: str):
    told, before = with_port(origin, client), run.contents()
    assert_refused(client.post("/api/goal", {"goal": "mine"}, origin=told), 403, "Only the page itself")
    assert_refused(client.get("/api/state", origin=told), 403)
    assert run.contents() == before


@pytest.mark.parametrize("origin", [None, "http://127.0.0.1:{port}", "https://127.0.0.1:{port}"])
def test_ones_own_origin_and_none_may_come_in(client: Client, origin: str | None):
    assert client.post("/api/goal", {"goal": "Open it"}, origin=origin and with_port(origin, client)).status == 200


def test_what_another_site_can_post_is_not_taken(run: StandIn, client: Client):
    """A form, or a script without asking first, sends no JSON as such."""
    body = json.dumps({"goal": "mine"}).encode()
    before = run.contents()
    for kind in (None, "text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
        assert_refused(client.send("POST", "/api/goal", body, content_type=kind), 422)
    assert run.contents() == before


# What goes out.


def test_every_answer_has_the_headers_that_keep_a_browser_safe(client: Client, clip: str, stranger: Client):
    pages = [client.get(path) for path in ("/", "/overview", "/api/state", "/openapi.json", "/health")]
    replies = {
        200: [*pages, client.get("/static/page.js"), client.get(clip)],
        206: [client.get(clip, range="bytes=0-1")],
        307: [client.get("/overview/")],
        400: [client.send("POST", "/api/next", 9000 * b"[", content_type="application/json")],
        401: [stranger.get("/")],
        403: [client.get("/", host="evil.example"), client.get("/", origin="null")],
        404: [client.get("/nothing"), client.get("/static/nothing"), client.get("/clips/nothing.mp4")],
        405: [client.send("DELETE", "/"), client.get("/api/next")],
        409: [client.post("/api/undo", {"post": new_id(), "annotator": "nobody"})],
        410: [client.post("/api/next", {"annotator": "nobody", "run": "another"})],
        413: [client.post("/api/goal", {"goal": MOST_BYTES * "x"})],
        416: [client.get(clip, range="bytes=99999999-")],
        422: [client.post("/api/next", {})],
    }
    for status, found in replies.items():
        for reply in found:
            assert reply.status == status
            assert reply.headers["content-security-policy"] == POLICY
            assert reply.headers["x-frame-options"] == "DENY"
            assert reply.headers["x-content-type-options"] == "nosniff"
            assert reply.headers["referrer-policy"] == "no-referrer"
            assert reply.headers["cross-origin-resource-policy"] == "same-origin"
            assert not {"access-control-allow-origin", "server"} & set(reply.headers)
            if status not in (206, 416) and reply not in replies[200][-2:]:
                assert reply.headers["cache-control"] == "no-store"


def test_a_failure_is_told_in_a_sentence_under_the_same_headers():
    async def fails(scope: Scope, receive: Receive, send: Send) -> None:
        raise RuntimeError("a secret")

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Message) -> None:
        sent.append(message)

    sent: list[Message] = []
    scope = {"type": "http", "method": "GET", "path": "/x", "query_string": b"", "headers": [(b"host", b"localhost")]}
    guard = Guard(fails, Access("", "", frozenset({"localhost"}), False))
    with pytest.raises(RuntimeError):
        asyncio.run(guard(scope, receive, send))
    assert sent[0]["status"] == 500
    assert dict(sent[0]["headers"])[b"content-security-policy"] == POLICY.encode()
    assert b"nothing was saved" in sent[1]["body"] and b"secret" not in sent[1]["body"]


class Elements(HTMLParser):
    """Every element of a page, and the text in it."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.inside: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.inside.append(self.found[-1][0] if self.found else "")


@pytest.mark.parametrize("page", ["/", "/overview"])
def test_pages_hold_no_script_and_no_style_and_nothing_from_elsewhere(client: Client, page: str):
    client.post("/api/goal", {"goal": "Open it"})
    elements = Elements()
    elements.feed(client.get(page).body.decode())
    scripts = [attributes for tag, attributes in elements.found if tag == "script"]
    assert scripts and all((one["src"] or "").startswith("/static/") for one in scripts)
    assert not {"script", "style"} & set(elements.inside)
    for tag, attributes in elements.found:
        assert tag not in ("style", "iframe", "object", "embed", "base")
        assert not [name for name in attributes if name.startswith("on") or name in ("style", "srcdoc")]
        for name in {"src", "href", "action", "formaction", "data", "poster"} & set(attributes):
            address = attributes[name] or ""
            assert address.startswith("/") and not address.startswith("//")
    for name in {*(one["src"] for one in scripts), "/static/page.css", "/static/icon.svg"}:
        text = client.get(name or "").body.decode()
        assert "http://" not in text.replace("http://www.w3.org/2000/svg", "") and "https://" not in text


def test_script_in_what_people_write_comes_back_as_text(client: Client):
    assert client.post("/api/goal", {"goal": SCRIPT}).data["goal"] == SCRIPT
    for page in ("/", "/overview"):
        text = client.get(page).body.decode()
        assert SCRIPT not in text and "<img src=x" not in text
        assert "&lt;script&gt;alert(&#39;1&#39;)&lt;/script&gt;" in text
    name, post = SCRIPT, new_id()
    pair = client.next(name)["pair"]["pair"]
    replies = [
        client.answer(name, pair, "left", post),
        client.answer(name, pair, SCRIPT),
        client.post("/api/undo", {"post": post, "annotator": 2 * SCRIPT}),
        client.post("/api/undo", {"post": SCRIPT, "annotator": name}),
        client.post("/api/next", {SCRIPT: SCRIPT, "annotator": name}),
        client.get("/api/state?annotator=%3Cscript%3Ealert(1)%3C/script%3E"),
        client.get("/static/%3Cscript%3Ealert(1)%3C%2Fscript%3E"),
        client.get("/api/overview"),
    ]
    assert [reply.status for reply in replies] == [200, 422, 422, 422, 422, 200, 404, 200]
    assert all(reply.headers["content-type"] == "application/json" for reply in replies)
    assert all(reply.headers["x-content-type-options"] == "nosniff" for reply in replies)
    undone = client.post("/api/undo", {"post": new_id(), "annotator": name}).data
    assert undone["said"] == {"pair": pair, "answer": "left", "strength": None}
    client.post("/api/goal", {"goal": "Open it"})


# Files.


UP = [
    "../",
    "..%2f",
    "%2e%2e/",
    "%2e%2e%2f",
    "..\\",
    "..%5c",
    "%252e%252e%252f",
    "....//",
    "/",
    "%2f",
    ".%00./",
    "..;/",
    "%c0%ae%c0%ae/",
    "../clips/../",
]
FILES = [
    "token",
    "token.mp4",
    "server.json",
    "config.json",
    "label/token",
    "label/server.json%00.mp4",
    "etc/passwd",
    "app.py",
    "label.html",
    "page/label.html",
]
NAMES = [
    "",
    ".",
    "..",
    "%00",
    ".mp4",
    "a.mp4",
    "*.mp4",
    "label.html",
    "page.js%00",
    "page.js/",
    "PAGE.JS",
    "~root",
    "con",
]


@pytest.mark.parametrize("root", ["/clips/", "/static/"])
def test_no_other_file_can_be_had(server: Server, client: Client, root: str):
    targets = [root + name for name in NAMES]
    targets += [root + n * up + file + end for up in UP for n in (1, 2, 3) for file in FILES for end in ("", ".mp4")]
    rest = f"HTTP/1.1\r\nHost: {client.netloc}\r\nCookie: {client.cookie}\r\nConnection: close\r\n\r\n"
    requests = [f"GET {target} {rest}".encode() for target in targets]
    heard = [reply for i in range(0, len(requests), 100) for reply in raw(server.url, requests[i : i + 100], 10)]
    codes = Counter(reply[9:12] for reply in heard)
    assert set(codes) <= {b"404", b"400", b"307"} and codes[b"404"] > len(targets) / 2, codes
    for reply in heard:
        body = reply.partition(b"\r\n\r\n")[2]
        assert not any(
            word in body for word in (token_of(server).encode(), b"root:", b"<!doctype", b'"preset"', b"import")
        )


def test_only_clips_that_the_file_knows_are_told(run: StandIn, client: Client, clip: str):
    (run.clips / "1234abcd.mp4").write_bytes(b"not in the file")
    assert_refused(client.get("/clips/1234abcd.mp4"), 404)
    reply = client.get(clip)
    assert (reply.status, reply.body, reply.headers["content-type"]) == (200, STUB, "video/mp4")


SIZE = len(STUB)


@pytest.mark.parametrize(
    ("asked", "got"),
    [
        ("bytes=0-3", (0, 4)),
        ("bytes=100-100", (100, 101)),
        ("bytes=256-", (256, SIZE)),
        ("bytes=-5", (SIZE - 5, SIZE)),
        ("bytes=0-", (0, SIZE)),
        (f"bytes=-{10 * SIZE}", (0, SIZE)),
        (f"bytes=10-{10 * SIZE}", (10, SIZE)),
        ("bytes=0-10,5-20", (0, 21)),
    ],
)
def test_a_range_of_a_clip_is_told(client: Client, clip: str, asked: str, got: tuple[int, int]):
    reply = client.get(clip, range=asked)
    assert (reply.status, reply.body) == (206, STUB[slice(*got)])
    assert reply.headers["content-range"] == f"bytes {got[0]}-{got[1] - 1}/{SIZE}"
    assert client.get(clip, range=asked, if_range='"another"').body == STUB


def test_several_ranges_of_a_clip_are_told_in_parts(client: Client, clip: str):
    reply = client.get(clip, range="bytes=0-3,10-13,-2")
    assert reply.status == 206
    boundary = reply.headers["content-type"].removeprefix("multipart/byteranges; boundary=").encode()
    parts = [part.partition(b"\r\n\r\n")[2].removesuffix(b"\r\n") for part in reply.body.split(b"--" + boundary)[1:-1]]
    assert parts == [STUB[:4], STUB[10:14], STUB[-2:]]


SENSELESS = (
    f"bytes={SIZE}- bytes=99999999999999999999999- bytes=5-1 bytes=-0 bytes=- bytes=--5 bytes= bytes = lines=1-2 "
    f"bytes=a-b bytes=1.5-2 bytes=0-0;1-1 bytes={5000 * '9'}- bytes=0x1-0x2 bytes=0-0,,99999999- \xff"
).split()


@pytest.mark.parametrize("asked", SENSELESS, ids=lambda asked: ascii(asked[:20]))
def test_a_range_that_makes_no_sense_is_refused(client: Client, clip: str, asked: str):
    reply = client.get(clip, range=asked)
    assert reply.status in (400, 416)
    assert len(reply.body) < 100
    assert client.get(clip).body == STUB


@pytest.mark.parametrize("count", [90, 1500])
@pytest.mark.parametrize("part", ["0-", "{0}-{0}", "-{0}", "0-0"])
def test_many_ranges_cost_no_more_than_the_clip(client: Client, clip: str, count: int, part: str):
    asked = "bytes=" + ",".join(part.format(2 * i + 1) for i in range(count))
    reply = client.get(clip, range=asked)
    assert reply.status in (200, 206)
    assert len(reply.body) < SIZE + 90 * 200


# What comes in.


def test_more_than_a_page_sends_is_not_taken(run: StandIn, client: Client, server: Server):
    def send(body: bytes) -> Reply:
        return client.send("POST", "/api/goal", body, content_type="application/json")

    before, goal = run.contents(), b'{"goal": "Open it"}'
    head = f"POST /api/goal HTTP/1.1\r\nHost: {client.netloc}\r\nCookie: {client.cookie}\r\n"
    lying = f"{head}Content-Length: {10**15}\r\n\r\n".encode() + 2 * MOST_BYTES * b"x"
    chunked = f"{head}Transfer-Encoding: chunked\r\n\r\n".encode() + 20 * (b"3e8\r\n" + 1000 * b"x" + b"\r\n")
    assert [heard[:13] for heard in raw(server.url, [lying, chunked])] == 2 * [b"HTTP/1.1 413 "]
    assert run.contents() == before
    assert send(goal.ljust(MOST_BYTES)).status == 200
    assert_refused(send(goal.ljust(MOST_BYTES + 1)), 413, f"{MOST_BYTES} bytes")


def test_what_comes_in_pieces_is_taken_whole(client: Client):
    pieces = (piece.encode() for piece in ('{"go', 'al": "Open', ' it"}'))
    reply = client.send("POST", "/api/goal", pieces, content_type="application/json")
    assert (reply.status, reply.data["goal"]) == (200, "Open it")


NO_GOALS = [
    *(
        b"",
        b"goal",
        b"{",
        b"[]",
        b"null",
        b'"goal"',
        b"\xff",
        b'{"goal": "\\ud800"}',
        b'{"\\ud800": 1}',
        b'{"goal": NaN}',
    ),
    *(
        b'{"goal": ""}',
        b'{"goal": "  "}',
        b'{"goal": 1}',
        b'{"goal": "x", "more": 1}',
        b'{"goal": "%s"}' % (301 * b"x"),
    ),
]
NO_ANSWERS: list[dict[str, Any]] = [
    *({"post": "short"}, {"post": "with spaces in it"}, {"post": None}),
    *({"annotator": ""}, {"annotator": "a\nb"}, {"annotator": "\x00"}, {"annotator": 61 * "x"}),
    *({"pair": 0}, {"pair": 2**63}, {"pair": 1.5}, {"pair": "x"}),
    *({"answer": "both"}, {"answer": None}, {"strength": "very"}),
    *({"seconds": -1}, {"seconds": float("nan")}, {"seconds": float("inf")}, {"seconds": 1e9}),
    *({"replays": -1}, {"replays": 1.5}, {"more": 1}),
]


@pytest.mark.parametrize("body", NO_GOALS, ids=lambda body: ascii(body[:20]))
def test_what_is_no_goal_is_refused(run: StandIn, client: Client, body: bytes):
    before = run.contents()
    reply = client.send("POST", "/api/goal", body, content_type="application/json")
    assert_refused(reply, 400 if body == b"\xff" else 422)
    assert run.contents() == before


@pytest.mark.parametrize("change", NO_ANSWERS, ids=str)
def test_what_is_no_answer_is_refused(run: StandIn, client: Client, change: dict[str, Any]):
    good = {"post": new_id(), "annotator": "zoe", "pair": 30, "answer": "left", "strength": "slightly"}
    before = run.contents()
    assert_refused(client.post("/api/answer", good | {"seconds": 1.5, "replays": 2} | change), 422)
    assert run.contents() == before


def test_people_may_be_called_what_they_like(client: Client):
    names = ["Ann Ä. Ö.", "安", "🤖", "a" * 60, "'; DROP TABLE answers; --", "%s{0}", "None"]
    for name in names:
        client.next(name)
        assert client.post("/api/undo", {"post": new_id(), "annotator": name}).status == 409
    assert client.post("/api/next", {"annotator": "  ann  "}).data == client.next("ann")


# The whole way of an answer.


def test_an_answer_undo_and_redo_are_told_as_the_page_expects(fresh: StandIn):
    fresh.ask(2, left=[0, 0])
    fresh.tell("waiting")
    with serving(fresh.path) as server, Client(server.url) as client:
        turn = client.next("ann")
        assert set(turn) == {"pair", "ahead", "why", "kind", "state", "said"}
        assert (turn["pair"]["pair"], [pair["pair"] for pair in turn["ahead"]], turn["said"]) == (1, [2], None)
        state = turn["state"]
        assert state["run"] == "point, m-senior, seed 0" and state["strength"] is True
        assert state["labels"]["budget"] == fresh.config.queries.budget
        assert state["you"] == {"answers": 0, "undo": False, "redo": False}
        assert state["trainer"]["phase"] == "waiting" and "step 1,000 of 2,000" in state["trainer"]["text"]
        answered = client.answer("ann", 1, "right", strength="clearly", seconds=2.5, replays=1).data
        assert answered["said"] == {"pair": 1, "answer": "right", "strength": "clearly"}
        assert answered["pair"]["pair"] == 2
        undone = client.post("/api/undo", {"post": new_id(), "annotator": "ann"}).data
        assert (undone["said"], undone["pair"]["pair"]) == (answered["said"], 1)
        assert undone["state"]["you"] == {"answers": 0, "undo": False, "redo": True}
        redone = client.post("/api/redo", {"post": new_id(), "annotator": "ann"}).data
        assert (redone["said"], redone["pair"]["pair"]) == (answered["said"], 2)
        refused = client.answer("ann", 1, "left")
        assert_refused(refused, 409, "answered pair 1 already")
        assert refused.data["turn"]["pair"]["pair"] == 2
        last = client.answer("ann", 2, "skip").data
        assert (last["pair"], last["kind"], last["ahead"]) == (None, "waiting", [])
        assert last["why"] == "There is nothing to answer now. The next pairs come when training has gone on."
        assert fresh.standing() == [(1, "ann", 1, "clearly"), (2, "ann", None, None)]
        fresh.collect()
        refused = client.post("/api/undo", {"post": new_id(), "annotator": "ann"})
        assert_refused(refused, 409, "trained on already")
        fresh.tell("finished")
        assert client.next("ann")["kind"] == "finished"
        fresh.tell("training", process=2**22 + 1)  # no process has that number
        assert client.next("ann")["kind"] == "stopped"


def test_a_page_hears_at_once_what_others_do(run: StandIn, server: Server, client: Client):
    """Server-sent events: the state first, then whenever it changes, whoever changes it."""
    with closing(HTTPConnection(client.netloc, timeout=20)) as listening:
        listening.request("GET", "/api/events?annotator=ann", headers={"Cookie": client.cookie})
        stream = listening.getresponse()
        assert stream.status == 200 and stream.getheader("content-type") == "text/event-stream; charset=utf-8"
        assert stream.getheader("content-security-policy") == POLICY

        def hear() -> Any:
            event, data, end = (stream.readline() for _ in range(3))
            assert event == b"event: state\n" and data.startswith(b"data: ") and end == b"\n"
            return json.loads(data.removeprefix(b"data: "))

        first = hear()
        assert first == client.get("/api/state?annotator=ann").data
        began = time.monotonic()
        pair = client.next("bea")["pair"]["pair"]
        client.answer("bea", pair, "skip")
        second = hear()
        assert second["labels"]["done"] == first["labels"]["done"] + 1
        assert {"name": "bea", "answers": 1} in second["annotators"]
        run.tell("training", step=1234)
        third = hear()
        assert third["trainer"] == {"phase": "training", "text": "Training: step 1,234 of 2,000."}
        assert time.monotonic() - began < 15  # and not the 15 s after which a quiet stream says that it is there
    assert_refused(client.get("/api/events?annotator="), 422)
    client.post("/api/undo", {"post": new_id(), "annotator": "bea"})


def test_the_overview_tells_numbers_whatever_the_curve_holds(fresh: StandIn):
    fresh.ask(3, left=[0, 0, 0])
    with open(fresh.path / "eval.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["step", "success_rate", "return_mean"])
        rows.writerows([[1000, 0.5, 3.25], [2000, 0.75, "nan"], [3000, "", ""]])
        file.write("4000,0.")
    with serving(fresh.path) as server, Client(server.url) as client:
        for number in (1, 2, 3):
            client.answer("ann", number, "left" if number < 3 else "equal", seconds=number)
        told = client.get("/api/overview").data
    assert told["curve"] == {"step": [1000, 2000], "success": [0.5, 0.75], "return": [3.25, None]}
    assert told["annotators"] == [{"name": "ann", "answers": 3, "skips": 0, "equals": 1, "median_seconds": 2.0}]
    assert told["agreement"]["pairs"] == 0 and told["agreement"]["cohen"] == []


@pytest.mark.parametrize(
    ("content", "phase"),
    [
        (None, "starting"),
        ("", "starting"),
        ("{", "starting"),
        ("[]", "starting"),
        ('{"phase": "training"}', "starting"),
        ('{"phase": "stopped", "step": 7, "steps": 9, "failure": "No space"}', "stopped"),
        ('{"phase": "training", "step": 7, "steps": 9}', "stopped"),
        ('{"phase": "finished", "step": 9, "steps": 9}', "finished"),
    ],
)
def test_what_the_trainer_does_is_told_whatever_it_has_written(tmp_path: Path, content: str | None, phase: str):
    if content is not None:
        (tmp_path / "status.json").write_text(content)
    told = trainer(tmp_path)
    assert told["phase"] == phase and told["text"].endswith((".", str(tmp_path)))
    assert ("No space" in told["text"]) == ("failure" in (content or ""))


def test_an_answer_is_not_held_back(client: Client):
    """By the two ends of the connection waiting for each other (Nagle, delayed acknowledgement): 40 ms, every time."""
    times = []
    for _ in range(20):
        began = time.monotonic()
        client.get("/health")
        times.append(time.monotonic() - began)
    assert min(times) < 0.035


# One server for a run, and its token.


def test_a_run_has_one_server_and_only_its_owner_can_read_the_token(fresh: StandIn):
    fresh.ask(1)
    token = fresh.path / "label" / "token"
    token.write_text("kept-from-before\n")
    token.chmod(0o644)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    Served("127.0.0.1", port, "", 1, "user").write(fresh.path)
    with serving(fresh.path) as server:
        assert server.url.startswith(f"http://127.0.0.1:{port}/")  # where it was before
        assert token_of(server) == "kept-from-before"
        assert token.stat().st_mode & 0o777 == 0o600
        file = fresh.path / "label" / "server.json"
        assert file.stat().st_mode & 0o777 == 0o600
        before = file.read_bytes()
        assert Served.read(fresh.path).url == server.url
        other = Server(fresh.path)
        assert other.process.wait(30) == SERVED and other.url == ""
        other.close()
        assert file.read_bytes() == before
        with Client(server.url) as client:
            assert client.next("ann")["pair"]["pair"] == 1
    with serving(fresh.path) as again:
        assert again.url == server.url  # a page that is open finds it


@pytest.mark.parametrize(
    ("owner", "wanted", "left"),
    [
        ("user", Address(token="wanted"), True),
        ("trainer", Address(), True),
        ("trainer", Address(host="localhost"), False),
        ("trainer", Address(token="wanted"), False),
        ("trainer", Address(allowed_hosts=("robot",)), False),
    ],
)
def test_a_server_that_is_there_is_left_but_not_a_trainer_s_at_another_address(
    fresh: StandIn, owner: str, wanted: Address, left: bool
):
    fresh.ask(1)
    told: Queue[str] = Queue()
    with serving(fresh.path, owner=owner) as server:
        with Serving(fresh.path, wanted, told.put):
            said = told.get(timeout=30).removeprefix("Answer in a browser: ")
            if left:
                assert said == server.url and server.process.poll() is None
            else:
                assert server.process.wait(30) in (0, -signal.SIGTERM)
                assert wanted.token is None or said.endswith(f"?token={wanted.token}")
                with Client(said) as client:
                    assert client.next("ann")["pair"]["pair"] == 1
        if owner == "trainer":
            assert server.process.wait(30) in (0, -signal.SIGTERM)
        else:
            assert server.process.poll() is None


def test_what_is_meant_for_another_run_changes_nothing(run: StandIn, client: Client):
    (pair,) = run.ask(1)
    state = client.next("ann")["state"]
    identity, goal = state["identity"], state["goal"]
    sent = {"annotator": "ann", "run": "another"}
    for path, more in {
        "/api/next": {},
        "/api/answer": {"post": new_id(), "pair": pair, "answer": "left"},
        "/api/undo": {"post": new_id()},
        "/api/redo": {"post": new_id()},
    }.items():
        assert_refused(client.post(path, sent | more), 410, "Another run is served here now.")
    assert_refused(client.post("/api/goal", {"goal": "Close it", "run": "another"}), 410)
    assert client.get("/api/state").data["goal"] == goal
    assert client.answer("ann", pair, "left", run=identity).status == 200
    assert f'data-run="{identity}"' in client.get("/").body.decode()


def test_a_server_waits_until_there_is_something_to_serve(tmp_path: Path):
    with StandIn(tmp_path / "run") as run:
        run.ask(1)
    run.file.rename(tmp_path / "later")
    waiting = threading.Timer(1, lambda: (tmp_path / "later").rename(run.file))
    waiting.start()
    with serving(run.path) as server, Client(server.url) as client:
        assert not waiting.is_alive()
        assert client.next("ann")["kind"] is None


def refused(run: Path, address: Address = LOCAL) -> str:
    with pytest.raises(BadInput) as caught:
        served.serve(run, address, "user")
    return str(caught.value)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "192.0.2.1", "example.org"])
def test_without_a_token_only_this_machine_is_served(fresh: StandIn, host: str):
    assert "Without a token" in refused(fresh.path, Address(host=host, token=""))
    assert not (fresh.path / "label" / "token").exists()


def test_what_cannot_be_served_is_told_in_a_sentence(fresh: StandIn, tmp_path: Path):
    assert "not a run directory" in refused(tmp_path / "nothing")
    for token in ("a b", "a;b", "ключ", "a&b", 'a"b', "a\nb"):
        assert "can stand in a token" in refused(fresh.path, Address(token=token))
    assert "Cannot listen on 192.0.2.1: " in refused(fresh.path, Address(host="192.0.2.1"))
    (fresh.path / "label" / "clips").rmdir()
    (fresh.path / "label" / "clips").write_text("in the way")
    assert "a file where a directory should be" in refused(fresh.path)
    plain = replace(fresh.config, method=methods.method("sac"))
    (fresh.path / "config.json").write_text(json.dumps({"config": to_json(plain), "protocol": {}}))
    assert "true reward" in refused(fresh.path)


def test_a_damaged_preference_file_is_told_and_not_waited_for(
    fresh: StandIn, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "other" / "label").mkdir(parents=True)
    (tmp_path / "other" / "config.json").write_bytes((fresh.path / "config.json").read_bytes())
    (tmp_path / "other" / "preferences.sqlite").write_bytes(100 * b"no database")
    told = json.dumps({"host": "127.0.0.1", "port": 0, "allowed_hosts": [], "token": None, "owner": "user"})
    assert served.main([str(tmp_path / "other"), told]) == BAD_INPUT
    assert "cannot be used" in capsys.readouterr().err


def test_an_address_in_use_is_told_and_one_nobody_asked_for_is_passed_over(
    run: StandIn, server: Server, fresh: StandIn
):
    port = int(Client(server.url, enter=False).netloc.partition(":")[2])
    assert f"port {port}: Address already in use" in refused(fresh.path, Address(port=port))
    fresh.ask(1)
    Served("127.0.0.1", port, "", 1, "user").write(fresh.path)
    with serving(fresh.path) as other:
        assert other.url and other.url.partition("?")[0] != server.url.partition("?")[0]


def test_other_machines_get_in_by_address_name_and_allowed_name_only():
    access = served.access_to(Address(host="0.0.0.0", allowed_hosts=("Robot.example",)), 8642, "x")
    guard = Guard(lambda *_: None, access)  # type: ignore[arg-type]
    ours = [
        "10.0.0.7:8642",
        "[2001:db8::1]:8642",
        "robot.example",
        "ROBOT.example:8642",
        "localhost:1234",
        os.uname().nodename,
    ]
    assert all(guard._is_ours(host) for host in ours)
    assert not any(
        guard._is_ours(host) for host in ("evil.example", "robot.example.evil.example", "", "10.0.0.7.evil.example")
    )


def test_the_address_that_is_printed_is_let_in():
    access = served.access_to(Address(host="127.0.0.2"), 8642, "x")
    assert Guard(lambda *_: None, access)._is_ours("127.0.0.2:8642")  # type: ignore[arg-type]


def test_where_a_run_was_is_not_forgotten_when_it_cannot_be_served(fresh: StandIn):
    fresh.ask(1)
    before = Served("127.0.0.1", 9, "kept", 1, "user")
    (fresh.path / "label").mkdir(exist_ok=True)
    before.write(fresh.path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port {port}: Address already in use" in refused(fresh.path, Address(port=port, token="other"))
    assert Served.find(fresh.path) == before
    assert not (fresh.path / "label" / "token").exists()


# What it survives.


def test_nothing_acknowledged_is_lost_or_doubled_when_the_server_is_killed(fresh: StandIn):
    killed = kill_while_posting(fresh, KILLS, seed=0)
    assert killed.kills == KILLS
    assert killed.acknowledged > KILLS and killed.cut_off > KILLS
    assert killed.cut_off > killed.done > 0, "the kills hit only before a post was carried out, or only after"


def test_many_people_at_once_are_never_given_the_same_pair_nor_locked_out(fresh: StandIn):
    people, pairs, sessions = 32, 64, 8
    fresh.ask(pairs)
    given: defaultdict[int, set[str]] = defaultdict(set)
    replies: list[Reply] = []
    begin = threading.Barrier(people + 1)

    def work(name: str, url: str) -> None:
        with Client(url) as client:
            begin.wait(60)
            reply = client.post("/api/next", {"annotator": name})
            replies.append(reply)
            while reply.status == 200 and (pair := reply.data["pair"]):
                given[pair["pair"]].add(name)
                reply = client.answer(name, pair["pair"], "left")
                replies.append(reply)

    with serving(fresh.path) as server:
        threads = [threading.Thread(target=work, args=(f"person {i}", server.url)) for i in range(people)]
        for thread in threads:
            thread.start()
        begin.wait(60)
        for _ in range(sessions):  # the trainer writes meanwhile
            fresh.ask(1)
            fresh.ready()
        for thread in threads:
            thread.join(120)
            assert not thread.is_alive()
        with Client(server.url) as late:  # what was asked after the last had looked
            while pair := late.next("late")["pair"]:
                given[pair["pair"]].add("late")
                assert late.answer("late", pair["pair"], "left").status == 200
    assert Counter(reply.status for reply in replies) == {200: len(replies)}
    assert sorted(given) == list(range(1, pairs + sessions + 1))
    assert all(len(names) == 1 for names in given.values())
    assert [(pair, who) for pair, who, _, _ in fresh.standing()] == [(pair, *given[pair]) for pair in sorted(given)]
    assert fresh.sql("SELECT COUNT(*) FROM answers") == [(pairs + sessions,)]
    assert len({name for names in given.values() for name in names}) > people / 2


def test_no_bytes_make_it_fail(run: StandIn, server: Server, client: Client, clip: str):
    found = throw_bytes(server, client, BYTES, clip, range(1, 6), seed=0)
    assert all(found[status] for status in (200, 400, 401, 403, 404, 422)), found
    with Client(server.url) as again:
        assert again.get("/health").data == {"status": "ok"}
    assert run.sql("PRAGMA integrity_check") == [("ok",)]


def test_nothing_that_the_description_allows_or_forbids_makes_it_fail(run: StandIn, server: Server, client: Client):
    found = follow_description(server, client, DESCRIBED, seed=0)
    assert found.total() >= DESCRIBED
    assert all(found[status] for status in (200, 404, 409, 422)), found
    with Client(server.url) as again:
        assert again.get("/health").data == {"status": "ok"}
    assert run.sql("PRAGMA integrity_check") == [("ok",)]
