"""People as teachers, from the trainer's side: labels come when they come, and training is what it would have been.

The person is a stand-in: a thread that writes answers as the labelling page does, through `senior.label.desk`.
"""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from senior.config import Asking, Config
from senior.envs.recording import film_of
from senior.files import unpack
from senior.label.address import Address
from senior.label.desk import Desk, Given, Side
from senior.labels import export_labels
from senior.preference_file import Rules, asked_of, connect, has_tables, pairs_of
from senior.program import resume, train
from senior.rundir import saved_steps
from senior.types import BadInput
from tests.equal import OPTIONS, assert_same_run, short
from tests.small import rows, small
from tests.test_resume import ROOT, Stop

RULES = Rules()
Judge = Callable[[np.ndarray], Side]
"""An answer to a pair by the true returns of what is shown left and right ``[2]``."""


def better(returns: np.ndarray) -> Side:
    """As the oracle would, but for a tie."""
    return "right" if returns[1] > returns[0] else "left"


def answer_open(run: Path, judge: Judge, rules: Rules = RULES, annotator: str = "ann", most: int = 10**6) -> int:
    """Answer what is asked in a run now and drawn, ``most`` pairs at most; returns how many were."""
    file = run / "preferences.sqlite"
    if not has_tables(file):
        return 0
    db, desk, done = connect(file), Desk(file, rules), 0
    try:
        for (session,) in db.execute("SELECT DISTINCT session FROM pairs WHERE collected_step IS NULL").fetchall():
            for pair in asked_of(pairs_of(db, "session = ?", session), rules):
                if done == most or pair.collected_step is not None or annotator in [one.annotator for one in pair.said]:
                    continue
                (blob,) = db.execute("SELECT reward FROM pairs WHERE id = ?", (pair.id,)).fetchone()
                returns = np.frombuffer(blob, "<f4").reshape(2, -1).sum(axis=1, dtype=np.float64)
                side = judge(returns if pair.shown_left == 0 else returns[::-1])
                outcome = desk.answer(f"{annotator}-{pair.id}-{time.time_ns()}", annotator, Given(pair.id, side))
                done += outcome.refused is None  # else its clips are not there yet
    finally:
        desk.close()
        db.close()
    return done


def answer(run: Path, pairs: int, judge: Judge = better) -> None:
    """Answer so many pairs, waiting for them."""
    done, until = 0, time.monotonic() + 120
    while done < pairs:
        assert time.monotonic() < until, f"{done} of {pairs} pairs could be answered"
        done += answer_open(run, judge, most=pairs - done)
        time.sleep(0.05)


@contextmanager
def person(run: Path, judge: Judge = better, rules: Rules = RULES, annotator: str = "ann") -> Iterator[None]:
    """Somebody answers whatever is asked, as long as this lasts."""
    over = threading.Event()

    def work() -> None:
        while not over.wait(0.02):
            answer_open(run, judge, rules, annotator)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def taught(**asking: object) -> Config:
    """`short`, taught by people who need not be waited for once they have answered."""
    return short(teacher="human", asking=Asking(**{"settle": 0.0, **asking}))


def labels(run: Path) -> list[tuple[int, int, int | None, float | None]]:
    """Of every pair: session, step at which it was asked, step at which it was learned from, label."""
    with sqlite3.connect(run / "preferences.sqlite") as db:
        found = db.execute("SELECT session, step, collected_step, second FROM pairs ORDER BY id").fetchall()
    db.close()
    return found


def assert_same_learning(one: Path, other: Path) -> None:
    """Two runs were trained on the same labels at the same steps to the same weights, whoever gave the labels."""
    assert labels(one) == labels(other)
    for name in ("eval.csv", "train.csv"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    first, second = (unpack(run / "policy" / "actor.npz") for run in (one, other))
    assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.fixture(scope="module")
def oracle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that the scripted oracle teaches."""
    out = tmp_path_factory.mktemp("oracle")
    train(short(), out, watcher=Stop())
    return out / "seed-0"


def test_a_person_who_answers_like_the_oracle_trains_the_same_policy(oracle: Path, tmp_path: Path):
    watcher = Stop()
    with person(tmp_path / "seed-0"):
        (result,) = train(taught(), tmp_path, watcher=watcher)
    assert result.finished and result.labels == 25
    assert_same_learning(tmp_path / "seed-0", oracle)
    assert [said for said in watcher.said if "waits for answers at step 400" in said]
    assert [said for said in watcher.said if said.startswith("Answer in a browser: http://127.0.0.1:")]


def test_a_trainer_that_is_killed_while_it_waits_goes_on_with_the_answers_it_got(oracle: Path, tmp_path: Path):
    run = tmp_path / "seed-0"
    command = [sys.executable, "-m", "senior.cli", "train", *OPTIONS, "--teacher", "human", "--settle", "0"]
    trainer = subprocess.Popen(
        [*command, "--out", str(tmp_path)], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    answer(run, 4)
    trainer.send_signal(signal.SIGKILL)
    trainer.communicate()
    assert saved_steps(run / "checkpoints")[0] == 400, "it is saved as it was before it asked"
    answer(run, 3)  # while nobody trains: the server lives on, and so does what draws
    with person(run):
        (result,) = resume(run, Stop())
    assert result.finished
    assert_same_learning(run, oracle)


def test_stopped_while_it_waits_a_run_is_saved_and_goes_on(oracle: Path, tmp_path: Path):
    class StopWaiting(Stop):
        def say(self, sentence: str) -> None:
            self.stop |= "waits for answers" in sentence  # the page's server speaks too, when it likes

    (result,) = train(taught(), tmp_path, watcher=StopWaiting())
    assert not result.finished and result.failure is None and result.step == 400
    with person(tmp_path / "seed-0"):
        resume(tmp_path, Stop())
    assert_same_learning(tmp_path / "seed-0", oracle)


def test_what_is_not_waited_for_is_learned_from_when_it_comes_and_again_at_the_same_step(tmp_path: Path):
    """A run that was killed comes back to the answers at the step at which it had learned from them."""
    whole, run = tmp_path / "whole" / "seed-0", tmp_path / "broken" / "seed-0"
    seen = count()

    class Late(Stop):
        """Answers the second session some steps after it was asked; breaks off afterwards, without a checkpoint."""

        def __init__(self, directory: Path, breaks: bool = False, beyond: int = 0) -> None:
            super().__init__()
            self.directory, self.breaks, self.beyond = directory, breaks, beyond

        def say(self, sentence: str) -> None:
            if "waits for answers" in sentence:
                next(seen)
                answer(self.directory, 10)

        def advance(self, step: int, trainees: object) -> None:
            if step in (633, 871) and step > self.beyond:
                answer(self.directory, 10 if step == 633 else 5)
            if step == 645 and self.breaks:
                raise KeyboardInterrupt

    config = taught(wait=False)
    (result,) = train(config, whole.parent, watcher=Late(whole))
    assert result.finished and result.labels == 25
    assert next(seen) == 1, "only the first session is waited for"
    assert [(session, asked, learned) for session, asked, learned, _ in labels(whole)][::10] == [
        (0, 400, 400),
        (1, 600, 640),
        (2, 800, 880),
    ]
    with pytest.raises(KeyboardInterrupt):
        train(config, run.parent, watcher=Late(run, breaks=True))
    assert saved_steps(run / "checkpoints")[0] == 600
    (result,) = resume(run, Late(run, beyond=645))
    assert result.finished
    assert labels(run) == labels(whole)
    assert_same_run(run, whole, interrupted=True)


def test_a_session_is_put_off_while_the_one_before_it_is_not_answered(tmp_path: Path):
    class Sluggish(Stop):
        def say(self, sentence: str) -> None:
            if "waits for answers" in sentence:
                answer(tmp_path / "seed-0", 10)

    (result,) = train(taught(wait=False), tmp_path, watcher=Sluggish())
    assert result.finished and result.labels == 10
    assert [row[:3] for row in labels(tmp_path / "seed-0")] == [(0, 400, 400)] * 10 + [(1, 600, None)] * 10


def test_until_there_is_a_label_every_session_is_waited_for(tmp_path: Path):
    run = tmp_path / "seed-0"

    class Skipping(Stop):
        """Skips the whole first session, and answers the last, which is not waited for any more, in time."""

        def say(self, sentence: str) -> None:
            super().say(sentence)
            if "waits for answers" in sentence:
                answer(run, 10, better if "at step 600" in sentence else lambda _: "skip")

        def advance(self, step: int, trainees: object) -> None:
            if step == 871:
                answer(run, 5)

    watcher = Skipping()
    (result,) = train(taught(wait=False), tmp_path, watcher=watcher)
    assert result.labels == 15
    found = labels(run)
    assert {(session, at, learned) for session, at, learned, _ in found[:20]} == {(0, 400, 400), (1, 600, 600)}
    assert [said for said in watcher.said if "waits for answers at step 600" in said]


def test_skips_spend_the_budget_unless_they_are_replaced(tmp_path: Path):
    def fussy(returns: np.ndarray) -> Side:
        return "skip" if int(1000 * returns.sum()) % 3 == 0 else better(returns)

    with person(tmp_path / "spent" / "seed-0", fussy):
        (spent,) = train(taught(), tmp_path / "spent", watcher=Stop())
    with person(tmp_path / "replaced" / "seed-0", fussy, Rules(replace_skipped=True)):
        (replaced,) = train(taught(replace_skipped=True), tmp_path / "replaced", watcher=Stop())
    learned = [row for row in labels(spent.path) if row[2] is not None]
    assert len(learned) == 25 and 0 < spent.labels == sum(row[3] is not None for row in learned) < 25
    assert replaced.labels == 25
    assert rows(replaced.path / "train.csv")[-1]["queried"] == "25"
    learned = [row for row in labels(replaced.path) if row[2] is not None]
    assert len(learned) > 25 and sum(row[3] is None for row in learned) == len(learned) - 25


def test_with_overlap_a_pair_costs_one_of_the_budget_and_is_learned_from_by_the_mean(tmp_path: Path):
    run, rules = tmp_path / "seed-0", Rules(overlap=2)
    with person(run, better, rules), person(run, lambda _: "left", rules, "bob"):
        (result,) = train(taught(overlap=2), tmp_path, watcher=Stop())
    assert result.labels == 25
    with sqlite3.connect(run / "preferences.sqlite") as db:
        said = db.execute(
            "SELECT pairs.second, GROUP_CONCAT(answer) FROM answers JOIN pairs ON pair = pairs.id GROUP BY pair"
        ).fetchall()
    db.close()
    for second, both in said:
        one, other = map(int, both.split(","))
        assert second == (one + other) / 2
    assert {second for second, _ in said} >= {0.5}


def test_a_file_of_labels_teaches_what_its_run_was_taught(oracle: Path, tmp_path: Path):
    """The same segments, labels and steps, so the same weights; a smaller budget takes the first of them."""
    file = tmp_path / "labels.jsonl"
    assert export_labels(oracle, file) == 25
    (result,) = train(short(teacher=str(file)), tmp_path / "again", watcher=Stop())
    assert result.labels == 25
    assert_same_learning(result.path, oracle)
    fewer = short(teacher=str(file))
    fewer = replace(fewer, queries=replace(fewer.queries, budget=12))
    (result,) = train(fewer, tmp_path / "fewer", watcher=Stop())
    assert labels(result.path) == [(row[0], row[1], row[2], row[3]) for row in labels(oracle)[:12]]
    more = replace(fewer, queries=replace(fewer.queries, budget=26))
    with pytest.raises(
        BadInput, match="holds 25 answered pairs, fewer than the budget of 26; give --budget 25 or less"
    ):
        train(more, tmp_path / "more", watcher=Stop())


def test_plain_sac_takes_a_file_of_labels_and_hears_nothing_of_it(tmp_path: Path):
    config = small("sac", teacher=str(tmp_path / "labels.jsonl"))
    (result,) = train(replace(config, steps=100), tmp_path / "out", watcher=Stop())
    assert result.finished and not (result.path / "preferences.sqlite").exists()


def test_what_makes_no_sense_with_people_is_refused(tmp_path: Path):
    for config, sentence in (
        (short("point", asking=Asking(overlap=2)), "--overlap 2 asks several people"),
        (taught(overlap=0), "--overlap must be at least 1"),
        (taught(settle=-1.0), "--settle must be 0 or more"),
        (replace(taught(), method=replace(taught().method, name="sac")), None),
    ):
        if sentence:
            with pytest.raises(BadInput, match=sentence):
                train(config, tmp_path / "refused", watcher=Stop())
    for address, sentence in (
        (Address(host="0.0.0.0", token=""), "Without a token the page can only be served to this machine"),
        (Address(token="a b"), "can stand in a token"),
        (Address(host="192.0.2.1"), "Cannot listen on 192.0.2.1"),
    ):
        with pytest.raises(BadInput, match=sentence):
            train(taught(), tmp_path / "refused", watcher=Stop(), page=address)
    assert not (tmp_path / "refused").exists()


SHAKY = '''
"""A point that shivers by itself: no episode of it can be lived through again. It draws itself, in one colour."""

import gymnasium
import numpy as np


class Shaky(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    observation_space = gymnasium.spaces.Box(-2, 2, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        self.place = np.zeros(2, np.float32)
        return self.place.copy(), {}

    def step(self, action):
        shiver = np.random.default_rng().normal(size=2)
        self.place = np.clip(self.place + 0.1 * action + 0.01 * shiver, -2, 2).astype(np.float32)
        return self.place.copy(), -float(np.abs(self.place - 1).sum()), False, False, {}

    def render(self):
        return np.full((64, 64, 3), int(60 * (self.place[0] + 2)), np.uint8)
'''


def test_what_cannot_be_lived_through_again_is_filmed_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its clips are cut from what was filmed in training; killed, it goes on with another episode."""
    (tmp_path / "shaky_environment.py").write_text(SHAKY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    config = replace(taught(), env="shaky_environment:Shaky", position="0:2", horizon=50)
    run = tmp_path / "out" / "seed-0"
    drawn: list[tuple[str | None, str | None]] = []

    class Looks(Stop):
        """Answers the first session when its clips are there, and breaks off in the second."""

        def say(self, sentence: str) -> None:
            self.said.append(sentence)
            if "at step 400" in sentence:
                drawn.extend(self.clips())
                answer(run, 10)
            elif "at step 600" in sentence:
                raise KeyboardInterrupt

        def clips(self) -> list[tuple[str | None, str | None]]:
            for _ in range(600):
                with sqlite3.connect(run / "preferences.sqlite") as db:
                    found = db.execute("SELECT name, failure FROM clips").fetchall()
                db.close()
                if len(found) == 20:
                    return found
                time.sleep(0.1)
            raise TimeoutError(found)

    with pytest.raises(KeyboardInterrupt):
        train(config, run.parent, watcher=Looks())
    unborn = run.parent / "unborn"
    shutil.copytree(run, unborn)
    assert len(drawn) == 20 and all(name and failure is None for name, failure in drawn), drawn
    assert len(list((run / "label" / "live").glob("episode-*.mp4"))) == 12
    with person(run):
        (result,) = resume(run, Stop())
    assert result.finished and result.labels == 25

    # one that is begun anew, for want of a checkpoint, films anew
    shutil.rmtree(unborn / "checkpoints")
    (unborn / "eval.csv").write_text((unborn / "eval.csv").read_text().partition("\n")[0] + "\n")  # none was due yet
    film = film_of(unborn / "label" / "live", 99)
    film.write_bytes(b"of a life that is over")
    resume(unborn, Stop(100))
    assert not film.exists() and len(list(film.parent.glob("*.mp4"))) == 2


def test_films_are_kept_while_people_are_asked_about_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Training goes on meanwhile, and its window of episodes with it."""
    (tmp_path / "shaky_environment.py").write_text(SHAKY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    config = replace(taught(wait=False), env="shaky_environment:Shaky", position="0:2", horizon=50)
    config = replace(config, queries=replace(config.queries, episodes=3), steps=2000)
    run = tmp_path / "out" / "seed-0"

    class Looks(Stop):
        def say(self, sentence: str) -> None:
            if "at step 400" in sentence:
                answer(run, 10)

    (result,) = train(config, run.parent, watcher=Looks())
    assert result.finished
    with sqlite3.connect(run / "preferences.sqlite") as db:
        asked = db.execute("SELECT episode_0, episode_1 FROM pairs WHERE collected_step IS NULL").fetchall()
    db.close()
    kept = {int(path.stem.removeprefix("episode-")) for path in (run / "label" / "live").glob("*.mp4")}
    assert len(asked) == 10 and kept == {number for pair in asked for number in pair} | {37, 38, 39}


def test_a_session_that_was_put_off_is_put_off_again(tmp_path: Path):
    """Killed after a session that came later than it was due, before a checkpoint: it comes at the same step again."""
    config = replace(short(), horizon=300, checkpoint_every=350)

    class Breaks(Stop):
        def advance(self, step: int, trainees: object) -> None:
            if step == 650:
                raise KeyboardInterrupt

    train(config, tmp_path / "whole", watcher=Stop())
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "broken", watcher=Breaks())
    run = tmp_path / "broken" / "seed-0"
    assert [row[:3] for row in labels(run)] == [(0, 600, 600)] * 10
    (result,) = resume(run, Stop())
    assert result.finished
    assert_same_learning(run, tmp_path / "whole" / "seed-0")
