"""A report on the paper's whole study: 8 methods, 6 tasks and 5 seeds of a million steps, in 60 seconds and 1 GB.

The runs were not trained (`tests.many_runs`) and have the files and sizes of those that are: 100 evaluations, 2,000
episodes, up to 1,000 pairs of segments, 20 snapshots. They take 2 GB of disk while the proof runs. What came of it is
printed with the machine (ARGS=-s shows it), to be kept.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from pathlib import Path

from tests.many_runs import paper_grid

SECONDS, MEGABYTES = 60, 1000


def test_a_report_on_240_runs(tmp_path: Path):
    began = time.monotonic()
    runs = sum(1 for _ in paper_grid(tmp_path / "runs"))
    assert runs == 240
    size = sum(file.stat().st_size for file in (tmp_path / "runs").rglob("*") if file.is_file())
    print(f"\n{runs} runs of {size / 1e9:.1f} GB made in {time.monotonic() - began:.0f} s", flush=True)

    out = tmp_path / "report"
    began = time.monotonic()
    command = [sys.executable, "-m", "senior.cli", "report", str(tmp_path / "runs"), "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        said = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds, megabytes = time.monotonic() - began, used.ru_maxrss / (1000 if sys.platform == "linux" else 1e6)

    assert process.returncode == 0, said
    page = (out / "index.html").stat().st_size
    figures = len(list((out / "figures").glob("*.svg")))
    print(
        f"{said}reported in {seconds:.1f} s ({used.ru_utime + used.ru_stime:.1f} s of a processor) and "
        f"{megabytes:,.0f} MB at most: a page of {page / 1e6:.1f} MB, {figures} figures\n"
        f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}",
        flush=True,
    )
    assert figures > 30
    assert seconds < SECONDS
    assert megabytes < MEGABYTES
