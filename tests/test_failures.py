"""An environment that breaks stops its own run, with a checkpoint and a sentence; early ends are no time limits."""

from __future__ import annotations

import errno
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]

from senior.config import Config
from senior.envs.episodes import AFTERWARDS, EVALUATION, TRAINING, episode_seed
from senior.envs.point import Point
from senior.files import unpack
from senior.judgement import evaluate_run
from senior.program import Quiet, Result, resume, train
from senior.rundir import RunDirectory, saved_steps
from senior.types import BadInput
from tests.equal import assert_same_run, progress_of
from tests.small import rows, small
from tests.test_resume import Stop

HORIZON, EDGE = 40, 0.85


@dataclass(frozen=True)
class Fault:
    """Where and how an environment breaks: at step ``at`` of those that a run takes for a purpose."""

    kind: str
    at: int
    purpose: int = TRAINING
    seed: int = 1

    def meets(self, reset_seed: int) -> bool:
        return reset_seed in {episode_seed(self.seed, self.purpose, episode) for episode in range(200)}


fault: Fault | None = None


class Robot(Point):
    """A point that falls off near the edges of its square, tells no success, and has the ``fault`` of this module.

    It is the same environment for all tests, so that one program is compiled.
    """

    def __init__(self) -> None:
        super().__init__(HORIZON, tell_success=False)
        self.taken = 0
        self.faulty = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        assert seed is not None
        self.faulty = fault is not None and fault.meets(seed)
        if self.faulty and fault is not None and fault.kind == "reset":
            raise RuntimeError("brake stuck")
        return super().reset(seed=seed)

    def step(self, action: np.ndarray):
        observation, reward, _, truncated, info = super().step(action)
        self.taken += 1
        if fault is not None and self.faulty and self.taken == fault.at:
            match fault.kind:
                case "nan":
                    observation[0] = np.nan
                case "reward":
                    reward = float("nan")
                case "shape":
                    observation = observation[:3]
                case "raise":
                    raise RuntimeError("motor\nburnt")
        return observation, reward, bool(np.abs(self.position).max() > EDGE), truncated, info


def config() -> Config:
    """Pre-training until 400, sessions at 400 and 600, evaluations at 500 and 700, checkpoints every 500."""
    where = {"task": "none", "env": f"{__name__}:Robot", "position": "0:2", "horizon": HORIZON}
    return small(steps=700, queries=replace(small().queries, episodes=60), **where)


def break_it(monkeypatch: pytest.MonkeyPatch, broken: Fault | None) -> None:
    monkeypatch.setitem(globals(), "fault", broken)


class Said(Quiet):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def say(self, sentence: str) -> None:
        self.sentences.append(sentence)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Result]:
    """Two runs in which nothing breaks."""
    return train(config(), tmp_path_factory.mktemp("whole"), seeds=2, watcher=Said())


def assert_stopped(result: Result, step: int, message: str, said: Said) -> None:
    """That run is named, and stands in a checkpoint of that step without a NaN in it."""
    assert not result.finished
    assert result.step == step
    assert result.failure is not None
    assert message in result.failure
    assert f"{__name__}:Robot of seed {result.seed} failed" in result.failure
    assert "\n" not in result.failure
    (sentence,) = [sentence for sentence in said.sentences if "stopped" in sentence]
    assert sentence == f"seed {result.seed} is stopped at step {step}, with a checkpoint: {result.failure}"
    assert saved_steps(result.path / "checkpoints")[0] == step
    assert progress_of(result.path)["step"] == step
    for path in (result.path / "checkpoints").glob("*.npz"):
        for name, array in unpack(path).items():
            assert not np.isnan(array).any(), f"{name} in {path}"
    assert (result.path / "policy" / "actor.npz").exists()


@pytest.mark.parametrize(
    ("kind", "at", "message"),
    [
        ("nan", 30, "the observation is nan at index 0"),  # while actions are random
        ("reward", 350, "the reward is nan"),  # in pre-training
        ("shape", 401, "the observation has shape (3,) instead of (4,)"),  # at the step of the first session
        ("raise", 650, "RuntimeError: motor burnt"),
    ],
)
def test_only_the_run_that_broke_stops_and_it_can_go_on(
    kind: str, at: int, message: str, whole: list[Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    break_it(monkeypatch, Fault(kind, at))
    said = Said()
    good, broken = train(config(), tmp_path, seeds=2, watcher=said)
    assert_stopped(broken, at - 1, message, said)
    assert good.finished
    assert good.step == 700
    assert_same_run(good.path, whole[0].path, interrupted=False)

    break_it(monkeypatch, None)
    (mended,) = resume(broken.path, said)
    assert mended.finished
    assert_same_run(mended.path, whole[1].path, interrupted=True)


def test_a_run_that_breaks_at_its_first_step_leaves_no_checkpoint_and_says_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    break_it(monkeypatch, Fault("nan", 1, seed=0))
    said = Said()
    (broken,) = train(config(), tmp_path, watcher=said)
    assert not broken.finished and saved_steps(broken.path / "checkpoints") == []
    assert said.sentences[-1] == f"seed 0 is stopped at step 0: {broken.failure}"
    break_it(monkeypatch, None)
    (mended,) = resume(broken.path, said)
    assert mended.finished


def test_under_vmap_too_only_the_run_that_broke_stops_with_its_step_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The update of step 649 is under way when the environment breaks; the checkpoint is as if it had been stopped."""
    break_it(monkeypatch, Fault("raise", 650))
    said = Said()
    good, broken = train(config(), tmp_path / "broken", seeds=2, watcher=said, lift="vmap")
    assert_stopped(broken, 649, "RuntimeError: motor burnt", said)
    assert good.finished and good.step == 700
    break_it(monkeypatch, None)
    _, stopped = train(config(), tmp_path / "stopped", seeds=2, watcher=Stop(649), lift="vmap")
    one, other = (unpack(run.path / "checkpoints" / "step-0000000649.npz") for run in (broken, stopped))
    compared = [name for name in one if name.startswith("run.agent")]
    assert len(compared) > 20
    for name in compared:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_a_break_that_stays_stops_the_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    break_it(monkeypatch, Fault("nan", 30, seed=0))
    said = Said()
    (first,) = train(config(), tmp_path, watcher=said)
    assert_stopped(first, 29, "nan", said)
    break_it(monkeypatch, Fault("raise", 33, seed=0))
    said = Said()
    (again,) = resume(tmp_path, said)
    assert again.failure is not None
    assert "motor burnt" in again.failure
    assert (again.finished, again.step) == (False, 32)  # the 29 steps before are lived through again


def test_an_environment_that_cannot_begin_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    break_it(monkeypatch, Fault("reset", 0))
    with pytest.raises(BadInput, match="of seed 1 failed in episode 0 after step 0: RuntimeError: brake stuck"):
        train(config(), tmp_path / "out", seeds=2)
    assert not (tmp_path / "out").exists()


def test_networks_that_diverge_stop_their_run_before_they_are_saved(tmp_path: Path):
    wild = config()
    wild = replace(wild, sac=replace(wild.sac, critic_rate=1e30, actor_rate=1e30))
    said = Said()
    (result,) = train(wild, tmp_path, watcher=said)
    assert result.failure is not None and "networks have diverged" in result.failure
    assert any("networks have diverged" in sentence for sentence in said.sentences)
    for step in saved_steps(result.path / "checkpoints"):
        held = unpack(result.path / "checkpoints" / f"step-{step:010d}.npz")
        assert all(np.isfinite(array).all() for array in held.values() if array.dtype == np.float32)


def test_a_disk_that_is_full_for_tensorboard_keeps_no_row_from_its_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object) -> None:
        raise OSError("No space left on device")

    directory = RunDirectory(tmp_path / "run")
    directory.create(config(), {})
    directory.forget_everything()
    for step in range(3):
        directory.append("eval.csv", {"step": step, "success_rate": None, "return_mean": 1.5, "return_std": 2.0})
        monkeypatch.setattr(EventsWriter, "write_event", full)
    directory.close()
    assert len(rows(directory.path / "eval.csv")) == 3

    (file,) = (directory.path / "tensorboard").iterdir()
    written, found = file.read_bytes(), []
    while written:  # length, checksum, event, checksum
        (length,) = struct.unpack("<Q", written[:8])
        event = Event.FromString(written[12 : 12 + length])
        found += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
        written = written[16 + length :]
    assert found == [(0, "eval/return_mean", 1.5), (0, "eval/return_std", 2.0)]


def test_positions_that_cannot_be_read_for_a_moment_are_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    directory, first, second = RunDirectory(tmp_path), np.zeros((5, 2)), np.ones((5, 2))
    directory.snapshot(10, first, {})
    kept = (tmp_path / "positions.npz").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", lambda path: raise_it(OSError(errno.EIO, "Input/output error", str(path))))
        with pytest.raises(OSError, match="Input/output error"):
            directory.snapshot(20, second, {})
    assert (tmp_path / "positions.npz").read_bytes() == kept
    directory.snapshot(20, second, {})
    found = unpack(tmp_path / "positions.npz")
    assert {name: array.tolist() for name, array in found.items()} == {
        "step-0000000010": first.tolist(),
        "step-0000000020": second.tolist(),
    }


def raise_it(error: Exception) -> Any:
    raise error


def test_all_runs_stop_when_all_break(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Fault, "meets", lambda self, seed: True)
    break_it(monkeypatch, Fault("raise", 60))  # evaluations come later
    results = train(config(), tmp_path, seeds=2, watcher=Said())
    assert [(result.finished, result.step) for result in results] == [(False, 59), (False, 59)]


def test_an_evaluation_that_breaks_stops_its_run(whole: list[Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    break_it(monkeypatch, Fault("nan", 45, EVALUATION))
    said = Said()
    good, broken = train(config(), tmp_path, seeds=2, watcher=said)
    assert_stopped(broken, 500, "the observation is nan", said)
    assert rows(broken.path / "eval.csv") == []
    assert_same_run(good.path, whole[0].path, interrupted=False)

    break_it(monkeypatch, None)
    (mended,) = resume(broken.path, said)
    assert mended.finished
    assert_same_run(mended.path, whole[1].path, interrupted=True)


def test_an_evaluation_afterwards_that_breaks_is_told(whole: list[Result], monkeypatch: pytest.MonkeyPatch):
    break_it(monkeypatch, Fault("raise", 3, AFTERWARDS))
    with pytest.raises(BadInput, match="seed 1 failed in episode 0 after step 2: RuntimeError: motor burnt"):
        evaluate_run(whole[1].path, episodes=2)
    assert evaluate_run(whole[0].path, episodes=2).episodes == 2


def test_early_ends_are_no_time_limits_and_untold_success_stays_empty(whole: list[Result]):
    for result in whole:
        assert result.finished
        assert result.success_rate is None
        assert result.labels == 20
        evaluations, episodes = rows(result.path / "eval.csv"), rows(result.path / "train.csv")
        assert [int(row["step"]) for row in evaluations] == [500, 700]
        assert [row["success_rate"] for row in evaluations] == ["", ""]
        assert all(float(row["return_mean"]) > 0 for row in evaluations)
        assert {row["episode_success"] for row in episodes} == {""}
        assert evaluate_run(result.path, episodes=2).success_rate is None

        lengths = [int(row["episode_length"]) for row in episodes]
        assert min(lengths) < max(lengths) == HORIZON
        assert [int(row["step"]) for row in episodes] == np.cumsum(lengths).tolist()
        for path in (result.path / "checkpoints").glob("facts-*.npz"):
            facts = unpack(path)
            fell = np.abs(facts["next_observation"][:, :2]).max(axis=1) > EDGE
            assert fell.any()
            np.testing.assert_array_equal(facts["terminated"], fell)
            ended = np.isin(np.arange(700), np.cumsum(lengths) - 1)
            first, last = (int(number) for number in path.stem.split("-")[1:])
            np.testing.assert_array_equal(facts["terminated"] | facts["truncated"], ended[first:last])
