"""Whole runs, small: the right counts and files, and a policy better than a random one."""

from dataclasses import replace
from pathlib import Path

import pytest

from senior.config import Bilevel, Evaluation, Pretraining
from senior.methods import METHODS
from senior.program import evaluate_run, train
from senior.rundir import EVAL, TRAIN
from senior.schedule import plan
from tests.equal import progress_of
from tests.small import rows, small

RANDOM_RETURN = 150.0
"""A uniformly random policy's mean true return on `point` is about 110 to 150; the most possible is near 400."""


@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_as_scheduled_on_point(method: str, tmp_path: Path):
    config = small(method, steps=3000)
    queries = replace(config.queries, budget=195, every=100, episodes=100)
    config = replace(config, queries=queries)
    (result,) = train(config, tmp_path)
    expected = plan(config)
    evaluations, episodes = rows(result.path / "eval.csv"), rows(result.path / "train.csv")
    assert result.finished
    assert result.labels == expected.queried
    assert tuple(evaluations[0]) == EVAL
    assert tuple(episodes[0]) == TRAIN
    assert [int(row["step"]) for row in evaluations] == list(range(500, config.steps + 1, 500))
    progress = progress_of(result.path)
    assert progress["step"] == config.steps
    assert progress["sessions"] == expected.sessions
    assert progress["outer_steps"] == expected.outer_steps
    assert progress["refreshes"] == expected.refreshes
    assert progress["updates"] == expected.updates
    assert progress["pretraining_updates"] == expected.pretraining_updates
    assert (result.path / "plots" / "learning-curve.png").read_bytes().startswith(b"\x89PNG")
    assert evaluate_run(result.path, episodes=10).return_mean > RANDOM_RETURN + 50
    if config.method.explore != "none":
        paid = [row for row in episodes if int(row["step"]) > 600]
        assert all(float(row["beta"]) > 0 and float(row["intrinsic_mean"]) > 0 for row in paid)
        assert all(float(row["bonus_mean"]) > 0 for row in paid)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_as_scheduled_on_meta_world(method: str, tmp_path: Path):
    """Two sessions, the second cut to what is left of the budget, and episodes of which pairs can be made."""
    config = small(method, task="door-close", steps=1350)
    learns = config.method.learns_reward
    config = replace(
        config,
        pretraining=Pretraining(random_steps=100, until=1000 if learns else 0),
        queries=replace(config.queries, budget=16, every=200),
        bilevel=Bilevel(every=100),
        evaluation=Evaluation(every=700, episodes=1),
    )
    (result,) = train(config, tmp_path)
    expected = plan(config)
    assert result.finished and result.failure is None
    progress = progress_of(result.path)
    counted = ("sessions", "queried", "outer_steps", "refreshes", "pretraining_updates", "updates")
    assert {name: progress[name] for name in counted} == {name: getattr(expected, name) for name in counted}
    assert expected.sessions == (2 if learns else 0)
    assert result.labels == expected.queried == (16 if learns else 0)
    assert bool(expected.outer_steps) == (config.method.outer == "bilevel")
    assert len(rows(result.path / "train.csv")) == 2
