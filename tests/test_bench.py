"""`senior bench` measures what it says: a real loop, and environments that are really stepped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from senior import bench, bench_environments
from senior.bench import PARTS, multiply_adds
from senior.cli import main
from senior.cli.shared import DONE
from senior.envs.episodes import Local
from senior.program import make_learner
from senior.together import Pools
from tests.small import small


@pytest.mark.parametrize("method", ["m-senior", "sac"])
def test_a_method_is_measured(method: str, tmp_path: Path):
    config = small(method)
    with Pools(1, "cpu") as pools:
        figures = bench.measure(config, 2, "cpu", 20, tmp_path, pools)
    learns = method != "sac"
    assert figures["runs"] == 2
    assert set(figures["milliseconds"]) == set(PARTS)
    positive = ["steps_per_second", "to_main_phase_seconds", "update_floor_ms", "resident_gigabytes"]
    rare = ["pretraining_steps_per_second", "session_seconds", "relabel_seconds"]
    assert all(figures[name] > 0 for name in (*positive, *(rare if learns else ())))
    assert learns or not set(rare) & set(figures)
    assert all(milliseconds > 0 for milliseconds in figures["milliseconds"].values())


def test_the_operations_of_an_update_are_counted():
    """Batch 64, one hidden layer of 32: the actor has 4 x 32 + 32 x 4 weights, a critic 6 x 32 + 32."""
    config = small("sac")
    assert multiply_adds(config, make_learner(config)) == 2 * 64 * (256 * 4 + 2 * 224 * 6)


def test_environments_are_stepped_in_three_ways(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    taken: list[int] = []
    receive = Local.receive
    monkeypatch.setattr(Local, "receive", lambda place: taken.append(place.seed) or receive(place))
    monkeypatch.setattr(bench_environments, "TURNS", 1)
    out = tmp_path / "environments.json"
    assert main(["bench", "--environments", "2", "--task", "window-open", "--json", str(out)]) == DONE
    assert taken == [0, 1] * 500
    figures = json.loads(out.read_text())["figures"]
    assert (figures["task"], figures["environments"]) == ("window-open", 2)
    rates = figures["steps_per_second"]
    assert set(rates) == {"sync_vector_env", "in_process", "workers"}
    told = capsys.readouterr().out
    assert all(f"{rate:8.0f}" in told for rate in rates.values())
