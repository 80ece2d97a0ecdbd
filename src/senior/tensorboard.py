"""TensorBoard's copy of a run's tables.

It is written at once. tensorboardX's own `SummaryWriter` hands what it is given to a thread, which dies of a full disk;
whoever hands it more then waits for ever.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.summary import scalar


class Board:
    """An event file in ``folder``. ``purge``: what was written of that step and later ones counts no more."""

    def __init__(self, folder: Path, purge: int | None = None) -> None:
        folder.mkdir(exist_ok=True)
        self._events = EventsWriter(str(folder / "events"))
        if purge is not None:
            self._write(step=purge, session_log=SessionLog(status=SessionLog.START))

    def add(self, numbers: Mapping[str, float | None], step: int) -> None:
        """Numbers of a step, each a curve of its own; what is None has none. A full disk is told by others."""
        with suppress(OSError):
            for name, value in numbers.items():
                if value is not None:
                    self._write(step=step, summary=scalar(name, float(value)))
            self._events.flush()

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):
            self._events.close()

    def _write(self, **content: Any) -> None:
        self._events.write_event(Event(wall_time=time.time(), **content))
