"""The live page: a real server process, real requests, and a browser before which it renews itself."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest

from senior.config import Config
from senior.report import watch
from senior.report.watch import Builder, Shown, fingerprint, is_ours, serve
from senior.types import BadInput
from tests.browser import chromium
from tests.many_runs import write_run
from tests.planted import config_of
from tests.stand_in import ROOT

PATIENCE = 120.0
"""Seconds that anything may take: the machine may be busy."""
PROGRAM = """
import sys
from pathlib import Path
from senior.report import watch
watch.REST = watch.LOOK_SECONDS = 0.2
watch.serve([Path(place) for place in sys.argv[1:]], least=0.2)
print("ended")
"""


class Watching:
    """A server in a process of its own, and a client of it."""

    def __init__(self, process: subprocess.Popen[str], url: str, client: httpx.Client) -> None:
        self.process, self.url, self.client = process, url, client

    def get(self, path: str = "/", **how: Any) -> httpx.Response:
        return self.client.get(path, **how)

    def version(self) -> dict[str, str]:
        return self.get("/version").json()

    def wait(self, condition: Callable[[dict[str, str]], bool]) -> dict[str, str]:
        """Until that is so of the version."""
        until = time.monotonic() + PATIENCE
        while not condition(now := self.version()):
            assert time.monotonic() < until, now
            time.sleep(0.1)
        return now


@contextmanager
def watching(*places: Path, folder: Path) -> Iterator[Watching]:
    """Serve the runs below the places; what the server writes goes below ``folder``."""
    folder.mkdir(exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *map(str, places)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(folder)},
    )
    try:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], PATIENCE)[0], "no address was printed"
        url = process.stdout.readline().strip()
        with httpx.Client(base_url=url, timeout=PATIENCE) as client:
            yield Watching(process, url, client)
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait(PATIENCE)
        process.stdout and process.stdout.close()


def add_run(place: Path, config: Config | None = None, until: int = 20_000) -> Path:
    """A run under way."""
    config = config or config_of("mrn")
    return write_run(place / f"{config.method.name}-{config.seed}", config, files=("eval.csv",), until=until)


def grow(run: Path, step: int) -> None:
    """Another evaluation, as the trainer writes it."""
    with open(run / "eval.csv", "a") as file:
        file.write(f"{step},250,250,10,0.9,3000,10\n")


def test_the_page_follows_the_runs_from_none_to_many(tmp_path: Path):
    runs = tmp_path / "runs"
    runs.mkdir()
    with watching(runs, folder=tmp_path / "temporary") as server:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", server.url)
        server.wait(lambda now: "There is no run" in now["trouble"])
        assert str(runs) in server.get().text
        assert 'src="/watch.js"' in server.get().text

        begun = write_run(runs / "begun", config_of("pebble"), files=())
        server.wait(lambda now: "eval.csv is missing" in now["trouble"])
        first = add_run(runs)
        one = server.wait(lambda now: not now["trouble"])
        page = server.get()
        assert "1 run of 1 arm on door-lock" in page.text and f'data-version="{one["version"]}"' in page.text
        assert server.get("/figures/door-lock-steps-mean.png").content.startswith(b"\x89PNG")

        add_run(runs / "deeper", replace(config_of("mrn"), seed=7))
        two = server.wait(lambda now: now["version"] != one["version"])
        assert "2 runs of 1 arm on door-lock" in server.get().text
        grow(first, 30_000)
        server.wait(lambda now: now["version"] != two["version"])

        last = server.get().text
        for path in (first / "eval.csv", runs / "deeper" / "mrn-7" / "eval.csv", begun / "config.json"):
            path.unlink()
        server.wait(lambda now: "There is no run" in now["trouble"])
        assert server.get().text == last  # the last page stands


def test_it_only_shows_and_only_to_this_machine(tmp_path: Path):
    runs = tmp_path / "runs"
    add_run(runs)
    (tmp_path / "secret").write_text("not for you")
    with watching(runs, folder=tmp_path / "temporary") as server:
        server.wait(lambda now: not now["trouble"])
        page = server.get()
        policy = page.headers["content-security-policy"]
        (digest,) = re.findall(r"'sha256-[^']+'", policy)
        assert policy == (
            f"default-src 'none'; script-src 'self'; style-src 'self' {digest}; img-src 'self' data:; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        for path in ("/", "/version", "/watch.js", "/figures/door-lock-steps-mean.svg", "/nothing"):
            reply = server.get(path)
            assert reply.headers["x-frame-options"] == "DENY" and reply.headers["cache-control"] == "no-store"
            assert reply.headers["cross-origin-resource-policy"] == "same-origin"
            for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
                assert server.client.request(method, path).status_code == 405
            for host in (
                "evil.example",
                "evil.example:80",
                "127.0.0.1.evil.example",
                "10.0.0.1",
                "",
                "[",
                "localhost@evil",
            ):
                refused = server.get(path, headers={"host": host})
                assert refused.status_code == 403 and "SENIOR" not in refused.text
        assert server.get("/", headers={"host": "localhost:1"}).status_code == 200
        for path in (
            "/../secret",
            "/%2e%2e/secret",
            "/..%2f..%2fsecret",
            f"/{tmp_path}/secret",
            "//etc/passwd",
            "/figures",
        ):
            assert server.get(path).status_code == 404
        links = re.findall(r'href="((?:figures|tables)/[^"]+)"', page.text)
        assert len(links) > 8
        for link in links:
            assert server.get(f"/{link}").status_code == 200


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_cleanly_in_the_midst_of_building(tmp_path: Path, number: signal.Signals):
    add_run(tmp_path / "runs")
    folder = tmp_path / "temporary"
    with watching(tmp_path / "runs", folder=folder) as server:
        server.get()  # the first building is under way
        assert any(folder.iterdir())
        began = time.monotonic()
        server.process.send_signal(number)
        assert server.process.wait(PATIENCE) == 0
        assert time.monotonic() - began < 20
        assert server.process.stdout is not None and server.process.stdout.read() == "ended\n"
        assert not list(folder.glob("senior-watch-*"))


def test_what_cannot_be_served_is_told(tmp_path: Path):
    with pytest.raises(BadInput, match="There is no directory"):
        serve([tmp_path / "nothing"])
    with pytest.raises(BadInput, match="--port 99999 must be between 0 and 65535"):
        serve([tmp_path], port=99999)
    with pytest.raises(BadInput, match=r"Cannot listen on nowhere\.invalid"):
        serve([tmp_path], host="nowhere.invalid")


@pytest.mark.parametrize(
    ("asked", "host", "expected"),
    [
        ("127.0.0.1:8000", "127.0.0.1", True),
        ("localhost", "127.0.0.1", True),
        ("LOCALHOST:80", "127.0.0.1", True),
        ("[::1]:80", "::1", True),
        ("192.168.0.7:80", "127.0.0.1", False),
        ("192.168.0.7:80", "0.0.0.0", True),
        ("evil.example", "0.0.0.0", False),
        ("evil.example", "lab.example", False),
        ("lab.example:80", "lab.example", True),
        ("", "127.0.0.1", False),
        ("[", "127.0.0.1", False),
    ],
)
def test_names_of_this_machine(asked: str, host: str, expected: bool):
    assert is_ours(asked, host) == expected


# What makes a new page, and how often.


def test_the_fingerprint_changes_when_a_file_of_a_run_does(tmp_path: Path):
    run = add_run(tmp_path)
    (tmp_path / "back").symlink_to(tmp_path)
    seen = {fingerprint([tmp_path])}
    changes: list[Callable[[], object]] = [
        lambda: grow(run, 30_000),
        lambda: (run / "train.csv").write_text("step\n"),
        lambda: add_run(tmp_path / "a" / "b", config_of("pebble")),
        lambda: (run / "bonus").mkdir(),
        lambda: (run / "bonus" / "step-0000010000.npz").write_bytes(b""),
        lambda: (run / "eval.csv").unlink(),
    ]
    for number, change in enumerate(changes, 2):
        change()
        seen.add(fingerprint([tmp_path]))
        assert len(seen) == number
    (tmp_path / "config.json").write_text('{"mine": 1}')  # of another program, above the runs
    assert fingerprint([tmp_path]) in seen
    (tmp_path / "notes.txt").write_text("nothing to do with it")
    (run / "checkpoints").mkdir()
    assert fingerprint([tmp_path]) in seen
    assert fingerprint([tmp_path, tmp_path]) in seen  # each once


@contextmanager
def building(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str, least: float = 0.05
) -> Iterator[tuple[Builder, Path]]:
    """A builder whose building process is a shell script; it is given where to write as ``$3``."""
    program, place = tmp_path / "program", tmp_path / "place"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    place.mkdir()
    monkeypatch.setattr(watch, "LOOK_SECONDS", 0.02)
    monkeypatch.setattr(watch, "PYTHON", [str(program)])
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    builder = Builder([place], least)
    try:
        yield builder, place
    finally:
        builder.close()


def until(builder: Builder, condition: Callable[[Shown], bool]) -> Shown:
    end = time.monotonic() + PATIENCE
    while not condition(shown := builder.shown):
        assert time.monotonic() < end
        time.sleep(0.01)
    return shown


def test_it_rests_three_times_as_long_as_it_builds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    log = tmp_path / "log"
    log.touch()
    Path(f"{log}.times").touch()
    script = f'echo >> {log}; date +%s.%N >> {log}.times; sleep 0.3; mkdir -p "$3"; cp {log} "$3/page"; echo "$3/page"'
    with building(monkeypatch, tmp_path, script) as (_, place):
        run = add_run(place)
        end, step, times = time.monotonic() + PATIENCE, 30_000, []
        while len(times) < 4:
            assert time.monotonic() < end
            grow(run, step := step + 1)
            time.sleep(0.05)
            times = [float(line) for line in Path(f"{log}.times").read_text().split()]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert min(gaps) > 1.1


def test_without_a_change_nothing_is_built_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    log = tmp_path / "log"
    script = f'echo >> {log}; mkdir -p "$3"; echo "<head></head>" > "$3/page"; echo "$3/page"'
    with building(monkeypatch, tmp_path, script) as (builder, _):
        until(builder, lambda shown: shown.folder is not None)
        time.sleep(1)
        assert log.read_text() == "\n"


def test_a_report_that_fails_is_told_and_the_next_one_is_tried(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    flag = tmp_path / "flag"
    fails = f'test -e {flag} || {{ echo "ValueError: <b>no" >&2; exit 1; }}'
    script = f'{fails}\nmkdir -p "$3"; echo "<head></head>fine" > "$3/page"; echo "$3/page"'
    with building(monkeypatch, tmp_path, script) as (builder, place):
        shown = until(builder, lambda shown: "failed" in shown.trouble)
        assert shown.trouble == "The report failed: ValueError: <b>no" and "&lt;b&gt;no" in shown.text
        flag.touch()
        run = add_run(place)
        fine = until(builder, lambda shown: not shown.trouble)
        assert fine.text.endswith("</head>fine\n")
        flag.unlink()
        grow(run, 30_000)
        kept = until(builder, lambda shown: bool(shown.trouble))
        assert kept == replace(fine, trouble="The report failed: ValueError: <b>no")
        kept_folders = [folder.name for folder in tmp_path.glob("senior-watch-*/*")]
        assert fine.folder is not None and fine.folder.name in kept_folders
        flag.touch()
        with monkeypatch.context() as patch:
            patch.setattr(watch, "PYTHON", [str(tmp_path / "nowhere")])  # as where there is no room for a process
            grow(run, 30_001)
            until(builder, lambda shown: "FileNotFoundError" in shown.trouble)
        until(builder, lambda shown: not shown.trouble)
    assert "ValueError: <b>no" in capfd.readouterr().err


# In a browser.


def test_a_browser_shows_the_newer_page_by_itself_where_it_was(tmp_path: Path):
    runs = tmp_path / "runs"
    run = add_run(runs)
    with chromium() as browser, watching(runs, folder=tmp_path / "temporary") as server:
        complaints: list[str] = []
        page = browser.new_page(viewport={"width": 1000, "height": 500})
        page.set_default_timeout(1000 * PATIENCE)
        page.on("console", lambda said: said.type in ("error", "warning") and complaints.append(said.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(server.url)  # perhaps before there is a page
        page.wait_for_selector("#watch:has-text('Live, as of')")
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
        color = page.evaluate("getComputedStyle(document.querySelector('nav')).borderRadius")
        assert color == "8px"  # the page's own style is let in
        page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
        page.evaluate("scrollTo(0, 700); document.body.dataset.before = ''")
        folded = page.evaluate("document.querySelectorAll('details').length")

        grow(run, 30_000)
        page.wait_for_selector("body:not([data-before]) #watch:has-text('Live, as of')")
        assert page.evaluate("scrollY") == 700
        assert page.evaluate("document.querySelectorAll('details[open]').length") == folded
        assert server.version()["version"] == page.evaluate("document.querySelector('script').dataset.version")

        (run / "eval.csv").unlink()
        page.wait_for_selector("#watch:has-text('Not up to date: There is no run')")
        assert not complaints
        server.process.send_signal(signal.SIGINT)
        page.wait_for_selector("#watch:has-text('has ended')")
        page.close()
