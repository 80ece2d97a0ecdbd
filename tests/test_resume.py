"""A run that was interrupted or killed, and then resumed, equals the uninterrupted one bit for bit."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from senior.cli.display import Display
from senior.cli.shared import DONE, INTERRUPTED
from senior.config import Answering, Config, load
from senior.envs.point import Point
from senior.judgement import evaluate_run
from senior.policy import load_policy
from senior.presets import release
from senior.program import Quiet, resume, train
from senior.rundir import saved_steps
from senior.schedule import plan
from senior.trainee import Trainee
from senior.types import BadInput
from tests import victim
from tests.equal import OPTIONS, assert_same_run, progress_of, short
from tests.small import preferences_dump, rows, small

ROOT = Path(__file__).parents[1]


class Stop(Quiet):
    """Says stop after some step, as an interrupt does; remembers what was said."""

    def __init__(self, after: int | None = None) -> None:
        self.after = after
        self.said: list[str] = []

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        self.stop = step == self.after

    def say(self, sentence: str) -> None:
        self.said.append(sentence)


def senior(moment: str | None, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, which a signal hits at a moment (tests/victim.py) if one is given."""
    program = ["tests.victim", moment] if moment else ["senior.cli"]
    command = [sys.executable, "-m", *program, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two uninterrupted runs, seeds 0 and 1."""
    out = tmp_path_factory.mktemp("reference")
    results = train(short(device="cpu"), out, seeds=2)
    assert all(result.finished and result.labels == 25 for result in results)
    return out


def assert_goes_on_from(run: Path, saved: int, asked: int, whole: Path) -> None:
    """The run stopped with that checkpoint and so many pairs asked; resumed, it equals the whole one."""
    assert saved_steps(run / "checkpoints")[:1] == ([saved] if saved else [])
    assert len(preferences_dump(run)) == asked
    watcher = Stop()
    (result,) = resume(run, watcher)
    assert result.finished
    assert_same_run(run, whole, interrupted=True)
    assert [sentence.split(",")[0] for sentence in watcher.said] == ["Training on the CPU"]
    assert not list(run.rglob("checkpoints/*.tmp"))


@pytest.mark.parametrize(
    ("place", "saved", "asked"),
    [
        ("300", 260, 0),  # in pre-training
        ("575", 520, 10),  # in the middle of an episode
        ("fit", 520, 20),
        ("checkpoint", 520, 20),
    ],
)
def test_killed_at_any_moment_a_run_goes_on_as_if_nothing_had_happened(
    place: str, saved: int, asked: int, reference: Path, tmp_path: Path
):
    killed = senior(f"SIGKILL:{place}", "train", *OPTIONS, "--out", tmp_path)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    run = tmp_path / "seed-0"
    assert load(run / "config.json") == load(reference / "seed-0" / "config.json")
    if place == "checkpoint":
        assert (run / "checkpoints" / "step-0000000650.npz.tmp").exists()
        assert (run / "checkpoints" / "facts-0000000520-0000000650.npz").exists()
    assert_goes_on_from(run, saved, asked, reference / "seed-0")


class Struck(BaseException):
    """Ends a run in this process: cheaper than a kill, and alike for files that are written whole."""


@pytest.mark.parametrize(
    ("place", "saved", "asked"),
    [
        ("60", 0, 0),  # before the first checkpoint
        ("asked", 520, 20),
        ("saved", 1000, 25),
    ],
)
def test_broken_off_where_it_matters_a_run_goes_on_alike(
    place: str, saved: int, asked: int, reference: Path, tmp_path: Path
):
    def strike() -> None:
        raise Struck

    with pytest.MonkeyPatch.context() as patch:
        victim.arm(place, strike, patch.setattr)
        with pytest.raises(Struck):
            train(short(), tmp_path, watcher=Stop())
    assert_goes_on_from(tmp_path / "seed-0", saved, asked, reference / "seed-0")


def test_interrupted_on_the_command_line_again_and_again(reference: Path, tmp_path: Path):
    """SIGINT in training, SIGTERM in what goes on, and a third process that comes to the end."""
    run = tmp_path / "seed-0"
    first = senior("SIGINT:575", "train", *OPTIONS, "--out", tmp_path)
    assert first.returncode == INTERRUPTED == 130, first.stderr
    assert f"interrupted at step 576, all saved; go on with: senior resume {run}" in first.stdout
    assert saved_steps(run / "checkpoints")[0] == 576
    second = senior("SIGTERM:777", "resume", run)
    assert second.returncode == INTERRUPTED, second.stderr
    assert "interrupted at step 778, all saved" in second.stdout
    assert saved_steps(run / "checkpoints")[0] == 778
    third = senior(None, "resume", run)
    assert third.returncode == DONE, third.stderr
    assert_same_run(run, reference / "seed-0", interrupted=True)
    last = [int(path.stem.split("-")[2]) for path in sorted((run / "checkpoints").glob("facts-*.npz"))]
    first_rows = [int(path.stem.split("-")[1]) for path in sorted((run / "checkpoints").glob("facts-*.npz"))]
    assert first_rows == [0, *last[:-1]], "a fact was written twice"
    assert [int(row["step"]) for row in rows(run / "timing.csv")] == [500, 1000]


def test_a_second_signal_ends_the_program_at_once():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        display = Display()
        os.kill(os.getpid(), signal.SIGTERM)
        assert display.stop
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_all_seeds_under_a_directory_go_on_wherever_each_stands(reference: Path, tmp_path: Path):
    """Interrupted together; then one is taken further than the other, and both go on at once."""
    results = train(short(), tmp_path, seeds=2, watcher=Stop(470))
    assert [(result.step, result.finished) for result in results] == [(470, False)] * 2
    (ahead,) = resume(tmp_path / "seed-1", Stop(655))
    assert (ahead.step, ahead.finished) == (655, False)
    results = resume(tmp_path)
    assert [(result.seed, result.finished) for result in results] == [(0, True), (1, True)]
    for seed in ("seed-0", "seed-1"):
        assert_same_run(tmp_path / seed, reference / seed, interrupted=True)


def test_a_run_that_an_interrupt_kept_from_going_on_is_among_the_results(reference: Path, tmp_path: Path):
    train(short(), tmp_path, seeds=2, watcher=Stop(470))
    resume(tmp_path / "seed-1", Stop(655))
    results = resume(tmp_path, Stop(480))  # one after the other; the second is not begun
    assert [(result.seed, result.step, result.finished) for result in results] == [(0, 480, False), (1, 655, False)]


def test_interrupted_at_awkward_moments(reference: Path, tmp_path: Path):
    """Before the first step, at a checkpoint, at an episode's end, around a session, right before the end."""
    for result in train(short(), tmp_path, watcher=Stop(1)):
        assert result.step == 1
    for step in (2, 130, 150, 400, 401, 600, 601, 999):
        (result,) = resume(tmp_path, Stop(step))
        assert (result.step, result.finished) == (step, False)
    (result,) = resume(tmp_path)
    assert result.finished
    assert_same_run(tmp_path / "seed-0", reference / "seed-0", interrupted=True)


def noisy_qpa() -> Config:
    """QPA with standardised observations and a teacher that errs, skips and calls equal."""
    config = small("qpa")
    config = replace(config, reward=replace(config.reward, standardise=True))
    keep = {
        name: getattr(short(), name) for name in ("steps", "horizon", "replay_capacity", "checkpoint_every", "queries")
    }
    answering = Answering(rationality=1.0, mistake=0.2, skip=0.9, equal=0.1)
    return replace(config, **keep, teacher="noisy", answering=answering, qpa=replace(config.qpa, episodes=4))


@pytest.mark.parametrize("name", ["qpa", "release"])
def test_other_methods_and_a_teacher_of_chance_go_on_alike_too(name: str, tmp_path: Path):
    config = noisy_qpa() if name == "qpa" else replace(release(short()), replay_capacity=None)
    (whole,) = train(config, tmp_path / "whole")
    assert whole.finished
    train(config, tmp_path / "cut", watcher=Stop(420))
    for step in (601, 799):
        resume(tmp_path / "cut", Stop(step))
    (result,) = resume(tmp_path / "cut")
    assert result.finished
    assert_same_run(result.path, whole.path, interrupted=True)
    if name == "qpa":
        assert 0 < whole.labels < plan(config).queried
    else:
        expected, last = plan(config), rows(whole.path / "train.csv")[-1]
        assert whole.labels == expected.queried
        counted = (int(last["refreshes"]), int(last["outer_steps"]))
        assert counted == (expected.refreshes, expected.outer_steps) == (5, 1)
        assert expected.refreshes == plan(short()).refreshes - 1  # none at steps with an outer step
        assert 0 < float(last["beta"]) == pytest.approx(0.1 * 0.99**900, rel=1e-4)  # counted in steps
        assert float(last["curiosity_share"]) == pytest.approx(19 / (19 + 44))  # int(0.3 * 64) and int(0.7 * 64)


def test_a_finished_run_is_left_as_it_is(reference: Path, tmp_path: Path):
    run = tmp_path / "seed-0"
    shutil.copytree(reference / "seed-0", run)
    for _ in range(2):
        before = sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*"))
        (result,) = resume(run)
        assert (result.finished, result.step, result.labels) == (True, 1000, 25)
        assert before == sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*"))
        assert_same_run(run, reference / "seed-0", interrupted=False)
        assert load_policy(run).step == 1000


def test_with_its_newest_checkpoint_damaged_a_run_goes_on_from_the_one_before(reference: Path, tmp_path: Path):
    run = tmp_path / "seed-0"
    shutil.copytree(reference / "seed-0", run)
    newest = run / "checkpoints" / "step-0000001000.npz"
    newest.write_bytes(newest.read_bytes()[:-1000])
    watcher = Stop()
    (result,) = resume(run, watcher)
    assert result.finished
    assert any(newest.name in sentence and "the one before" in sentence for sentence in watcher.said), watcher.said
    assert_same_run(run, reference / "seed-0", interrupted=True)


def test_a_run_that_cannot_go_on_is_told_and_the_others_do(reference: Path, tmp_path: Path):
    train(short(), tmp_path, seeds=2, watcher=Stop(655))
    for path in (tmp_path / "seed-0" / "checkpoints").glob("step-*.npz"):
        path.write_bytes(b"PK no archive")
    (tmp_path / "settings").mkdir()
    (tmp_path / "settings" / "config.json").write_text("{}")  # somebody else's
    watcher = Stop()
    broken, good = resume(tmp_path, watcher)
    assert broken.failure is not None and "No checkpoint in" in broken.failure
    assert (broken.path, broken.finished) == (tmp_path / "seed-0", False)
    assert any(sentence.endswith(broken.failure) for sentence in watcher.said)
    assert (good.seed, good.finished) == (1, True)
    assert_same_run(tmp_path / "seed-1", reference / "seed-1", interrupted=True)


def test_a_run_is_trained_by_one_process_at_a_time(reference: Path, tmp_path: Path):
    """The second is refused before it changes anything; the lock goes with the process that held it."""

    class Intruder(Stop):
        refused: subprocess.CompletedProcess[str] | None = None

        def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
            if step == 300:
                self.refused = senior(None, "resume", tmp_path)

    watcher = Intruder()
    train(short(device="cpu"), tmp_path, watcher=watcher)
    assert watcher.refused is not None
    assert watcher.refused.returncode == 2
    assert watcher.refused.stderr == f"senior: The run in {tmp_path / 'seed-0'} is being trained by another process.\n"
    assert_same_run(tmp_path / "seed-0", reference / "seed-0", interrupted=False)
    (result,) = resume(tmp_path)
    assert result.finished


@pytest.mark.parametrize("moment", ["directory", "config.json", "tables"])
def test_killed_while_its_directory_is_made(moment: str, reference: Path, tmp_path: Path):
    """``config.json`` comes first, so there is nothing to resume, or a run that begins."""
    run = tmp_path / "seed-0"
    run.mkdir()
    if moment == "config.json":
        (run / "config.json.tmp").write_text('{"config": {"se')
    if moment == "tables":
        shutil.copy(reference / "seed-0" / "config.json", run)
        (result,) = resume(tmp_path)
    else:
        (result,) = train(short(device="cpu"), tmp_path)
    assert result.finished
    assert_same_run(run, reference / "seed-0", interrupted=False)


def test_with_all_checkpoints_damaged_there_is_one_clear_sentence(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run = tmp_path / "seed-0"
    shutil.copytree(reference / "seed-0", run)
    for step in saved_steps(run / "checkpoints"):
        (run / "checkpoints" / f"step-{step:010d}.npz").write_bytes(b"")
    before = {path: path.read_bytes() for path in sorted(run.rglob("*.csv"))}
    with pytest.raises(BadInput, match=r"^No checkpoint in .*seed-0 can be read; the run cannot be resumed\.$"):
        resume(run, Stop())
    assert before == {path: path.read_bytes() for path in sorted(run.rglob("*.csv"))}
    with pytest.raises(BadInput, match="There is no run in"):
        resume(tmp_path / "elsewhere", Stop())


def test_a_run_whose_checkpoints_are_gone_keeps_its_results(reference: Path, tmp_path: Path):
    run = tmp_path / "seed-0"
    shutil.copytree(reference / "seed-0", run)
    shutil.rmtree(run / "checkpoints")
    for name in (None, "status.json", "policy"):  # as somebody may have copied it
        if name:
            shutil.rmtree(run / name) if (run / name).is_dir() else (run / name).unlink()
        before = {path: path.read_bytes() for path in sorted(run.rglob("*.csv"))}
        with pytest.raises(BadInput, match=r"The checkpoints of the run in .*seed-0 are gone, so it cannot go on"):
            resume(run, Stop())
        assert before == {path: path.read_bytes() for path in sorted(run.rglob("*.csv"))}


def test_a_run_whose_environment_has_changed_does_not_go_on(reference: Path, tmp_path: Path):
    run = tmp_path / "seed-0"
    shutil.copytree(reference / "seed-0", run)
    (run / "checkpoints" / "step-0000001000.npz").unlink()
    content = json.loads((run / "config.json").read_text())
    content["protocol"]["observation_size"] = 3
    (run / "config.json").write_text(json.dumps(content))
    sentence = r"The environment point has changed since the run in .* began: its observation size was 3 and is 4\."
    with pytest.raises(BadInput, match=sentence):
        resume(run, Stop())
    with pytest.raises(BadInput, match=sentence):
        evaluate_run(run, episodes=1)


def test_a_run_of_another_machine_goes_on_but_says_so(reference: Path, tmp_path: Path):
    run = tmp_path / "seed-0"
    shutil.copytree(reference / "seed-0", run)
    content = json.loads((run / "config.json").read_text())
    (run / "checkpoints" / "step-0000001000.npz").unlink()
    content["protocol"]["threads"] += 1
    content["protocol"]["packages"]["jax"] = "0.0.1"
    (run / "config.json").write_text(json.dumps(content))
    watcher = Stop()
    (result,) = resume(run, watcher)
    assert result.finished
    sentence, _ = watcher.said
    assert sentence.startswith("seed 0: threads and packages differ from when the run began, so it goes on but")


def test_what_could_not_be_read_again_is_not_begun(tmp_path: Path):
    with pytest.raises(BadInput, match=r"expected int @ \$\.checkpoint_every"):
        train(replace(short(), checkpoint_every=20.0), tmp_path, watcher=Stop())  # pyright: ignore[reportArgumentType]
    assert not list(tmp_path.iterdir())


def test_runs_of_another_device_than_the_first_are_left_to_be_resumed_by_themselves(reference: Path, tmp_path: Path):
    """One that has no steps to take does not matter."""
    shutil.copytree(reference, tmp_path, dirs_exist_ok=True)
    shutil.copytree(reference / "seed-0", tmp_path / "over")
    for name in ("seed-0", "seed-1"):
        (tmp_path / name / "checkpoints" / "step-0000001000.npz").unlink()
    for name in ("seed-1", "over"):
        about = tmp_path / name / "config.json"
        about.write_text(about.read_text().replace('"device": "cpu"', '"device": "gpu"', 1))
    watcher = Stop()
    over, first, left = resume(tmp_path, watcher)
    assert [result.path.name for result in (over, first, left)] == ["over", "seed-0", "seed-1"]
    assert over.finished and first.finished
    assert left.failure == "It is computed on the GPU, and others here on the CPU; resume it by itself."
    assert f"{tmp_path / 'seed-1'}: {left.failure}" in watcher.said


class Moody(Point):
    """A point that begins where it likes, whatever seed it is given."""

    moods = np.random.default_rng(0)

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        return super().reset(seed=int(self.moods.integers(1 << 30)))


@pytest.mark.parametrize(("stop", "elapsed"), [(70, 20), (100, 0)], ids=["amid an episode", "between episodes"])
@pytest.mark.parametrize("name", ["tests.test_resume:Moody", "senior.envs.point:Point"])
def test_only_an_environment_that_repeats_itself_can_be_resumed(name: str, stop: int, elapsed: int, tmp_path: Path):
    config = short(env=name, position="0:2", steps=500)
    (result,) = train(config, tmp_path, watcher=Stop(stop))
    assert progress_of(result.path)["elapsed"] == elapsed
    if name.startswith("senior"):
        (result,) = resume(tmp_path, Stop(110))
        assert result.step == 110
        return
    with pytest.raises(BadInput) as caught:
        resume(tmp_path, Stop())
    assert str(caught.value) == (
        f"The environment {name} does not repeat an episode from its seed and actions, so the run in {result.path} "
        "cannot be resumed exactly; its reset must honour the seed it is given."
    )


def test_killed_on_meta_world(tmp_path: Path):
    """In the middle of an episode of simulated physics, after an evaluation and a session."""
    (whole,) = train(short("door-close", steps=700), tmp_path / "whole")
    options = [*OPTIONS, "--task", "door-close", "--steps", "700"]
    killed = senior("SIGKILL:575", "train", *options, "--out", tmp_path / "killed")
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    run = tmp_path / "killed" / "seed-0"
    assert progress_of(run)["elapsed"] == 20
    assert_goes_on_from(run, 520, 10, whole.path)
