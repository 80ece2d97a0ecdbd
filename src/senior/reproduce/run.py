"""The cells of the paper's studies, and the report that sets them beside the paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from senior.config import Config, differences
from senior.report.build import found, page_of
from senior.report.names import normal
from senior.report.records import LeftOut, Run
from senior.report.results import grouped
from senior.reproduce import page
from senior.reproduce.studies import STUDIES, Arm, Scale, Study, Table, chosen, configuration
from senior.sweep.cells import Cell
from senior.sweep.grid import place
from senior.types import BadInput


def studies_of(tables: Sequence[Table], tasks: tuple[str, ...] | None) -> dict[Table, Study]:
    """The studies, on those of ``tasks`` that each has; `BadInput` for a task that none has."""
    known = dict.fromkeys(task for table in tables for task in STUDIES[table].tasks)
    for task in tasks or ():
        if task not in known:
            raise BadInput(f"The paper has no {task} in {' or '.join(tables)}; its tasks there are {', '.join(known)}.")
    return {table: chosen(table, tasks) for table in tables}


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


def runs_by_arm(
    studies: Iterable[Study], scale: Scale, out: Path, runs: Sequence[Run]
) -> tuple[dict[tuple[str, str], list[Run]], list[str]]:
    """Of finished ``runs`` those below ``out`` by arm and task, and in sentences what is there and does not count.

    Runs count that were trained with the configuration of that arm, task and scale, and of those the most that agree in
    all that a number depends on (`senior.report.records.Arm`).
    """
    there: dict[Path, list[Run]] = {}
    for run in runs:
        there.setdefault(run.path.parent, []).append(run)
    counted: dict[tuple[str, str], list[Run]] = {}
    refused: list[LeftOut] = []
    for study in studies:
        for task in study.tasks:
            for arm in study.arms:
                alike: dict[object, list[Run]] = {}
                for run in there.get(folder(out, arm, task, scale), []):
                    wanted = configuration(arm, task, run.seed, scale)
                    if run.config is None or differences(_comparable(run.config), _comparable(wanted)):
                        refused.append(LeftOut(run.path, f"no run of its arm at the scale {scale}"))
                    else:
                        alike.setdefault(run.arm.fingerprint, []).append(run)
                most = max(alike.values(), key=len, default=[])
                for run in (run for own in alike.values() if own is not most for run in own):
                    refused.append(LeftOut(run.path, "another protocol than the runs beside it that count"))
                if most:
                    counted[arm.name, task] = most
    return counted, [f"Not judged: {line}." for line in grouped(list(dict.fromkeys(refused)))]


def _comparable(config: Config) -> Config:
    """With a teacher's numbers, and without what no number depends on."""
    return replace(normal(config), device="auto", checkpoint_every=1, snapshot_every=1)


def write(studies: dict[Table, Study], scale: Scale, out: Path, seeds: int | None = None) -> str:
    """The page of what is finished below ``out``, in ``out/report``; returns its verdicts in lines for a terminal.

    seeds: only so many count, from 0 on; None: all that are there. `BadInput` if no run of the studies is there.
    """
    results = found([out])
    wanted = tuple(run for run in results.runs if seeds is None or run.seed < seeds)
    beyond = len(results.runs) - len(wanted)
    results = results._replace(runs=wanted)
    runs, refused = runs_by_arm(studies.values(), scale, out, results.runs)
    if not runs and not refused:
        raise BadInput(f"{out} holds no finished run of the studies {', '.join(studies)} at the scale {scale}.")
    judged = page.judge(list(studies), studies, runs)
    notes = [*_restriction(studies), *refused]
    if beyond:
        notes.append(f"Left out on demand: {beyond} finished runs of seeds from {seeds} on.")
    built = page_of(results, out / "report", page.sections(judged, scale, notes))
    return "\n".join([page.summary(judged, scale), *notes, str(built.page)])


def _restriction(studies: dict[Table, Study]) -> list[str]:
    """A sentence on the tasks of the studies that are left out, if some are."""
    left = dict.fromkeys(task for table in studies for task in STUDIES[table].tasks if task not in studies[table].tasks)
    if not left:
        return []
    return [
        f"Left out on demand: {', '.join(left)}. What the paper's sentences say of them counts as missing: such a "
        "sentence can be refuted here, and not confirmed."
    ]
