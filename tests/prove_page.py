"""How long people wait at the labelling page, and a whole run of door-close that somebody at the page teaches.

PROVE_PAIRS tells how many pairs are answered for the latencies. What came of it is printed with the machine and the
command (ARGS=-s shows it), to be kept. Latencies are reported and not judged: browser, server and, while clips are
drawn, the clip process share this machine.
"""

from __future__ import annotations

import os
import platform
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from senior.config import Config
from senior.presets import preset
from tests.browser import Lived, Person, Trainer, chromium, ending, sql, teach
from tests.small import rows
from tests.stand_in import serving

PAIRS = int(os.environ.get("PROVE_PAIRS", "200"))
LOOK = 1.0
"""Seconds that the stand-in looks at a pair: a quick person."""
STEPS = 500
"""Of an episode of Meta-World."""
QUICK = ("--task", "door-close", "--method", "m-senior", "--preset", "quick", "--teacher", "human", "--settle", "0")


def report(*lines: str) -> None:
    """Print what came of it, so that it can be kept."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    busy = f"load {os.getloadavg()[0]:.1f} when it ended"
    print("", *lines, f"  {machine}, {busy}; PROVE_PAIRS={PAIRS} {shlex.join(sys.argv)}", sep="\n", flush=True)


def spread(name: str, milliseconds: list[float]) -> str:
    """Median and 95th percentile in words."""
    median, high = np.percentile(milliseconds, [50, 95])
    return f"{name}: median {median:.0f} ms, 95th percentile {high:.0f} ms, of {len(milliseconds)}"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


@contextmanager
def lived(path: Path, pairs: int) -> Iterator[Lived]:
    """A run of door-close in which episodes of random actions are compared."""
    run = Lived(path, configured(pairs), lambda _, rng, n: rng.uniform(-1, 1, (n, 4)), STEPS)
    run.tell("waiting")
    try:
        yield run
    finally:
        run.close()


def configured(pairs: int) -> Config:
    config = preset("quick", "door-close", "m-senior")
    return replace(config, teacher="human", queries=replace(config.queries, budget=pairs))


@pytest.mark.timeout(3600)
def test_how_soon_a_session_is_ready(browser: Browser, tmp_path: Path):
    """Ten pairs cut from twenty episodes, while somebody waits at the page."""
    with lived(tmp_path / "run", 10) as run, serving(run.path) as server:
        ann = Person(browser, "ann").open(server.url)
        ann.wait_for_text("empty-title", "Nothing to label just now")
        ann.page.wait_for_timeout(5000)  # the clip process has started
        run.ask(10, episodes=20)
        began = time.monotonic()
        ann.ready()
        first = time.monotonic() - began
        run.wait_drawn()
        whole = time.monotonic() - began
        assert run.sql("SELECT COUNT(*), COUNT(failure) FROM clips") == [(20, 0)]
        ann.leave()
    report(f"10 pairs of door-close: the first plays after {first:.1f} s, the last is drawn after {whole:.1f} s")


@pytest.mark.timeout(3600)
def test_how_soon_the_next_pair_plays(browser: Browser, tmp_path: Path):
    with lived(tmp_path / "run", PAIRS) as run, serving(run.path) as server:
        ids = run.ask(PAIRS, episodes=20)
        run.wait_drawn(3000)
        ann = Person(browser, "ann").open(server.url)
        for _ in ids:
            ann.ready()
            ann.page.wait_for_timeout(1000 * LOOK)
            assert ann.press("ArrowLeft").startswith("Saved")
        told = ann.page.evaluate("window.senior")
        ann.leave()
        assert len(run.answers()) == len(told["saves"]) == len(told["latencies"]) + 1 == PAIRS
    report(
        spread("from the key to the next pair playing", told["latencies"]),
        spread("from the key to the answer saved", told["saves"]),
        f"pairs loaded when they were to be shown: {told['loaded']['before']}, not yet: {told['loaded']['late']}",
    )


@pytest.mark.timeout(4 * 3600)
def test_a_whole_run_is_taught_at_the_page(browser: Browser, tmp_path: Path):
    run = tmp_path / "out" / "seed-0"
    began = time.monotonic()
    with ending(Trainer(run, "train", *QUICK, "--out", run.parent)) as trainer:
        ann = Person(browser, "ann").open(trainer.url())
        ann.page.set_default_timeout(3600 * 1000)  # between sessions
        pairs = preset("quick", "door-close", "m-senior").queries.budget
        teach(ann, run, pairs)
        ann.wait("#empty[data-kind=finished]")
        trainer.wait()
        ann.leave()
    assert sql(run, "SELECT COUNT(*), COUNT(withdrawn) FROM answers") == [(pairs, 0)]
    curve = ", ".join(f"{float(row['success_rate']):.0%} at {int(row['step']):,}" for row in rows(run / "eval.csv"))
    minutes = (time.monotonic() - began) / 60
    report(f"senior train {' '.join(QUICK)}: {pairs} answers at the page, {minutes:.0f} min", f"success: {curve}")
