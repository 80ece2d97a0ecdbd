"""Sweeps: grids of options, cells that are skipped, go on, are tried again, and real workers that are killed."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from dataclasses import replace
from io import StringIO
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from senior.cli import main
from senior.cli.shared import DONE, INTERRUPTED
from senior.envs.point import Point
from senior.protocol import threads
from senior.rundir import HELD, RunDirectory, is_finished
from senior.sweep.board import Board
from senior.sweep.cells import Cell, Done, Job, Outcome, check_cells, job_of, order, outcomes_of, report
from senior.sweep.grid import cells_of, merged, read, split
from senior.sweep.local import LocalCrew
from senior.sweep.run import run
from senior.sweep.scheduler import RETRIES, Sweep
from senior.sweep.worker import Watch, train
from senior.types import BAD_INPUT, BadInput
from tests.equal import OPTIONS, assert_same_run, short
from tests.small import small

GRID = """
task = "point"
method = ["m-senior", "mrn"]
seed = [0, 1]
wait = false
networks.width = 32
"pge.relabel" = false
"""


def named(cells: list[Cell], out: Path) -> list[str]:
    return [str(cell.path.relative_to(out)) for cell in cells]


# Grids.


def test_every_option_can_have_several_values(tmp_path: Path):
    given = "--task door-lock window-open --out x --seed 0 1 --method m-senior pebble --no-wait --budget=100 --jobs 2"
    mine, grid = split(given.split(), ("out", "jobs"))
    assert mine == ["--out", "x", "--jobs", "2"]
    assert grid["no-wait"] == [] and grid["budget"] == ["100"]
    cells = cells_of(grid, tmp_path)
    assert named(cells, tmp_path) == [
        f"{task}/{method}/seed-{seed}"
        for seed in (0, 1)
        for task in ("door-lock", "window-open")
        for method in ("m-senior", "pebble")
    ]
    assert {cell.config.queries.budget for cell in cells} == {100}
    assert not any(cell.config.asking.wait for cell in cells)
    assert [(cell.config.task, cell.config.method.name, cell.config.seed) for cell in cells][1] == (
        "door-lock",
        "pebble",
        0,
    )


def test_arms_are_methods_with_options_and_what_varies_is_in_the_name(tmp_path: Path):
    _, grid = split(["--arm", "mrn", "m-senior --select disagreement", "--budget", "100", "200"], ())
    cells = cells_of(grid, tmp_path)
    assert named(cells, tmp_path) == [
        "door-lock/mrn-budget-100/seed-0",
        "door-lock/m-senior-select-disagreement-budget-100/seed-0",
        "door-lock/mrn-budget-200/seed-0",
        "door-lock/m-senior-select-disagreement-budget-200/seed-0",
    ]
    assert cells[1].config.method.select == "disagreement"
    assert cells[3].config.queries.per_session == 4, "--budget brings its pairs per session, as in senior train"


def test_a_grid_in_a_file(tmp_path: Path):
    (tmp_path / "grid.toml").write_text(GRID)
    cells = cells_of(read(tmp_path / "grid.toml"), tmp_path)
    assert len(cells) == 4
    assert all(
        cell.config.networks.width == 32 and not cell.config.pge.relabel and not cell.config.asking.wait
        for cell in cells
    )


def test_options_beside_a_file_win():
    file = {"method": ["mrn"], "wait": [], "seed": ["0"], "replay-capacity": ["9"]}
    assert merged(file, {"arm": ["pebble"], "no-wait": [], "seed": ["1", "2"]}) == {
        "replay-capacity": ["9"],
        "arm": ["pebble"],
        "no-wait": [],
        "seed": ["1", "2"],
    }


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("task = [", "cannot be read"),
        ("task = [['a']]", "task must be a value or a list of values"),
        ("wait = [true, false]", "wait must be true or false"),
        ("wait = []", "wait must be true or false"),
        ('wait = "false"', "wait must be true or false"),
    ],
)
def test_a_file_that_is_no_grid_is_refused(content: str, said: str, tmp_path: Path):
    (tmp_path / "grid.toml").write_text(content)
    with pytest.raises(BadInput, match=said):
        read(tmp_path / "grid.toml")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--metod m-senior", "did you mean --method"),
        ("--method m-seniro", "m-senior"),
        ("--arm mrn --method pebble", "not both"),
        ("--steps many", "--steps needs a whole number"),
        ("--budget 100 0.5", "--budget needs a whole number"),
        ("--seed 0 0", "Two cells"),
        ("--method sac --outer bilevel", "makes no sense"),
        ("--teacher human", "does not wait for people"),
        ("--jobs 0", "--jobs 0 must be between"),
        ("--precision bfloat16", "is not offered"),
        ("--segment 600", "does not fit into an episode"),
        ("--env nosuch:Thing", "nosuch"),
        ("--env tests.test_sweep:Fragile", "--position"),
        (
            r"--arm=mrn --budget=50 --arm=pebble\ --budget\ 100",
            "and the sweep both have --budget; give it to the arms that need it",
        ),
        ("--file nowhere.toml", "nowhere.toml cannot be read"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_runs(
    options: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["sweep", "--out", str(tmp_path / "out"), "--device", "cpu", *shlex.split(options)]) == BAD_INPUT
    assert said in capsys.readouterr().err
    assert not list(tmp_path.rglob("config.json"))


@pytest.mark.parametrize(
    ("beside", "said"),
    [
        ("", "grid.toml: Unknown option --metod"),
        ("--seed 3", "grid.toml, or the options beside it: Unknown option --metod"),
    ],
)
def test_what_makes_no_sense_in_a_file_is_told_with_the_file(
    beside: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "grid.toml").write_text('metod = "m-senior"')
    arguments = ["sweep", "--out", str(tmp_path / "out"), "--file", str(tmp_path / "grid.toml"), *beside.split()]
    assert main(arguments) == BAD_INPUT
    assert said in capsys.readouterr().err


def test_values_that_differ_in_sign_have_directories_of_their_own(tmp_path: Path):
    found = cells_of({"method": ["pebble"], "teacher": ["noisy"], "rationality": ["-1", "1"]}, tmp_path)
    assert [cell.path.parent.name for cell in found] == ["pebble-rationality-minus-1", "pebble-rationality-1"]


def test_a_worker_is_told_where_a_label_file_is_wherever_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (cell,) = job_of(order((Cell(replace(small("pebble"), teacher="own.jsonl"), tmp_path / "run"),)))
    assert cell.config.teacher == str(tmp_path / "own.jsonl")


# Cells to workers, with a crew that does what the test says.


class Script:
    """A crew that answers each job with what is written for its cells; ``None`` loses the worker."""

    def __init__(self, device: str, size: int, answers: dict[str, list[str | None]]) -> None:
        self.device = device
        self.size = size
        self.answers = answers
        self.given: list[Job] = []
        self.stopped = False
        self._busy: deque[Job] = deque()

    @property
    def idle(self) -> int:
        return self.size - len(self._busy)

    def give(self, job: Job) -> None:
        self.given.append(job)
        self._busy.append(job)

    def wait(self, seconds: float) -> list[Done]:
        if not self._busy:
            return []
        job = self._busy.popleft()
        outcomes = []
        for cell in job:
            said = self.answers.get(str(cell), []).pop(0) if self.answers.get(str(cell)) else "finished"
            (cell.path).mkdir(parents=True, exist_ok=True)
            (cell.path / "status.json").write_text(json.dumps({"phase": "training", "step": len(self.given)}))
            if said is None:
                return [Done(job, (), "its process was killed (signal 9)")]
            if said == "ends":
                (cell.path / "status.json").write_text(json.dumps({"phase": "finished", "step": 9}))
                continue
            if said == "saves":
                (cell.path / "checkpoints").mkdir(parents=True, exist_ok=True)
                (cell.path / "checkpoints" / f"step-{len(self.given):010d}.npz").touch()
                return [Done(job, (), "its process was killed (signal 9)")]
            outcomes.append(Outcome(said == "finished", None if said in ("finished", "stopped") else said))
        return [Done(job, tuple(outcomes))]

    def stop(self) -> None:
        self.stopped = True


class Looker:
    def __init__(self, stop_after: int = 10**9) -> None:
        self.said: list[str] = []
        self.left = stop_after

    def look(self, sweep: Sweep) -> None:
        self.left -= 1

    def say(self, sentence: str) -> None:
        self.said.append(sentence)

    @property
    def stop(self) -> bool:
        return self.left <= 0


def cells(tmp_path: Path, count: int = 3) -> list[Cell]:
    return [Cell(short(seed=i), tmp_path / f"seed-{i}") for i in range(count)]


def test_a_cell_that_fails_is_tried_three_times_more_and_then_named(tmp_path: Path):
    made = cells(tmp_path)
    sweep, looker = Sweep(made), Looker()
    crew = Script("cpu", 2, {str(made[0]): ["broken"] * 9, str(made[1]): ["broken", "finished"]})
    sweep.run(crew, looker)
    assert sweep.finished == {made[1], made[2]} and sweep.failed == {made[0]: "broken"}
    assert [job[0] for job in crew.given].count(made[0]) == 1 + RETRIES
    assert sum("is tried again from step 0" in line for line in looker.said) == RETRIES + 1
    assert looker.said[-1].endswith("failed 4 times and is left: broken")


def test_a_worker_that_is_lost_counts_only_if_nothing_new_was_saved(tmp_path: Path):
    made = cells(tmp_path, 2)
    sweep = Sweep(made)
    sweep.run(Script("cpu", 1, {str(made[0]): ["saves"] * 20, str(made[1]): [None] * 9}), Looker())
    assert sweep.finished == {made[0]}
    assert "was killed" in sweep.failed[made[1]]


def test_on_a_gpu_cells_share_a_job(tmp_path: Path):
    made = cells(tmp_path, 5)
    crew = Script("gpu", 2, {})
    Sweep(made).run(crew, Looker())
    assert crew.given == [tuple(made[:3]), tuple(made[3:])]


def test_on_a_gpu_what_was_finished_or_not_begun_when_a_worker_was_lost_is_not_blamed(tmp_path: Path):
    made = cells(tmp_path, 3)
    answers = {str(made[0]): ["ends"], str(made[1]): [None, "saves", None, "saves", "finished"]}
    sweep = Sweep(made)
    sweep.run(Script("gpu", 1, answers), Looker())
    assert sweep.finished == set(made) and not sweep.failed


def test_a_cell_that_another_process_trains_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made, looker = cells(tmp_path, 1), Looker()
    clock = count(step=10)
    monkeypatch.setattr("senior.sweep.scheduler.time.monotonic", lambda: float(next(clock)))
    sweep = Sweep(made)
    sweep.run(Script("cpu", 1, {str(made[0]): [f"The run {HELD}."] * 9}), looker)
    assert sweep.finished == set(made) and len(looker.said) == 1 and "is waited for" in looker.said[0]


def test_told_to_stop_it_gives_nothing_more_and_keeps_what_was_stopped_waiting(tmp_path: Path):
    made = cells(tmp_path)
    sweep = Sweep(made)
    crew = Script("cpu", 2, {str(made[1]): ["stopped"]})
    sweep.run(crew, Looker(stop_after=1))
    assert crew.stopped and len(crew.given) == 2
    assert sweep.finished == {made[0]} and set(sweep.waiting) == {made[1], made[2]} and not sweep.failed


def test_jobs_and_outcomes_travel_as_json(tmp_path: Path):
    made = tuple(cells(tmp_path.resolve(), 2))
    assert job_of(order(made)) == made
    told = (Outcome(False, "why"), Outcome(True, None))
    assert outcomes_of(report(told)) == told


def test_the_board_tells_where_a_sweep_stands(tmp_path: Path):
    made = cells(tmp_path)
    (made[0].path).mkdir()
    (made[0].path / "status.json").write_text(
        json.dumps({"phase": "finished", "step": 1000, "labels": 25, "success": 0.5})
    )
    for live in (False, True):
        console = Console(file=StringIO(), force_terminal=live, width=150)
        sweep = Sweep(made)
        with Board(tmp_path, console) as board:
            board.look(sweep)
            board.look(sweep)
        shown = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
        assert "1 of 3 cells done" in shown
        assert ("0 running, 2 waiting" in shown) == live
        assert ("25/75" in shown and "50%" in shown) == live
        assert live or shown.count("\n") == 1, "a line only when there is something new"


# Real workers.

SWEEP = ["sweep", *OPTIONS, "--seed", "0", "1"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    assert main([*SWEEP, "--out", str(out)]) == DONE
    return out / "point" / "m-senior"


def test_cells_are_runs_like_any_other_and_a_finished_sweep_does_nothing(
    undisturbed: Path, capsys: pytest.CaptureFixture[str]
):
    for seed in (0, 1):
        config = json.loads((undisturbed / f"seed-{seed}" / "config.json").read_text())
        assert config["protocol"]["threads"] == max(1, threads() // 2)
        assert is_finished(undisturbed / f"seed-{seed}")
    before = {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")}
    out = str(undisturbed.parents[1])
    assert main([*SWEEP, "--out", out]) == DONE
    assert {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")} == before
    assert main([*SWEEP, "2", "--out", out, "--list"]) == DONE
    assert [line.split("  ")[1] for line in capsys.readouterr().out.splitlines()[-3:]] == ["finished"] * 2 + [
        "not begun"
    ]
    assert main([*SWEEP, "--pge.beta", "0.2", "--out", out]) == BAD_INPUT
    assert "holds another run: its pge.beta is 0.1, not 0.2" in capsys.readouterr().err


def begin(out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "senior.cli", *SWEEP, "--out", str(out), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def worker_of(path: Path, beyond: int) -> int:
    """The process that trains a run, once it is beyond a step."""
    for _ in range(1500):
        try:
            told = json.loads((path / "status.json").read_text())
        except (OSError, ValueError):
            told = {"step": -1}
        if told["step"] > beyond:
            return told["process"]
        time.sleep(0.1)
    raise AssertionError(f"{path} never came beyond step {beyond}: {told}")


def test_a_killed_worker_loses_nothing(undisturbed: Path, tmp_path: Path):
    run = tmp_path / "point" / "m-senior" / "seed-0"
    with begin(tmp_path) as sweep:
        os.kill(worker_of(run, 450), signal.SIGKILL)
        out, err = sweep.communicate(timeout=300)
    assert sweep.returncode == DONE, err
    assert "its process was killed (signal 9)" in err and "2 of 2 cells are finished" in out
    for seed in (0, 1):
        assert_same_run(run.with_name(f"seed-{seed}"), undisturbed / f"seed-{seed}", interrupted=seed == 0)


def test_interrupted_it_leaves_everything_resumable(undisturbed: Path, tmp_path: Path):
    run = tmp_path / "point" / "m-senior" / "seed-0"
    with begin(tmp_path, "--jobs", str(min(2, threads()))) as sweep:
        worker = worker_of(run, 450)
        os.kill(worker, signal.SIGSTOP)  # else it may be done before the second has come so far
        second = subprocess.run(
            [sys.executable, "-m", "senior.cli", *SWEEP, "--out", tmp_path], capture_output=True, text=True, timeout=60
        )
        assert second.returncode == BAD_INPUT and "Another sweep is at work" in second.stderr
        sweep.send_signal(signal.SIGINT)
        os.kill(worker, signal.SIGCONT)
        out, err = sweep.communicate(timeout=300)
    assert sweep.returncode == INTERRUPTED, err
    assert "Interrupted, all saved; the same command goes on." in out
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)
    assert main([*SWEEP, "--out", str(tmp_path)]) == DONE
    for seed in (0, 1):
        assert_same_run(run.with_name(f"seed-{seed}"), undisturbed / f"seed-{seed}", interrupted=True)


def test_workers_end_with_a_sweep_that_is_killed(tmp_path: Path):
    run = tmp_path / "point" / "m-senior" / "seed-0"
    with begin(tmp_path) as sweep:
        worker = worker_of(run, 450)
        sweep.kill()
        sweep.communicate()
    for _ in range(600):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            break
        time.sleep(0.1)
    else:
        raise AssertionError("the worker trains on")
    assert (run / "checkpoints").exists() and not is_finished(run)


class Fragile(Point):
    """A point that breaks after 104 steps, and again when it is brought back to where it stood."""

    def __init__(self) -> None:
        super().__init__(50)
        self.taken = 0

    def step(self, action: np.ndarray):
        self.taken += 1
        if self.taken > 104:
            raise RuntimeError("motor burnt")
        return super().step(action)


def test_a_cell_that_cannot_be_trained_is_named_and_the_others_go_on(
    undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(undisturbed / "seed-0", tmp_path / "point" / "m-senior" / "seed-0")
    made = [Cell(short(device="cpu"), tmp_path / "point" / "m-senior" / "seed-0")]
    made += [Cell(short(device="cpu", env="tests.test_sweep:Fragile", position="0:2"), tmp_path / "fragile")]
    with Board(tmp_path, Console(file=StringIO())) as board:
        sweep = run(made, tmp_path, board, jobs=1)
    assert sweep.finished == {made[0]}
    assert "motor burnt" in sweep.failed[made[1]]


def test_a_dead_worker_is_found_though_something_that_it_started_lives_on(tmp_path: Path):
    """What a worker forks holds its end of the pipe."""
    crew = LocalCrew("cpu", 1, tmp_path / "logs")
    config = short(device="cpu", env="tests.test_sweep:Forking", position="0:2")
    crew.give((Cell(config, tmp_path / "run"),))
    os.kill(worker_of(tmp_path / "run", 10), signal.SIGKILL)
    until = time.monotonic() + 60
    while not (done := crew.wait(0.5)):
        assert time.monotonic() < until
    assert done[0].outcomes == () and "signal 9" in done[0].reason
    crew.close()


def test_a_worker_that_died_idle_costs_no_cell_a_try(tmp_path: Path):
    crew = LocalCrew("cpu", 1, tmp_path / "logs")

    def outcome(name: str) -> tuple[Outcome, ...]:
        crew.give((Cell(short(device="cpu"), tmp_path / name),))
        until = time.monotonic() + 300
        while not (done := crew.wait(0.5)):
            assert time.monotonic() < until
        return done[0].outcomes

    assert outcome("first") == (Outcome(True, None),)
    dead = json.loads((tmp_path / "first" / "status.json").read_text())["process"]
    os.kill(dead, signal.SIGKILL)
    os.waitid(os.P_PID, dead, os.WEXITED | os.WNOWAIT)
    assert outcome("second") == (Outcome(True, None),)
    crew.close()


def test_a_worker_that_was_told_to_stop_by_somebody_else_is_given_nothing_more(tmp_path: Path):
    crew = LocalCrew("cpu", 1, tmp_path / "logs")
    cell = Cell(short(device="cpu"), tmp_path / "run")

    def outcomes() -> tuple[Outcome, ...]:
        until = time.monotonic() + 300
        while not (done := crew.wait(0.5)):
            assert time.monotonic() < until
        return done[0].outcomes

    crew.give((cell,))
    os.kill(worker_of(cell.path, 10), signal.SIGTERM)
    assert outcomes() == (Outcome(False, None),)
    crew.give((cell,))
    assert outcomes() == (Outcome(True, None),)
    crew.close()


class Forking(Point):
    """A point with a helper, which outlives it for two minutes."""

    def __init__(self) -> None:
        super().__init__(50)
        if "FORKED" not in os.environ:
            os.environ["FORKED"] = "1"
            if os.fork() == 0:
                time.sleep(120)
                os._exit(0)


def test_one_cell_of_a_job_that_cannot_be_opened_leaves_the_others_alone(undisturbed: Path, tmp_path: Path):
    mine, other = tmp_path / "mine", tmp_path / "other"
    shutil.copytree(undisturbed / "seed-1", other)
    held = RunDirectory(other)
    held.lock()
    job = (Cell(short(device="cpu", seed=1), other), Cell(short(device="cpu"), mine))
    try:
        first, second = train(job, Watch())
    finally:
        held.close()
    assert not first.finished and first.failure is not None and HELD in first.failure
    assert second.finished and second.failure is None
    (again,) = train(job[:1], Watch())
    assert again.finished, "its lock was let go of"


def test_cells_that_hold_something_else_are_refused(tmp_path: Path):
    (tmp_path / "seed-0").mkdir()
    (tmp_path / "seed-0" / "thesis.tex").touch()
    with pytest.raises(BadInput, match="is not empty"):
        check_cells(cells(tmp_path))
    with pytest.raises(BadInput, match="Two cells"):
        check_cells([cells(tmp_path)[1]] * 2)
    one, other = cells(tmp_path)[1:]
    with pytest.raises(BadInput, match="--device must be the same"):
        check_cells([one, replace(other, config=replace(other.config, device="gpu"))])
