"""The examples run as their docstrings say, and do what they show."""

from __future__ import annotations

import json
import re
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from senior.judgement import Judgement
from senior.trainee import make_environment
from tests.small import rows

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, place: Path) -> tuple[str, Path]:
    """What an example prints, and its run."""
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py")],
        cwd=place,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    (path,) = place.glob("runs/*/seed-0")
    return done.stdout, path


def test_custom_environment(tmp_path: Path):
    told, path = run("custom_environment", tmp_path)
    assert "40 labels" in told
    assert Judgement.__name__ in told
    evaluated = rows(path / "eval.csv")[-1]
    assert (evaluated["step"], evaluated["labels"]) == ("1200", "40")
    assert 0 < float(evaluated["return_mean"]) < 50
    assert evaluated["success_rate"] != ""
    assert {row["episode_length"] for row in rows(path / "train.csv")} == {"50"}


def test_custom_selection(tmp_path: Path):
    told, path = run("custom_selection", tmp_path)
    with sqlite3.connect(path / "preferences.sqlite") as file:
        asked = file.execute("SELECT session, scores FROM pairs ORDER BY id").fetchall()
    file.close()
    scores = {session: [json.loads(text) for number, text in asked if number == session] for session, _ in asked}
    assert [len(pairs) for pairs in scores.values()] == [20, 20]
    assert scores[0] == [{}] * 20  # the first session is uniform
    distance = [pair["distance"] for pair in scores[1]]
    assert distance == sorted(distance, reverse=True)
    assert min(distance) > 0
    assert f"session 1: {asked[-1][1]}" in told


def test_custom_bonus(tmp_path: Path):
    told, path = run("custom_bonus", tmp_path)
    train = rows(path / "train.csv")
    paid = [(int(row["labels"]), float(row["beta"]), float(row["bonus_mean"])) for row in train if row["beta"]]
    assert {labels for labels, *_ in paid} >= {20, 40}
    for labels, beta, bonus in paid:
        assert beta == pytest.approx(0.1 if labels else 0)
        assert 0 < bonus <= 0.1 if labels else bonus == 0
    assert f"{paid[-1][-1]:.3f} a row" in told


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_to_run_it(path: Path):
    text = path.read_text()
    assert len(text.splitlines()) < 60
    assert f"python examples/{path.name}\n" in text.split('"""')[1]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_the_command_in_an_example_is_one(path: Path, monkeypatch: pytest.MonkeyPatch):
    from senior import cli, program

    command = re.search(r"^    senior (train .*)$", path.read_text(), re.MULTILINE)
    assert command
    asked = []
    monkeypatch.setattr(program, "train", lambda config, out, *_, **_options: asked.append((config, out)) or [])
    assert cli.main(command[1].split()) == cli.DONE
    ((config, out),) = asked
    assert f"{path.stem}:" in f"{config.env} {config.method.select} {config.method.explore}"
    assert str(out) == command[1].split()[-1]
    monkeypatch.syspath_prepend(str(EXAMPLES))
    if config.env:
        environment, spec = make_environment(config)
        for seed in (1, 2):
            first, _ = environment.reset(seed=seed)
            np.testing.assert_array_equal(first, environment.reset(seed=seed)[0])
        assert spec.horizon > config.queries.segment
    else:
        assert callable(program.parts.selection(config))
