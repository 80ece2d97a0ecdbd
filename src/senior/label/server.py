"""The labelling page's server: ``python -m senior.label.server RUN``, beside the run directory. Imports no JAX.

It serves what `senior.label.desk` keeps, and the clips that `senior.label.clips` draws in a process of its own. Nothing
but ``/health`` is told without the token of the printed address, which becomes a strict cookie. One server serves a
run at a time; its address outlives it in ``RUN/label/``, so that a page which lost it finds the next one.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

import uvicorn

from senior.config import Config, load
from senior.label.address import PLAIN, Address, check_address, is_loopback, listening_at, shown_host
from senior.label.app import application
from senior.label.desk import Desk
from senior.label.guard import MOST_BYTES, Access
from senior.label.serving import SERVED, Served
from senior.label.standing import Standing
from senior.preference_file import has_tables
from senior.rundir import told
from senior.types import BAD_INPUT, BadInput

FIRST_PORT = 8642


def standing_of(run: Path, config: Config) -> Standing:
    """What is served of a run."""
    return Standing(run, config, Desk(run / "preferences.sqlite", config.asking.rules))


def access_to(address: Address, port: int, token: str) -> Access:
    """Who is let in at an address."""
    local = is_loopback(address.host)
    own = ("127.0.0.1", "::1") if local else (socket.gethostname(),)
    names = {name.lower() for name in ("localhost", address.host, *own, *address.allowed_hosts)}
    return Access(token, f"senior-{port}", frozenset(names), anywhere=not local)


def _token(folder: Path, wanted: str | None) -> str:
    """The token that is asked for, else that of the run's last server, else a new one; only its owner can read it."""
    file, token = folder / "token", wanted
    if token is None:
        with suppress(OSError, UnicodeDecodeError):
            token = file.read_text().strip()
        if not token or not PLAIN.fullmatch(token):
            token = secrets.token_urlsafe(24)
    with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as opened:
        os.fchmod(opened.fileno(), 0o600)  # it may have been there
        opened.write(token)
    return token


def _bind(address: Address, before: int | None) -> socket.socket:
    """A listening socket: on the wanted port, else on that of the run's last server, else on the first that is free."""
    ports = [address.port] if address.port else [*([before] if before else []), *range(FIRST_PORT, FIRST_PORT + 50), 0]
    for port in ports:
        try:
            return listening_at(address.host, port)
        except OSError as error:
            if address.port or error.errno != errno.EADDRINUSE:
                raise BadInput(f"Cannot listen on {address.host}, port {port}: {error.strerror or error}.") from error
    raise BadInput(f"No port is free on {address.host}.")


def serve(run: Path, address: Address, owner: str) -> Served:
    """Serve a run until SIGINT or SIGTERM. Where another process serves it already, returns at once where that is."""
    folder = run / "label"
    config = load(run / "config.json")
    if config.teacher != "human":
        raise BadInput(f"The run in {run} is answered by {config.teacher}, not by people (--teacher human).")
    if not config.method.learns_reward:
        raise BadInput(f"The run in {run} learns from the true reward; nobody is asked anything.")
    check_address(address)
    with told(folder):
        (folder / "clips").mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        return Served.read(run)
    try:
        return _serve_alone(run, config, address, owner)
    finally:
        os.close(lock)


def _serve_alone(run: Path, config: Config, address: Address, owner: str) -> Served:
    """Serve a run whose lock is held."""
    folder = run / "label"
    before = Served.find(run)
    (folder / "server.json").unlink(missing_ok=True)  # of a server that is gone
    try:
        if owner == "user" and not has_tables(run / "preferences.sqlite"):
            print("The run has not begun; the page is served when it does.", file=sys.stderr)
        while not has_tables(run / "preferences.sqlite"):
            time.sleep(0.2)
        listening = _bind(address, before.port if before else None)
    except BaseException:  # nothing is served, and where it was is the run's own
        if before is not None:
            before.write(run)
        raise
    token, port = _token(folder, address.token), listening.getsockname()[1]
    served = Served(shown_host(address.host), port, token, os.getpid(), owner, address.allowed_hosts)
    served.write(run)
    print(served.url, flush=True)
    access = access_to(address, port, token)
    serving = uvicorn.Config(
        application(standing_of(run, config), access, over=lambda: server.should_exit),
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=2,
        h11_max_incomplete_event_size=MOST_BYTES,
    )
    server = uvicorn.Server(serving)
    server.run(sockets=[listening])
    return served


def main(arguments: list[str]) -> int:
    """The process: its arguments are the run, and an `Address` and the owner as JSON."""
    run, wanted = Path(arguments[0]), json.loads(arguments[1])
    owner = wanted.pop("owner")
    try:
        served = serve(run, Address(**{**wanted, "allowed_hosts": tuple(wanted["allowed_hosts"])}), owner)
    except BadInput as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    return 0 if served.process == os.getpid() else SERVED


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
