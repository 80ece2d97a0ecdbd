"""Reports of run directories that were made by hand."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro
from matplotlib.figure import Figure

from senior.cli.train import TrainOptions, starting_from
from senior.config import Answering, Asking, Config, Evaluation, to_json
from senior.methods import METHODS
from senior.options import parse
from senior.preference_file import Foretold
from senior.presets import preset, release, with_budget
from senior.report import across, sections
from senior.report.asked import asked
from senior.report.bands import MOST, Band, Frame, banded
from senior.report.bands import grid as grid_of_panels
from senior.report.bonus import steps_of
from senior.report.build import Built, report
from senior.report.looks import COLOURS, in_order, looks
from senior.report.names import label, normal, options
from senior.report.page import Drawing, Section, Table, write
from senior.report.plane import visited
from senior.report.records import NOT_TOLD
from senior.report.results import Results, read
from senior.report.statistics import interquartile_means
from senior.report.tables import latex, shown
from senior.types import BadInput
from tests.many_runs import FILES, protocol, write_run
from tests.small import rows

CSV_FILES = ("eval.csv", "train.csv", "timing.csv")


def config(method: str = "pebble", task: str = "door-lock", seed: int = 0, **changes: Any) -> Config:
    """Evaluations at 10,000, 20,000, 30,000 and 40,000 steps, labels from 10,000 on."""
    own = replace(preset("paper", task, method), seed=seed, steps=40_000)
    return replace(own, **changes)


def evaluated(path: Path, own: Config, success: list[float], told: dict[str, Any] | None = None) -> Path:
    """A run that has these success rates (NaN: not told), and no other file."""
    path.mkdir(parents=True)
    content = {"config": to_json(own), "protocol": protocol() if told is None else told}
    (path / "config.json").write_text(json.dumps(content))
    lines = ["step,labels,queried,episodes,success_rate,return_mean,return_std"]
    for i, rate in enumerate(success, 1):
        cell = "" if math.isnan(rate) else rate
        lines.append(f"{10_000 * i},{50 * i},{50 * i},10,{cell},{100 * i},1")
    (path / "eval.csv").write_text("\n".join(lines) + "\n")
    return path


def labels_of(results: Results) -> dict[str, list[int]]:
    return {str(arm): [run.seed for run in runs] for arm, runs in results.arms().items()}


def reasons(results: Results | Built) -> dict[str, str]:
    return {left.path.name: left.reason for left in results.left_out}


# What is averaged.


def test_runs_that_differ_in_seed_and_machine_are_one_arm(tmp_path: Path):
    evaluated(tmp_path / "a", config(seed=3, device="gpu"), [0, 0, 0, 1], protocol(device="gpu", threads=8))
    evaluated(tmp_path / "deeper" / "b", config(seed=1, checkpoint_every=7, snapshot_every=9), [0, 0, 1, 1])
    evaluated(tmp_path / "c", config("mrn"), [0, 0, 0, 0])
    (tmp_path / "deeper" / "config.json").write_text('{"mine": 1}')  # somebody else's
    found = read([tmp_path])
    assert labels_of(found) == {"mrn on door-lock": [0], "pebble on door-lock": [1, 3]}
    assert not [left for left in found.left_out if "csv" not in left.reason]


PAPER_ON = preset("paper", "door-lock", "m-senior")
QPA = preset("paper", "door-lock", "qpa")
NAMED = [
    (replace(PAPER_ON, seed=4, steps=10, evaluation=Evaluation(7, 3), checkpoint_every=3, device="gpu"), "m-senior"),
    (
        replace(PAPER_ON, method=replace(PAPER_ON.method, explore="none", mix="uniform")),
        "m-senior --explore none --mix uniform",
    ),
    (
        replace(PAPER_ON, method=replace(PAPER_ON.method, select="disagreement")),
        "m-senior --select disagreement",
    ),
    (replace(QPA, teacher="mistake", answering=Answering(-1.0, 1.0, 0.1, 0.0, 0.0)), "qpa --teacher mistake"),
    (replace(QPA, teacher="mistake", answering=Answering(mistake=0.2)), "qpa --teacher mistake --mistake 0.2"),
    (with_budget(PAPER_ON, 500), "m-senior --budget 500"),
    (release(PAPER_ON), "m-senior --compat release"),
    (release(with_budget(PAPER_ON, 1000)), "m-senior --budget 1000 --compat release"),
    (replace(PAPER_ON, asking=Asking(wait=False, overlap=2)), "m-senior --no-wait --overlap 2"),
    (replace(PAPER_ON, mds=replace(PAPER_ON.mds, bandwidth=0.1)), "m-senior --bandwidth-mds 0.1"),
    (replace(PAPER_ON, pge=replace(PAPER_ON.pge, relabel=False)), "m-senior --pge.relabel False"),
    (replace(PAPER_ON, queries=replace(PAPER_ON.queries, every=2500)), "m-senior --session-every 2500"),
    (replace(PAPER_ON, sac=replace(PAPER_ON.sac, actor_rate=1e-4)), "m-senior --sac.actor-rate 0.0001"),
    (replace(preset("quick", "door-close", "mrn"), steps=7), "mrn"),
    (replace(PAPER_ON, horizon=100), "m-senior --horizon 100"),
    (replace(PAPER_ON, env="mine:Mine", position="0:3", length_scale=2.0, horizon=100), "m-senior"),
]


@pytest.mark.parametrize(("own", "expected"), NAMED, ids=[name for _, name in NAMED])
def test_a_label_is_what_one_would_type(own: Config, expected: str):
    assert label(own) == expected
    words = ["--preset", own.preset, "--task", own.task, "--method", *expected.split()]
    typed = parse(TrainOptions, words, TrainOptions(config=starting_from(words)), "train").config
    silent = {"seed", "steps", "evaluation", "checkpoint_every", "device"}
    silent |= {"env", "position", "length_scale", "horizon"} if own.env else set()
    same = {name: getattr(own, name) for name in silent}
    assert normal(replace(typed, **same)) == normal(own)


def test_a_file_of_labels_is_told_by_its_name():
    assert label(replace(PAPER_ON, teacher="/home/me/said.jsonl")) == "m-senior --teacher said.jsonl"


def test_every_option_has_its_name_on_the_command_line():
    shown_help = io.StringIO()
    with contextlib.redirect_stdout(shown_help), contextlib.suppress(SystemExit):
        tyro.cli(TrainOptions, args=["--help"])
    there = set(re.findall(r"--(?:no-)?[a-z][a-z0-9.-]*", shown_help.getvalue()))
    for option in options().values():
        assert option.name in there
        assert option.flag == (f"--no-{option.name[2:]}" in there)


def with_versions(**versions: str) -> dict[str, Any]:
    return protocol(packages={**protocol()["packages"], **versions})


def test_another_version_makes_another_arm_with_the_same_name_in_every_task(tmp_path: Path):
    for task in ("door-lock", "door-open"):
        evaluated(tmp_path / f"{task}-0", config(task=task), [0, 0, 0, 0], with_versions(mujoco="3.3.0"))
    evaluated(tmp_path / "door-lock-1", config(seed=1), [1, 1, 1, 1], with_versions(mujoco="3.4.0"))
    evaluated(tmp_path / "door-lock-2", config(seed=2), [1, 1, 1, 1], with_versions(jax="9.9"))  # splits nothing
    assert labels_of(read([tmp_path])) == {
        "pebble [mujoco 3.3.0] on door-lock": [0, 2],
        "pebble [mujoco 3.4.0] on door-lock": [1],
        "pebble [mujoco 3.3.0] on door-open": [0],
    }


@pytest.mark.parametrize(
    ("changes", "told", "suffix"),
    [
        ({"steps": 30_000}, {}, "--steps 30000"),
        ({"evaluation": Evaluation(10_000, 20)}, {}, "--evaluation.episodes 20"),
        ({"preset": "qpa_original"}, {}, None),
        ({}, {"reward_version": "v1"}, "reward version v1"),
        ({}, {"horizon": 200}, "horizon 200"),
        ({}, {"observation_size": 5}, "observation size 5"),
        ({}, {"packages": {"mujoco": "3.3.0", "metaworld": "3.1.1"}}, f"senior-rl {NOT_TOLD}"),
        ({}, {"device": "gpu", "threads": 9, "machine": "other", "python": "3", "git_commit": "f"}, ""),
    ],
)
def test_what_numbers_depend_on_splits_and_nothing_else(
    tmp_path: Path, changes: dict[str, Any], told: dict[str, Any], suffix: str | None
):
    evaluated(tmp_path / "a", config(), [0, 0, 0, 0])
    evaluated(tmp_path / "b", config(seed=1, **changes), [1, 1, 1, 1], protocol(**told))
    arms = read([tmp_path]).arms()
    assert len(arms) == (1 if suffix == "" else 2)
    if suffix:
        assert f"pebble [{suffix}]" in {arm.label for arm in arms}


def test_arms_that_differ_in_much_get_a_number_and_the_page_tells_all(tmp_path: Path):
    evaluated(tmp_path / "a", config(), [0, 0, 0, 0])
    other = with_versions(mujoco="3.4.0", metaworld="4") | {"horizon": 200}
    evaluated(tmp_path / "b", config(seed=1), [1, 1, 1, 1], other)
    found = read([tmp_path])
    assert set(labels_of(found)) == {"pebble [protocol 1] on door-lock", "pebble [protocol 2] on door-lock"}
    report([tmp_path], tmp_path / "out")
    told = {(row["arm"], row["differs in"], row["has"]) for row in rows(tmp_path / "out" / "tables" / "kept-apart.csv")}
    assert {name for _, name, _ in told} == {"horizon", "metaworld", "mujoco"}
    assert {value for _, name, value in told if name == "horizon"} == {"200", "500"}
    page = (tmp_path / "out" / "index.html").read_text()
    assert "On door-lock the arms differ in mujoco." in page


def test_a_configuration_of_another_form_is_read_as_far_as_it_goes(tmp_path: Path):
    for seed in (0, 1):
        path = evaluated(tmp_path / f"{seed}", config(seed=seed), [0, 0, 0, 0])
        content = json.loads((path / "config.json").read_text())
        content["config"]["of_the_future"] = {"x": 1}
        (path / "config.json").write_text(json.dumps(content))
    [(arm, runs)] = read([tmp_path]).arms().items()
    assert (arm.label, len(runs), runs[0].config) == ("pebble", 2, None)
    assert ("--of_the_future.x", "1") in arm.fingerprint


# What is left out.


def spoil(path: Path, content: bytes | None) -> None:
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)


HEAD = b"step,labels,queried,episodes,success_rate,return_mean,return_std\n"
BROKEN = {
    "no JSON": ("config.json", b'{"config": ', "config.json is damaged"),
    "no object": ("config.json", b'{"config": 3, "protocol": {}}', "config.json is damaged"),
    "no method": ("config.json", b'{"config": {"seed": 0, "steps": 9}, "protocol": {}}', "config.json is damaged"),
    "no text": ("config.json", b"\xff\xfe", "config.json is damaged"),
    "no end of steps": ("config.json", b'{"config": {"seed": 0, "steps": Infinity}, "protocol": {}}', "is damaged"),
    "no end of depth": ("config.json", 100_000 * b"[", "config.json is damaged"),
    "no evaluations": ("eval.csv", None, "eval.csv is missing"),
    "nothing": ("eval.csv", b"", "eval.csv is empty"),
    "head only": ("eval.csv", HEAD, "not evaluated yet"),
    "cut head": ("eval.csv", HEAD[:20], "eval.csv is empty"),
    "other columns": ("eval.csv", b"a,b\n1,2\n", "no column step"),
    "short line": ("eval.csv", HEAD + b"10000,0,0\n20000,0,0,10,0,1,1\n", "line 2 has 3 cells, not 7"),
    "no number": ("eval.csv", HEAD + b"10000,0,0,ten,0,1,1\n", "damaged"),
    "no return": ("eval.csv", HEAD + b"40000,0,0,10,0.5,,1\n", "cells are missing"),
    "back in time": ("eval.csv", HEAD + b"40000,0,0,10,0,1,1\n20000,0,0,10,0,1,1\n", "do not increase"),
    "no episodes": ("eval.csv", HEAD + b"40000,0,0,0,0.5,1,1\n", "an evaluation has no episode"),
    "no rate": ("eval.csv", HEAD + b"40000,0,0,10,1.5,1,1\n", "between 0 and 1"),
    "some rates": ("eval.csv", HEAD + b"20000,0,0,10,,1,1\n40000,0,0,10,1,1,1\n", "success rates are missing"),
    "zeros": ("eval.csv", HEAD + b"40000,0,0,10,\0,1,1\n", "damaged"),
    "no letters": ("eval.csv", b"\xff\xfe\n", "damaged"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_run_is_named_and_the_others_are_read(tmp_path: Path, kind: str):
    name, content, reason = BROKEN[kind]
    for seed in (0, 1):
        evaluated(tmp_path / f"run-{seed}", config(seed=seed), [0, 0, 0, 1])
    spoil(tmp_path / "run-0" / name, content)
    found = read([tmp_path])
    assert [run.seed for run in found.runs] == [1]
    assert reason in reasons(found)["run-0"]


def test_runs_that_were_not_evaluated_until_half_cost_the_page_of_no_others(tmp_path: Path):
    late = replace(config(), steps=2_400_000)
    path = write_run(tmp_path / "late", late, files=())
    (path / "eval.csv").write_bytes(HEAD + b"1200000,9,9,10,0.5,1,1\n2400000,9,9,10,1,1,1\n")
    evaluated(tmp_path / "other", config(method="mrn"), [0, 0, 0, 1])
    page = report([tmp_path], tmp_path / "out").page.read_text()
    assert "mrn" in page


def test_a_name_that_is_no_text_costs_no_page(tmp_path: Path):
    evaluated(tmp_path / "run", config(), [0, 0, 0, 1])
    broken = Path(os.fsdecode(bytes(tmp_path) + b"/caf\xe9"))
    try:
        broken.mkdir()
    except OSError:
        pytest.skip("this file system has no such names")
    (broken / "config.json").write_text("{")
    assert r"caf\udce9" in report([tmp_path], tmp_path / "out").page.read_text()


def test_a_folder_in_a_file_s_place_is_named(tmp_path: Path):
    path = evaluated(tmp_path / "run", config(), [0, 0, 0, 1])
    (path / "eval.csv").unlink()
    (path / "eval.csv").mkdir()
    assert "cannot be read" in reasons(read([tmp_path]))["run"]


@pytest.mark.parametrize("name", ["train.csv", "timing.csv"])
@pytest.mark.parametrize("content", [None, b"", b"step\n1\n", b"step,seconds,episode_return\n1,x,x\n", b"\xff\n"])
def test_what_a_report_can_do_without_costs_no_run(tmp_path: Path, name: str, content: bytes | None):
    path = write_run(tmp_path / "run", config(), files=CSV_FILES)
    spoil(path / name, content)
    [run] = read([tmp_path]).runs
    assert (run.episodes is None) == (name == "train.csv")
    assert (run.seconds is None) == (name == "timing.csv")
    assert name in reasons(read([tmp_path]))


def test_a_line_that_is_being_written_does_not_count(tmp_path: Path):
    path = evaluated(tmp_path / "run", config(), [0, 0, 0.5, 1])
    whole = (path / "eval.csv").read_text()
    (path / "eval.csv").write_text(whole[:-5])
    assert reasons(read([tmp_path]))["run"] == "unfinished: it stands at step 30,000 of 40,000"
    [run] = read([tmp_path], unfinished=True).runs
    assert list(run.score) == [0, 0, 0.5]


def test_runs_can_be_looked_at_up_to_a_step(tmp_path: Path):
    """Then all that is read of a run is as if its files ended there."""
    own = replace(preset("paper", "door-lock", "m-senior"), steps=40_000, snapshot_every=10_000)
    whole, short = (write_run(tmp_path / name, own) for name in ("whole", "short"))
    for name in CSV_FILES:
        head, *lines = (short / name).read_text().splitlines(keepends=True)
        (short / name).write_text(head + "".join(line for line in lines if int(line.partition(",")[0]) <= 20_000))
    with closing(sqlite3.connect(short / "preferences.sqlite")) as db, db:
        db.execute("DELETE FROM pairs WHERE step >= 20000")  # a run asks nothing where it ends
    write_run(tmp_path / "behind", replace(own, seed=1), until=10_000)
    late = write_run(tmp_path / "late", replace(own, seed=2))
    (late / "timing.csv").write_text("step,seconds,steps_per_second\n30000,300,100\n")

    [expected] = read([short], unfinished=True).runs
    found = read([whole, late, tmp_path / "behind"], until=20_000)
    run, timeless = found.runs
    assert run.finished and run.steps == 20_000
    assert reasons(found) == {
        "behind": "it stands at step 10,000, before 20,000",
        "timing.csv": "timing.csv tells no time",
    }
    assert timeless.seed == 2 and timeless.seconds is None
    for field in ("evaluation", "episodes"):
        np.testing.assert_array_equal(getattr(run, field), getattr(expected, field), err_msg=field)
    assert run.foretold == expected.foretold and run.foretold and run.seconds == expected.seconds
    assert list(visited(run)) == [10_000, 20_000] and list(steps_of(run)) == [20_000]
    held, same, all_of_it = (asked(one) for one in (run, expected, read([whole]).runs[0]))
    assert held and same and all_of_it
    assert held.id.tolist() == same.id.tolist() == all_of_it.id[: len(held.id)].tolist()
    assert len(held.id) < len(all_of_it.id)
    assert reasons(read([whole], until=25_000))["whole"] == "it was not evaluated at step 25,000"


def test_one_seed_counts_once_and_a_finished_run_first(tmp_path: Path):
    evaluated(tmp_path / "a", config(), [0, 0])
    evaluated(tmp_path / "b", config(), [0, 0, 0, 1])
    evaluated(tmp_path / "c", config(), [0, 0, 0, 0])
    found = read([tmp_path], unfinished=True)
    assert [run.path.name for run in found.runs] == ["b"]
    said = reasons(found)
    assert said["a"] == said["c"] == f"seed 0 of pebble on door-lock was taken from {tmp_path / 'b'} already"


def test_places_are_told_that_hold_nothing_and_none_is_read_twice(tmp_path: Path):
    path = evaluated(tmp_path / "runs" / "a", config(), [0, 0, 0, 1])
    (tmp_path / "empty").mkdir()
    (tmp_path / "runs" / "loop").symlink_to(tmp_path / "runs")
    found = read([tmp_path / "runs", path, tmp_path / "empty", tmp_path / "gone"])
    assert [run.path for run in found.runs] == [path]
    assert reasons(found)["empty"] == "there is no run in it"
    assert reasons(found)["gone"] == "there is no such directory"


def test_runs_of_a_task_are_judged_alike(tmp_path: Path):
    evaluated(tmp_path / "told", config(), [0, 0, 0, 1])
    evaluated(tmp_path / "silent", config(seed=1), [math.nan] * 4)
    evaluated(tmp_path / "other", config(task="door-open"), [math.nan] * 4)
    found = read([tmp_path])
    assert [run.path.name for run in found.runs] == ["told", "other"]
    assert reasons(found)["silent"] == "it tells no success, and other runs of its task do"
    assert list(found.runs[1].score) == [100, 200, 300, 400]


def test_nothing_to_report_is_bad_input_with_a_reason(tmp_path: Path):
    with pytest.raises(BadInput, match=r"There is no run that can be reported.*no run in it"):
        report([tmp_path], tmp_path / "out")
    evaluated(tmp_path / "a", config(), [0.5])
    with pytest.raises(BadInput, match="stands at step 10,000 of 40,000"):
        report([tmp_path], tmp_path / "out")
    assert not (tmp_path / "out").exists()


# Numbers.


def test_scores_are_those_of_the_last_evaluation_up_to_a_step(tmp_path: Path):
    evaluated(tmp_path / "run", config(), [0.1, 0.2, 0.3, 0.4])
    [run] = read([tmp_path]).runs
    assert [run.score_at(step) for step in (10_000, 25_000, 40_000)] == [0.1, 0.2, 0.4]
    assert math.isnan(run.score_at(9_999)) and math.isnan(run.score_at(40_001))


def test_the_clock_of_a_resumed_run_goes_on(tmp_path: Path):
    path = write_run(tmp_path / "run", config(), files=CSV_FILES)
    (path / "timing.csv").write_text("step,seconds\n10000,100\n20000,220\n30000,50\n40000,90\n")
    assert read([tmp_path]).runs[0].seconds == 220 + 90


def test_a_clock_that_began_anew_is_known_by_the_rate_it_does_not_fit(tmp_path: Path):
    path = write_run(tmp_path / "run", config(), files=CSV_FILES)
    head = "step,seconds,steps_per_second\n10000,165,60.6060606\n"  # killed after it; what follows began anew there
    (path / "timing.csv").write_text(f"{head}20000,170,58.8235294\n30000,340,58.8235294\n40000,510,58.8235294\n")
    assert read([tmp_path]).runs[0].seconds == pytest.approx(165 + 510)


def test_steps_between_the_last_row_and_a_stop_count_at_the_rate_they_go_on_with(tmp_path: Path):
    """At 50 steps a second throughout; stopped and saved at 9,900."""
    path = write_run(tmp_path / "run", config(), files=CSV_FILES)
    rows = "5000,100,50\n10000,2,50\n15000,102,50\n40000,602,50\n"
    (path / "timing.csv").write_text(f"step,seconds,steps_per_second\n{rows}")
    assert read([tmp_path]).runs[0].seconds == pytest.approx(40_000 / 50)


def train_csv(path: Path, lines: list[str]) -> None:
    head = "step,episode_return,learned_return,queried,labels,reward_accuracy"
    (path / "train.csv").write_text("\n".join([head, *lines]) + "\n")


def test_prospective_accuracy_is_of_the_latest_pairs_of_sessions_that_knew_something(tmp_path: Path):
    evaluated(tmp_path / "run", config(), [0, 0, 0, 1])
    [run] = read([tmp_path]).runs
    assert across.prospective(run) is None
    told = [Foretold(15_500, 15, 30), Foretold(20_500, 20, 20), Foretold(25_500, 2, 20), Foretold(30_500, 40, 60)]
    curve = across.prospective(replace(run, foretold=told))
    assert curve is not None
    assert list(curve[0]) == [15_500, 20_500, 25_500, 30_500]
    whole = [15 / 30, (15 + 20) / 50, (15 + 20 + 2) / 70, 40 / 60]  # sessions, of 50 pairs or more together
    assert curve[1] == pytest.approx(whole)


def test_predictions_are_read_from_the_preference_file_and_damage_is_told(tmp_path: Path):
    path = write_run(tmp_path / "run", config(), files=("eval.csv", "preferences.sqlite"))
    with closing(sqlite3.connect(path / "preferences.sqlite")) as db:
        pairs = db.execute("SELECT session, step, prediction, second FROM pairs").fetchall()
    per_session = config().queries.per_session
    [run] = read([tmp_path]).runs
    assert len(run.foretold) == len(pairs) // per_session - 1  # nothing was known before the first
    for number, session in enumerate(run.foretold, 1):
        own = pairs[number * per_session : (number + 1) * per_session]
        right = sum((prediction > 0.5) == second for _, _, prediction, second in own)
        assert session == (own[0][1], right, per_session)
    (path / "preferences.sqlite").write_bytes(b"no database at all" * 100)
    found = read([tmp_path])
    assert not found.runs[0].foretold
    assert "preferences.sqlite is damaged" in " ".join(entry.reason for entry in found.left_out)


def test_returns_are_correlated_over_the_main_phase(tmp_path: Path):
    path = evaluated(tmp_path / "run", config(), [0, 0, 0, 1])
    train_csv(path, ["5000,9,0,0,0,", "10500,1,2,5,5,", "11000,2,4,5,5,", "11500,3,6,5,5,", "12000,4,,5,5,"])
    tasks = sections.by_task(read([tmp_path]).runs)
    section = sections.reward_model(tasks, looks(["pebble"]))
    assert section is not None
    assert section.tables[0].rows[0][-3:-1] == ["1.00", "1.00"]


def test_episodes_with_success_are_counted_until_the_last_session(tmp_path: Path):
    path = evaluated(tmp_path / "run", config(), [0, 0, 0, 1])
    head = "step,episode_return,learned_return,queried,labels,reward_accuracy,episode_success"
    told = ["9000,1,0,0,0,,1", "10500,2,1,5,5,1,0", "11000,3,2,5,5,1,1", "15500,4,3,9,9,1,1", "16000,5,4,9,9,1,1"]
    (path / "train.csv").write_text("\n".join([head, *told]) + "\n")
    section = sections.reward_model(sections.by_task(read([tmp_path]).runs), looks(["pebble"]))
    assert section is not None
    assert section.tables[0].head[-1] == "successful episodes while asking"
    assert section.tables[0].rows[0][-1] == "2.00"
    (every_run,) = [
        table for table in sections.summary(sections.by_task(read([tmp_path]).runs)).tables if table.name == "every-run"
    ]
    assert every_run.rows[0][list(every_run.head).index("successful episodes while asking")] == 2
    (path / "train.csv").write_text("\n".join([head, *(line[:-1] for line in told)]) + "\n")
    section = sections.reward_model(sections.by_task(read([tmp_path]).runs), looks(["pebble"]))
    assert section is not None
    assert section.tables[0].rows[0][-1] is None  # not told is not none
    (path / "train.csv").write_text(head + "\n")
    assert sections.reward_model(sections.by_task(read([tmp_path]).runs), looks(["pebble"])) is None


def test_what_was_found_while_asking_is_set_beside_what_was_reached(tmp_path: Path):
    head = "step,episode_return,learned_return,queried,labels,reward_accuracy,episode_success"

    def said(runs: int) -> tuple[str, ...]:
        for seed in range(runs):
            path = tmp_path / str(runs) / f"seed-{seed}"
            evaluated(path, config(seed=seed), [0, 0, 0, (runs - seed) / 100])
            told = [f"{10_500 + i},1,1,{5 if i < 12 else 9},5,1,{int(i < seed)}" for i in range(20)]
            (path / "train.csv").write_text("\n".join([head, *told]) + "\n")
        section = sections.reward_model(sections.by_task(read([tmp_path / str(runs)]).runs), looks(["pebble"]))
        assert section is not None
        return section.text[1:]

    assert said(9) == ()
    assert [line.split(", ", 1)[1] for line in said(10)] == [
        "the number of those episodes and the area by steps have a rank correlation of -1.00."
    ]


def test_runs_evaluated_at_other_steps_are_read_off_lines():
    places, values = across.together(
        [(np.array([1.0, 3, 5]), np.array([0.0, 2, 4])), (np.array([2.0, 4]), np.array([1.0, 3]))]
    )
    assert list(places) == [2, 3, 4]
    assert values == pytest.approx(np.array([[1, 2, 3], [1, 2, 3]]))


@pytest.mark.parametrize("bands", [MOST, MOST + 1])
def test_a_few_bands_share_an_axis_and_more_have_a_panel_each(bands: int):
    x = np.array([0.0, 40.0, 80.0])
    labels = [f"pebble --budget {10 * (i + 1)}" for i in range(bands)]
    own = {label: Band(x, np.full(3, 0.1 * i), np.full(3, 0.1 * i - 0.1), x / 800) for i, label in enumerate(labels)}
    figure = banded(own, looks(labels), Frame("door-lock", "steps", "rate", 100.0))
    figure.canvas.draw()
    axes = [axis for axis in figure.axes if axis.axison]
    assert len(axes) == (1 if bands == MOST else bands)
    for axis in axes:
        assert axis.get_xlim() == (0, 100)
        assert axis.get_ylim() == (-0.03, 1.03)
        assert len(axis.lines) == bands  # the others' too, for comparison
    assert sum(len(axis.collections) for axis in axes) == bands
    if bands > MOST:
        assert "grey" in figure.get_supxlabel()
        for label, axis in zip(labels, axes, strict=True):
            assert axis.get_title() == label
            assert [line.get_color() for line in axis.lines].count(looks(labels)[label].colour) == 1


def test_panels_are_spread_evenly():
    for panels, lines in ((5, [3, 2]), (7, [4, 3]), (9, [3, 3, 3]), (2, [2])):
        _, axes = grid_of_panels({str(i): str(i) for i in range(panels)}, Frame("door-lock", "steps", "rate", 100.0))
        rows = [axis.get_position().y0 for axis in axes.values()]
        assert [rows.count(row) for row in sorted(set(rows), reverse=True)] == lines


def test_a_page_of_something_else_is_not_overwritten(tmp_path: Path):
    page = write([Section("Runs", ("m-senior --select uniform & others",))], tmp_path, "first")
    assert '<span class="option">--select</span> uniform &amp; others' in page.read_text()
    assert "<h1>second</h1>" in write([], tmp_path, "second").read_text()
    own = tmp_path / "tables" / "own.csv"
    own.write_text("somebody's")
    tables = [Table("Kept", ("a",), [["1"]], name) for name in ("kept", "left")]
    write([Section("Two", (), tuple(tables))], tmp_path, "two")
    write([Section("One", (), tuple(tables[:1]))], tmp_path, "one")
    names = {path.name for path in own.parent.iterdir()}
    assert names == {"own.csv", "kept.csv", "kept.tex"}  # what the page before had made is gone
    write([], tmp_path, "none")
    page.write_text("<h1>my own</h1>")
    with pytest.raises(BadInput, match=r"index\.html is no page of a report, and would be overwritten"):
        write([], tmp_path, "third")
    assert page.read_text() == "<h1>my own</h1>"


GRID = {
    ("pebble", "door-lock"): [[0.0, 0.2, 0.4, 0.5], [0.0, 0.4, 0.6, 0.9]],
    ("pebble", "door-open"): [[0.0, 0.0, 0.2, 0.3], [0.0, 0.0, 0.0, 0.1]],
    ("mrn", "door-lock"): [[0.1, 0.6, 0.8, 0.9], [0.1, 0.4, 0.8, 1.0]],
    ("mrn", "door-open"): [[0.0, 0.2, 0.4, 0.6], [0.0, 0.2, 0.4, 0.4]],
    ("sac", "door-lock"): [[0.5, 1.0, 1.0, 1.0], [0.5, 1.0, 1.0, 1.0]],
}


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two tasks and one on one; one run is under way, one is broken. Reported twice."""
    place = tmp_path_factory.mktemp("grid")
    for (method, task), runs in GRID.items():
        for seed, success in enumerate(runs):
            path = evaluated(place / "runs" / f"{task}-{method}" / f"seed-{seed}", config(method, task, seed), success)
            train_csv(path, [f"{10_500 + 500 * i},{i},{2 * i},{5 * i},{5 * i},0.6" for i in range(1, 8)])
    evaluated(place / "runs" / "door-lock-mrn" / "seed-2", config("mrn", seed=2), [0.3, 0.3])
    spoil(evaluated(place / "runs" / "broken", config("rune"), [0, 0, 0, 0]) / "eval.csv", b"")
    report([place / "runs"], place / "one", (Section("Verdicts", ("Nothing was claimed.",)),))
    report([place / "runs"], place / "two", (Section("Verdicts", ("Nothing was claimed.",)),))
    report([place / "runs"], place / "live", unfinished=True)
    return place


def table(place: Path, name: str) -> dict[tuple[str, str], dict[str, str]]:
    return {(row.get("task", ""), row["arm"]): row for row in rows(place / "tables" / f"{name}.csv")}


def test_the_summary_tells_short_runs_at_half_and_at_the_end(grid: Path):
    found = table(grid / "one", "summary-40k")
    assert found["door-lock", "pebble"]["at 20K"] == "0.30 ± 0.14"
    assert found["door-lock", "pebble"]["at 40K"] == "0.70 ± 0.28"
    assert found["door-lock", "pebble"]["runs"] == "2"
    assert found["door-lock", "pebble"]["area by steps [95 %]"] == "0.38 [0.28, 0.48]"
    assert found["door-lock", "sac"]["area by labels [95 %]"] == ""
    assert found["door-lock", "sac"]["95 % interval"] == "[1.00, 1.00]"
    assert found["door-lock", "sac"]["90 % interval of the mean"] == "[0.78, 1.00]"  # the episodes' own
    assert "they have 40,000 steps" in (grid / "one" / "index.html").read_text()


def test_long_runs_are_told_where_the_paper_does(tmp_path: Path):
    for seed in (0, 1):
        write_run(tmp_path / f"{seed}", config(seed=seed, steps=1_200_000), files=("eval.csv",))
    section = sections.summary(sections.by_task(read([tmp_path]).runs))
    assert {"at 500K", "at 1000K"} < set(section.tables[0].head)
    assert len(section.text) == 1


def test_the_paper_s_table_has_averages_of_those_that_have_all_tasks(grid: Path):
    found = {row["arm"]: row for row in rows(grid / "one" / "tables" / "rates-40k.csv")}
    assert found["mrn"]["door-lock at 40K"] == "95%"
    assert found["mrn"]["average at 40K"] == "72%"
    assert (found["sac"]["door-open at 40K"], found["sac"]["average at 40K"]) == ("", "")


def test_arms_are_compared_over_the_tasks_that_they_share(grid: Path):
    over_both = rows(grid / "one" / "tables" / "2-tasks-aggregate.csv")
    assert {row["arm"]: row["mean"] for row in over_both} == {"mrn": "0.72", "pebble": "0.45"}
    assert {row["arm"] for row in rows(grid / "one" / "tables" / "door-lock-aggregate.csv")} == {"mrn", "pebble", "sac"}
    better = {(row["better"], row["worse"]): row for row in rows(grid / "one" / "figures" / "2-tasks-improvement.csv")}
    assert float(better["mrn", "pebble"]["probability"]) == pytest.approx((1.0 - 0.5 / 4 + 1.0) / 2)
    profile = rows(grid / "one" / "figures" / "2-tasks-profile.csv")
    at = {row["arm"]: float(row["share"]) for row in profile if float(row["threshold"]) == 0.5}
    assert at == {"mrn": 0.75, "pebble": 0.25}
    drawn = rows(grid / "one" / "figures" / "2-tasks-steps-iqm.csv")
    assert {row["arm"] for row in drawn} == {"mrn", "pebble"}


def test_csv_files_hold_what_is_drawn(grid: Path):
    expected = np.array(GRID["pebble", "door-lock"])
    drawn = [row for row in rows(grid / "one" / "figures" / "door-lock-steps-mean.csv") if row["arm"] == "pebble"]
    assert [float(row["step"]) for row in drawn] == [10_000, 20_000, 30_000, 40_000]
    assert [float(row["mean"]) for row in drawn] == pytest.approx(expected.mean(axis=0))
    assert [float(row["deviation"]) for row in drawn] == pytest.approx(expected.std(axis=0, ddof=1), abs=1e-8)
    middle = [row for row in rows(grid / "one" / "figures" / "door-lock-steps-iqm.csv") if row["arm"] == "pebble"]
    found = interquartile_means({"pebble": [expected]})["pebble"]
    for name, values in zip(("interquartile_mean", "low", "high"), found, strict=True):
        assert [float(row[name]) for row in middle] == pytest.approx(values)
    asked = [row for row in rows(grid / "one" / "figures" / "door-lock-labels.csv") if row["arm"] == "pebble"]
    assert [float(row["asked"]) for row in asked] == [50, 100, 150, 200]
    assert not [row for row in rows(grid / "one" / "figures" / "door-lock-labels.csv") if row["arm"] == "sac"]
    each = rows(grid / "one" / "figures" / "door-lock-every-run.csv")
    assert [float(row["score"]) for row in each if row["arm"] == "pebble" and row["seed"] == "1"] == list(expected[1])


def test_runs_under_way_are_in_curves_alone(grid: Path):
    assert table(grid / "live", "summary-40k")["door-lock", "mrn"]["runs"] == "2 of 3 finished"
    assert (
        table(grid / "live", "summary-40k")["door-lock", "mrn"]["at 20K"]
        == table(grid / "one", "summary-40k")["door-lock", "mrn"]["at 20K"]
    )
    drawn = [row for row in rows(grid / "live" / "figures" / "door-lock-steps-mean.csv") if row["arm"] == "mrn"]
    assert [(row["step"], row["runs"]) for row in drawn] == [("10000", "3"), ("20000", "3")]  # as far as all have come
    each = rows(grid / "live" / "figures" / "door-lock-every-run.csv")
    assert len([row for row in each if row["arm"] == "mrn"]) == 4 + 4 + 2
    assert "seed 2 of mrn on door-lock at step 20,000 of 40,000" in (grid / "live" / "index.html").read_text()


def test_equal_runs_make_equal_files(grid: Path):
    files = sorted(path.relative_to(grid / "one") for path in (grid / "one").rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(grid / "two") for path in (grid / "two").rglob("*") if path.is_file())
    assert len(files) > 50
    for file in files:
        assert (grid / "one" / file).read_bytes() == (grid / "two" / file).read_bytes(), file


# The page.


class Seen(HTMLParser):
    """What a page names, and its attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_data(self, data: str) -> None:
        self.words += data


def seen(page: Path) -> Seen:
    found = Seen()
    found.feed(page.read_text())
    return found


def test_the_page_stands_alone_and_its_links_lead_somewhere(grid: Path):
    page = grid / "one" / "index.html"
    found = seen(page)
    sources = [value for name, value in found.attributes if name == "src"]
    assert sources and all(re.match(r"data:image/(svg\+xml|png);base64,", value) for value in sources)
    anchors = {value for name, value in found.attributes if name == "id"}
    for value in (value for name, value in found.attributes if name == "href"):
        assert value[1:] in anchors if value.startswith("#") else (page.parent / value).is_file()
    assert "://" not in page.read_text()
    assert not {"script", "link", "iframe"} & set(found.tags)
    assert "style" not in {name for name, _ in found.attributes}


def test_all_sections_are_there_in_order_and_what_is_left_out_is_named(grid: Path):
    text = (grid / "one" / "index.html").read_text()
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    assert titles == [
        "Verdicts",
        "Summary",
        "Learning curves",
        "Success against labels",
        "Methods compared",
        "Reward model",
        "Time and labels",
        "Protocol",
        "Left out",
    ]
    assert "eval.csv is empty" in text and "stands at step 20,000 of 40,000" in text
    assert text.count("<nav") == 1 and all(f">{title}</a>" in text for title in titles)


def test_names_are_escaped_everywhere(tmp_path: Path):
    nasty = "<script>alert(1)</script> $x_1$ & 50% \\ {a}"
    for seed in (0, 1):
        own = config("m-senior", seed=seed, env=nasty, position="0:3", teacher="<b>:x")
        evaluated(tmp_path / f"<i>{seed}", own, [0, 0.5, 0.7, 0.9])
    evaluated(tmp_path / "<i>under way", config("mrn", seed=5, env=nasty, position="0:3"), [0.0])
    built = report([tmp_path], tmp_path / "out", (Section("<u>first</u>", ("<p>&amp;",)),))
    found = seen(built.page)
    assert not {"script", "b", "i", "u"} & set(found.tags)
    assert nasty in found.words and "m-senior --teacher <b>:x" in found.words and "<p>&amp;" in found.words
    for drawing in (tmp_path / "out" / "figures").glob("*.svg"):
        assert "<script" not in drawing.read_text()
    tex = (tmp_path / "out" / "tables" / "summary-40k.tex").read_text()
    assert r"\textless{}script\textgreater{}alert(1)" in tex
    assert r"\$x\_1\$ \& 50\% \textbackslash{} \{a\}" in tex
    row = rows(tmp_path / "out" / "tables" / "summary-40k.csv")[0]
    assert (row["task"], row["arm"]) == (nasty, "m-senior --teacher <b>:x")


def test_where_success_is_not_told_returns_are_compared(tmp_path: Path):
    for method in ("pebble", "mrn"):
        for seed in (0, 1):
            evaluated(tmp_path / f"{method}-{seed}", config(method, seed=seed), [math.nan] * 4)
    built = report([tmp_path], tmp_path / "out")
    text = built.page.read_text()
    assert "No success is told by door-lock" in text
    assert table(tmp_path / "out", "summary-40k")["door-lock", "mrn"]["at 40K"] == "400 ± 0.00"
    assert not (tmp_path / "out" / "tables" / "door-lock-aggregate.csv").exists()
    assert (tmp_path / "out" / "figures" / "door-lock-improvement.png").exists()


def test_what_does_not_split_is_told(tmp_path: Path):
    for seed, machine in enumerate(("quick", "quick", "slow")):
        evaluated(tmp_path / f"{seed}", config(seed=seed), [0, 0, 0, 1], protocol(machine=machine))
    built = report([tmp_path], tmp_path / "out")
    [row] = rows(tmp_path / "out" / "tables" / "also-differs.csv")
    assert (row["also differs in"], row["values"]) == ("machine", "quick (2); slow (1)")
    assert built.runs == 3


def test_a_page_of_anything(tmp_path: Path):
    figure = Figure(figsize=(4, 3))
    figure.subplots().scatter(*np.random.default_rng(0).random((2, 6000)))
    drawing = Drawing("A name/with: signs", "many points", figure, [("x", "y"), (1, 2.5)])
    small = Drawing("a name with signs", "none", Figure(figsize=(4, 3)), [("x",)])
    held = Table("cells", ("a", "b"), [[None, 1234567], ["x", 0.123456]])
    page = write([Section("One", (), (held, held), (drawing, small)), Section("One")], tmp_path / "out", "A page")
    names = {path.name for path in (tmp_path / "out" / "figures").iterdir()}
    assert {"a-name-with-signs.png", "a-name-with-signs-2.svg"} < names
    assert {path.name for path in (tmp_path / "out" / "tables").iterdir()} >= {"one.csv", "one-2.tex"}
    sources = [value for name, value in seen(page).attributes if name == "src"]
    assert [value.split(";")[0] for value in sources] == ["data:image/png", "data:image/svg+xml"]  # the first is large
    assert "1,234,567" in page.read_text() and "0.123<" in page.read_text()
    with open(tmp_path / "out" / "tables" / "one.csv", newline="") as file:
        assert list(csv.reader(file))[1:] == [["", "1234567"], ["x", "0.123456"]]


def test_a_place_that_cannot_be_written_is_bad_input(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="cannot be written"):
        write([], tmp_path / "file" / "out", "A page")


def test_latex_has_rules_and_numbers_to_the_right():
    text = latex("a & b", ("name", "n"), [["x_1", 3], ["y", None]])
    assert r"\begin{tabular}{lr}" in text and r"\toprule" in text and r"\caption{a \& b}" in text
    assert r"x\_1 & 3 \\" in text and r"y & -- \\" in text


@pytest.mark.parametrize(
    ("cell", "text"),
    [(None, "–"), ("", "–"), (math.nan, "–"), (3, "3"), (12_345, "12,345"), (1.0, "1"), (0.12345, "0.123"), ("a", "a")],  # noqa: RUF001
)
def test_cells_are_shown_shortly(cell: Any, text: str):
    assert shown(cell) == text


# Colours.


def test_a_method_has_one_colour_and_no_two_arms_look_alike():
    plain = looks(METHODS)
    assert {name: look.colour for name, look in plain.items()} == COLOURS
    more = [*METHODS, *(f"m-senior --pge.every {i}" for i in range(12))]
    found = looks(more)
    assert len(set(found.values())) == len(more)
    assert all(found[name] == plain[name] for name in METHODS)
    assert looks(reversed(more)) == found
    few = looks(["m-senior --select uniform", "m-senior", "pebble"])
    assert few["m-senior"].colour == COLOURS["m-senior"]
    assert len({look.colour for look in few.values()}) == 3
    assert next(iter(looks(["qpa --budget 5"]).values())).colour == COLOURS["qpa"]


def test_labels_stand_in_one_order():
    assert in_order(["mine", "sac", "m-senior --x 1", "m-senior"]) == ["m-senior", "m-senior --x 1", "sac", "mine"]


def test_all_files_of_a_run_are_read(tmp_path: Path):
    """As training writes them, states and pairs included."""
    for seed in (0, 1):
        write_run(tmp_path / f"{seed}", config("m-senior", seed=seed, snapshot_every=20_000), files=FILES)
    built = report([tmp_path], tmp_path / "out")
    assert (built.runs, built.left_out) == (2, [])


def test_budgets_stand_beside_each_other(tmp_path: Path):
    for budget, last in ((250, 0.5), (500, 0.9)):
        for seed in (0, 1):
            own = replace(with_budget(config("m-senior"), budget), seed=seed)
            evaluated(tmp_path / f"{budget}-{seed}", own, [0, 0, 0, last + 0.1 * seed])
    evaluated(tmp_path / "mrn", config("mrn"), [0, 0, 0, 1])
    [arms] = sections.by_task(read([tmp_path]).runs).values()
    drawing = across.budget_curves("door-lock", arms)
    assert drawing is not None
    assert [row[1:4] for row in drawing.rows[1:]] == [("m-senior", 250, 2), ("m-senior", 500, 2)]
    assert [row[4] for row in drawing.rows[1:]] == pytest.approx([0.55, 0.95])
    assert across.budget_curves("door-lock", {"mrn": arms["mrn"]}) is None


def test_budgets_of_two_protocols_are_two_lines(tmp_path: Path):
    for name, method, budgets in (("paper", "m-senior", (150, 500, 1000)), ("quick", "m-senior", (250, 500))):
        for budget in budgets:
            own = with_budget(preset(name, "door-open", method), budget)
            success = [budget / 2000] * 3 + [budget / 1000]
            evaluated(tmp_path / name / str(budget), replace(own, steps=40_000), success)
    arms = sections.by_task(read([tmp_path]).runs)["door-open"]
    drawing = across.budget_curves("door-open", arms)
    assert drawing is not None
    told = {row[1:3]: row[4] for row in drawing.rows[1:]}
    assert sorted(budget for _, budget in told) == [150, 250, 500, 500, 1000]  # only one of them has two protocols
    assert all(mean == budget / 1000 for (_, budget), mean in told.items())
    assert len({label for label, _ in told}) == 2


def test_what_all_arms_have_is_told_once(tmp_path: Path):
    for method in ("mrn", "pebble", "sac"):
        config = preset("quick", "door-lock", method)
        config = replace(config, steps=1000, networks=replace(config.networks, width=16))
        if method == "mrn":
            config = replace(config, method=replace(config.method, select="entropy"))
        write_run(tmp_path / method, config)
    found = read([tmp_path])
    assert found.shared == ("--networks.width 16",)
    assert {run.arm.label for run in found.runs} == {"mrn --select entropy", "pebble", "sac"}
    alone = read([tmp_path / "pebble", tmp_path / "sac"])
    assert not alone.shared and {run.arm.label for run in alone.runs} == {
        "pebble --networks.width 16",
        "sac --networks.width 16",
    }
