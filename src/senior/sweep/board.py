"""The table that a sweep shows while it runs: on a terminal live, else a line whenever a cell is done."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from senior.rundir import status
from senior.sweep.cells import Cell
from senior.sweep.scheduler import Sweep

REDRAW_SECONDS = 2.0
RATE_SECONDS = 600.0
"""The time left is told by the rate of so many seconds."""


class Board:
    """Shows where a sweep stands. ``stop`` is set by whoever handles signals."""

    def __init__(self, out: Path, console: Console | None = None) -> None:
        self.stop = False
        self._out = out
        self._console = console or Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        self._drawn = 0.0
        self._finished = -1
        self._past: deque[tuple[float, int]] = deque()

    def __enter__(self) -> Board:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def say(self, sentence: str) -> None:
        """A line of its own."""
        self._console.print(sentence, markup=False, highlight=False, soft_wrap=True)

    def look(self, sweep: Sweep) -> None:
        """Draw what is new, every two seconds at most."""
        now = time.monotonic()
        settled = len(sweep.finished) + len(sweep.failed)
        if now - self._drawn < REDRAW_SECONDS and settled == self._finished:
            return
        line = self._line(sweep, now)
        if self._live:
            self._live.update(self._table(sweep, line), refresh=True)
        elif settled != self._finished:
            self.say(line)
        self._drawn, self._finished = now, settled

    def _line(self, sweep: Sweep, now: float) -> str:
        taken, steps = sweep.steps_done()
        self._past.append((now, taken))
        while now - self._past[0][0] > RATE_SECONDS:
            self._past.popleft()
        (then, before), left = self._past[0], ""
        if taken > before and now > then:
            rate = (taken - before) / (now - then)
            left = f", {rate:,.0f} steps/s, {timedelta(seconds=round((steps - taken) / rate))} left"
        done = f"{len(sweep.finished)} of {len(sweep.cells)} cells done"
        others = f", {len(sweep.running)} running, {len(sweep.waiting)} waiting" if self._live else ""
        failed = f", {len(sweep.failed)} failed" if sweep.failed else ""
        return f"{done}{others}{failed}{left}"

    def _table(self, sweep: Sweep, line: str) -> Table:
        """A row per directory of seeds, as many as the terminal has room for, those under way first."""
        table = Table(title=line, title_justify="left", title_style="", box=None, pad_edge=False)
        for name in ("cells", "done", "running", "waiting", "failed", "labels", "success"):
            table.add_column(name, justify="left" if name == "cells" else "right", no_wrap=True)
        groups: dict[Path, list[Cell]] = {}
        for cell in sweep.cells:
            groups.setdefault(cell.path.parent, []).append(cell)
        room = max(1, self._console.height - 4)
        stirring = [folder for folder, cells in groups.items() if set(cells) & sweep.running]
        shown = [*stirring, *(folder for folder in groups if folder not in stirring)][:room]
        for folder, cells in ((folder, cells) for folder, cells in groups.items() if folder in shown):
            told = [status(cell.path) for cell in cells]
            success = [one["success"] for one in told if one.get("success") is not None]
            table.add_row(
                str(folder.relative_to(self._out) if folder.is_relative_to(self._out) else folder),
                *(_count(cells, part) for part in (sweep.finished, sweep.running, sweep.waiting, sweep.failed)),
                f"{sum(one.get('labels', 0) for one in told)}/{sum(_budget(cell) for cell in cells)}",
                f"{sum(success) / len(success):.0%}" if success else "-",
            )
        if len(shown) < len(groups):
            table.add_row(f"and {len(groups) - len(shown)} more")
        return table


def _count(cells: Iterable[Cell], part: Iterable[Cell]) -> str:
    return str(len(set(cells) & set(part)) or "-")


def _budget(cell: Cell) -> int:
    return cell.config.queries.budget if cell.config.method.learns_reward else 0
