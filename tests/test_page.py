"""The labelling page in a real browser, before the real server and real clips: what people do is what is kept, whatever
dies in between; and a policy that somebody at the page teaches by true return is the one that the oracle teaches.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import os
import random
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Route

from senior.config import Asking, Queries
from senior.envs.point import Point
from senior.label.desk import LEASE_SECONDS
from senior.program import train
from tests import browser as browsers
from tests.browser import SETTLED, Lived, Person, Trainer, better_side, chromium, sql, teach
from tests.equal import OPTIONS, short
from tests.stand_in import LOCAL, Server, configured, serving
from tests.test_people import assert_same_learning
from tests.test_resume import Stop

H, BUDGET, STEPS = 8, 400, 50
WORDS = {"left": "left", "right": "right", "equal": "about equal", "skip": "cannot tell"}
KEYS = [  # all that answer
    ("ArrowLeft", "left", "clearly"),
    ("ArrowRight", "right", "clearly"),
    ("Shift+ArrowLeft", "left", "slightly"),
    ("Shift+ArrowRight", "right", "slightly"),
    ("ArrowDown", "equal", None),
    ("s", "skip", None),
    ("a", "left", "clearly"),
    ("d", "right", "clearly"),
    ("Shift+A", "left", "slightly"),
    ("Shift+D", "right", "slightly"),
    ("e", "equal", None),
    ("=", "equal", None),
]
GONE = "net::ERR_"
"""What the browser complains of where no server answers, in the middle of its sentence."""
REFUSED = "the server responded with a status of"


def steered(episode: int, rng: np.random.Generator, steps: int) -> np.ndarray:
    """To the right in even episodes, to the left in odd ones."""
    return np.array([0.3 * (-1) ** episode, 0]) + rng.uniform(-0.1, 0.1, (steps, 2))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


Enter = Callable[..., Person]


@contextmanager
def visited(browser: Browser, run: Lived) -> Iterator[Enter]:
    """The run's server, and a way to have somebody enter its page; all leave, without complaints, before it ends."""
    here: list[Person] = []
    with serving(run.path) as server:

        def enter(name: str = "ann", **context: Any) -> Person:
            here.append(Person(browser, name, **context).open(server.url))
            return here[-1]

        yield enter
        for person in here:
            person.leave()


@contextmanager
def lived(path: Path, **asking: Any) -> Iterator[Lived]:
    """A run of the point task, whose trainer waits."""
    config = replace(configured(Asking(**asking)), queries=Queries(budget=BUDGET, segment=H))
    run = Lived(path, config, steered, STEPS)
    run.tell("waiting")
    try:
        yield run
    finally:
        run.close()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Lived]:
    with lived(tmp_path / "run") as opened:
        yield opened


def saved(answer: str, strength: str | None) -> str:
    """How the page says what."""
    return ", ".join(word for word in (WORDS[answer], strength) if word)


def meant(answer: str, shown_left: int) -> int | None:
    """Which segment is better by an answer."""
    return {"left": shown_left, "right": 1 - shown_left, "equal": -1, "skip": None}[answer]


def test_without_a_browser_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("SENIOR_BROWSER", raising=False)
    with pytest.raises(pytest.skip.Exception, match="apt-get install chromium"):
        browsers.chromium_path()
    monkeypatch.setenv("SENIOR_BROWSER", "required")
    with pytest.raises(pytest.fail.Exception, match="apt-get install chromium"):
        browsers.chromium_path()


def test_a_session_by_keyboard(browser: Browser, run: Lived):
    """What the file holds in the end is what the page showed and said."""
    ids = run.ask(len(KEYS))
    with visited(browser, run) as enter:
        ann = enter()
        expected = []
        for number, (key, answer, strength) in enumerate(KEYS, start=1):
            pair = ann.ready()
            assert pair == ids[number - 1]
            assert ann.text("number") == f"Pair {number} of {len(KEYS)}"
            shown = ann.clips()
            if number == 1:  # once to the end, and again
                ann.wait(f"#frame:text-is('{H} / {H}')")
                ann.wait("#frame:text-is('1 / 8')")
            assert ann.press(key) == f"Saved: {saved(answer, strength)}"
            assert ann.text("labels") == f"{number} of {BUDGET} labels"
            assert ann.text("session") == f"session 1: {number} of {len(KEYS)}"
            assert ann.text("who") == f"ann · {number}"
            expected.append((pair, answer, strength, shown))
        ann.wait("body[data-state=empty]")
        assert ann.text("empty-title") == "Nothing to label just now"
    rows = run.answers()
    assert len(rows) == len(expected)
    for row, (pair, answer, strength, shown) in zip(rows, expected, strict=True):
        clips = dict(run.sql("SELECT side, name FROM clips WHERE pair = ?", pair))
        assert shown == (clips[row.shown_left], clips[1 - row.shown_left])
        digests = [hashlib.sha256((run.path / f"label/clips/{clips[side]}.mp4").read_bytes()) for side in (0, 1)]
        assert row[:4] == (pair, "ann", meant(answer, row.shown_left), strength)
        assert row.clips == tuple(digest.hexdigest() for digest in digests)
        assert row.seconds is not None and row.seconds > 0
    assert {row.shown_left for row in rows} == {0, 1}
    assert rows[0].replays is not None and rows[0].replays >= 1 and rows[0].seconds >= 1  # pyright: ignore


def test_what_is_seen_on_a_side_is_the_segment_that_is_shown_there(browser: Browser, run: Lived):
    """Frame by frame, from the screen: the red point is where it was. Both clips stand at one frame."""
    (first, _) = run.ask(2, left=[1, 0])
    with visited(browser, run) as enter:
        ann = enter()
        for pair in (first, first + 1):
            assert ann.ready() == pair
            ((blob, left),) = run.sql("SELECT observation, shown_left FROM pairs WHERE id = ?", pair)
            observation = np.frombuffer(blob, "<f4").reshape(2, H, 4)
            ann.page.keyboard.press("Space")
            ann.wait("#play[aria-label=Play]")
            for _ in range(H):
                ann.page.keyboard.press(",")
            ann.page.keyboard.press("1" if pair == first else "2")
            for frame in range(0, H, 3):
                assert ann.text("frame") == f"{frame + 1} / {H}"
                for side, segment in (("left", left), ("right", 1 - left)):
                    ann.wait(f"#video-{side}")
                    position = observation[segment, frame, :2]
                    other = observation[1 - segment, frame, :2]
                    seen = red_point(ann, side)
                    assert np.abs(seen - position).max() < 0.06, (side, frame, seen, position)
                    assert np.abs(other - position).max() > 0.12, "or this shows nothing"
                for _ in range(3):
                    ann.page.keyboard.press(".")
            ann.press("ArrowDown")


def red_point(person: Person, side: str) -> np.ndarray:
    """Where the point is on the screen, in the point's own coordinates."""
    person.page.wait_for_timeout(100)
    image = person.page.locator(f"#video-{side}").screenshot()
    pixels = np.asarray(Image.open(io.BytesIO(image)).convert("RGB")).astype(int)
    rows, columns = np.nonzero((pixels[..., 0] > 150) & (pixels[..., 1] < 110) & (pixels[..., 2] < 110))
    assert len(rows) > 20
    height, width = pixels.shape[:2]
    return np.array([(columns.mean() + 0.5) / width, 1 - (rows.mean() + 0.5) / height]) * 2.4 - 1.2
