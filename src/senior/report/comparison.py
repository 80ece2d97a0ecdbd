"""The part of a report that sets arms against each other, and what keeps them from being comparable.

Imports no JAX.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from senior.report import across, estimates
from senior.report.cells import Tasks, estimate_and_interval, finished, single, tells_success
from senior.report.looks import Look, in_order
from senior.report.page import Drawing, Section, Table
from senior.report.records import PACKAGES, PROTOCOL, Arm, Run
from senior.report.results import unlike
from senior.report.statistics import REPETITIONS, improvement, interquartile_means, means, profiles
from senior.report.tables import NOTHING

SHARED = ("--preset", "--steps", "--evaluation.every", "--evaluation.episodes")
"""Options that make no label, and that arms which are compared should share."""
THRESHOLDS = np.linspace(0, 1, 51)


def comparison(tasks: Tasks, looks: Mapping[str, Look]) -> Section | None:
    """Arms against each other over the tasks that they share; None where there is nothing to compare."""
    text, tables, figures = [], [], []
    for names, group in _groups(tasks):
        where = names[0] if len(names) == 1 else f"{len(names)} tasks ({', '.join(names)})"
        short = names[0] if len(names) == 1 else f"{len(names)}-tasks"
        last = {label: [np.array([run.score[-1] for run in runs]) for runs in own] for label, own in group.items()}
        several = len(names) > 1
        if several:
            figures += _over_tasks(names, group, looks)
        if tells_success(tasks[names[0]]) and (several or len(group) > 1):
            middle, mean = interquartile_means(last), means(last)
            panels = {"interquartile mean": single(middle), "mean": single(mean)}
            caption = f"{where}: success at the end, with 95 % bootstrap intervals."
            figures.append(estimates.aggregates(f"{short}-aggregate", caption, panels, looks))
            rows = [
                [
                    label,
                    sum(len(runs) for runs in group[label]),
                    *estimate_and_interval(middle[label]),
                    *estimate_and_interval(mean[label]),
                ]
                for label in group
            ]
            head = ("arm", "runs", "interquartile mean", "95 % interval", "mean", "95 % interval of the mean")
            tables.append(Table(caption, head, rows, f"{short}-aggregate"))
        if several:
            found = profiles(last, THRESHOLDS)
            figures.append(across.profile_curves(f"{short}-profile", THRESHOLDS, found, looks))
        if len(group) > 1:
            figures.append(estimates.improvements(f"{short}-improvement", where, improvement(last), list(group)))
        if several:
            mixed = _mixed(names, group)
            text += [mixed] if mixed else []
    if not figures:
        return None
    first = (
        "Probability of improvement, P(X > Y) + P(X = Y) / 2, takes a run of each at random; a half means no "
        "difference. Intervals are percentiles of a bootstrap that draws runs within each task (rliable, "
        f"{REPETITIONS:,} draws), so they tell of other seeds and not of other tasks. They have no width where all "
        "runs say the same; the 90 % intervals of the summary do."
    )
    return Section("Methods compared", (first, *text), tuple(tables), tuple(figures))


def _groups(tasks: Tasks) -> list[tuple[list[str], dict[str, list[list[Run]]]]]:
    """Which arms are compared over which tasks, with the finished runs per task.

    For every set of tasks that some arm has, all arms that have these tasks; those with the most tasks first. True
    returns of different tasks cannot be averaged, so such tasks stand alone.
    """
    ended = {
        task: {label: done for label, runs in arms.items() if (done := finished(runs))} for task, arms in tasks.items()
    }
    sets: set[tuple[str, ...]] = set()
    for label in {label for arms in ended.values() for label in arms}:
        having = [task for task in ended if label in ended[task]]
        sets.add(tuple(task for task in having if tells_success(tasks[task])))
        sets |= {(task,) for task in having if not tells_success(tasks[task])}
    found = []
    for names in sorted(sets - {()}, key=lambda names: (-len(names), names)):
        having = in_order(label for label in ended[names[0]] if all(label in ended[task] for task in names))
        if len(names) > 1 or len(having) > 1:
            found.append((list(names), {label: [ended[task][label] for task in names] for label in having}))
    return found


def _over_tasks(
    names: Sequence[str], group: Mapping[str, Sequence[Sequence[Run]]], looks: Mapping[str, Look]
) -> list[Drawing]:
    """The curve over all tasks, if all runs were evaluated at the same steps."""
    runs = [run for own in group.values() for per_task in own for run in per_task]
    steps = runs[0].evaluation.step
    if any(not np.array_equal(steps, run.evaluation.step) for run in runs):
        return []
    scores = {label: [np.stack([run.score for run in runs]) for runs in own] for label, own in group.items()}
    return [across.curves_over_tasks(names, steps, interquartile_means(scores), looks)]


def _mixed(names: Sequence[str], group: Mapping[str, Sequence[Sequence[Run]]]) -> str | None:
    """That runs which are averaged over tasks do not share what they should, and what; None if they do."""
    said = []
    for label, own in group.items():
        arms = list({run.arm for runs in own for run in runs})
        differing = [name for name in unlike(arm.fingerprint for arm in arms) if name in (*SHARED, *PACKAGES)]
        said += [f"{label} in {name} ({values_of(arms, name, task=True)})" for name in differing]
    if not said:
        return None
    return f"Averaged over the {len(names)} tasks although they do not differ in the task alone: {'; '.join(said)}."


def values_of(arms: Sequence[Arm], name: str, task: bool) -> str:
    """Which arms have which value of an entry of the fingerprint, by their tasks or by their labels."""
    by_value: dict[str, set[str]] = defaultdict(set)
    for arm in arms:
        by_value[dict(arm.fingerprint).get(name, NOTHING)].add(arm.task if task else arm.label)
    return "; ".join(f"{value}: {', '.join(sorted(found))}" for value, found in sorted(by_value.items()))


def unlike_on_one_task(tasks: Tasks) -> list[str]:
    """Sentences about tasks whose arms were not all run under one protocol."""
    said = []
    for task, arms in tasks.items():
        found = [runs[0].arm for runs in arms.values()]
        names = (*SHARED, *(name.replace("_", " ") for name in PROTOCOL), *PACKAGES)
        for name in unlike(arm.fingerprint for arm in found):
            if name in names:
                said.append(f"On {task} the arms differ in {name}. {values_of(found, name, task=False)}.")
    return said
