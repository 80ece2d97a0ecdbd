"""The cells of a sweep, and what became of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from senior import parts
from senior.config import Config, from_json, made_by, to_json
from senior.fit import check_fit, check_offered, spec_of
from senior.rundir import RunDirectory
from senior.types import BadInput, EnvSpec


@dataclass(frozen=True)
class Cell:
    """One run of a sweep: its configuration and its directory."""

    config: Config
    path: Path

    def __str__(self) -> str:
        return str(self.path)


Job = tuple[Cell, ...]
"""Cells that one worker is given at a time."""


class Outcome(NamedTuple):
    """What became of a cell."""

    finished: bool
    failure: str | None
    """Why it was stopped; None: it finished, or was told to stop."""


class Done(NamedTuple):
    """A job that a worker is through with."""

    job: Job
    outcomes: tuple[Outcome, ...]
    """In the order of the job's cells; empty if the worker was lost."""
    reason: str = ""
    """Why it was lost."""


def check_cells(cells: Sequence[Cell]) -> None:
    """Refuse, before anything runs, cells that make no sense or whose directories hold something else."""
    if not cells:
        raise BadInput("There is no cell in the sweep.")
    paths = [cell.path.resolve() for cell in cells]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise BadInput(f"Two cells of the sweep would be in {twice}.")
    if len({cell.config.device for cell in cells}) > 1:
        raise BadInput("All cells of a sweep are on one kind of device, so their --device must be the same.")
    specs: dict[str, EnvSpec] = {}
    for cell in cells:
        check_offered(cell.config)
        if parts.takes_time(cell.config):
            raise BadInput(f"A sweep does not wait for people; the teacher of {cell} is {cell.config.teacher}.")
        own = parts.resolved(cell.config)
        environment = json.dumps(made_by(own))
        if environment not in specs:
            specs[environment] = spec_of(own)
        check_fit(own, specs[environment])
        directory = RunDirectory(cell.path)
        if (cell.path / "config.json").is_file():
            directory.check_holds(own)
        else:
            directory.check_free()


def opened_at(path: Path) -> int:
    """When a run last said anything, in nanoseconds; 0: it never did."""
    try:
        return (path / "status.json").stat().st_mtime_ns
    except OSError:
        return 0


def order(job: Job) -> str:
    """A job as a line of JSON, for a worker."""
    return json.dumps([{"path": str(cell.path.resolve()), "config": to_json(_anywhere(cell.config))} for cell in job])


def _anywhere(config: Config) -> Config:
    """With the path of a label file absolute: a worker may stand in another directory."""
    return replace(config, teacher=parts.resolved(config).teacher)


def job_of(order: str) -> Job:
    """The job that an `order` was made of."""
    return tuple(Cell(from_json(cell["config"]), Path(cell["path"])) for cell in json.loads(order))


def report(outcomes: Sequence[Outcome]) -> str:
    """Outcomes as a line of JSON."""
    return json.dumps(outcomes)


def outcomes_of(report: str) -> tuple[Outcome, ...]:
    """The outcomes that a `report` was made of."""
    return tuple(Outcome(*fields) for fields in json.loads(report))
