"""A Ray cluster of two nodes on this machine, each in processes of its own, which asks for a token."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

RAY = Path(sys.executable).with_name("ray")
NODE = ["--num-cpus=1", "--num-gpus=0", "--object-store-memory=100000000", "--disable-usage-stats", "--block"]
PATIENCE = 120.0


class Cluster(NamedTuple):
    """Where it is, and the environment of processes that use it."""

    address: str
    environment: dict[str, str]


@contextmanager
def two_nodes() -> Iterator[Cluster]:
    """One processor each. Ended with everything that runs in them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    folder = Path(tempfile.mkdtemp(prefix="ray-"))  # short: sockets lie in it
    nodes = []
    try:
        head = ["--head", f"--port={port}", "--include-dashboard=false", f"--temp-dir={folder}"]
        for options in (head, [f"--address=127.0.0.1:{port}"]):
            log = open(folder / f"node-{len(nodes)}.log", "w")  # noqa: SIM115
            command = [str(RAY), "start", *options, *NODE]
            nodes.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True))
            log.close()
            _wait_started(nodes[-1], folder / f"node-{len(nodes) - 1}.log")
        yield Cluster(f"127.0.0.1:{port}", environment)
    finally:
        for node in reversed(nodes):
            node.terminate()
        for node in nodes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                node.wait(20)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(node.pid, signal.SIGKILL)
            node.wait()
        shutil.rmtree(folder, ignore_errors=True)


def _wait_started(node: subprocess.Popen[bytes], log: Path) -> None:
    until = time.monotonic() + PATIENCE
    while "Ray runtime started" not in log.read_text():
        assert node.poll() is None and time.monotonic() < until, log.read_text()
        time.sleep(0.2)
