"""Whole runs, small: the right counts and files, and a policy better than a random one."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from senior.config import Answering, Bilevel, Evaluation, Pretraining
from senior.judgement import evaluate_run
from senior.methods import METHODS
from senior.preferences import Preferences
from senior.program import train
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
    later = [row for row in episodes if int(row["step"]) > 600]
    asking = [row for row in later if int(row["queried"]) < expected.queried]
    shares = {"curiosity": (19 / 64, 0.0), "recent": (0.0, 0.5)}.get(config.method.mix, (0.0, 0.0))  # of 64 rows
    assert asking or method == "sac"
    for row in asking:
        assert (float(row["curiosity_share"]), float(row["recent_share"])) == shares
    if config.method.mix == "recent":
        assert float(later[-1]["recent_share"]) == 0
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


def test_a_teacher_errs_in_a_run_as_it_does_by_itself(tmp_path: Path):
    """Skipped pairs are those whose better segment earned too little by the ten episodes before, and were asked."""
    config = small("pebble", steps=1000, teacher="skip", answering=Answering(skip=1.05, mistake=0.3))
    (result,) = train(config, tmp_path)
    assert result.finished
    resolved = json.loads((result.path / "config.json").read_text())["config"]["answering"]
    assert resolved == {"rationality": -1, "foresight": 1, "mistake": 0.3, "skip": 1.05, "equal": 0}
    preferences = Preferences(result.path / "preferences.sqlite", 35, 10, 4, 2)
    episodes = rows(result.path / "train.csv")
    turned = answered = 0
    try:
        asked = preferences.asked()
        for pair in asked:
            before = [row for row in episodes if int(row["step"]) <= int(pair["step"])][-10:]  # pyright: ignore
            earned = sum(float(row["episode_return"]) for row in before)
            average = 10 * earned / sum(int(row["episode_length"]) for row in before)
            total = preferences.segments(int(pair["id"])).reward[0].astype(float).sum(axis=1)  # pyright: ignore
            assert (pair["second"] is None) == (total.max() <= 1.05 * average)
            if pair["second"] is not None:
                answered += 1
                turned += pair["second"] != float(total[1] > total[0])
    finally:
        preferences.close()
    assert len(asked) == plan(config).queried
    assert 0 < turned < answered == result.labels < len(asked)
