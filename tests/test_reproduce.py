"""The paper's studies as grids, the rules by which its numbers and sentences are judged, and the page of a toy run."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy import stats

from senior.checks import check
from senior.cli import experiments, main
from senior.cli.shared import DONE, FAILED
from senior.report.records import Run
from senior.report.results import read
from senior.reproduce import run as reproduce
from senior.reproduce.studies import (
    AVERAGES,
    BUDGETS,
    CLAIMS,
    MAIN,
    SEEDS,
    STUDIES,
    TASKS,
    Claim,
    Comparison,
    Quantity,
    Scale,
    configuration,
)
from senior.reproduce.verdicts import judge_claim, judge_number
from senior.schedule import plan
from senior.types import BAD_INPUT
from tests.many_runs import protocol, write_run
from tests.small import small

SCALES: tuple[Scale, ...] = get_args(Scale)


def runs_with(tmp_path: Path, arm: str, task: str, rates: Sequence[float], halves: Sequence[float] = ()) -> list[Run]:
    """Finished runs whose last evaluations are ``rates``, and those after half of the steps ``halves``."""
    made = []
    for seed, rate in enumerate(rates):
        config = replace(small("pebble", task=task), seed=seed, steps=2000)
        path = write_run(tmp_path / arm / task / f"seed-{seed}", config)
        half = halves[seed] if halves else rate
        lines = ["step,labels,queried,episodes,success_rate,return_mean,return_std"]
        lines += [f"{step},9,9,10,{half if step <= 1000 else rate},0,0" for step in (500, 1000, 1500, 2000)]
        (path / "eval.csv").write_text("\n".join(lines) + "\n")
        made.append(path)
    found = {run.path: run for run in read([tmp_path / arm / task]).runs}
    return [found[path] for path in made]


# The data.


def test_the_papers_averages_are_those_of_its_tasks():
    for method, averages in AVERAGES.items():
        assert len(MAIN[method]) == len(TASKS)
        for place, average in enumerate(averages):
            assert abs(np.mean([numbers[place] for numbers in MAIN[method]]) - average) <= 0.5


def test_the_grids_are_the_papers():
    count = {table: len(study.arms) * len(study.tasks) for table, study in STUDIES.items()}
    assert count == {"main": 8 * 6, "feedback": 7 * 4 * 2, "ablation": 4 * 6, "quality": 6 * 2}
    assert set(MAIN) == {arm.name for arm in STUDIES["main"].arms} - {"sac"} == set(AVERAGES)
    assert SEEDS["paper"] == 5


@pytest.mark.parametrize("scale", SCALES)
def test_every_cell_can_be_trained_and_no_two_are_alike(scale: Scale, tmp_path: Path):
    cells = reproduce.cells(STUDIES.values(), range(2), scale, tmp_path)
    configs = [check(cell.config) for cell in cells]
    assert len({cell.path for cell in cells}) == len(set(configs)) == len(cells)
    # trained once: seven arms with 250 labels; the ablation's mrn and m-senior; the quality study's MDS and QPA
    shared = 7 * 2 + 2 * 6 + 2 * 2
    alone = sum(len(study.arms) * len(study.tasks) for study in STUDIES.values())
    assert len(cells) == 2 * (alone - shared)
    assert {cell.config.preset for cell in cells} == {"paper" if scale == "paper" else "quick"}
    for cell in cells:
        if cell.config.method.learns_reward:
            told = plan(cell.config)
            assert told.queried == cell.config.queries.budget, f"{cell} cannot spend its budget"


def test_arms_are_what_the_paper_says():
    arms = {arm.name: arm for study in STUDIES.values() for arm in study.arms}
    made = {name: configuration(arm, "door-lock", 3, "paper") for name, arm in arms.items()}
    assert all(config.seed == 3 and config.steps == 1_000_000 for config in made.values())
    assert [made[f"m-senior-{budget}"].queries.budget for budget in BUDGETS] == list(BUDGETS)
    without = made["m-senior-without-pge"].method
    assert (without.select, without.explore, without.mix, without.outer) == (
        "motion_distinction",
        "none",
        "uniform",
        "bilevel",
    )
    without = made["m-senior-without-mds"].method
    assert (without.select, without.explore) == ("disagreement", "preference_guided")
    assert made["mds-fn"].teacher == made["qpa-fn"].teacher == "mistake"
    assert made["mds-ff"].teacher == made["qpa-ff"].teacher == "skip"
    assert configuration(arms["m-senior"], "door-lock", 0, "quick").steps == 100_000


def test_claims_speak_of_what_is_trained():
    for claim in CLAIMS:
        study = STUDIES[claim.table]
        names = {arm.name for arm in study.arms}
        assert claim.comparisons
        for comparison in claim.comparisons:
            for quantity in (comparison.higher, comparison.lower):
                if isinstance(quantity, Quantity):
                    assert quantity.arm in names and set(quantity.tasks) <= set(study.tasks)


# The rules.


@pytest.mark.parametrize(
    ("rates", "paper", "verdict"),
    [
        ([0.9, 1.0, 1.0, 0.9, 1.0], 0.98, "reproduced"),
        ([1.0] * 5, 1.0, "reproduced"),
        ([0.9, 1.0, 1.0, 0.9, 1.0], 0.75, "not reproduced"),
        ([0.0, 1.0, 0.0, 1.0, 1.0], 0.98, "undecided"),
        ([1.0], 1.0, "undecided"),
    ],
)
def test_numbers_are_judged_by_the_interval_of_our_mean(rates: list[float], paper: float, verdict: str, tmp_path: Path):
    runs = {("mrn", "door-lock"): runs_with(tmp_path, "mrn", "door-lock", rates)}
    judged = judge_number(paper, runs, "mrn", ("door-lock",), "end")
    assert (judged.verdict, judged.seeds) == (verdict, len(rates))
    assert judged.ours is not None and judged.ours.mean == pytest.approx(np.mean(rates))
    assert judge_number(paper, runs, "mrn", ("door-open",), "end").verdict == "missing"


def test_the_number_of_seeds_that_would_decide(tmp_path: Path):
    rates = [0.5, 0.7, 0.9, 0.6, 0.8]  # 0.7, and a deviation above what ten episodes leave open
    runs = {("mrn", "door-lock"): runs_with(tmp_path, "mrn", "door-lock", rates)}
    judged = judge_number(0.75, runs, "mrn", ("door-lock",), "end")
    deviation = np.std(rates, ddof=1)
    needed = next(
        n for n in range(6, 1000) if stats.t.ppf(0.95, n - 1) * deviation / np.sqrt(n) <= 0.05 + 1e-9
    )  # from 0.7 - 0.05 to 0.7 + 0.05 lies within 0.65 and 0.85
    assert (judged.verdict, judged.needed) == ("undecided", needed)
    assert judge_number(0.6, runs, "mrn", ("door-lock",), "end").needed is None, "its mean lies on the border"


def test_an_average_over_tasks_is_judged_as_one_number(tmp_path: Path):
    rates = {task: [place / 10, place / 10 + 0.1] for place, task in enumerate(TASKS)}
    runs = {("mrn", task): runs_with(tmp_path, "mrn", task, rates[task], [0.0, 0.0]) for task in TASKS}
    judged = judge_number(0.3, runs, "mrn", TASKS, "end")
    assert judged.ours is not None and judged.ours.mean == pytest.approx(np.mean(list(rates.values())))
    half = judge_number(0.0, runs, "mrn", TASKS, "half")
    assert half.ours is not None and half.ours.mean == 0.0
    curve = judge_number(0.0, runs, "mrn", TASKS, "curve")
    assert curve.ours is not None and half.ours.mean < curve.ours.mean < judged.ours.mean


def test_a_claim_holds_if_all_of_it_does(tmp_path: Path):
    runs = {
        ("best", "door-lock"): runs_with(tmp_path, "best", "door-lock", [1.0, 0.9, 1.0, 1.0, 0.9]),
        ("good", "door-lock"): runs_with(tmp_path, "good", "door-lock", [0.6, 0.5, 0.6, 0.7, 0.6]),
        ("wild", "door-lock"): runs_with(tmp_path, "wild", "door-lock", [1.0, 0.0, 1.0, 1.0, 0.9]),
    }

    def verdict(*pairs: tuple[str, str | float, float]) -> str:
        comparisons = tuple(
            Comparison(
                Quantity(higher, ("door-lock",)),
                Quantity(lower, ("door-lock",)) if isinstance(lower, str) else lower,
                margin,
            )
            for higher, lower, margin in pairs
        )
        return judge_claim(Claim("main", "", "", comparisons), runs).verdict

    assert verdict(("best", "good", 0.0), ("best", 0.8, 0.0)) == "confirmed"
    assert verdict(("best", "good", 0.0), ("good", "best", 0.0)) == "refuted"
    assert verdict(("best", "good", 0.0), ("best", "wild", 0.0)) == "undecided"
    assert verdict(("best", "good", 0.0), ("best", "gone", 0.0)) == "undecided"
    assert verdict(("best", "gone", 0.0), ("gone", 0.5, 0.0)) == "missing"
    assert verdict(("best", "good", 0.6)) == "refuted", "the margin counts"
    assert verdict(("good", "best", -0.6)) == "confirmed"


def test_only_the_studys_own_runs_count_and_only_those_of_one_protocol(tmp_path: Path):
    studies = reproduce.studies_of(["main"], ("door-lock",))
    arm = next(arm for arm in studies["main"].arms if arm.name == "mrn")
    place = reproduce.folder(tmp_path, arm, "door-lock", "quick")
    for seed in range(6):
        config = configuration(arm, "door-lock", seed, "quick")
        if seed == 5:
            config = replace(config, steps=50_000)
        packages = {"mujoco": "9.9"} if seed in (3, 4) else {}
        told = protocol()
        write_run(place / f"seed-{seed}", config, {**told, "packages": {**told["packages"], **packages}}, ("eval.csv",))
    runs = read([tmp_path]).runs
    found, refused = reproduce.runs_by_arm(studies.values(), "quick", tmp_path, runs)
    assert [run.seed for run in found["mrn", "door-lock"]] == [0, 1, 2]
    assert refused == [
        f"Not judged: {place / 'seed-5'}: no run of its arm at the scale quick.",
        f"Not judged: {place / 'seed-3'} and 1 more: another protocol than the runs beside it that count.",
    ]
    at_paper, _ = reproduce.runs_by_arm(studies.values(), "paper", tmp_path, runs)
    assert not at_paper
    told = reproduce.write(studies, "quick", tmp_path)
    line = next(line for line in told.splitlines() if line.startswith("  mrn "))
    assert "3 seeds" in line and "reproduced" not in line
    fewer = reproduce.write(studies, "quick", tmp_path, seeds=2)
    assert "2 seeds" in next(line for line in fewer.splitlines() if line.startswith("  mrn "))
    assert "Left out on demand: window-close, handle-press, window-open, door-open, door-unlock." in told
    page = (tmp_path / "report" / "index.html").read_text()
    assert "arXiv 2506.14648" in page and "can be refuted here, and not confirmed" in page


def test_runs_of_something_else_make_no_page_beside_the_paper(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_run(tmp_path / "door-lock" / "own" / "seed-0", small("pebble"), protocol(), ("eval.csv",))
    command = ["reproduce", "senior", "--scale", "smoke", "--no-train", "--out", str(tmp_path)]
    assert main(command) == BAD_INPUT
    assert f"{tmp_path} holds no finished run of the studies main at the scale smoke." in capsys.readouterr().err
    assert not (tmp_path / "report").exists()


def test_the_cells_of_a_study_can_be_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = ["reproduce", "senior", "--table", "quality", "--scale", "smoke", "--seeds", "3", "--list", "--out"]
    assert main([*command, str(tmp_path / "new")]) == DONE
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 * 2 * 6 and all(line.endswith("not begun") for line in lines)
    assert not (tmp_path / "new").exists()


# The command.


def test_a_study_without_any_of_the_tasks_is_told_of(tmp_path: Path):
    studies = reproduce.studies_of(["main", "quality"], ("window-open",))
    assert not studies["quality"].tasks
    arm = next(arm for arm in studies["main"].arms if arm.name == "mrn")
    write_run(
        reproduce.folder(tmp_path, arm, "window-open", "quick") / "seed-0",
        configuration(arm, "window-open", 0, "quick"),
        files=("eval.csv",),
    )
    told = reproduce.write(studies, "quick", tmp_path)
    assert "Left out on demand: door-lock, window-close, handle-press, door-open, door-unlock." in told
    own = [claim for claim in CLAIMS if claim.table == "quality"]
    assert told.count("  missing ") >= len(own) > 0


def test_runs_that_do_not_count_are_told_once_however_many_studies_have_them(tmp_path: Path):
    studies = reproduce.studies_of(["main", "ablation"], ("door-lock",))
    arm = next(arm for arm in studies["main"].arms if arm.name == "mrn")
    config = replace(configuration(arm, "door-lock", 5, "quick"), steps=50_000)
    path = write_run(reproduce.folder(tmp_path, arm, "door-lock", "quick") / "seed-5", config, files=("eval.csv",))
    _, refused = reproduce.runs_by_arm(studies.values(), "quick", tmp_path, read([tmp_path]).runs)
    assert refused == [f"Not judged: {path}: no run of its arm at the scale quick."]


def test_where_cells_failed_the_code_says_so_though_there_is_no_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(experiments, "run_cells", lambda *_: FAILED)
    command = ["reproduce", "senior", "--scale", "smoke", "--out", str(tmp_path)]
    assert main(command) == FAILED
    assert "There is no run that can be reported" in capsys.readouterr().err
    monkeypatch.setattr(experiments, "run_cells", lambda *_: DONE)
    assert main(command) == BAD_INPUT


def test_what_the_paper_has_not_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for options, said in (
        ("senior --tasks door-close", "has no door-close in main; its tasks there are door-lock, window-close, handle"),
        (
            "senior --table feedback quality --tasks door-open",
            "in feedback or quality; its tasks there are door-lock, w",
        ),
        ("senior --seeds 0", "--seeds must be at least 1"),
        ("pebble", "senior"),
        ("senior --table fig9", "ablation"),
    ):
        assert main(["reproduce", *options.split(), "--out", str(tmp_path)]) == BAD_INPUT
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.timeout(1200)
def test_the_main_table_in_toy_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = ["reproduce", "senior", "--table", "main", "--scale", "smoke", "--seeds", "1", "--out", str(tmp_path)]
    assert main(command) == DONE
    told = capsys.readouterr().out
    assert "48 of 48 cells are finished" in told and "Toy sizes" in told
    page = (tmp_path / "report" / "index.html").read_text()
    assert "The numbers mean nothing" in page
    with open(tmp_path / "report" / "tables" / "beside-the-paper.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 7 * (6 + 1)
    assert "verdict" not in rows[0], "toys decide nothing"
    row = next(row for row in rows if (row["method"], row["task"], row["when"]) == ("m-senior", "door-open", "end"))
    assert float(row["paper"]) == 1.0
    with open(tmp_path / "door-open" / "m-senior" / "seed-0" / "eval.csv") as file:
        assert float(row["ours"]) == float(list(csv.DictReader(file))[-1]["success_rate"])
    assert main([*command, "--no-train"]) == DONE
    assert (tmp_path / "report" / "index.html").read_text() == page
