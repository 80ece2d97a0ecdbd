"""The labelling page in a real browser, before the real server and real clips: what people do is what is kept, whatever
dies in between; and a policy that somebody at the page teaches by true return is the one that the oracle teaches.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import os
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Route

from senior.config import Asking, Queries
from senior.label.desk import LEASE_SECONDS
from senior.program import train
from tests import browser as browsers
from tests.browser import PATIENCE, SETTLED, Lived, Person, Trainer, chromium, ending, sql, teach
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
REFUSED = "the server responded with a status of 409"


def steered(episode: int, rng: np.random.Generator, steps: int) -> np.ndarray:
    """To the right in even episodes, to the left in odd ones."""
    return np.array([0.3 * (-1) ** episode, 0]) + rng.uniform(-0.1, 0.1, (steps, 2))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


Enter = Callable[..., Person]


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


@contextmanager
def entrance(browser: Browser, url: str) -> Iterator[Enter]:
    """A way to have somebody enter a page. All leave it in the end, without complaints."""
    here: list[Person] = []

    def enter(name: str = "ann", **context: Any) -> Person:
        here.append(Person(browser, name, **context).open(url))
        return here[-1]

    try:
        yield enter
        for person in here:
            person.leave()
    finally:
        for person in here:
            person.context.close()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Lived, str]]:
    """A run and the address of its page, for most tests, one after the other."""
    with lived(tmp_path_factory.mktemp("page") / "run") as run, serving(run.path) as server:
        yield run, server.url


@pytest.fixture
def run(house: tuple[Lived, str]) -> Lived:
    """The run of the house; nothing is asked in it."""
    house[0].begin()
    return house[0]


@pytest.fixture
def enter(browser: Browser, house: tuple[Lived, str]) -> Iterator[Enter]:
    with entrance(browser, house[1]) as way:
        yield way


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[Lived]:
    """A run that nobody serves yet."""
    with lived(tmp_path / "run") as opened:
        yield opened


@contextmanager
def visited(browser: Browser, run: Lived) -> Iterator[Enter]:
    """A server of its own for a run."""
    with serving(run.path) as server, entrance(browser, server.url) as enter:
        yield enter


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


def test_a_session_by_keyboard(run: Lived, enter: Enter):
    """What the file holds in the end is what the page showed and said."""
    ids = run.ask(len(KEYS))
    run.wait_drawn()
    kim = enter("kim")
    expected = []
    for number, (key, answer, strength) in enumerate(KEYS, start=1):
        pair = kim.ready()
        assert pair == ids[number - 1]
        assert kim.text("number") == f"Pair {number} of {len(KEYS)}"
        shown = kim.clips()
        if number == 1:  # once to the end, and again
            assert kim.page.locator("video").count() == 2 * (1 + 3), "the next three pairs are loaded beforehand"
            kim.wait(f"#frame:text-is('{H} / {H}')")
            kim.wait(f"#frame:not(:text-is('{H} / {H}'))")
        assert kim.press(key) == f"Saved: {saved(answer, strength)}"
        assert kim.text("labels") == f"{run.before + number} of {BUDGET} labels"
        assert kim.text("session") == f"session {run.sessions}: {number} of {len(KEYS)}"
        assert kim.text("who") == f"kim · {number}"
        expected.append((pair, answer, strength, shown))
    kim.wait("body[data-state=empty]")
    assert kim.text("empty-title") == "Nothing to label just now"
    rows = run.answers()
    assert len(rows) == len(expected)
    for row, (pair, answer, strength, shown) in zip(rows, expected, strict=True):
        clips = dict(run.sql("SELECT side, name FROM clips WHERE pair = ?", pair))
        assert shown == (clips[row.shown_left], clips[1 - row.shown_left])
        digests = [hashlib.sha256((run.path / f"label/clips/{clips[side]}.mp4").read_bytes()) for side in (0, 1)]
        assert row[:4] == (pair, "kim", meant(answer, row.shown_left), strength)
        assert row.clips == tuple(digest.hexdigest() for digest in digests)
        assert row.seconds is not None and row.seconds > 0
    assert {row.shown_left for row in rows} == {0, 1}
    assert (rows[0].replays or 0) >= 1 and (rows[0].seconds or 0) >= 1


def test_what_is_seen_on_a_side_is_the_segment_that_is_shown_there(run: Lived, enter: Enter):
    """Frame by frame, from the screen: the red point is where it was. Both clips stand at one frame."""
    (first, _) = run.ask(2, left=[1, 0])
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


def test_undo_and_redo_in_any_order(run: Lived, enter: Enter):
    """Page, file and trainer agree after every key."""
    ids = run.ask(3)
    rng = random.Random(0)
    standing: list[tuple[int, str, str | None]] = []
    undone: list[tuple[int, str, str | None]] = []
    left = dict(run.sql("SELECT id, shown_left FROM pairs WHERE id > ?", run.before))
    seen = set()
    run.wait_drawn()
    una = enter("una")
    una.ready()
    for _ in range(50):
        una.wait(SETTLED)
        pair = una.pair
        kind = rng.choices(["answer", "undo", "redo"], [4, 3, 2])[0]
        if kind == "undo":
            said = una.press(rng.choice(["z", "Backspace", "Control+z"]))
            if standing:
                undone.append(standing.pop())
                assert said == f"Undone: {saved(*undone[-1][1:])}. Please answer again."
                assert una.pair == undone[-1][0]
            else:
                assert said == "There is no answer of yours to undo." and una.pair == pair
        elif kind == "redo":
            said = una.press(rng.choice(["y", "Shift+Z", "Control+y"]))
            if undone:
                standing.append(undone.pop())
                assert said == f"Redone: {saved(*standing[-1][1:])}"
            else:
                assert said == "There is nothing to redo." and una.pair == pair
        elif pair:
            key, answer, strength = rng.choice(KEYS)
            said = una.press(key)
            assert said == f"Saved: {saved(answer, strength)}"
            standing.append((pair, answer, strength))
            undone.clear()
        else:
            continue
        seen.add((said.split()[0], pair is None))
        assert una.text("labels") == f"{run.before + len(standing)} of {BUDGET} labels"
        assert [(row.pair, row.answer, row.strength) for row in sorted(run.answers())] == sorted(
            (pair, meant(answer, left[pair]), strength) for pair, answer, strength in standing
        )
        assert una.pair in (None, *ids) and una.pair not in [pair for pair, *_ in standing]
        for button, some in (("undo", standing), ("redo", undone)):
            assert ("spent" in (una.attribute(f"#{button}", "class") or "").split()) == (not some)
    assert seen == {("Saved:", False), ("Redone:", False), *product(("Undone:", "There"), (True, False))}
    while (pair := una.pair) is not None:
        una.ready()
        una.press("ArrowLeft")
        standing.append((pair, "left", "clearly"))
    run.collect()
    assert una.press("z") == "Your last answer belongs to what has been trained on already; it cannot be undone."
    assert una.text("labels") == f"{run.before + len(ids)} of {BUDGET} labels"
    una.forgive(REFUSED)
    targets = {0: 0.0, 1: 1.0, -1: 0.5, None: None}
    assert dict(run.sql("SELECT id, second FROM pairs WHERE id > ?", run.before)) == {
        pair: targets[meant(answer, left[pair])] for pair, answer, _ in standing
    }


def test_a_held_key_counts_once_and_a_double_click_too(run: Lived, enter: Enter):
    ids = run.ask(5)
    ann = enter()
    ann.ready()
    for _ in range(20):
        ann.page.keyboard.down("ArrowRight")
        ann.page.wait_for_timeout(20)
    ann.page.keyboard.up("ArrowRight")
    assert ann.ready() == ids[1]
    ann.page.dblclick("#equal", delay=10)
    assert ann.ready(but=ids[1]) == ids[2]
    ann.page.focus("#left-slightly")
    for _ in range(20):
        ann.page.keyboard.down("Enter")
        ann.page.wait_for_timeout(20)
    ann.page.keyboard.up("Enter")
    assert ann.ready(but=ids[2]) == ids[3]
    ann.page.click("#skip")
    assert ann.ready(but=ids[3]) == ids[4]
    ann.page.keyboard.press("Space")  # pauses: it does not press the button again
    ann.wait("#play[aria-label=Play]")
    assert [(row.pair, row.answer, row.strength) for row in run.answers()] == [
        (ids[0], meant("right", 0), "clearly"),
        (ids[1], -1, None),
        (ids[2], meant("left", 0), "slightly"),
        (ids[3], None, None),
    ]


def test_keys_do_nothing_where_they_are_not_meant(run: Lived, enter: Enter):
    """Before the clips are seen only a skip is taken; in a text field keys write; under the help they wait."""
    ids = run.ask(3)
    held: list[Route] = []
    ann = enter()
    ann.ready()
    ann.press("ArrowLeft")
    ann.ready(but=ids[0])
    ann.context.route("**/clips/*", lambda route: held.append(route))
    ann.page.reload()
    ann.wait("body[data-state=loading]")
    assert ann.press("ArrowLeft") == "The clips are still loading."
    assert ann.attribute("#left", "aria-disabled") == "true"
    assert ann.press("s") == "Saved: cannot tell"
    ann.context.unroute("**/clips/*")
    ann.page.reload()
    assert ann.ready() == ids[2]
    ann.page.click("#goal-edit")
    ann.page.keyboard.type("as de=z, .[]1")
    ann.page.keyboard.press("Backspace")
    assert ann.page.input_value("#goal-input").endswith("as de=z, .[]")
    ann.page.keyboard.press("Escape")
    ann.page.keyboard.press("?")
    ann.wait("#help[open]")
    ann.page.keyboard.press("ArrowLeft")
    ann.page.keyboard.press("s")
    ann.page.keyboard.press("?")
    ann.wait("#help:not([open])")
    for key in ("Alt+ArrowLeft", "Control+d", "Meta+s", "Shift+s", "q"):
        ann.page.keyboard.press(key)
    ann.page.wait_for_timeout(200)
    assert ann.ready() == ids[2] and ann.text("goal") == "Reach the goal"
    assert [(row.pair, row.answer) for row in run.answers()] == [(ids[0], 0), (ids[1], None)]


def test_playing(run: Lived, enter: Enter):
    run.ask(1)
    times = "[...document.querySelectorAll('video.on')].map((video) => [video.currentTime, video.playbackRate])"
    ann = enter()
    ann.ready()
    for key, rate, pressed in (("]", 2, "two"), ("[", 1, "one"), ("[", 0.5, "half"), ("]", 1, "one")):
        ann.page.keyboard.press(key)
        ann.wait(f"#rate-{pressed}[aria-pressed=true]")
        for _ in range(50):  # a busy machine takes its time; one may catch up with the other
            ann.page.wait_for_timeout(150)
            (_, left), (_, right) = ann.page.evaluate(times)
            if all(rate <= now < 1.2 * rate for now in (left, right)):
                break
        else:
            raise AssertionError(f"at rate {rate} the clips play at {left} and {right}")
    for soon in (300, 500, 700):  # stopped anywhere, both stand at one frame
        ann.page.wait_for_timeout(soon)
        ann.page.keyboard.press("Space")
        ann.wait("#play[aria-label=Play]")
        ann.page.wait_for_timeout(100)
        frame = int(ann.text("frame").split()[0])
        (left, _), (right, _) = ann.page.evaluate(times)
        assert left == right and frame == int(8 * left) + 1
        ann.page.keyboard.press("Space")
        ann.wait("#play[aria-label=Pause]")
    for key, side in (("1", "left"), ("2", "right"), ("2", None)):
        ann.page.keyboard.press(key)
        for name in ("left", "right"):
            ann.wait(f"#pane-{name}[aria-pressed={'true' if name == side else 'false'}]")
    assert ann.page.locator("video").count() == 2


def test_keys_count_by_their_character_on_every_keyboard(run: Lived, enter: Enter):
    """A French 1 needs Shift, a French or German bracket a third level, which is AltGr, Control and Alt, or Option."""
    run.ask(1)
    ann = enter()
    ann.ready()

    def press(key: str, **modifiers: bool) -> None:
        ann.page.evaluate(
            "told => document.body.dispatchEvent(new KeyboardEvent('keydown', {bubbles: true, ...told}))",
            {"key": key, **modifiers},
        )

    def stands() -> tuple[str | None, ...]:
        pressed = ("#pane-left", "#rate-one", "#rate-two")
        return tuple(name for name in pressed if ann.attribute(name, "aria-pressed") == "true")

    press("1", altKey=True)  # Firefox's first tab on Linux
    press("]", altKey=True)
    press("=", ctrlKey=True)
    assert stands() == ("#rate-one",)
    press("1", shiftKey=True)
    press("]", ctrlKey=True, altKey=True)
    assert stands() == ("#pane-left", "#rate-two")
    press("[", altKey=True, modifierAltGraph=True)
    assert stands() == ("#pane-left", "#rate-one")
    press("?", shiftKey=True)
    ann.wait("#help[open]")
    press("?")
    ann.wait("#help:not([open])")
    press("=", shiftKey=True)
    ann.wait_for_text("status", "Saved: about equal")


def test_nobody_is_given_a_name(browser: Browser, house: tuple[Lived, str]):
    """Or two people might be one."""
    somebody = Person(browser, "")
    somebody.page.goto(house[1])
    somebody.wait("#name:focus")
    assert somebody.page.input_value("#name") == ""
    somebody.page.keyboard.press("Enter")
    somebody.wait("#start[open]")
    assert somebody.attribute("body", "data-state") == "start"
    somebody.leave()


def test_a_tab_of_another_run_is_loaded_anew_and_answers_nothing_there(browser: Browser, tmp_path: Path):
    address = replace(LOCAL, token="")
    with lived(tmp_path / "first") as first, lived(tmp_path / "second") as second:
        first.ask(1)
        second.ask(2)
        with serving(first.path, address) as server:
            ann = Person(browser, "ann").open(server.url)
            ann.ready()
        ann.page.keyboard.press("ArrowLeft")
        ann.wait_for_text("unsaved", "Not saved, trying again")
        with serving(second.path, replace(address, port=ann_port(server))):
            ann.wait("body[data-state=ready]")
            ann.wait_for_text("session", "0 of 2")
            assert first.answers() == second.answers() == []
            assert ann.press("ArrowLeft").startswith("Saved")
            assert len(second.answers()) == 1
            ann.forgive("Failed to load resource")
            ann.leave()


def test_two_people_never_get_the_same_pair(run: Lived, enter: Enter):
    ids = run.ask(10)
    rng = random.Random(1)
    people = [enter("ann"), enter("bob")]
    for person in people:
        person.ready()
    for _ in range(len(ids) - 1):
        showing = [person.pair for person in people]
        assert None not in showing and len(set(showing)) == 2
        person = rng.choice(people)
        assert person.press(rng.choice(["ArrowLeft", "ArrowRight"])).startswith("Saved")
        person.wait(SETTLED)
    (idle,) = [person for person in people if person.pair is None]
    (busy,) = [person for person in people if person.pair is not None]
    idle.wait_for_text("empty-title", "Others have the rest")
    busy.press("ArrowLeft")
    busy.wait_for_text("empty-title", "Nothing to label just now")
    idle.wait_for_text("empty-title", "Nothing to label just now")
    idle.wait_for_text("labels", f"{run.before + len(ids)} of {BUDGET} labels")
    (last,) = run.ask(1)
    while not (leased := run.sql("SELECT annotator FROM leases WHERE pair = ?", last)):
        idle.page.wait_for_timeout(50)  # of the browser's time, which a sleep would stop
    for person in people:
        if (person.name,) in leased:
            assert person.ready() == last
        else:
            person.wait_for_text("empty-title", "Others have the rest")
    rows = run.answers()
    assert sorted(row.pair for row in rows) == ids
    assert {row.annotator for row in rows} == {"ann", "bob"}


def test_a_pair_that_is_not_answered_goes_to_somebody_else_after_its_lease(run: Lived, enter: Enter):
    (first, second) = run.ask(2)
    ann = enter("ann")
    assert ann.ready() == first
    bob = enter("bob")
    assert bob.ready() == second
    leased = run.sql("SELECT annotator, until - ? FROM leases WHERE pair = ?", time.time(), first)
    assert leased[0][0] == "ann" and LEASE_SECONDS - PATIENCE < leased[0][1] < LEASE_SECONDS
    run.sql("UPDATE leases SET until = until - ? WHERE pair = ?", LEASE_SECONDS, first)
    assert bob.press("ArrowLeft").startswith("Saved")
    assert bob.ready() == first
    assert ann.pair == first, "she still looks at it"
    assert bob.press("ArrowRight").startswith("Saved")
    said = ann.press("ArrowLeft")
    assert said == f"Pair {first} has been answered by somebody else meanwhile."
    ann.wait("body[data-state=empty]")
    ann.forgive(REFUSED)
    assert [(row.pair, row.annotator) for row in run.answers()] == [(second, "bob"), (first, "bob")]


def test_a_reload_brings_the_same_pair_and_name(run: Lived, enter: Enter):
    run.ask(4)
    ann = enter("rea")
    ann.ready()
    ann.press("ArrowLeft")
    pair, clips = ann.ready(), ann.clips()
    bob = enter("bob")
    assert bob.ready() != pair
    ann.page.reload()
    assert ann.ready() == pair and ann.clips() == clips
    assert ann.text("who") == "rea · 1" and ann.text("labels") == f"{run.before + 1} of {BUDGET} labels"
    assert "token" not in ann.page.url
    assert ann.press("z").startswith("Undone")


def test_a_killed_server_loses_nothing_and_doubles_nothing(browser: Browser, alone: Lived):
    run = alone
    (first, second, third) = run.ask(3)
    server = Server(run.path)
    ann = Person(browser, "ann").open(server.url)
    assert ann.ready() == first
    assert ann.press("ArrowLeft").startswith("Saved")
    assert ann.ready() == second
    server.kill()
    ann.page.keyboard.press("ArrowRight")
    ann.wait_for_text("unsaved", "Not saved, trying again")
    assert ann.page.is_visible("#unsaved")
    ann.wait("#connection:not([hidden])")
    ann.page.keyboard.press("ArrowLeft")  # the answer that is under way is the one that counts
    assert ann.pair == second and ann.attribute("body", "data-state") == "saving"
    assert len(run.answers()) == 1
    with serving(run.path) as again:
        assert again.url == server.url
        assert ann.ready(but=second) == third
        assert ann.text("status") == "Saved: right, clearly" and not ann.page.is_visible("#unsaved")
        ann.wait("#connection[hidden]")
        assert [(row.pair, row.annotator, row.answer) for row in run.answers()] == [
            (first, "ann", meant("left", 0)),
            (second, "ann", meant("right", 1)),
        ]
        assert ann.press("z") == "Undone: right, clearly. Please answer again."
    with serving(run.path, replace(LOCAL, token="another", port=ann_port(server))):
        ann.page.keyboard.press("ArrowLeft")
        ann.wait("body[data-state=expired]")
        ann.wait_for_text("unsaved", "This link has expired.")
        ann.forgive("Failed to load resource")
        ann.leave()


def ann_port(server: Server) -> int:
    return int(server.url.split(":")[2].split("/")[0])


def test_an_answer_whose_acknowledgement_is_lost_is_saved_once(run: Lived, enter: Enter):
    run.ask(2)
    sent: list[Any] = []

    def lose(route: Route) -> None:
        sent.append(route.request.post_data_json)
        if len(sent) == 1:
            route.fetch()
            route.abort()
        elif len(sent) == 2:
            route.fulfill(status=503)
        else:
            route.continue_()

    ann = enter()
    ann.page.route("**/api/answer", lose)
    ann.page.reload()  # a page that is open already was once seen to send past it
    ann.ready()
    assert ann.press("ArrowDown") == "Saved: about equal"
    assert len(sent) == 3 and sent[0] == sent[1] == sent[2]
    assert len(run.answers()) == 1
    assert run.sql("SELECT COUNT(*) FROM posts WHERE id = ?", sent[0]["post"]) == [(1,)]
    assert len(ann.complaints) == 2
    ann.forgive("Failed to load resource")


def test_what_is_going_on_where_there_is_nothing_to_answer(browser: Browser, alone: Lived):
    """Starting, drawing, waiting, a pair that cannot be drawn, training stopped and finished: each in words."""
    run = alone
    (run.path / "status.json").unlink()
    (run.path / "label" / "clips").mkdir(parents=True)
    drawing = os.open(run.path / "label" / "clips", os.O_RDONLY)
    fcntl.flock(drawing, fcntl.LOCK_EX)  # as if another process were drawing, slowly
    with visited(browser, run) as enter:
        ann = enter()
        ann.wait("#empty[data-kind=waiting]")
        ann.wait_for_text("trainer", "The run has not begun.")
        run.tell("pretraining", 500)
        ann.wait_for_text("trainer", "The robot is trying things out: step 500 of 2,000.")
        ids = run.ask(2)
        run.tell("waiting")
        ann.wait_for_text("empty-title", "Clips are on their way")
        ann.wait_for_text("trainer", "Training waits for your answers at step 1,000 of 2,000.")
        assert ann.attribute("#drawn", "value") == "0" and ann.page.is_visible("#drawn")
        assert not ann.page.is_visible("#left")
        os.close(drawing)
        assert ann.ready() == ids[0]
        assert ann.page.is_visible("#left") and not ann.page.is_visible("#empty")
        for _ in ids:
            ann.ready()
            ann.press("ArrowLeft")
        ann.wait_for_text("empty-title", "Nothing to label just now")
        run.collect()
        run.tell("training", 1200, steps_per_second=41.0)
        ann.wait_for_text("empty-trainer", "Training: step 1,200 of 2,000, 41 a second.")
        (broken,) = run.ask(1)
        run.sql("DELETE FROM episodes")  # so that it cannot be lived through again
        ann.wait("body[data-state=broken]")
        ann.wait_for_text("empty-why", "cannot be lived through again. Choose “Cannot tell” to go on.")
        assert ann.press("ArrowLeft") == "This pair can only be skipped."
        assert ann.press("s") == "Saved: cannot tell"
        run.collect()
        run.tell("training", 1500, failure="the motor is hot", process=2**22 + 1)
        ann.wait_for_text("empty-title", "Training has stopped")
        ann.wait_for_text("empty-why", "stands still at step 1,500 (the motor is hot)")
        ann.wait_for_text("empty-why", "senior resume")
        run.tell("finished", 2000)
        ann.wait_for_text("empty-title", "Training has finished. Thank you.")
    assert [row.answer for row in run.answers() if row.pair == broken] == [None]


def test_what_people_write_stays_text(run: Lived, enter: Enter):
    name = "<script>document.title = 1</script>"
    goal = "\"><img src=x onerror='document.body.remove()'> {{ 7 * 7 }} & so on"
    run.ask(2)
    ann, bob = enter(name), enter("bob")
    ann.ready()
    ann.page.click("#goal-edit")
    ann.page.keyboard.type(goal)
    ann.page.keyboard.press("Enter")
    ann.wait_for_text("status", "Goal saved")
    ann.press("ArrowLeft")
    bob.wait_for_text("goal", "so on")
    for page in ("/", "/overview"):
        ann.page.goto(ann.page.url.split("/")[0] + "//" + ann.page.url.split("/")[2] + page)
        ann.wait_for_text("goal" if page == "/" else "annotators", "so on" if page == "/" else "script")
        assert ann.text("goal") == goal
        assert ann.page.locator("img[src=x], main script, nav script").count() == 0
    assert name in ann.page.locator("#annotators tbody th").all_text_contents()
    assert bob.text("goal") == goal
    assert ann.page.title() != "1"


def test_the_overview_shows_who_said_what_and_how_far_they_agree(browser: Browser, tmp_path: Path):
    said = {"ann": "left left right right skip left", "bob": "left right right right left left"}
    with lived(tmp_path / "run", overlap=2) as run:
        run.ask(5, left=[0] * 5)
        run.ask(1, left=[0])
        (run.path / "eval.csv").write_text("step,success_rate,return_mean\n0,0,10\n2000,0.8,30\n")
        with visited(browser, run) as enter:
            for name, answers in said.items():
                person = enter(name)
                for answer in answers.split():
                    person.ready()
                    person.press({"left": "ArrowLeft", "right": "ArrowRight", "skip": "s"}[answer])
                person.wait("body[data-state=empty]")
            run.collect()
            run.collect()
            person.page.click("#overview-link")
            person.wait("#curve svg")
            # Of five pairs that both judged, they agree on four. By chance: 12/25 (Cohen), 0.5 (Fleiss).
            assert person.text("fleiss") == "Fleiss' kappa: 0.60 (5 pairs)"
            cells = person.page.locator("#cohen tbody tr").all_inner_texts()
            assert [row.split("\t") for row in cells] == [["ann, bob", "5", "0.62"]]
            people = [row.split("\t") for row in person.page.locator("#annotators tbody tr").all_inner_texts()]
            median = {
                name: np.median([row.seconds or 0 for row in run.answers() if row.annotator == name]) for name in said
            }
            assert people == [
                ["ann", "6", "0", "1", f"{median['ann']:.1f} s"],
                ["bob", "6", "0", "0", f"{median['bob']:.1f} s"],
            ]
            assert person.text("curve-about") == "At step 2,000: 80 % success."
            told = person.attribute("#prospective svg", "aria-label") or ""
            assert "0 at 2.01k" in told and "Guessing gives 0.5" in told, told
            person.page.click("#label-link")
            person.wait("body[data-state=empty]")


LAYOUTS: dict[str, dict[str, Any]] = {
    "light": {"viewport": {"width": 1280, "height": 800}},
    "dark": {"viewport": {"width": 1280, "height": 720}, "color_scheme": "dark"},
    "phone": {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True},
    "dark phone": {
        "viewport": {"width": 360, "height": 640},
        "has_touch": True,
        "is_mobile": True,
        "color_scheme": "dark",
    },
    "phone on its side": {"viewport": {"width": 844, "height": 390}, "has_touch": True, "is_mobile": True},
    "small phone": {"viewport": {"width": 320, "height": 568}, "has_touch": True, "is_mobile": True},
}


def test_everything_fits_light_or_dark_desk_or_phone(run: Lived, enter: Enter, tmp_path: Path):
    run.ask(2 * len(LAYOUTS))  # each also leases a pair that is not answered
    for name, layout in LAYOUTS.items():
        person = enter(name, **layout)
        pair = person.ready()
        width, height = layout["viewport"]["width"], layout["viewport"]["height"]
        for id in ("left", "right", "equal", "skip", "left-slightly", "right-slightly", "undo", "redo"):
            box = person.page.locator(f"#{id}").bounding_box()
            assert box, id
            assert box["x"] >= 0 and box["x"] + box["width"] <= width, (name, id, box)
            if name != "small phone":  # on which one scrolls
                assert box["y"] >= 0 and box["y"] + box["height"] <= height, (name, id, box)
            assert box["height"] >= (44 if layout.get("has_touch") else 36), (name, id, box)
        panes = [person.page.locator(f"#pane-{side}").bounding_box() for side in ("left", "right")]
        assert all(box and min(box["width"], box["height"]) >= 130 for box in panes), (name, panes)
        for label in ("Left clearly better", "Right slightly better", "About equal", "Cannot tell", "Undo", "Redo"):
            assert person.page.get_by_role("button", name=label).count() == 1, label
        shot = Image.open(io.BytesIO(person.page.screenshot(path=tmp_path / f"{name}.png"))).convert("L")
        assert shot.size == (width, height)
        bright = np.median(np.asarray(shot)[-8:])
        assert bright < 60 if layout.get("color_scheme") == "dark" else bright > 200
        press = person.page.tap if layout.get("has_touch") else person.page.click
        press("#left")
        person.wait(f"body:not([data-pair='{pair}'])")
        person.page.goto(person.page.url + "overview")
        person.wait("#annotators tbody")
        person.leave()
    assert len(run.answers()) == len(LAYOUTS)


# The trainer and a person who answers by true return.


@pytest.fixture(scope="module")
def oracle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that the scripted oracle teaches: sessions of 10, 10 and 5 pairs."""
    out = tmp_path_factory.mktemp("oracle")
    train(short(), out, watcher=Stop())
    return out / "seed-0"


PEOPLE = (*OPTIONS, "--teacher", "human", "--settle", "0")


def test_a_person_at_the_page_trains_the_policy_that_the_oracle_trains(browser: Browser, oracle: Path, tmp_path: Path):
    """Even if the trainer is killed amid the second session: the page lives on, and goes on with another trainer."""
    run = tmp_path / "out" / "seed-0"
    first = Trainer(run, "train", *PEOPLE, "--out", run.parent)
    with ending(first), entrance(browser, first.url()) as enter:
        ann = enter()
        teach(ann, run, 13)
        first.kill()
        ann.wait_for_text("trainer", "Training stands still at step 600")
        teach(ann, run, 3)
        assert not ann.complaints
        with ending(Trainer(run, "resume", run)) as second:
            teach(ann, run, 9)
            ann.wait_for_text("empty-title", "All labels are given. Thank you.")
            ann.wait("#empty[data-kind=finished]")
            second.wait()
        ann.page.wait_for_timeout(2000)
        assert not ann.complaints, "the server ended with the trainer, and the page leaves it alone"
    assert sql(run, "SELECT COUNT(*), COUNT(withdrawn) FROM answers") == [(25, 0)]
    assert_same_learning(run, oracle)
