"""The report page while runs train: ``senior watch RUN...`` serves it on this machine.

The files of the runs are looked at every two seconds. Where some have changed, `senior.report.build` makes the page
anew, in a process of its own with low priority, and rests at least three times as long as that took. A browser that
shows the page loads the new one by itself and stays where it was. Runs that appear below the places later are taken
in. Nothing can be changed through the page, and nothing is told under a name that is not this machine's.
"""

from __future__ import annotations

import base64
import hashlib
import html
import ipaddress
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from senior.label.address import is_loopback, listening_at
from senior.label.guard import SEALED
from senior.processes import PYTHON, importing_alike
from senior.rundir import is_run
from senior.types import BAD_INPUT, BadInput

LOOK_SECONDS = 2.0
LEAST_SECONDS = 5.0
"""Between the end of one building and the beginning of the next."""
REST = 3.0
"""And so many times as long as the last one took."""
FILES = (
    "config.json",
    "eval.csv",
    "train.csv",
    "timing.csv",
    "positions.npz",
    "preferences.sqlite",
    "preferences.sqlite-wal",
    "bonus",
)
"""Of a run, whose change changes the page."""
SCRIPT = Path(__file__).with_name("watch.js")
FILE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
"""Of drawings, which have a style on every line, when they are opened by themselves."""
HEADERS = {**SEALED, "Cache-Control": "no-store"}


@dataclass(frozen=True)
class Shown:
    """What is served now."""

    text: str
    """The page, with the script that loads a newer one."""
    version: str
    """Of the page; another one has another."""
    policy: str
    """Its Content-Security-Policy: its own styles and scripts, letter for letter, ours, and nothing else."""
    folder: Path | None = None
    """What the report wrote beside the page; None while there is no page yet."""
    built: str = ""
    """When, by the clock."""
    trouble: str = ""
    """Why the latest state of the runs is not shown; empty if it is."""


def _shown(text: str, folder: Path | None, built: str = "", trouble: str = "") -> Shown:
    """A page, made one that renews itself."""
    version = hashlib.sha256(text.encode()).hexdigest()[:16]
    script = f'<link rel="icon" href="data:,"><script src="/watch.js" data-version="{version}" defer></script>\n'
    head, found, rest = text.partition("</head>")
    own = {kind: "".join(f" 'sha256-{digest}'" for digest in _digests(kind, text)) for kind in ("script", "style")}
    policy = (
        f"default-src 'none'; script-src 'self'{own['script']}; style-src 'self'{own['style']}; img-src 'self' data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return Shown(head + script + found + rest, version, policy, folder, built, trouble)


def _digests(kind: str, text: str) -> list[str]:
    """Of what stands within the page's style or script elements, as a policy names it."""
    inside = re.findall(rf"<{kind}\b[^>]*>(.*?)</{kind}>", text, re.DOTALL)
    return [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in inside]


def _notice(sentence: str) -> Shown:
    """What is shown while there is no page."""
    text = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>SENIOR: no page yet</title></head>'
        f"<body><h1>There is no page yet</h1><p>{html.escape(sentence)}</p>"
        "<p>It will be shown here as soon as there is one.</p></body></html>\n"
    )
    return _shown(text, None, trouble=sentence)


class Builder:
    """Keeps the page up to date, in a thread, until it is closed."""

    def __init__(self, places: Sequence[Path], least: float = LEAST_SECONDS) -> None:
        """``least``: seconds between buildings. Everything that is written goes into a folder that goes with it."""
        self.places = list(places)
        self.shown = _notice("The page is being built for the first time.")
        self._least = least
        self._folder = Path(tempfile.mkdtemp(prefix="senior-watch-"))
        self._count = 0
        self._over = threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it, the building that is under way too."""
        self._over.set()
        if self._process is not None:
            self._process.terminate()
        self._thread.join(10)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _keep(self) -> None:
        known, rest = None, 0.0
        while not self._over.is_set():
            began = time.monotonic()
            try:
                now = fingerprint(self.places)
                if now != known and rest <= 0:
                    self._build()
                    known, rest = now, max(self._least, REST * (time.monotonic() - began))
            except Exception as error:  # no memory for a process, and whatever else may pass
                self._tell(f"The report failed: {type(error).__name__}: {error}")
                known, rest = None, self._least
            pause = LOOK_SECONDS if rest <= 0 else min(rest, LOOK_SECONDS)
            self._over.wait(pause)
            rest -= pause

    def _build(self) -> None:
        """Make the page once; what cannot be shown leaves the last one standing."""
        self._count += 1
        out, before = self._folder / str(self._count), self.shown
        command = [*PYTHON, "-m", "senior.report.watch", str(out), *map(str, self.places)]
        # a session of its own: it is ended by us, not by the keyboard's interrupt
        self._process = subprocess.Popen(
            command,
            env=importing_alike(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        if self._over.is_set():
            self._process.terminate()
        page, said = self._process.communicate()
        if self._over.is_set():
            return
        if self._process.returncode == 0:
            text = Path(page.splitlines()[-1]).read_text()
            self.shown = _shown(text, out, time.strftime("%H:%M:%S"))
        else:
            last = said.strip().splitlines()[-1] if said.strip() else f"code {self._process.returncode}"
            expected = self._process.returncode == BAD_INPUT
            if not expected:
                print(said, file=sys.stderr, end="")
            self._tell(last if expected else f"The report failed: {last}")
        for folder in self._folder.iterdir():
            if folder not in (self.shown.folder, before.folder):  # somebody may be reading the one before
                shutil.rmtree(folder, ignore_errors=True)

    def _tell(self, why: str) -> None:
        """What keeps a newer page from being there."""
        self.shown = _notice(why) if self.shown.folder is None else replace(self.shown, trouble=why)


def fingerprint(places: Sequence[Path]) -> tuple[tuple[str, int, int], ...]:
    """What changes when a file of a run at or below the places does: names, times and sizes."""
    found, seen = [], set()
    for place in places:
        for folder, folders, _ in os.walk(place, followlinks=True):
            own = os.path.realpath(folder)
            if own in seen:  # a link may lead back
                folders.clear()
                continue
            seen.add(own)
            if not is_run(Path(folder)):
                folders.sort()
                continue
            folders.clear()  # no run lies within another
            for name in FILES:
                path = os.path.join(folder, name)
                try:
                    told = os.stat(path)
                except OSError:  # not there yet, or no more
                    continue
                found.append((path, told.st_mtime_ns, told.st_size))
    return tuple(found)


def application(builder: Builder, host: str) -> Starlette:
    """The server: the page, what lies beside it, and the script that asks whether there is a newer one."""

    def page(_: Request) -> Response:
        shown = builder.shown
        return HTMLResponse(shown.text, headers={"Content-Security-Policy": shown.policy})

    def version(_: Request) -> Response:
        shown = builder.shown
        return JSONResponse({"version": shown.version, "built": shown.built, "trouble": shown.trouble})

    def script(_: Request) -> Response:
        return FileResponse(SCRIPT, media_type="text/javascript")

    def beside(request: Request) -> Response:
        folder = builder.shown.folder
        if folder is not None:
            file = (folder / request.path_params["name"]).resolve()
            if file.is_file() and file.is_relative_to(folder.resolve()):
                return FileResponse(file, headers={"Content-Security-Policy": FILE_POLICY})
        return PlainTextResponse("There is no such file.", 404)

    app = Starlette(
        routes=[
            Route("/", page),
            Route("/version", version),
            Route("/watch.js", script),
            Route("/{name:path}", beside),
        ]
    )
    app.add_middleware(Guard, host=host)
    return app


class Guard:
    """Lets in who asks under a name of this machine, and puts the headers on what goes out.

    A page of another site can make a browser ask here under that site's name; it is told nothing.
    """

    def __init__(self, app: ASGIApp, host: str) -> None:
        self.app = app
        self.host = host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
            await send(message)

        if is_ours(Request(scope).headers.get("host", ""), self.host):
            await self.app(scope, receive, send_guarded)
        else:
            refusal = PlainTextResponse("This page is not served under that name.", 403)
            await refusal(scope, receive, send_guarded)


def is_ours(asked: str, host: str) -> bool:
    """Whether a ``Host`` header names this machine, when it is listened on ``host``."""
    try:
        name = urlsplit(f"//{asked}").hostname or ""
    except ValueError:
        return False
    if name in ("localhost", "127.0.0.1", "::1", host.lower()):
        return True
    if is_loopback(host):
        return False
    try:  # an address cannot be another site's name for this machine
        ipaddress.ip_address(name)
    except ValueError:
        return name == socket.gethostname().lower()
    return True


def serve(places: Sequence[Path], host: str = "127.0.0.1", port: int = 0, least: float = LEAST_SECONDS) -> None:
    """Serve the page of all runs at or below the places, until SIGINT or SIGTERM. Call it from the main thread.

    port: 0: any that is free. least: seconds between two buildings of the page. Prints the address. Raises `BadInput`
    if a place is not there or the address cannot be listened on.
    """
    if not 0 <= port < 2**16:
        raise BadInput(f"--port {port} must be between 0 and 65535.")
    for place in places:
        if not place.is_dir():
            raise BadInput(f"{place} is no directory." if place.exists() else f"There is no directory {place}.")
    try:
        listening = listening_at(host, port)
    except OSError as error:
        raise BadInput(f"Cannot listen on {host}, port {port}: {error.strerror or error}.") from error
    shown = f"[{host}]" if ":" in host else host
    builder = Builder(places, least)
    config = uvicorn.Config(
        application(builder, host),
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=2,
    )
    server = uvicorn.Server(config)

    def stop(number: int, frame: FrameType | None) -> None:
        server.should_exit = True

    # uvicorn raises the signal that ended it again when it has closed everything
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        print(f"http://{shown}:{listening.getsockname()[1]}/", flush=True)
        if not is_loopback(host):
            print(f"It asks for no token: whoever reaches {socket.gethostname()} can read it.", flush=True)
        server.run(sockets=[listening])
    finally:
        builder.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def main(arguments: Sequence[str]) -> int:
    """The building process: its arguments are where to write and the places. Prints where the page is."""
    from senior.report import build  # brings what draws, which the server does not need

    out, *places = map(Path, arguments)
    if sys.platform != "win32":
        os.nice(10)  # training comes first
    try:
        print(build.report(places, out, unfinished=True).page)
    except BadInput as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
