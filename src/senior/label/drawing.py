"""Keeps the clip process of a run alive."""

from __future__ import annotations

import subprocess
import threading
import time
from pathlib import Path

from senior.processes import PYTHON, importing_alike


class Drawing:
    """The clip process, started anew whenever it dies. It ends when its standard input does."""

    def __init__(self, run: Path) -> None:
        self.run = run
        self._over = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._over.set()
        if self._process is not None:
            self._process.terminate()
        self._thread.join(10)

    def _keep(self) -> None:
        pause = 1.0
        while not self._over.is_set():
            began = time.monotonic()
            command = [*PYTHON, "-m", "senior.label.clips", str(self.run)]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, env=importing_alike())
            if self._over.is_set():
                self._process.terminate()
            self._process.wait()
            pause = 1.0 if time.monotonic() - began > 60 else min(2 * pause, 30.0)
            self._over.wait(pause)
