"""Methods side by side, from run directories made by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from senior.config import Config, to_json
from senior.methods import METHODS
from senior.report.compare import compare, interval, read
from senior.types import BadInput
from tests.small import rows

LABELS = [0, 50, 100, 100]


def run_of(place: Path, method: str, seed: int, success: list[float | str], **changes: object) -> Path:
    """A run directory with evaluations at 100, 200, 300 and 400 of 400 steps."""
    path = place / f"{method}-{seed}"
    path.mkdir()
    config = Config(**{"task": "door-close", "method": METHODS[method], "seed": seed, "steps": 400, **changes})  # pyright: ignore
    (path / "config.json").write_text(json.dumps({"config": to_json(config), "protocol": {}}))
    lines = ["step,labels,queried,episodes,success_rate,return_mean,return_std"]
    for i, rate in enumerate(success):
        lines.append(f"{100 * (i + 1)},{LABELS[i]},{LABELS[i]},10,{rate},0,0")
    (path / "eval.csv").write_text("\n".join(lines) + "\n")
    return path


def test_areas_are_mean_success_over_steps_and_over_labels(tmp_path: Path):
    run = read(run_of(tmp_path, "pebble", 0, [0.0, 1.0, 0.5, 0.9]))
    assert run is not None
    assert run.area_by_steps == pytest.approx((0.5 + 0.75 + 0.7) / 3)
    assert run.area_by_labels == pytest.approx((0.5 + 0.75) / 2)  # the second evaluation with 100 labels does not count
    sac = read(run_of(tmp_path, "sac", 0, [0.0, 1.0, 1.0, 1.0]))
    assert sac is not None and np.isnan(sac.area_by_labels)


def test_table_rows_and_figure_are_of_all_finished_runs(tmp_path: Path):
    for seed, last in ((3, 1.0), (1, 0.0)):
        run_of(tmp_path, "pebble", seed, [0.0, 0.0, 0.0, last])
        run_of(tmp_path, "sac", seed, [0.0, 1.0, 1.0, 1.0])
    run_of(tmp_path, "mrn", 0, [0.0, 1.0, 1.0])  # not finished
    run_of(tmp_path, "rune", 0, ["", "", "", ""])  # tells no success
    text = compare([tmp_path], tmp_path / "out")
    assert text == (tmp_path / "out" / "table.md").read_text()
    lines = text.splitlines()[2:]
    assert [line.split("|")[1].strip() for line in lines] == ["`sac`", "`pebble`"]  # by area
    assert "| 1, 3 | 0.50 [0.00, 1.00] |" in lines[1]
    assert "| 1.00 [1.00, 1.00] | 0.83 [0.83, 0.83] | - |" in lines[0]
    found = rows(tmp_path / "out" / "table.csv")
    assert [(row["method"], row["seed"]) for row in found] == [
        ("pebble", "1"),
        ("pebble", "3"),
        ("sac", "1"),
        ("sac", "3"),
    ]
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_the_interval_holds_the_mean_and_narrows_with_seeds():
    rng = np.random.default_rng(0)
    few, many = (interval(list(rng.normal(0.5, 0.2, n))) for n in (5, 500))
    for mean, low, high in (few, many):
        assert low < mean < high
    assert many[2] - many[1] == pytest.approx(2 * 1.96 * 0.2 / np.sqrt(500), rel=0.1)
    assert few[2] - few[1] > many[2] - many[1]
    assert interval([0.3, 0.3]) == (0.3, 0.3, 0.3)


def test_nothing_to_compare_and_several_tasks_are_told(tmp_path: Path):
    with pytest.raises(BadInput, match="no finished run"):
        compare([tmp_path], tmp_path / "out")
    run_of(tmp_path, "pebble", 0, [0, 0, 0, 1])
    run_of(tmp_path, "pebble", 1, [0, 0, 0, 1], task="door-open")
    with pytest.raises(BadInput, match="door-close, door-open"):
        compare([tmp_path], tmp_path / "out")


def test_runs_that_are_not_alike_make_no_row(tmp_path: Path):
    run_of(tmp_path, "pebble", 0, [0, 0, 0, 1])
    run_of(tmp_path, "pebble", 1, [0, 0, 0, 1], teacher="mistake")
    with pytest.raises(BadInput, match=r"pebble-0 and .*pebble-1 differ in teacher"):
        compare([tmp_path], tmp_path / "out")
