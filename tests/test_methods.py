"""Whole runs, small: the right counts and files, and a policy better than a random one."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from senior.config import Answering, Bilevel, Evaluation, Pretraining
from senior.judgement import evaluate_run
from senior.methods import METHODS, Method
from senior.preferences import Preferences
from senior.program import train
from senior.rundir import EVAL, TRAIN
from senior.schedule import Counts, plan
from tests.equal import arrays_of, progress_of, short
from tests.small import preferences_dump, rows, small

RANDOM_RETURN = 150.0
"""A uniformly random policy's mean true return on `point` is about 110 to 150; the most possible is near 400."""


SHARES = {"curiosity": (19 / 64, 0.0), "recent": (0.0, 0.5), "uniform": (0.0, 0.0)}
"""Of curious and of recent rows in a batch of 64, while there is budget."""


def assert_counted(path: Path, expected: Counts, method: Method) -> None:
    """That the run's progress tells the plan's counts, and that what was learned tells the same.

    Adam counts its steps; critics are new at the end of pre-training. The outer step's Adam is its own here.
    """
    progress, arrays = progress_of(path), arrays_of(path)
    counted = ("sessions", "queried", "outer_steps", "refreshes", "pretraining_updates", "updates")
    assert {name: progress[name] for name in counted} == {name: getattr(expected, name) for name in counted}
    assert arrays["run.agent.critic_adam.count"] == expected.updates
    for part in ("actor", "alpha"):
        assert arrays[f"run.agent.{part}_adam.count"] == expected.updates + expected.pretraining_updates
    if method.learns_reward:
        assert arrays["run.model.outer_adam.count"] == expected.outer_steps
    if method.explore == "preference_guided":
        assert arrays["run.bonus.refreshes"] == expected.refreshes


@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_as_scheduled_on_point(method: str, tmp_path: Path):
    config = small(method, steps=3000)
    queries = replace(config.queries, budget=195, every=100, episodes=100)
    config = replace(config, queries=queries, bilevel=Bilevel(every=200, optimizer="separate"))
    (result,) = train(config, tmp_path)
    expected = plan(config)
    evaluations, episodes = rows(result.path / "eval.csv"), rows(result.path / "train.csv")
    assert result.finished
    assert result.labels == expected.queried
    assert tuple(evaluations[0]) == EVAL
    assert tuple(episodes[0]) == TRAIN
    assert [int(row["step"]) for row in evaluations] == list(range(500, config.steps + 1, 500))
    assert progress_of(result.path)["step"] == config.steps
    assert_counted(result.path, expected, config.method)
    assert (result.path / "plots" / "learning-curve.png").read_bytes().startswith(b"\x89PNG")
    assert evaluate_run(result.path, episodes=10).return_mean > RANDOM_RETURN + 50
    later = [row for row in episodes if int(row["step"]) > 600]
    asking = [row for row in later if int(row["queried"]) < expected.queried]
    assert asking or method == "sac"
    for row in asking:
        assert (float(row["curiosity_share"]), float(row["recent_share"])) == SHARES[config.method.mix]
    if config.method.mix == "recent":
        assert float(later[-1]["recent_share"]) == 0
    if config.method.explore != "none":
        paid = [row for row in episodes if int(row["step"]) > 600]
        assert all(float(row["beta"]) > 0 and float(row["intrinsic_mean"]) > 0 for row in paid)
        assert all(float(row["bonus_mean"]) > 0 for row in paid)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_as_scheduled_on_meta_world(method: str, tmp_path: Path):
    """Two sessions, the second cut to what is left of the budget, and episodes of which pairs can be made."""
    config = small(method, task="door-close", steps=2000)
    learns = config.method.learns_reward
    config = replace(
        config,
        pretraining=Pretraining(random_steps=100, until=1000 if learns else 0),
        queries=replace(config.queries, budget=16, every=600),
        bilevel=Bilevel(every=100, optimizer="separate"),
        evaluation=Evaluation(every=1000, episodes=1),
    )
    (result,) = train(config, tmp_path)
    expected = plan(config)
    assert result.finished and result.failure is None
    assert_counted(result.path, expected, config.method)
    assert expected.sessions == (2 if learns else 0)
    assert result.labels == expected.queried == (16 if learns else 0)
    assert bool(expected.outer_steps) == (config.method.outer == "bilevel")
    *before, asking, after = rows(result.path / "train.csv")
    assert [int(row["step"]) for row in (*before, asking, after)] == [500, 1000, 1500, 2000]
    assert int(asking["queried"]) == (10 if learns else 0)
    curious, recent = SHARES[config.method.mix]
    assert (float(asking["curiosity_share"]), float(asking["recent_share"])) == (curious, recent)
    assert (float(after["curiosity_share"]), float(after["recent_share"])) == (curious, 0.0)


def test_evaluation_leaves_training_alone(tmp_path: Path):
    """It has environments and random numbers of its own, and may begin in the middle of an episode."""
    often, seldom = (
        train(replace(short(), evaluation=evaluation), tmp_path / name)[0].path
        for name, evaluation in (("often", Evaluation(every=130, episodes=3)), ("seldom", Evaluation(1000, 1)))
    )
    assert len(rows(often / "eval.csv")) > len(rows(seldom / "eval.csv"))
    assert (often / "train.csv").read_bytes() == (seldom / "train.csv").read_bytes()
    assert preferences_dump(often) == preferences_dump(seldom)


ABLATIONS = {
    "without PGE": ("m-senior", {"explore": "none", "mix": "uniform"}, {"m", "d"}),
    "without MDS": ("m-senior", {"select": "disagreement"}, {"disagreement"}),
    "kcenter": ("pebble", {"select": "kcenter"}, {"distance"}),
    "kcenter_disagreement": ("pebble", {"select": "kcenter_disagreement"}, {"disagreement", "distance"}),
    "kcenter_entropy": ("pebble", {"select": "kcenter_entropy"}, {"entropy", "distance"}),
}
"""Method, cells in place of its own, and the scores that its rule writes down of a pair."""


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablations_and_other_rules_run_as_scheduled(name: str, tmp_path: Path):
    method, cells, scores = ABLATIONS[name]
    config = small(method, steps=1000)
    config = replace(config, method=replace(config.method, **cells), bilevel=Bilevel(every=200, optimizer="separate"))
    (result,) = train(config, tmp_path)
    expected = plan(config)
    assert result.finished and result.labels == expected.queried == 30
    assert_counted(result.path, expected, config.method)
    assert bool(expected.outer_steps) == (method == "m-senior")
    assert bool(expected.refreshes) == (config.method.explore != "none")
    last = rows(result.path / "train.csv")[-1]
    assert float(last["curiosity_share"]) == SHARES[config.method.mix][0]
    preferences = Preferences(result.path / "preferences.sqlite", 35, 10, 4, 2)
    try:
        asked = preferences.asked()
    finally:
        preferences.close()
    assert [json.loads(str(pair["scores"])).keys() for pair in asked] == [set()] * 10 + [scores] * 20


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
