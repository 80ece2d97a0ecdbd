"""The labelling page's server killed a thousand times in a stream of posts, and sent 20,000 requests of all kinds.

PROVE_KILLS and PROVE_REQUESTS tell how many, PROVE_SEED draws others. What came of it is printed with the machine and
the command (ARGS=-s shows it), to be kept.
"""

from __future__ import annotations

import os
import platform
import shlex
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from tests.siege import follow_description, kill_while_posting, throw_bytes
from tests.stand_in import Client, StandIn, serving

KILLS = int(os.environ.get("PROVE_KILLS", "1000"))
REQUESTS = int(os.environ.get("PROVE_REQUESTS", "20000"))
SEED = int(os.environ.get("PROVE_SEED", "0"))
AT_ONCE = 500
"""Requests to one server before another run and server are taken, so that no run is worn out."""


def report(what: str, began: float) -> None:
    """Print what came of it, so that it can be kept."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    settings = f"PROVE_KILLS={KILLS} PROVE_REQUESTS={REQUESTS} PROVE_SEED={SEED}"
    print(
        f"\n{what}\n  in {time.monotonic() - began:,.0f} s, {machine}\n  {settings} {shlex.join(sys.argv)}", flush=True
    )


@pytest.mark.timeout(24 * 3600)
def test_killed_in_a_stream_of_posts(tmp_path: Path):
    began = time.monotonic()
    with StandIn(tmp_path / "run", capacity=12 * KILLS) as run:
        killed = kill_while_posting(run, KILLS, SEED, lambda so_far: print(so_far, flush=True))
    assert killed.kills == KILLS and killed.acknowledged > KILLS
    assert killed.cut_off > killed.done > 0, "the kills hit only before a post was carried out, or only after"
    report(
        f"{KILLS:,} kills: of {killed.acknowledged:,} acknowledged posts 0 lost, 0 doubled; of {killed.cut_off:,} "
        f"cut off {killed.done:,} had been done; sent again, each was done once; integrity check clean",
        began,
    )


@pytest.mark.timeout(24 * 3600)
def test_requests_of_all_kinds(tmp_path: Path):
    began = time.monotonic()
    found = Counter[int]()
    for i in range(0, REQUESTS, 2 * AT_ONCE):
        with StandIn(tmp_path / f"run-{i}") as run:
            ids = run.ask(20)
            clip = f"/clips/{run.sql('SELECT name FROM clips')[0][0]}.mp4"
            with serving(run.path) as server, Client(server.url) as client:
                found += throw_bytes(server, client, AT_ONCE, clip, ids, SEED + i)
                found += follow_description(server, client, AT_ONCE, SEED + i)
            assert run.sql("PRAGMA integrity_check") == [("ok",)]
        print(f"{i + 2 * AT_ONCE:,} requests: {dict(sorted(found.items()))}", flush=True)
    assert not [status for status in found if status >= 500]
    report(f"{found.total():,} requests, 0 answers of 5xx: {dict(sorted(found.items()))} (0: none came)", began)
