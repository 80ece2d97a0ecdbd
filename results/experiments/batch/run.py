"""M-SENIOR with PGE's batch and without its bonus, stopped at step 45,000: ``python run.py OUT CORE SEED...``."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from senior import program
from senior.sweep import grid
from senior.trainee import Trainee

GRID = {"arm": ["m-senior --pge.beta 0"], "task": ["door-close"], "preset": ["quick"], "steps": ["100000"]}


class StopsAt(program.Quiet):
    """Says stop at a step."""

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        self.stop = step >= 45_000


if __name__ == "__main__":
    out, core, *seeds = sys.argv[1:]
    os.sched_setaffinity(0, {int(core)})  # as a sweep binds its workers
    for seed in seeds:
        [cell] = grid.cells_of({**GRID, "device": ["cpu"], "seed": [seed]}, Path(out))
        program.train_all([(cell.config, cell.path)], StopsAt())
