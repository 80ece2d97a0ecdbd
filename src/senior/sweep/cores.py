"""A share of this machine's processors for each worker, so that each computes with equally many threads.

A run's last bits depend on how many threads it was computed with, which its ``config.json`` tells. Workers of any sweep
on a machine take processors that no other worker has, by locks that go with the process.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_held: list[int] = []
"""Locks of this process."""


def take_cores(count: int) -> None:
    """Bind this process to ``count`` of the processors that it may use, free ones first. Call it before JAX starts.

    Does nothing where processes cannot be bound (macOS, Windows).
    """
    if fcntl is None or not hasattr(os, "sched_setaffinity"):
        return
    there = sorted(os.sched_getaffinity(0))
    free = [core for core in there if len(_held) < count and _lock(core)]
    others = [core for core in there if core not in free]
    shift = os.getpid() % max(1, len(others))  # all taken: spread
    os.sched_setaffinity(0, (free + others[shift:] + others[:shift])[:count])


def _lock(core: int) -> bool:
    """Hold a processor; False if another process does, or the folder of locks is not ours."""
    assert fcntl is not None
    folder = Path(tempfile.gettempdir()) / f"senior-cores-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if folder.stat(follow_symlinks=False).st_uid != os.getuid():
            return False
        file = os.open(folder / str(core), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        return False
    _held.append(file)
    return True
