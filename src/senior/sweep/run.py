"""A sweep from beginning to end: one at a time in a directory, with the workers it is given."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from senior.files import hold
from senior.rundir import told
from senior.sweep.cells import Cell, check_cells
from senior.sweep.local import LocalCrew
from senior.sweep.scheduler import Spectator, Sweep
from senior.types import BadInput


def run(
    cells: Sequence[Cell], out: Path, spectator: Spectator, jobs: int | None = None, ray: str | None = None
) -> Sweep:
    """Train all cells that are not finished; returns where each stands.

    out: directory of the sweep, for its logs and its lock. jobs: workers on this machine; None: what suits it.
    ray: the address of a Ray cluster to use instead. Raises `BadInput` before anything runs if a cell makes no sense,
    a directory holds another run, or another sweep is at work in ``out``.
    """
    if jobs is not None and not 1 <= jobs <= 1024:
        raise BadInput(f"--jobs {jobs} must be between 1 and 1024.")
    check_cells(cells)
    sweep = Sweep(cells)
    if not sweep.waiting:
        return sweep
    with told(out):
        out.mkdir(parents=True, exist_ok=True)
    with _alone(out):
        if ray is not None:
            from senior.sweep.cluster import RayCrew

            crew = RayCrew(ray, cells[0].config.device, jobs, out, spectator.say)
        else:
            crew = LocalCrew(cells[0].config.device, jobs, out / "logs")
        try:
            sweep.run(crew, spectator)
        except KeyboardInterrupt:  # impatient: the workers see that nobody is there, save, and end
            raise
        except BaseException:
            crew.close()
            raise
        crew.close()
    return sweep


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Keep other sweeps out of a directory."""
    try:
        lock = hold(out)
    except BlockingIOError:
        raise BadInput(f"Another sweep is at work in {out}.") from None
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)
