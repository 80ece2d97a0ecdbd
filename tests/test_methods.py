"""Whole runs, small: the right counts and files, and a policy better than a random one."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from senior.checkpoint import steps, unpack
from senior.methods import METHODS
from senior.program import evaluate_run, train
from senior.rundir import EVAL, TRAIN
from senior.schedule import plan
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
    last = steps(result.path / "checkpoints")[0]
    about = json.loads(unpack(result.path / "checkpoints" / f"step-{last:010d}.npz")["about"].tobytes())
    progress = about["progress"]
    assert last == config.steps
    assert progress["sessions"] == expected.sessions
    assert progress["outer_steps"] == expected.outer_steps
    assert progress["refreshes"] == expected.refreshes
    assert progress["updates"] == expected.updates
    assert progress["pretraining_updates"] == expected.pretraining_updates
    assert (result.path / "plots" / "learning-curve.png").read_bytes().startswith(b"\x89PNG")
    assert evaluate_run(result.path, episodes=10).return_mean > RANDOM_RETURN + 50
    if config.method.explore == "preference_guided":
        paid = [row for row in episodes if row["refreshes"] != "0"]
        assert all(float(row["beta"]) > 0 for row in paid)
        assert float(paid[1]["bonus_mean"]) > 0
