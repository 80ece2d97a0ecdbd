"""A sweep on two Ray nodes of which one loses its worker every minute, and the same sweep undisturbed.

PROVE_STEPS tells how long each of the four runs of door-close is. What came of it is printed with the machine and the
command (ARGS=-s shows it), to be kept.
"""

from __future__ import annotations

import os
import platform
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from senior.cli.shared import DONE
from senior.rundir import is_finished, status
from tests.cluster import two_nodes
from tests.equal import assert_same_run

STEPS = int(os.environ.get("PROVE_STEPS", "30000"))
EVERY = 60.0
"""Seconds between two kills."""
SWEEP = (
    "sweep --task door-close --method m-senior pebble --seed 0 1 --preset quick --checkpoint-every 1000 --device cpu"
)


@pytest.mark.timeout(4 * 3600)
def test_a_worker_is_killed_every_minute(tmp_path: Path):
    arguments = [*SWEEP.split(), "--steps", str(STEPS)]
    program = [sys.executable, "-m", "senior.cli", *arguments]
    quiet = tmp_path / "undisturbed"
    assert subprocess.run([*program, "--out", quiet, "--jobs", "2"]).returncode == DONE
    out, kills, draw, began = tmp_path / "out", 0, random.Random(0), time.monotonic()
    runs = [out / "door-close" / method / f"seed-{seed}" for method in ("m-senior", "pebble") for seed in (0, 1)]
    with two_nodes() as cluster:
        sweep = subprocess.Popen([*program, "--out", out, "--ray", cluster.address], env=cluster.environment)
        while sweep.poll() is None:
            time.sleep(EVERY)
            under_way = [run for run in runs if status(run) and not is_finished(run)]
            if under_way and sweep.poll() is None:
                kills += 1
                try:
                    os.kill(status(draw.choice(under_way))["process"], signal.SIGKILL)
                except ProcessLookupError:  # it waits for its turn after an earlier kill
                    kills -= 1
    assert sweep.returncode == DONE
    for run in runs:
        assert_same_run(run, quiet / run.relative_to(out), interrupted=True)
    assert kills > 1, "make the runs longer"
    print(
        f"\n{len(runs)} runs of {STEPS:,} steps on two Ray nodes, {kills} workers killed, a minute apart: all "
        f"finished, equal to the undisturbed sweep, bit for bit; {time.monotonic() - began:,.0f} s\n"
        f"  {platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"PROVE_STEPS={STEPS}: senior {' '.join(arguments)}"
    )
