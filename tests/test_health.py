"""Every health warning fires where it should and nowhere else, once per run, and is kept in warnings.log."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from senior import health, loop, session
from senior.fit import spec_of
from senior.program import Quiet, make_learner
from senior.runs import Runs
from senior.trainee import Trainee
from tests.small import small


@pytest.mark.parametrize(
    ("right", "asked", "told"),
    [
        ([], [], None),
        ([14], [29], None),  # too few to say anything
        ([15], [30], "15 of the last 30"),
        ([16], [30], "16 of the last 30"),
        ([17], [30], None),  # 57 %
        ([30, 5, 5, 5], [30, 10, 10, 10], "15 of the last 30"),  # good once, bad since
        ([0, 9, 9, 9], [30, 10, 10, 10], None),  # bad once, good since
        ([0, 20], [40, 20], "20 of the last 60"),  # the latest 20 are too few, so older ones count too
        ([0, 0], [15, 15], "0 of the last 30"),
    ],
)
def test_accuracy_at_chance(right: list[int], asked: list[int], told: str | None):
    found = health.accuracy_at_chance(right, asked)
    assert (found is None) == (told is None)
    assert told is None or (told in found and "no better than chance" in found)


@pytest.mark.parametrize(
    ("beta", "mean", "fires"), [(0.1, 0.5, False), (0, 0.5, True), (0.1, 0, True), (1e-9, 1, True)]
)
def test_bonus_zero(beta: float, mean: float, fires: bool):
    found = health.bonus_zero(beta, mean)
    assert (found is not None) == fires
    assert found is None or "bonus is zero" in found


@pytest.mark.parametrize(
    ("spread", "scale", "fires"),
    [(0, 1, True), (5e-5, 1, True), (2e-4, 1, False), (2e-4, 10, True), (2e-4, 0.1, False), (5e-6, 0.1, True)],
)
def test_nothing_moves(spread: float, scale: float, fires: bool):
    found = health.nothing_moves(spread**2, scale)
    assert (found is not None) == fires
    assert found is None or "No candidate segment moves" in found


@pytest.mark.parametrize(
    ("success", "learned", "fires"),
    [
        ([], [], False),
        ([0.9, 0.0], [1, 2], False),  # too early
        ([0.2, 0.9, 0.1, 0.0], [1, 2, 3, 4], True),
        ([0.2, 0.9, 0.1, 0.0], [1, 4, 3, 2], False),  # the learned return fell too: not exploited, only unlearned
        ([0.2, 0.9, 0.1, 0.8], [1, 2, 3, 4], False),  # recovered
        ([0.2, 0.9, 0.8, 0.0], [1, 2, 3, 4], False),  # one bad evaluation is not yet a fall
        ([0.2, 0.4, 0.2, 0.2], [1, 2, 3, 4], False),  # it never stood much higher
        ([0.0, 0.0, 0.0], [1, 2, 3], False),
        ([1.0, 0.6, 0.7], [1, 2, 3], True),
        ([0.7, 0.4, 0.4], [1, 2, 3], True),  # by three tenths, which in floating point is a little less
    ],
)
def test_success_falls(success: list[float], learned: list[float], fires: bool):
    found = health.success_falls(success, learned)
    assert (found is not None) == fires
    if found is not None:
        assert f"from {max(success):.0%} to {success[-1]:.0%}" in found
        assert "exploiting the reward model" in found


class Said(Quiet):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def say(self, sentence: str) -> None:
        self.sentences.append(sentence)


def two_runs(path: Path) -> tuple[loop.Training, Said]:
    """Two runs that have just begun, with no state on the device, for what needs none."""
    said, config = Said(), small()
    learner = make_learner(config)
    trainees = [Trainee(small(seed=seed), path / f"seed-{seed}", learner, spec_of(config)) for seed in (0, 1)]
    for trainee in trainees:
        trainee.directory.create(trainee.config, {})
    return loop.Training(trainees, Runs([], "loop"), said), said


def test_a_warning_is_told_once_per_run_and_kind_and_kept(tmp_path: Path):
    training, said = two_runs(tmp_path)
    training.warn(0, "bonus", None)
    assert said.sentences == []
    for step in (1, 2):
        training.warn(0, "bonus", f"It is zero at {step}.")
    training.warn(0, "motion", "Nothing moves.")
    training.warn(1, "bonus", "It is zero here too.")
    assert said.sentences == [
        "Warning (seed 0): It is zero at 1.",
        "Warning (seed 0): Nothing moves.",
        "Warning (seed 1): It is zero here too.",
    ]
    assert (tmp_path / "seed-0" / "warnings.log").read_text() == "It is zero at 1.\nNothing moves.\n"
    assert (tmp_path / "seed-1" / "warnings.log").read_text() == "It is zero here too.\n"
    assert training.trainees[0].progress.warned == ["bonus", "motion"]  # goes into checkpoints


def test_a_session_without_episodes_is_told(tmp_path: Path):
    training, said = two_runs(tmp_path)
    training.trainees[0].progress.recent = [[0, 0, 50]]
    for _ in range(2):
        assert not session.ask(training.trainees[0], training.runs, 0, 400, 10, partial(training.warn, 0))
    (sentence,) = said.sentences
    assert "session at step 400 is put off" in sentence
    assert training.trainees[0].progress.queried == 0
