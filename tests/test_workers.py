"""Environments in processes of their own: the same steps as in this one, whatever befalls the processes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from senior import envs
from senior.envs.episodes import EVALUATION, TRAINING, Episodes, Failure, Local, Step
from senior.envs.point import Point
from senior.envs.workers import LIVES, Remote, Workers
from senior.program import Quiet, resume, train
from senior.trainee import Trainee
from senior.types import BadInput
from tests.equal import assert_same_run, short
from tests.small import small

HERE = __name__


class Treacherous(Point):
    """A point that does, at step 3 of an episode, what a file in the working directory of its user says."""

    def __init__(self) -> None:
        super().__init__(horizon=6)

    def step(self, action: np.ndarray) -> Any:
        order = Path(os.environ["TREACHERY"])
        if self.elapsed == 2 and order.exists():
            match order.read_text():
                case "die":
                    os._exit(7)
                case "hang once":
                    order.unlink()
                    time.sleep(3600)
                case "die once":
                    order.unlink()
                    os._exit(7)
                case "nan":
                    return np.full(4, np.nan, np.float32), 0.0, False, False, {"success": 0.0}
        return super().step(action)


class Forgetful(Point):
    """A point that starts anywhere, whatever its seed."""

    def reset(self, **options: Any) -> Any:
        return super().reset(seed=time.monotonic_ns() % 2**31)


@pytest.fixture
def treachery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TREACHERY", str(tmp_path / "order"))
    return tmp_path / "order"


def test_workers_are_started_when_they_are_needed():
    pool = Workers(2)
    try:
        assert pool.workers == []
        first = pool.next()
        assert pool.workers == [first]
        second = pool.next()
        assert pool.next() is first is not second
        assert first.fellows == second.fellows == [first, second]
    finally:
        pool.close()


@pytest.fixture
def pool(treachery: Path) -> Iterator[Workers]:
    """Two workers."""
    workers = Workers(2)
    yield workers
    workers.close()


class Attached(Point):
    """A point with a simulator that it starts, of two files that lie side by side."""

    def __init__(self) -> None:
        super().__init__(horizon=6)
        subprocess.run([sys.executable, os.environ["SIMULATOR"]], check=True)


def test_a_worker_imports_from_where_this_process_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not first from the working directory, where a user's module may have the name of one of Python's.

    What its environments start looks where Python always does.
    """
    (tmp_path / "simulator").mkdir()
    (tmp_path / "simulator" / "main.py").write_text("import beside\n")
    (tmp_path / "simulator" / "beside.py").touch()
    (tmp_path / "json.py").write_text("raise RuntimeError('not the module json that was meant')\n")
    monkeypatch.setenv("SIMULATOR", str(tmp_path / "simulator" / "main.py"))
    monkeypatch.chdir(tmp_path)
    pool = Workers(1)
    try:
        remote, _ = pair(pool, made_by("Attached"), 0)
        assert remote.begin(0) is None
    finally:
        pool.close()


def made_by(env: str | None = None, task: str | None = None) -> dict[str, Any]:
    return {
        "task": task,
        "env": env and f"{HERE}:{env}",
        "position": "0:2" if env else None,
        "horizon": 6 if env else 50,
    }


def pair(pool: Workers, made: dict[str, Any], seed: int, purpose: int = TRAINING) -> tuple[Remote, Local]:
    local = Local(lambda: envs.make(**made), seed, purpose)
    return Remote(pool.next(), made, local.spec, seed, purpose), local


def go(place: Episodes, action: np.ndarray) -> Step | Failure:
    place.send(action)
    return place.receive()


def assert_same(one: Step | Failure, other: Step | Failure) -> None:
    assert isinstance(one, Step) and isinstance(other, Step), (one, other)
    for name, left, right in zip(Step._fields, one, other, strict=True):
        assert np.array_equal(left, right), name
        assert getattr(left, "dtype", type(left)) == getattr(right, "dtype", type(right)), name


@pytest.mark.parametrize("task", ["point", "handle-press"])
def test_killed_workers_change_nothing(pool: Workers, task: str):
    """Three environments in two workers, which are killed in turn, at an episode's end and beginning too."""
    made = made_by(task=task)
    places = [pair(pool, made, seed) for seed in (0, 1, 2)]
    for remote, local in places:
        assert (remote.begin(3), local.begin(3)) == (None, None)
        np.testing.assert_array_equal(remote.observation, local.observation)
    rng = np.random.default_rng(0)
    for step in range(110):
        actions = rng.uniform(-1, 1, (3, places[0][1].spec.action_size)).astype(np.float32)
        if step in (0, 20, 21, 49, 50, 99):
            pool.workers[step % 2].process.kill()
        for (remote, _), action in zip(places, actions, strict=True):
            remote.send(action)
        if step == 70:
            pool.workers[0].process.kill()
        for (remote, local), action in zip(places, actions, strict=True):
            assert_same(remote.receive(), go(local, action))
            assert remote.episode == local.episode
    notes = [remote.notes for remote, _ in places]
    assert [len(told) for told in notes] == [4, 3, 4]  # the first and the third share a worker
    # killed while the step was under way, or when it was done
    assert re.search(r"died \(SIGKILL\); another took over in episode 4 after step 2[01]\.$", notes[0][-1])
    assert places[0][0].begin(9) is None and places[0][1].begin(9) is None
    np.testing.assert_array_equal(places[0][0].observation, places[0][1].observation)


def test_a_worker_that_hangs_is_replaced(pool: Workers, treachery: Path):
    remote, local = pair(pool, made_by("Treacherous"), 0, EVALUATION)
    remote.begin(0)
    local.begin(0)
    action = np.ones(2, np.float32)
    assert_same(go(remote, action), go(local, action))
    assert_same(go(remote, action), go(local, action))
    remote._worker.patience = 10
    treachery.write_text("hang once")
    remote.send(action)
    answer = remote.receive()
    assert not treachery.exists()
    assert_same(answer, go(local, action))
    assert remote.notes == [
        f"The worker of the environment {HERE}:Treacherous gave no answer for 10 seconds; another took over in "
        "episode 0 after step 2."
    ]


def test_an_environment_that_kills_its_worker_again_and_again_is_given_up(pool: Workers, treachery: Path):
    (remote, _), (beside, local) = (pair(pool, made_by("Treacherous"), seed) for seed in (0, 1))
    action = np.ones(2, np.float32)
    for place in (remote, beside, local):
        place.begin(0)
    for _ in range(2):
        assert isinstance(go(remote, action), Step)
    treachery.write_text("die")
    failure = go(remote, action)
    assert failure == Failure(
        f"The environment {HERE}:Treacherous of seed 0 failed in episode 0 after step 2: {LIVES} workers were lost at "
        "this step; the last one died (exit code 7)."
    )
    assert go(remote, action) == failure
    treachery.unlink()
    assert_same(go(beside, action), go(local, action))
    assert remote.begin(1) is None
    assert isinstance(go(remote, action), Step)


def test_a_worker_lost_while_another_brings_the_environment_back_is_replaced_too(pool: Workers, treachery: Path):
    remote, local = pair(pool, made_by("Treacherous"), 3)
    rng = np.random.default_rng(0)
    for place in (remote, local):
        place.begin(0)
    for step in range(9):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        if step == 4:
            treachery.write_text("die once")  # at step 3, which is lived through again
            remote._worker.process.kill()
        assert_same(go(remote, action), go(local, action))
    assert not treachery.exists()
    assert len(remote.notes) == 2


def test_an_answer_nobody_asked_for_is_not_taken_for_the_next(pool: Workers, treachery: Path):
    remote, local = pair(pool, made_by("Treacherous"), 3)
    remote.begin(0)
    remote.send(np.ones(2, np.float32))
    assert (remote.begin(1), local.begin(1)) == (None, None)
    np.testing.assert_array_equal(remote.observation, local.observation)
    assert_same(go(remote, np.ones(2, np.float32)), go(local, np.ones(2, np.float32)))


def test_an_environment_that_cannot_be_built_there_is_told(pool: Workers):
    _, local = pair(pool, made_by("Treacherous"), 3)
    remote = Remote(pool.next(), {**made_by("Treacherous"), "env": "nowhere:Robot"}, local.spec, 3, TRAINING)
    failure = remote.begin(0)
    assert failure is not None
    assert f"The environment {HERE}:Treacherous of seed 3 failed in episode 0 after step 0: BadInput" in failure.message
    assert remote.begin(1) == remote.begin(1) != failure  # the worker lives


def test_what_an_environment_does_wrong_is_told_as_in_this_process(pool: Workers, treachery: Path):
    remote, local = pair(pool, made_by("Treacherous"), 5)
    for place in (remote, local):
        place.begin(0)
        for _ in range(2):
            go(place, np.ones(2, np.float32))
    treachery.write_text("nan")
    failure = go(remote, np.ones(2, np.float32))
    assert isinstance(failure, Failure)
    assert failure == go(local, np.ones(2, np.float32))
    assert "the observation is nan at index 0" in failure.message


def test_an_environment_that_does_not_repeat_itself_cannot_be_brought_back(pool: Workers):
    made = made_by("Forgetful")
    remote, _ = pair(pool, made, 0)
    remote.begin(0)
    assert isinstance(go(remote, np.ones(2, np.float32)), Step)
    remote._worker.process.kill()
    failure = go(remote, np.ones(2, np.float32))
    assert isinstance(failure, Failure)
    assert "its worker was lost, and it does not repeat an episode" in failure.message


class Killer(Quiet):
    """Kills every worker when training comes to certain steps."""

    def __init__(self, *steps: int) -> None:
        self.steps = steps
        self.said: list[str] = []

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        if step in self.steps:
            for trainee in trainees:
                place: Any = trainee.environment
                os.kill(place._worker.process.pid, signal.SIGKILL)

    def say(self, sentence: str) -> None:
        self.said.append(sentence)


def test_a_run_whose_workers_are_killed_equals_the_undisturbed_one(tmp_path: Path):
    """In pre-training, before the session of step 600, before an evaluation; and resumed with a worker in the end."""
    whole = train(short(), tmp_path / "whole", seeds=2)
    killer = Killer(150, 500, 600, 733)
    disturbed = train(short(), tmp_path / "disturbed", seeds=2, watcher=killer, workers=2)
    for one, other in zip(whole, disturbed, strict=True):
        assert_same_run(one.path, other.path, interrupted=False)
        told = (other.path / "workers.log").read_text()
        assert told.count("died (SIGKILL); another took over") == 4
        assert told.splitlines()[0].split(" ", 1)[1] in " ".join(killer.said)
        assert not (one.path / "workers.log").exists()
    for path in (disturbed[0].path / "checkpoints").glob("step-0000001000*"):
        path.unlink()
    (again,) = resume(disturbed[0].path, Killer(950), workers=1)
    assert again.finished
    assert_same_run(whole[0].path, again.path, interrupted=True)


def test_no_negative_number_of_workers(tmp_path: Path):
    with pytest.raises(BadInput, match="--workers -1"):
        train(replace(small(), steps=500), tmp_path, workers=-1)
