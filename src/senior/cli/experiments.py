"""`senior sweep`, `senior reproduce`, `senior report` and `senior watch`: many runs, and what they show."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from senior.cli.display import stop_when_asked
from senior.cli.shared import DONE, FAILED, INTERRUPTED
from senior.extras import require
from senior.options import parse
from senior.rundir import is_finished, status
from senior.sweep import grid
from senior.sweep.cells import Cell, check_cells
from senior.types import BadInput


@dataclass(frozen=True)
class SweepOptions:
    """Train every combination of options, on this machine or on a Ray cluster.

    Every option of senior train that says what a run is can be given several values: --method m-senior pebble
    --task door-lock window-open --seed 0 1 2 makes twelve cells; an option that is given twice has the values of both.
    --arm takes methods with options of their own, "m-senior --select disagreement". Each cell is a run in
    OUT/TASK/ARM/seed-N; finished ones are skipped, interrupted ones go on.
    """

    out: Path
    """Directory that takes the cells."""
    file: Path | None = None
    """A TOML file that holds the grid: a key per option, a value or a list of them. Options given beside it win."""
    jobs: int | None = None
    """Workers on this machine. Left out: one per processor on a CPU, one on a GPU."""
    ray: str | None = None
    """Address of a Ray cluster to train on, HOST:PORT or auto, instead of this machine.
    OUT must be a folder that all its machines share."""
    list: bool = False
    """Only list the cells and where they stand."""


def sweep(arguments: Sequence[str]) -> int:
    names = [entry.name for entry in fields(SweepOptions)]
    mine, given = grid.split(arguments, [*names, "help"])
    if "-h" in arguments:
        mine = ["--help"]
    options = parse(SweepOptions, mine, None, "sweep")
    cells = _cells(options.file, given, options.out)
    if options.list:
        return _list(cells)
    return run_cells(cells, options.out, options.jobs, options.ray)


def _cells(file: Path | None, given: grid.Grid, out: Path) -> list[Cell]:
    if file is None:
        return grid.cells_of(given, out)
    axes = grid.merged(grid.read(file), given)
    try:
        return grid.cells_of(axes, out)
    except BadInput as error:
        raise BadInput(f"{file}{', or the options beside it' if given else ''}: {error}") from error


def _list(cells: Sequence[Cell]) -> int:
    check_cells(cells)
    for cell in cells:
        print(f"{cell}  {_stands(cell)}")
    return DONE


def run_cells(cells: Sequence[Cell], out: Path, jobs: int | None, ray: str | None) -> int:
    """Run a sweep under the eyes of a person; returns the exit code."""
    from senior.sweep.board import Board
    from senior.sweep.run import run

    board = Board(out)
    before = stop_when_asked(board)
    try:
        with board:
            done = run(cells, out, board, jobs, ray)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    print(
        f"{len(done.finished)} of {len(cells)} cells are finished"
        + (f", {len(done.failed)} failed:" if done.failed else ".")
    )
    for cell, reason in done.failed.items():
        print(f"  {cell}: {reason}")
    if board.stop and len(done.finished) < len(cells):
        print("Interrupted, all saved; the same command goes on.")
        return INTERRUPTED
    return FAILED if done.failed else DONE


def _stands(cell: Cell) -> str:
    if is_finished(cell.path):
        return "finished"
    told = status(cell.path)
    return f"step {told['step']:,}" if "step" in told else "not begun"


@dataclass(frozen=True)
class ReproduceOptions:
    """Train what a paper trained, and set its numbers and sentences beside ours.

    Finished runs are skipped and interrupted ones go on, so the same command goes on with a study, or with more seeds.
    """

    paper: tyro.conf.Positional[Literal["senior"]]
    """Which paper: senior."""
    table: tuple[Literal["main", "feedback", "ablation", "quality"], ...] = ("main",)
    """Its studies: main (Fig. 3, Table I), feedback (Fig. 4), ablation (Fig. 5), quality (Fig. 6).
    What several of them train is trained once."""
    scale: Literal["paper", "quick", "smoke"] = "paper"
    """paper: the paper's numbers. quick: the preset quick, for a CPU, for 100,000 steps. smoke: toy sizes."""
    tasks: tuple[str, ...] = ()
    """Only these of the studies' tasks (docs/experiments.md). Left out: all."""
    seeds: int | None = None
    """How many seeds, from 0 on, are trained and judged.
    Left out: 5, with --scale quick 8, with smoke 2 are trained, and all that are there judged."""
    out: Path | None = None
    """Directory that takes runs and report. Left out: runs/reproduce-senior-SCALE."""
    jobs: int | None = None
    """As in senior sweep."""
    ray: str | None = None
    """As in senior sweep."""
    list: bool = False
    """Only list the cells and where they stand."""
    train: bool = True
    """--no-train: only make the page of what is finished."""


def reproduce(arguments: list[str]) -> int:
    options = parse(ReproduceOptions, arguments, None, "reproduce")
    from senior.report.build import check_installed
    from senior.reproduce import run
    from senior.reproduce.studies import SEEDS

    check_installed()
    seeds = SEEDS[options.scale] if options.seeds is None else options.seeds
    if seeds < 1:
        raise BadInput(f"--seeds must be at least 1, not {seeds}.")
    studies = run.studies_of(options.table, options.tasks or None)
    out = options.out or Path("runs") / f"reproduce-{options.paper}-{options.scale}"
    cells = run.cells(studies.values(), range(seeds), options.scale, out)
    if options.list:
        return _list(cells)
    code = DONE
    if options.train:
        code = run_cells(cells, out, options.jobs, options.ray)
    if code == INTERRUPTED:
        return code
    try:
        print(run.write(studies, options.scale, out, options.seeds))
    except BadInput as error:
        if code == DONE:
            raise
        print(f"senior: {error}", file=sys.stderr)  # where cells failed the code is theirs
    return code


@dataclass(frozen=True)
class ReportOptions:
    """Put finished runs on one page: curves, intervals, comparisons, what the robot did and what was asked."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run directories, or directories that hold some."""
    out: Path
    """Directory that takes index.html, figures/ and tables/."""
    until: int | None = None
    """Look at all runs as if they had ended at this step, at which they must have been evaluated."""


def report(arguments: list[str]) -> int:
    options = parse(ReportOptions, arguments, None, "report")
    if not options.runs:
        raise BadInput("Name at least one run, or a directory that holds some.")
    from senior.report.build import counted, report
    from senior.report.results import grouped

    built = report(options.runs, options.out, until=options.until)
    for line in grouped(built.left_out):
        print(f"left out: {line}", file=sys.stderr)
    print(f"{counted(built.runs, 'run')}: {built.page}")
    return DONE


@dataclass(frozen=True)
class WatchOptions:
    """Serve the page of senior report, live, while runs are trained."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run directories, or directories that hold some or will."""
    host: str = "127.0.0.1"
    """Address to listen on. 0.0.0.0 lets other machines in, all of them: there is no token."""
    port: int = 0
    """0: a free one."""


def watch(arguments: list[str]) -> int:
    options = parse(WatchOptions, arguments, None, "watch")
    if not options.runs:
        raise BadInput("Name at least one run, or a directory that holds some, or will.")
    require("The live page", "report", "starlette", "uvicorn")
    from senior.report.watch import serve

    serve(options.runs, options.host, options.port)
    return DONE
