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
from tests.browser import PATIENCE, SETTLED, Lived, Person, Trainer, chromium, sql, teach
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


def test_undo_and_redo_in_any_order(browser: Browser, run: Lived):
    """Page, file and trainer agree after every key."""
    ids = run.ask(3)
    rng = random.Random(0)
    standing: list[tuple[int, str, str | None]] = []
    undone: list[tuple[int, str, str | None]] = []
    left = dict(run.sql("SELECT id, shown_left FROM pairs"))
    seen = set()
    with visited(browser, run) as enter:
        ann = enter()
        ann.ready()
        for _ in range(50):
            ann.wait(SETTLED)
            pair = ann.pair
            kind = rng.choices(["answer", "undo", "redo"], [4, 3, 2])[0]
            if kind == "undo":
                said = ann.press(rng.choice(["z", "Backspace", "Control+z"]))
                if standing:
                    undone.append(standing.pop())
                    assert said == f"Undone: {saved(*undone[-1][1:])}. Please answer again."
                    assert ann.pair == undone[-1][0]
                else:
                    assert said == "There is no answer of yours to undo." and ann.pair == pair
            elif kind == "redo":
                said = ann.press(rng.choice(["y", "Shift+Z", "Control+y"]))
                if undone:
                    standing.append(undone.pop())
                    assert said == f"Redone: {saved(*standing[-1][1:])}"
                else:
                    assert said == "There is nothing to redo." and ann.pair == pair
            elif pair:
                key, answer, strength = rng.choice(KEYS)
                said = ann.press(key)
                assert said == f"Saved: {saved(answer, strength)}"
                standing.append((pair, answer, strength))
                undone.clear()
            else:
                continue
            seen.add((said.split()[0], pair is None))
            assert ann.text("labels") == f"{len(standing)} of {BUDGET} labels"
            assert [(row.pair, row.answer, row.strength) for row in sorted(run.answers())] == sorted(
                (pair, meant(answer, left[pair]), strength) for pair, answer, strength in standing
            )
            assert ann.pair in (None, *ids) and ann.pair not in [pair for pair, *_ in standing]
            spent = [
                f"#{name}{'.spent' if not some else ':not(.spent)'}"
                for name, some in (("undo", standing), ("redo", undone))
            ]
            for selector in spent:
                ann.wait(selector)
        assert seen == {(word, last) for word in ("Undone:", "There") for last in (True, False)} | {
            ("Saved:", False),
            ("Redone:", False),
        }
        while (pair := ann.pair) is not None:
            ann.ready()
            ann.press("ArrowLeft")
            standing.append((pair, "left", "clearly"))
        run.collect()
        assert ann.press("z") == "Your last answer has been trained on already, so it cannot be undone."
        assert ann.text("labels") == f"{len(ids)} of {BUDGET} labels"
        ann.forgive(REFUSED)
    targets = {0: 0.0, 1: 1.0, -1: 0.5, None: None}
    assert dict(run.sql("SELECT id, second FROM pairs")) == {
        pair: targets[meant(answer, left[pair])] for pair, answer, _ in standing
    }


def test_a_held_key_counts_once_and_a_double_click_too(browser: Browser, run: Lived):
    ids = run.ask(5)
    with visited(browser, run) as enter:
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


def test_keys_do_nothing_where_they_are_not_meant(browser: Browser, run: Lived):
    """Before the clips are seen only a skip is taken; in a text field keys write; under the help they wait."""
    ids = run.ask(3)
    held: list[Route] = []
    with visited(browser, run) as enter:
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
        assert ann.ready() == ids[2]
    assert [(row.pair, row.answer) for row in run.answers()] == [(ids[0], 0), (ids[1], None)]


def test_playing(browser: Browser, run: Lived):
    run.ask(1)
    times = "[...document.querySelectorAll('video.on')].map((video) => [video.currentTime, video.playbackRate])"
    with visited(browser, run) as enter:
        ann = enter()
        ann.ready()
        for key, rate, pressed in (("]", 2, "two"), ("[", 1, "one"), ("[", 0.5, "half"), ("]", 1, "one")):
            ann.page.keyboard.press(key)
            ann.wait(f"#rate-{pressed}[aria-pressed=true]")
            ann.page.wait_for_timeout(150)
            (_, left), (_, right) = ann.page.evaluate(times)
            assert all(rate <= now < 1.2 * rate for now in (left, right)), "one may catch up with the other"
        for _ in range(3):  # stopped anywhere, both stand at one frame
            ann.wait(f"#frame:text-is('{H - 2} / {H}')")
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


def test_two_people_never_get_the_same_pair(browser: Browser, run: Lived):
    ids = run.ask(10)
    rng = random.Random(1)
    with visited(browser, run) as enter:
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
        idle.wait_for_text("labels", f"{len(ids)} of {BUDGET} labels")
        run.ask(1)
        idle_or_busy = [person.page.locator("body[data-state=ready]").count() for person in people]
        while not any(idle_or_busy):
            people[0].page.wait_for_timeout(50)
            idle_or_busy = [person.page.locator("body[data-state=ready]").count() for person in people]
        people[0].page.wait_for_timeout(1500)  # both ask every second
        assert sorted(person.attribute("body", "data-state") for person in people) == ["empty", "ready"]
    rows = run.answers()
    assert sorted(row.pair for row in rows) == ids
    assert {row.annotator for row in rows} == {"ann", "bob"}


def test_a_pair_that_is_not_answered_goes_to_somebody_else_after_its_lease(browser: Browser, run: Lived):
    (first, second) = run.ask(2)
    with visited(browser, run) as enter:
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


def test_a_reload_brings_the_same_pair_and_name(browser: Browser, run: Lived):
    run.ask(4)
    with visited(browser, run) as enter:
        ann = enter()
        ann.ready()
        ann.press("ArrowLeft")
        pair, clips = ann.ready(), ann.clips()
        bob = enter("bob")
        assert bob.ready() != pair
        ann.page.reload()
        assert ann.ready() == pair and ann.clips() == clips
        assert ann.text("who") == "ann · 1" and ann.text("labels") == f"1 of {BUDGET} labels"
        assert "token" not in ann.page.url
        assert ann.press("z").startswith("Undone")


def test_a_killed_server_loses_nothing_and_doubles_nothing(browser: Browser, run: Lived):
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


def test_an_answer_whose_acknowledgement_is_lost_is_saved_once(browser: Browser, run: Lived):
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

    with visited(browser, run) as enter:
        ann = enter()
        ann.ready()
        ann.page.route("**/api/answer", lose)
        assert ann.press("ArrowDown") == "Saved: about equal"
        assert len(sent) == 3 and sent[0] == sent[1] == sent[2]
        assert len(run.answers()) == 1
        assert len(run.sql("SELECT * FROM posts")) == 1
        assert len(ann.complaints) == 2
        ann.forgive("Failed to load resource")


def test_what_is_going_on_where_there_is_nothing_to_answer(browser: Browser, run: Lived):
    """Starting, drawing, waiting, a pair that cannot be drawn, training stopped and finished: each in words."""
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
        ann.wait_for_text("empty-title", "All labels are given. Thank you.")
    assert [row.answer for row in run.answers() if row.pair == broken] == [None]


def test_what_people_write_stays_text(browser: Browser, run: Lived):
    name = "<script>document.title = 1</script>"
    goal = "\"><img src=x onerror='document.body.remove()'> {{ 7 * 7 }} & so on"
    run.ask(2)
    with visited(browser, run) as enter:
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
        assert ann.page.locator("#annotators tbody th").all_text_contents() == [name]
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
            assert [row[:4] for row in people] == [["ann", "6", "0", "1"], ["bob", "6", "0", "0"]]
            assert all(float(row[4].removesuffix(" s")) > 0 for row in people)
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


def test_everything_fits_light_or_dark_desk_or_phone(browser: Browser, run: Lived, tmp_path: Path):
    run.ask(2 * len(LAYOUTS))  # each also leases a pair that is not answered
    with visited(browser, run) as enter:
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
    run = tmp_path / "out" / "seed-0"
    trainer = Trainer(run, "train", *PEOPLE, "--out", run.parent)
    ann = Person(browser, "ann").open(trainer.url())
    teach(ann, run, 25)
    ann.wait_for_text("empty-title", "All labels are given. Thank you.")
    trainer.wait()
    ann.forgive(GONE)
    ann.leave()
    assert_same_learning(run, oracle)


def test_a_trainer_that_is_killed_amid_a_session_goes_on_and_so_does_the_page(
    browser: Browser, oracle: Path, tmp_path: Path
):
    run = tmp_path / "out" / "seed-0"
    trainer = Trainer(run, "train", *PEOPLE, "--out", run.parent)
    ann = Person(browser, "ann").open(trainer.url())
    teach(ann, run, 13)
    trainer.kill()
    ann.wait_for_text("trainer", "Training stands still at step 600")
    teach(ann, run, 3)
    assert not ann.complaints, "the server lives on"
    trainer = Trainer(run, "resume", run)
    teach(ann, run, 9)
    ann.wait_for_text("empty-title", "All labels are given. Thank you.")
    trainer.wait()
    ann.forgive(GONE)
    ann.leave()
    ((count,),) = sql(run, "SELECT COUNT(*) FROM answers")
    assert count == 25
    assert_same_learning(run, oracle)
