"""The parts of a report that say what was compared: fingerprints, versions, machines, and what was left out."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from senior.report.cells import Tasks
from senior.report.comparison import SHARED, unlike_on_one_task
from senior.report.page import Section, Table
from senior.report.records import PACKAGES, PROTOCOL, Arm, LeftOut, Run
from senior.report.results import unlike
from senior.report.tables import Cell

APART = ("device", "threads", "machine", "python", "git_commit", "action_size", "position")
"""Entries of a run's protocol that are told and keep no runs apart."""


def protocol(tasks: Tasks) -> Section:
    """What numbers depend on, where arms of one name differ, and machines and versions."""
    arms = {run.arm: own for by_label in tasks.values() for own in by_label.values() for run in own[:1]}
    runs = [run for own in arms.values() for run in own]
    text = [
        "Runs are averaged only where all that a number depends on is the same: the configuration but seed, device, "
        "checkpoints and snapshots, the versions of the reward function, senior-rl, metaworld and mujoco, the horizon "
        "and the observation. A fingerprint stands for all of that.",
        *unlike_on_one_task(tasks),
    ]
    unread = [run for run in runs if run.config is None]
    if unread:
        text.append(
            f"The configurations of {len(unread)} runs are of another version's form. They are compared field by "
            "field, and their labels tell the method alone."
        )
    tables = [_conditions(arms), _arms(arms)]
    for table in (_apart(list(arms)), _also(arms)):
        tables += [table] if table else []
    return Section("Protocol", tuple(text), (*tables, _machines(runs)))


def digest(arm: Arm) -> str:
    """Eight letters that stand for a fingerprint."""
    return hashlib.sha256(repr(arm.fingerprint).encode()).hexdigest()[:8]


def _conditions(arms: Mapping[Arm, Sequence[Run]]) -> Table:
    """What arms share beyond their method: a line for each combination."""
    names = (*SHARED, *(name.replace("_", " ") for name in PROTOCOL), *PACKAGES)
    found: dict[tuple[str, ...], list[Arm]] = defaultdict(list)
    for arm in arms:
        entries = dict(arm.fingerprint)
        found[tuple(entries.get(name, "") for name in names)].append(arm)
    rows: list[list[Cell]] = []
    for values, own in found.items():
        where = ", ".join(sorted({arm.task for arm in own}))
        rows.append([where, len(own), sum(len(arms[arm]) for arm in own), *values])
    head = ("tasks", "arms", "runs", *(name.removeprefix("--").replace(".", " ") for name in names))
    return Table("Conditions under which runs were made.", head, rows, "conditions")


def _arms(arms: Mapping[Arm, Sequence[Run]]) -> Table:
    rows = [
        [arm.task, arm.label, len(runs), ", ".join(str(run.seed) for run in runs), digest(arm)]
        for arm, runs in arms.items()
    ]
    return Table("Arms.", ("task", "arm", "runs", "seeds", "fingerprint"), rows, "arms", folded=True)


def _apart(arms: Sequence[Arm]) -> Table | None:
    """In what arms of one name and task differ; None if there are none."""
    alike: dict[tuple[str, str], list[Arm]] = defaultdict(list)
    for arm in arms:
        alike[arm.task, arm.name].append(arm)
    rows = [
        [task, arm.label, name, dict(arm.fingerprint).get(name)]
        for (task, _), own in alike.items()
        for name in (unlike(arm.fingerprint for arm in own) if len(own) > 1 else ())
        for arm in own
    ]
    if not rows:
        return None
    caption = "Arms of one method on one task that are not averaged with each other, and in what they differ."
    return Table(caption, ("task", "arm", "differs in", "has"), rows, "kept-apart")


def _told(run: Run) -> dict[str, str]:
    """All of a run's protocol that keeps no runs apart."""
    found: dict[str, Any] = {name.replace("_", " "): run.protocol.get(name) for name in APART}
    packages = run.protocol.get("packages") or {}
    found |= {name: version for name, version in packages.items() if name not in PACKAGES}
    return {name: str(value) for name, value in found.items() if value is not None}


def _also(arms: Mapping[Arm, Sequence[Run]]) -> Table | None:
    """In what else runs of one arm differ; None if in nothing."""
    rows: list[list[Cell]] = []
    for arm, runs in arms.items():
        told = [_told(run) for run in runs]
        for name in sorted({name for one in told for name in one}):
            counts = Counter(one.get(name, "not told") for one in told)
            if len(counts) > 1:
                values = "; ".join(f"{value} ({count})" for value, count in sorted(counts.items()))
                rows.append([arm.task, arm.label, name, values])
    if not rows:
        return None
    caption = "In what else runs of one arm differ, with how many runs. They are averaged all the same."
    return Table(caption, ("task", "arm", "also differs in", "values"), rows, "also-differs", folded=True)


def _machines(runs: Sequence[Run]) -> Table:
    counts = Counter(entry for run in runs for entry in _told(run).items())
    rows = [[name, value, count] for (name, value), count in sorted(counts.items())]
    caption = "Machines and versions that were told, and by how many runs."
    return Table(caption, ("what", "value", "runs"), rows, "machines", folded=True)


def left_out(found: Sequence[LeftOut]) -> Section | None:
    """Runs and files that are not in the report, by the reason; None if there are none."""
    if not found:
        return None
    by_reason: dict[str, list[Path]] = defaultdict(list)
    for path, reason in found:
        by_reason[reason].append(path)
    rows = [
        [reason, len(paths), _places(paths, reason)]
        for reason, paths in sorted(by_reason.items(), key=lambda item: -len(item[1]))
    ]
    text = (
        "What is named here is in no number above. Where it is a file of a run, the run itself is in the report, but "
        "for what that file tells."
    )
    table = Table("Left out, and why.", ("reason", "how many", "which"), rows, "left-out")
    return Section("Left out", (text,), (table,))


def _places(paths: Sequence[Path], reason: str) -> str:
    """Runs by the folder that they are in; of a file that the reason names, its run."""
    by_folder: dict[Path, list[str]] = defaultdict(list)
    for path in paths:
        run = path.parent if reason.startswith(path.name) else path
        by_folder[run.parent].append(run.name)
    return "; ".join(f"{folder}: {', '.join(runs)}" for folder, runs in by_folder.items())
