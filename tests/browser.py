"""The labelling page in a real browser, Chromium: people who sit before it, and run directories whose pairs are cut
from episodes that were lived through, so that the clip process of the server draws them. Nothing is trained here.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from senior import envs
from senior.config import Config, made_by, to_json
from senior.envs.episodes import TRAINING, episode_seed
from senior.label.serving import Served
from senior.preference_file import Rules
from senior.preferences import Preferences
from senior.types import Pairs, Query
from tests.stand_in import ROOT

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = """
--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-component-update
--disable-sync
"""
MISSING = "No Chromium was found to open the labelling page in; install chromium (Debian: apt-get install chromium)."
PATIENCE = 90.0
"""Seconds that anything on the page may take: the machine may be busy."""
SETTLED = "body:is([data-state=ready], [data-state=broken], [data-state=empty])"


def chromium_path() -> str:
    """Where Chromium is. Where it is not, the test is skipped, or fails if ``SENIOR_BROWSER`` is ``required``."""
    for name in PROGRAMS:
        if found := shutil.which(name):
            return found
    if os.environ.get("SENIOR_BROWSER") == "required":
        pytest.fail(MISSING, pytrace=False)
    pytest.skip(MISSING)


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser that nobody sees."""
    path = chromium_path()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS.split())
        try:
            yield browser
        finally:
            browser.close()


class Person:
    """Somebody at the page, in a browser context of their own, with a keyboard.

    ``complaints`` are the errors and warnings of the browser's console, where violations of the
    Content-Security-Policy are told too, and what the page's script raised.
    """

    def __init__(self, browser: Browser, name: str, **context: Any) -> None:
        """``context``: as `playwright.sync_api.Browser.new_context` takes it."""
        self.name = name
        self.context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **context})
        self.context.set_default_timeout(1000 * PATIENCE)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self._forgiven: list[str] = []
        self.page.on("console", lambda said: said.type in ("error", "warning") and self.complaints.append(said.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))

    def open(self, url: str) -> Person:
        """Open the printed address and say who one is."""
        self.page.goto(url)
        self.wait("#name:focus")
        self.page.keyboard.press("Control+A")
        self.page.keyboard.type(self.name)
        self.page.keyboard.press("Enter")
        return self

    def wait(self, selector: str) -> None:
        """Until there is such an element, seen or not."""
        self.page.wait_for_selector(selector, state="attached")

    def wait_for_text(self, id: str, text: str) -> None:
        """Until the element says so, among other things."""
        self.wait(f"#{id}:has-text({json.dumps(text, ensure_ascii=False)})")

    def ready(self, but: int | None = None) -> int:
        """The pair on the screen, once both clips play; ``but``: of another one than that."""
        self.wait("body[data-state=ready]" + (f":not([data-pair='{but}'])" if but else ""))
        return self.pair or 0

    @property
    def pair(self) -> int | None:
        return int(self.attribute("body", "data-pair") or 0) or None

    def attribute(self, selector: str, name: str) -> str | None:
        return self.page.get_attribute(selector, name)

    def text(self, id: str) -> str:
        """What an element says."""
        return " ".join((self.page.text_content(f"#{id}") or "").split())

    def press(self, key: str) -> str:
        """Press a key that answers, undoes or redoes, and wait until the server has answered; what the page says."""
        self.page.keyboard.press(key)
        self.wait("body:not([data-state=saving])")
        return self.text("status")

    def clips(self) -> tuple[str, str]:
        """Names of the clips that are shown left and right."""
        left, right = (Path(self.attribute(f"#video-{side}", "src") or "").stem for side in ("left", "right"))
        return left, right

    def forgive(self, words: str) -> None:
        """Complaints that hold these words are no fault of the page."""
        self._forgiven.append(words)

    def leave(self) -> None:
        """Close the page, if it is open. Nothing of it sticks out sideways, and nothing was complained of."""
        if self.context.pages:
            wide = self.page.evaluate("document.documentElement.scrollWidth - innerWidth")
            self.context.close()
            assert wide <= 0, f"{wide} pixels of the page stick out"
            wrong = [said for said in self.complaints if not any(words in said for words in self._forgiven)]
            assert not wrong, wrong


class Row(NamedTuple):
    """An answer as the preference file holds it, and the pair and clips that it is about."""

    pair: int
    annotator: str
    answer: int | None
    strength: str | None
    seconds: float | None
    replays: int | None
    shown_left: int
    clips: tuple[str | None, str | None]
    """SHA-256."""


Steered = Callable[[int, np.random.Generator, int], np.ndarray]
"""Actions ``[n, a]`` of an episode by its number, a source of randomness, and n."""


class Lived:
    """A run directory in which pairs were asked that were cut from episodes, and nothing is trained."""

    def __init__(self, path: Path, config: Config, steered: Steered, steps: int) -> None:
        """``steps``: of an episode."""
        asking = config.asking
        self.path, self.config, self.rules = path, config, Rules(asking.overlap, asking.replace_skipped)
        path.mkdir(parents=True, exist_ok=True)
        (path / "config.json").write_text(json.dumps({"config": to_json(config), "protocol": {}}))
        self.env, spec = envs.make(**made_by(config))
        self._steered, self._steps = steered, steps
        sizes = spec.observation_size, spec.action_size
        self.preferences = Preferences(self.file, config.queries.budget, config.queries.segment, *sizes)
        self.sessions = self.collected = self.episodes = 0
        self.before = 0
        """How many pairs there were when the present test began."""

    @property
    def file(self) -> Path:
        return self.path / "preferences.sqlite"

    def close(self) -> None:
        """Close file and environment."""
        self.preferences.close()
        self.env.close()

    def ask(self, pairs: int, left: Sequence[int] | None = None, episodes: int = 2) -> list[int]:
        """Ask another session of pairs, each of segments of two of ``episodes`` new episodes, not from their
        beginnings; returns their numbers.

        left: which segment of each is shown there, else alternating. All are predicted to be better in the second.
        """
        segment, first = self.config.queries.segment, self.episodes
        self.episodes += episodes
        lived = {number: self._live(number) for number in range(first, self.episodes)}
        rng = np.random.default_rng(self.sessions)
        cut = [
            [
                (int(number), int(rng.integers(self._steps // 3, self._steps - segment)))
                for number in rng.permutation(list(lived))[:2]
            ]
            for _ in range(pairs)
        ]

        def of(column: int) -> np.ndarray:
            return np.array(
                [[lived[number][column][start:][:segment] for number, start in pair] for pair in cut], np.float32
            )

        places = np.array(cut)
        query = Query(Pairs(of(0), of(1), of(2), places[..., 0], places[..., 1]), {}, np.full(pairs, 0.9))
        shown = np.arange(pairs) % 2 if left is None else np.array(left)
        whole = {number: (self._seed(number), actions) for number, (_, actions, _) in lived.items()}
        step = 1000 * (self.sessions + 1)
        ids = self.preferences.add(query, self.sessions, step, self.config.seed, shown, 0, whole)
        self.sessions += 1
        return ids

    def _seed(self, number: int) -> int:
        return episode_seed(self.config.seed, TRAINING, number)

    def _live(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observations [n, o], actions [n, a] and rewards [n] of an episode."""
        actions = self._steered(number, np.random.default_rng([self.config.seed, number]), self._steps)
        observation, observations, rewards = self.env.reset(seed=self._seed(number))[0], [], []
        for action in actions.astype(np.float32):
            observations.append(np.array(observation, np.float32))
            observation, reward, *_ = self.env.step(action.copy())
            rewards.append(float(reward))
        return np.array(observations), actions.astype(np.float32), np.array(rewards, np.float32)

    def wait_drawn(self, patience: float = PATIENCE) -> None:
        """Until the clips of all that is asked are there, or cannot be; so many seconds at most."""
        until = time.monotonic() + patience
        missing = (
            "SELECT 2 * COUNT(*) - (SELECT COUNT(*) FROM clips JOIN pairs ON pairs.id = pair "
            "WHERE collected_step IS NULL) FROM pairs WHERE collected_step IS NULL"
        )
        while self.sql(missing) != [(0,)]:
            assert time.monotonic() < until
            time.sleep(0.1)

    def collect(self) -> None:
        """Train on the earliest session that is not collected, all of which is answered."""
        assert self.preferences.collect(self.collected, 1000 * (self.collected + 1) + 5, self.rules)
        self.collected += 1

    def begin(self) -> None:
        """Have all that was asked count as trained on, be it answered or not, so that nobody is asked it any more."""
        self.sql("UPDATE pairs SET collected_step = step WHERE collected_step IS NULL")
        self.collected = self.sessions
        ((self.before,),) = self.sql("SELECT COUNT(*) FROM pairs")
        self.sql("DELETE FROM notes")
        self.tell("waiting")

    def tell(self, phase: str, step: int = 1000, **more: object) -> None:
        """Write down what the trainer, which is this process, is doing."""
        told = {"phase": phase, "step": step, "steps": 2000, "process": os.getpid(), **more}
        new = self.path / "status.json.tmp"
        new.write_text(json.dumps(told))
        os.replace(new, self.path / "status.json")

    def sql(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """What another process sees or changes."""
        return sql(self.path, statement, *values)

    def answers(self) -> list[Row]:
        """Those to the pairs of the present test that stand, in the order in which they were given first."""
        return [
            Row(*row[:7], clips=row[7:])
            for row in self.sql(
                "SELECT pair, annotator, answer, strength, seconds, replays, shown_left, clip_0, clip_1 FROM answers "
                "WHERE withdrawn IS NULL AND pair > ? ORDER BY id",
                self.before,
            )
        ]


def sql(run: Path, statement: str, *values: object) -> list[tuple[Any, ...]]:
    """Read or change a run's preference file as another process would."""
    with closing(sqlite3.connect(run / "preferences.sqlite", timeout=PATIENCE)) as db, db:
        return db.execute(statement, values).fetchall()


# A person who answers by true return, and the trainer that is taught so.


def better_side(run: Path, pair: int) -> str:
    """Where the segment of a pair is shown that earned more; where both earned the same, the first."""
    ((blob, left),) = sql(run, "SELECT reward, shown_left FROM pairs WHERE id = ?", pair)
    first, second = np.frombuffer(blob, "<f4").reshape(2, -1).sum(axis=1, dtype=np.float64)
    return "left" if int(second > first) == left else "right"


def teach(person: Person, run: Path, pairs: int) -> None:
    """Answer so many pairs at the page, as they come, by true return."""
    for _ in range(pairs):
        side = better_side(run, person.ready())
        assert person.press(f"Arrow{side.title()}") == f"Saved: {side}, clearly"


class Trainer:
    """`senior` in a process of its own, training or resuming a run that people teach."""

    def __init__(self, run: Path, *arguments: str | Path) -> None:
        self.run = run
        self._log = run.parent.with_name("trainer.log")
        with open(self._log, "a") as log:
            command = [sys.executable, "-m", "senior.cli", *map(str, arguments)]
            self.process = subprocess.Popen(
                command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log
            )

    def url(self) -> str:
        """Of its page, once it is served."""
        until = time.monotonic() + PATIENCE
        while not (served := Served.find(self.run)):
            assert self.process.poll() is None and time.monotonic() < until, self._log.read_text()
            time.sleep(0.05)
        return served.url

    def wait(self) -> None:
        """Until it has done its work."""
        assert self.process.wait(PATIENCE) == 0, self._log.read_text()

    def kill(self) -> None:
        """As nobody should. The server of its page lives on."""
        self.process.kill()
        self.process.wait()


@contextmanager
def ending(trainer: Trainer) -> Iterator[Trainer]:
    """Leave nothing running of a trainer that has not done its work: neither it nor the server of its page."""
    try:
        yield trainer
    finally:
        if trainer.process.returncode != 0:
            trainer.kill()
            if served := Served.find(trainer.run):
                with suppress(ProcessLookupError):
                    os.kill(served.process, signal.SIGTERM)
