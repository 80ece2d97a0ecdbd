"""The cells of the paper's studies, and the report that sets them beside the paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from senior.report.build import Built, report
from senior.report.results import Run, read
from senior.reproduce import page
from senior.reproduce.studies import Arm, Scale, Study, Table, chosen, configuration
from senior.sweep.cells import Cell
from senior.sweep.grid import place
from senior.types import BadInput


def studies_of(tables: Sequence[Table], tasks: tuple[str, ...] | None) -> dict[Table, Study]:
    """The studies, on those of ``tasks`` that each has; `BadInput` for a task that none has."""
    found: dict[Table, Study] = {table: chosen(table, tasks) for table in tables}
    for task in tasks or ():
        if not any(task in study.tasks for study in found.values()):
            raise BadInput(f"None of the studies {', '.join(tables)} is on {task}.")
    return {table: study for table, study in found.items() if study.tasks}


def folder(out: Path, arm: Arm, task: str, scale: Scale) -> Path:
    """Where an arm's seeds are, as in `senior.sweep.grid`; what several studies train is there once."""
    method = arm.options.split()[0]
    config = configuration(arm, task, 0, scale)
    same = config == configuration(Arm(method, method), task, 0, scale)
    return place(out, config, method if same else arm.options).parent


def cells(studies: Iterable[Study], seeds: Sequence[int], scale: Scale, out: Path) -> list[Cell]:
    """All runs of the studies, each once, the first seed of everything first."""
    found: dict[Path, Cell] = {}
    for seed in seeds:
        for study in studies:
            for task in study.tasks:
                for arm in study.arms:
                    path = folder(out, arm, task, scale) / f"seed-{seed}"
                    found.setdefault(path, Cell(configuration(arm, task, seed, scale), path))
    return list(found.values())


def runs_by_arm(studies: Iterable[Study], scale: Scale, out: Path) -> dict[tuple[str, str], list[Run]]:
    """Finished runs below ``out`` by arm and task."""
    there: dict[Path, list[Run]] = {}
    for run in read([out]).runs:
        there.setdefault(run.path.parent, []).append(run)
    return {
        (arm.name, task): there[place]
        for study in studies
        for task in study.tasks
        for arm in study.arms
        if (place := folder(out, arm, task, scale)) in there
    }


def write(studies: dict[Table, Study], scale: Scale, out: Path) -> tuple[Built, str]:
    """The page of what is finished below ``out``, in ``out/report``; and its verdicts in lines for a terminal."""
    runs = runs_by_arm(studies.values(), scale, out)
    first = page.sections(list(studies), studies, scale, runs)
    return report([out], out / "report", first), page.summary(list(studies), studies, scale, runs)
