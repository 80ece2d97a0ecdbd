"""Where the labelling page of a run is served, and the process that serves it while the run is trained.

Needs nothing that is not installed by default; `senior.label.server`, which it starts, needs the extra ``label``.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from senior.extras import require
from senior.label.address import Address, shown_host
from senior.processes import PYTHON, importing_alike
from senior.types import BAD_INPUT, BadInput

SERVED = 75
"""Exit code of a server whose run is served by another process already."""
NEEDED = ("fastapi", "jinja2", "uvicorn")


@dataclass(frozen=True)
class Served:
    """Where a page is served, as its server wrote it down."""

    host: str
    port: int
    token: str
    process: int
    owner: str
    """trainer or user: who started the server, and ends it."""
    allowed_hosts: tuple[str, ...] = ()
    """As in `Address`."""

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return f"http://{self.host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def is_at(self, wanted: Address) -> bool:
        """Whether that is where it is."""
        port, token = wanted.port or self.port, self.token if wanted.token is None else wanted.token
        where = shown_host(wanted.host), port, token, wanted.allowed_hosts
        return where == (self.host, self.port, self.token, self.allowed_hosts)

    def write(self, run: Path) -> None:
        """Write it down, for its owner's eyes only."""
        file = run / "label" / "server.json"
        new = file.with_name("server.json.tmp")
        with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as opened:
            json.dump(asdict(self), opened)
        os.replace(new, file)

    @classmethod
    def find(cls, run: Path) -> Served | None:
        """The server that serves or last served a run."""
        try:
            told = json.loads((run / "label" / "server.json").read_text())
            return cls(**{**told, "allowed_hosts": tuple(told.get("allowed_hosts", ()))})
        except (OSError, ValueError, TypeError):
            return None

    @classmethod
    def read(cls, run: Path) -> Served:
        """The server that serves a run now, which may be just about to write itself down."""
        for _ in range(100):
            if found := cls.find(run):
                return found
            time.sleep(0.1)
        raise BadInput(f"Another process serves the run in {run}, but does not say where.")


def check_installed() -> None:
    """`BadInput` if what the server needs is not there."""
    require("The labelling page", "label", *NEEDED)


class Serving:
    """Keeps a run served while it is trained: starts the server, and again whenever it dies.

    A server that is there already, because the trainer was killed and the server was not, or because the user started
    one, is left to serve; but the trainer's is ended where it is not at the address that is wanted now. ``say`` is told
    the address, once.
    """

    def __init__(self, run: Path, address: Address, say: Callable[[str], None]) -> None:
        self.run = run
        self._address = address
        self._say = say
        self._over = threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self._told: str | None = None
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def __enter__(self) -> Serving:
        return self

    def __exit__(self, *_: object) -> None:
        """Give the pages a moment to hear how it ended, and end the server unless the user started it."""
        try:
            self._over.wait(1.5)
        finally:
            self._end()

    def _end(self) -> None:
        self._over.set()
        served = Served.find(self.run)
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        elif served is not None and served.owner == "trainer" and _serves(self.run):
            os.kill(served.process, signal.SIGTERM)
        self._thread.join(10)

    def _keep(self) -> None:
        told = json.dumps({**asdict(self._address), "owner": "trainer"})
        command = [*PYTHON, "-m", "senior.label.server", str(self.run), told]
        folder = self.run / "label"
        folder.mkdir(exist_ok=True)
        complained = ""
        while not self._over.is_set():
            with open(folder / "server.log", "w+") as log:
                self._process = subprocess.Popen(
                    command,
                    env=importing_alike(),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    start_new_session=True,  # an interrupt at the keyboard is the trainer's, which then ends the server
                )
                if self._over.is_set():
                    self._process.terminate()
                assert self._process.stdout is not None
                url = self._process.stdout.readline().strip()
                if url:
                    self._tell(url)
                self._process.communicate()
                log.seek(0)
                complaint = (log.read().strip().splitlines() or ["it said nothing"])[-1]
            if self._over.is_set():
                return
            if self._process.returncode == SERVED:
                self._leave_to_serve(Served.read(self.run))
            elif self._process.returncode == BAD_INPUT:
                self._say(f"The labelling page is not served: {complaint} Serve it with: senior label {self.run}")
                return
            else:
                if self._process.returncode > 0 and complaint != complained:  # else it was killed
                    self._say(f"The labelling page's server ended and is started again: {complaint}")
                    complained = complaint
                self._over.wait(0.5)

    def _leave_to_serve(self, other: Served) -> None:
        """Until another server ends, or this object does."""
        if other.owner == "trainer" and not other.is_at(self._address):
            with suppress(ProcessLookupError):
                os.kill(other.process, signal.SIGTERM)
        else:
            self._tell(other.url)
        while _serves(self.run) and not self._over.wait(0.5):
            pass

    def _tell(self, url: str) -> None:
        if url != self._told:
            self._told = url
            self._say(f"Answer in a browser: {url}")


def _serves(run: Path) -> bool:
    """Whether a server holds the run's lock."""
    import fcntl

    try:
        lock = os.open(run / "label" / "lock", os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False
