"""The parts of a report that tell arm by arm: what is reached, how fast, from how many labels, and at what cost.

Imports no JAX.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from senior.report import across
from senior.report.bands import thousands
from senior.report.cells import (
    Tasks,
    bracketed,
    counted,
    estimate_and_interval,
    finished,
    interval_of_mean,
    listed,
    mean_of,
    plus_minus,
    scores_at,
    span,
    tells_success,
    with_interval,
)
from senior.report.looks import Look, in_order
from senior.report.page import Drawing, Section, Table
from senior.report.records import Run
from senior.report.statistics import (
    by_labels,
    correlation,
    interquartile_means,
    mean_over,
    means,
    rank_correlation,
)
from senior.report.tables import Cell, shown

PAPER = (500_000, 1_000_000)
"""The steps at which the paper's table tells success."""
FOUND = "successful episodes while asking"
CORRELATED = 10
"""Runs of a task, at least, over which a correlation is told."""
LONG = 24
"""Lines of a table above which it is shown when it is asked for."""


def by_task(runs: Sequence[Run]) -> dict[str, dict[str, list[Run]]]:
    """Runs by task and by label."""
    found: dict[str, dict[str, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        found[run.arm.task][run.arm.label].append(run)
    return {task: {label: found[task][label] for label in in_order(found[task])} for task in sorted(found)}


def summary(tasks: Tasks, shared: Sequence[str] = (), until: int | None = None) -> Section:
    """Success at two steps, intervals and areas, a line per arm; with several tasks, the paper's table too.

    shared: options of all arms, which their labels do not tell. until: the step that all runs are cut at.
    """
    by_marks: dict[tuple[int, int], dict[str, dict[str, Sequence[Run]]]] = defaultdict(lambda: defaultdict(dict))
    for task, arms in tasks.items():
        for label, runs in arms.items():
            by_marks[_marks(runs)][task][label] = runs
    tables: list[Table] = []
    for marks, own in sorted(by_marks.items(), reverse=True):
        told = {task: arms for task, arms in own.items() if tells_success(arms)}
        if len(told) > 1:
            tables.append(_as_in_the_paper(marks, told))
        tables.append(_summary(marks, own))
    tables.append(every_run(tasks))
    runs = [run for arms in tasks.values() for own in arms.values() for run in own]
    under_way = [run for run in runs if not run.finished]
    text = [
        "Each line is an arm: runs that differ in nothing but their seed. Numbers are means ± sample standard "
        "deviations over seeds. The 90 % interval of the mean is Student's, and never narrower than the episodes that "
        "were judged allow; those of interquartile means and of areas are by the bootstrap. Areas are the mean over "
        "all steps, or over all asked pairs."
    ]
    if shared:
        text.append(f"All arms that ask for answers have, beside what their names tell: {' '.join(shared)}.")
    if until is not None:
        text.append(
            f"All runs are looked at up to step {until:,}, as if they had ended there, whatever they were to take."
        )
    short = sorted({run.steps for run in runs if run.steps < PAPER[1]})
    if short:
        text.append(
            "The SENIOR paper tells success at 500K and 1M steps. Shorter runs are told at half of their steps and at "
            f"their end: they have {listed([f'{steps:,}' for steps in short])} steps."
        )
    silent = [task for task, arms in tasks.items() if not tells_success(arms)]
    if silent:
        text.append(f"No success is told by {listed(silent)}; numbers there are mean true returns of an episode.")
    if under_way:
        text.append(
            "Under way, in the curves and not in the tables of success: "
            + listed([f"seed {run.seed} of {run.arm} at step {run.step:,} of {run.steps:,}" for run in under_way])
            + "."
        )
    return Section("Summary", tuple(text), tuple(tables))


def _marks(runs: Sequence[Run]) -> tuple[int, int]:
    steps = max(run.steps for run in runs)
    return PAPER if steps >= PAPER[1] else (steps // 2, steps)


def _summary(marks: tuple[int, int], tasks: Tasks) -> Table:
    head = ("task", "arm", "runs", *(f"at {thousands(step)}" for step in marks), "90 % interval of the mean")
    head += ("interquartile mean", "95 % interval", "area by steps [95 %]", "area by labels [95 %]", "labels")
    rows: list[list[Cell]] = []
    for task, arms in tasks.items():
        ended = {label: done for label, runs in arms.items() if (done := finished(runs))}
        last = {label: scores_at(runs, marks[1]) for label, runs in ended.items()}
        middle = interquartile_means({label: [scores] for label, scores in last.items() if len(scores)})
        by_steps, by_asked = (
            means({label: [np.array([area(run) for run in runs])] for label, runs in ended.items()})
            for area in (_area_by_steps, _area_by_labels)
        )
        for label, runs in arms.items():
            done = ended.get(label, [])
            cells: list[Cell] = [task, label, counted(runs), *(plus_minus(scores_at(done, step)) for step in marks)]
            if not done:
                rows.append([*cells, *[None] * 6])
                continue
            cells.append(bracketed(interval_of_mean(done, marks[1])))
            cells += estimate_and_interval(middle[label]) if label in middle else (None, None)
            cells += [with_interval(areas[label]) for areas in (by_steps, by_asked)]
            cells.append(span([float(run.evaluation.labels[-1]) for run in done]))
            rows.append(cells)
    caption = f"At {thousands(marks[0])} and {thousands(marks[1])} steps, by task and arm."
    return Table(caption, head, rows, f"summary-{thousands(marks[1])}", len(rows) > LONG)


def _area_by_steps(run: Run) -> float:
    return mean_over(run.evaluation.step, run.score)


def _area_by_labels(run: Run) -> float:
    """NaN where nobody is asked."""
    return mean_over(*by_labels(run.evaluation.queried, run.score)) if run.asks else math.nan


def _as_in_the_paper(marks: tuple[int, int], tasks: Tasks) -> Table:
    head = ["arm", *(f"{task} at {thousands(step)}" for task in tasks for step in marks)]
    head += [f"average at {thousands(step)}" for step in marks]
    rows: list[list[Cell]] = []
    for label in in_order(label for arms in tasks.values() for label in arms):
        found = {
            step: [mean_of(scores_at(finished(arms.get(label, ())), step)) for arms in tasks.values()] for step in marks
        }
        values = [found[step][place] for place in range(len(tasks)) for step in marks]
        values += [mean_of(found[step]) for step in marks]  # NaN where a task is missing
        rows.append([label, *(None if math.isnan(value) else f"{100 * value:.0f}%" for value in values)])
    return Table("Mean success rates as the paper's table has them.", head, rows, f"rates-{thousands(marks[1])}")


def curves(tasks: Tasks, looks: Mapping[str, Look]) -> Section:
    """Learning curves per task, in three ways."""
    figures: list[Drawing] = []
    for task, arms in tasks.items():
        figures.append(across.mean_curves(task, arms, looks))
        figures.append(across.interquartile_curves(task, arms, looks))
        figures.append(across.every_run(task, arms, looks))
    text = "Every point is an evaluation: fresh episodes with the mean action, in an environment of their own."
    return Section("Learning curves", (text,), (), tuple(figures))


def labels(tasks: Tasks, looks: Mapping[str, Look]) -> Section | None:
    """Success against asked pairs; None if nobody is asked."""
    figures = [drawing for task, arms in tasks.items() if (drawing := across.label_curves(task, arms, looks))]
    if not figures:
        return None
    figures += [drawing for task, arms in tasks.items() if (drawing := across.budget_curves(task, arms))]
    text = "How much is learned from how many answers. Methods that learn from the true reward ask nobody."
    return Section("Success against labels", (text,), (), tuple(figures))


def reward_model(tasks: Tasks, looks: Mapping[str, Look]) -> Section | None:
    """How well rewards are learned; None where no run tells."""
    figures = [drawing for task, arms in tasks.items() if (drawing := across.accuracy_curves(task, arms, looks))]
    rows: list[list[Cell]] = []
    for task, arms in tasks.items():
        for label, runs in arms.items():
            told = [run for run in runs if run.asks and run.episodes is not None]
            accuracy = [curve[1][-1] for run in told if (curve := across.prospective(run))]
            linear, ranks = (
                [value for run in told if math.isfinite(value := _agreement(run, measure))]
                for measure in (correlation, rank_correlation)
            )
            found = [count for run in told if (count := _found(run)) is not None]
            if accuracy or linear or found:
                cells = [plus_minus(values) for values in (accuracy, linear, ranks, found)]
                rows.append([task, label, len(told), *cells])
    if not rows:
        return None
    head = ("task", "arm", "runs", "right of the last pairs", "correlation", "rank correlation", FOUND)
    caption = (
        f"Prospective accuracy over the latest sessions that have {across.PAIRS} decided pairs together, or all there "
        "are, and how learned and true return of an episode go together."
    )
    text = (
        "Prospective accuracy is of pairs that the reward model has not seen: it judges a session's pairs before it is "
        "fitted to them. Correlations are over the episodes of the main phase, each with the return that the model of "
        "its time gave it, and are means ± standard deviations over seeds. A chosen pair may be harder than a random "
        "one: accuracies of methods that choose differently do not rank their reward models. Nobody can be "
        "asked about what was never reached: the last column counts the training episodes with success before the last "
        "session."
    )
    said = [sentence for task, arms in tasks.items() if (sentence := _discovery(task, arms))]
    return Section(
        "Reward model", (text, *said), (Table(caption, head, rows, "reward-model", len(rows) > LONG),), tuple(figures)
    )


def _found(run: Run) -> int | None:
    """Training episodes with success before the last session; None where it is not told, or nobody is asked."""
    told = run.episodes
    if told is None or not run.asks:
        return None
    known = np.isfinite(told.queried) & np.isfinite(told.episode_success)
    if not known.any():
        return None
    asking = told.queried < np.nanmax(told.queried)
    return int((known & asking & (told.episode_success > 0)).sum())


def _discovery(task: str, arms: Mapping[str, Sequence[Run]]) -> str | None:
    """How that number goes with what is reached, over all runs of a task; None of few runs, or of equal ones."""
    told = [
        (found, _area_by_steps(run))
        for run in finished([run for runs in arms.values() for run in runs])
        if (found := _found(run)) is not None
    ]
    together = rank_correlation(*np.array(told).T) if len(told) >= CORRELATED else math.nan
    if math.isnan(together):
        return None
    return (
        f"{task}: over {len(told)} runs of all arms, the number of those episodes and the area by steps have a rank "
        f"correlation of {together:.2f}."
    )


def _agreement(run: Run, measure: Callable[[np.ndarray, np.ndarray], float]) -> float:
    """Of learned and true returns, over the episodes of the main phase."""
    assert run.episodes is not None
    told = run.episodes
    main = (told.step > run.main_phase) & np.isfinite(told.learned_return) & np.isfinite(told.episode_return)
    return measure(told.learned_return[main], told.episode_return[main])


def cost(tasks: Tasks) -> Section:
    """Wall time, speed and labels."""
    rows: list[list[Cell]] = []
    total, untold = 0.0, 0
    for task, arms in tasks.items():
        for label, runs in arms.items():
            seconds = [run.seconds for run in runs if run.seconds]
            total, untold = total + sum(seconds), untold + len(runs) - len(seconds)
            speeds = [run.step / run.seconds for run in runs if run.seconds]
            asked = span([float(run.evaluation.queried[-1]) for run in runs if run.asks])
            answered = span([float(run.evaluation.labels[-1]) for run in runs if run.asks])
            devices = ", ".join(sorted({str(run.protocol.get("device", "not told")) for run in runs}))
            hours = [second / 3600 for second in seconds]
            cells = [span(hours), sum(hours) if hours else None, span(speeds), asked, answered, devices]
            rows.append([task, label, len(runs), *cells])
    head = ("task", "arm", "runs", "hours a run", "hours in all", "steps/s", "pairs asked", "labels", "device")
    text = []
    if total:
        text.append(
            f"{shown(total / 3600)} hours of wall time in all. Hours are counted run by run, evaluations included; "
            "runs that shared a program or a machine each count the whole time, so machines may have been busy less."
        )
    if untold:
        text.append(f"{untold} runs do not tell their time.")
    caption = "Wall time and labels by arm, from the least to the most over its runs."
    table = Table(caption, head, rows, "cost", len(rows) > LONG)
    return Section("Time and labels", tuple(text), (table,))


def every_run(tasks: Tasks) -> Table:
    """A line per run, for programs more than for people."""
    rows: list[list[Cell]] = []
    for task, arms in tasks.items():
        for label, runs in arms.items():
            for run in runs:
                told = run.evaluation
                cells: list[Cell] = [task, label, run.seed, *(run.score_at(step) for step in _marks([run]))]
                cells += [_area_by_steps(run), _area_by_labels(run), _found(run)]
                cells += [int(told.labels[-1]), run.seconds, run.step, run.steps, str(run.path)]
                rows.append(cells)
    head = ("task", "arm", "seed", "at 500K or half", "at 1M or the end", "area by steps", "area by labels", FOUND)
    return Table("Every run.", (*head, "labels", "seconds", "step", "of", "path"), rows, "every-run", folded=True)
