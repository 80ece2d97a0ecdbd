"""A small run killed with SIGKILL at random moments, again and again, and resumed until it is done, equals the
uninterrupted one bit for bit. PROVE_KILLS tells how many kills there are in all, PROVE_SEED draws other moments.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from senior.program import train
from senior.rundir import saved_steps
from tests.equal import OPTIONS, assert_same_run, short

ROOT = Path(__file__).parents[1]
KILLS = int(os.environ.get("PROVE_KILLS", "1000"))
SEED = int(os.environ.get("PROVE_SEED", "0"))
EARLY = 0.15
"""Share of the kills that may come before training has begun; most of a process is its start."""


def size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def begin(run: Path) -> "subprocess.Popen[bytes]":
    """Start the run, or resume it; a directory that was killed before it was a run is made anew."""
    if (run / "config.json").exists():
        arguments = ["resume", str(run)]
    else:
        shutil.rmtree(run, ignore_errors=True)
        arguments = ["train", *OPTIONS, "--out", str(run.parent)]
    command = [sys.executable, "-m", "senior.cli", *arguments]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def wait(child: "subprocess.Popen[bytes]", table: Path, early: bool, delay: float) -> None:
    """Until a while after the child started, or after it finished its first episode; or until it ends."""
    before, until = size(table), time.monotonic() + delay if early else None
    while child.poll() is None and (until is None or time.monotonic() < until):
        # resuming cuts the table, so that it may be shorter first
        before = min(before, size(table))
        if until is None and size(table) > before:
            until = time.monotonic() + delay
        time.sleep(0.002)


@pytest.mark.timeout(24 * 3600)
def test_killed_at_random_moments(tmp_path: Path):
    rng = np.random.default_rng(SEED)
    (whole,) = train(short(device="cpu"), tmp_path / "whole")
    began = time.monotonic()
    train(short(device="cpu"), tmp_path / "again")
    seconds = time.monotonic() - began
    kills = runs = early_kills = 0
    at: list[int] = []
    while kills < KILLS:
        run = tmp_path / "killed" / "seed-0"
        finished = False
        while not finished:
            child = begin(run)
            if kills < KILLS:
                early = bool(rng.random() < EARLY)
                wait(child, run / "train.csv", early, rng.uniform(0, 5 if early else seconds))
                child.kill()
                early_kills += early
            _, complaint = child.communicate()
            finished = child.returncode == 0
            kills += child.returncode == -signal.SIGKILL
            assert child.returncode in (0, -signal.SIGKILL), complaint.decode()
            at += saved_steps(run / "checkpoints")[:1]
        assert_same_run(run, whole.path, interrupted=True)
        shutil.rmtree(run)
        runs += 1
        print(f"{kills} kills, {early_kills} of them early; {runs} runs equal the uninterrupted one", flush=True)
    assert kills == KILLS
    assert len(set(at)) > min(3, KILLS // 10), "the kills hit one part of the run only"
