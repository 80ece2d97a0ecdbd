"""The parts of a report that compare arms: what they reach, how fast, from how many labels, and at what cost.

Numbers in tables are of finished runs. Imports no JAX.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from senior.report import across
from senior.report.looks import Look, in_order
from senior.report.page import Drawing, Section, Table
from senior.report.results import PACKAGES, PROTOCOL, Arm, Run, unlike
from senior.report.statistics import (
    REPETITIONS,
    Interval,
    Intervals,
    by_labels,
    correlation,
    improvement,
    interquartile_means,
    mean_and_deviation,
    mean_interval,
    mean_over,
    means,
    profiles,
    rank_correlation,
)
from senior.report.tables import NOTHING, Cell, shown

Tasks = Mapping[str, Mapping[str, Sequence[Run]]]
"""Runs by task and by label, both in order."""
PAPER = (500_000, 1_000_000)
"""The steps at which the paper's table tells success."""
SHARED = ("--preset", "--steps", "--evaluation.every", "--evaluation.episodes")
"""Options that make no label, and that arms which are compared should share."""
THRESHOLDS = np.linspace(0, 1, 51)
LONG = 24
"""Lines of a table above which it is shown when it is asked for."""


def by_task(runs: Sequence[Run]) -> dict[str, dict[str, list[Run]]]:
    """Runs by task and by label."""
    found: dict[str, dict[str, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        found[run.arm.task][run.arm.label].append(run)
    return {task: {label: found[task][label] for label in in_order(found[task])} for task in sorted(found)}


# What is reached.


def summary(tasks: Tasks, shared: Sequence[str] = ()) -> Section:
    """Success at two steps, intervals and areas, a line per arm; with several tasks, the paper's table too.

    shared: options of all arms, which their labels do not tell.
    """
    by_marks: dict[tuple[int, int], dict[str, dict[str, Sequence[Run]]]] = defaultdict(lambda: defaultdict(dict))
    for task, arms in tasks.items():
        for label, runs in arms.items():
            by_marks[_marks(runs)][task][label] = runs
    tables: list[Table] = []
    for marks, own in sorted(by_marks.items(), reverse=True):
        told = {task: arms for task, arms in own.items() if _tells_success(arms)}
        if len(told) > 1:
            tables.append(_as_in_the_paper(marks, told))
        tables.append(_summary(marks, own))
    tables.append(every_run(tasks))
    runs = [run for arms in tasks.values() for own in arms.values() for run in own]
    under_way = [run for run in runs if not run.finished]
    text = [
        "Each line is an arm: runs that differ in nothing but their seed. Numbers are means ± sample standard "
        "deviations over seeds. The 90 % interval of the mean is Student's, and never narrower than the episodes that "
        "were judged allow; that of the interquartile mean is by the bootstrap. Areas are the mean over all steps, or "
        "over all asked pairs."
    ]
    if shared:
        text.append(f"All arms that ask people have, beside what their names tell: {' '.join(shared)}.")
    short = sorted({run.steps for run in runs if run.steps < PAPER[1]})
    if short:
        text.append(
            "The paper tells success at 500K and 1M steps. Runs that are shorter are told at half of their steps and "
            f"at their end: they have {_listed([f'{steps:,}' for steps in short])} steps."
        )
    silent = [task for task, arms in tasks.items() if not _tells_success(arms)]
    if silent:
        text.append(f"No success is told by {_listed(silent)}; numbers there are mean true returns of an episode.")
    if under_way:
        text.append(
            "Under way, in the curves and not in the tables: "
            + _listed([f"seed {run.seed} of {run.arm} at step {run.step:,} of {run.steps:,}" for run in under_way])
            + "."
        )
    return Section("Summary", tuple(text), tuple(tables))


def _marks(runs: Sequence[Run]) -> tuple[int, int]:
    steps = max(run.steps for run in runs)
    return PAPER if steps >= PAPER[1] else (steps // 2, steps)


def _summary(marks: tuple[int, int], tasks: Tasks) -> Table:
    head = ("task", "arm", "runs", *(f"at {across.thousands(step)}" for step in marks), "90 % interval of the mean")
    head += ("interquartile mean", "95 % interval", "area by steps", "area by labels", "labels")
    rows: list[list[Cell]] = []
    for task, arms in tasks.items():
        ended = {label: done for label, runs in arms.items() if (done := _finished(runs))}
        middle = interquartile_means({label: [_at(runs, marks[1])] for label, runs in ended.items()})
        for label, runs in arms.items():
            done = ended.get(label, [])
            cells: list[Cell] = [task, label, _count(runs), *(_pm(_at(done, step)) for step in marks)]
            if not done:
                rows.append([*cells, *[None] * 6])
                continue
            cells.append(_bracketed(_mean_interval(done, marks[1])))
            mean, low, high = (float(bound[0]) for bound in middle[label])
            cells += [_number(mean), _bracketed(Interval(mean, low, high))]
            cells.append(_pm([mean_over(run.evaluation.step, run.score) for run in done]))
            cells.append(_pm([mean_over(*by_labels(run.evaluation.queried, run.score)) for run in done if run.asks]))
            cells.append(_range([float(run.evaluation.labels[-1]) for run in done]))
            rows.append(cells)
    caption = f"At {across.thousands(marks[0])} and {across.thousands(marks[1])} steps, by task and arm."
    return Table(caption, head, rows, f"summary-{across.thousands(marks[1])}", len(rows) > LONG)


def _as_in_the_paper(marks: tuple[int, int], tasks: Tasks) -> Table:
    head = ["arm", *(f"{task} at {across.thousands(step)}" for task in tasks for step in marks)]
    head += [f"average at {across.thousands(step)}" for step in marks]
    rows: list[list[Cell]] = []
    for label in in_order(label for arms in tasks.values() for label in arms):
        found = {step: [_mean(_at(_finished(arms.get(label, ())), step)) for arms in tasks.values()] for step in marks}
        values = [found[step][place] for place in range(len(tasks)) for step in marks]
        values += [_mean(found[step]) for step in marks]  # NaN where a task is missing
        rows.append([label, *(None if math.isnan(value) else f"{100 * value:.0f}%" for value in values)])
    return Table("Mean success rates as the paper's table has them.", head, rows, f"rates-{across.thousands(marks[1])}")


# Curves.


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


# Methods against each other.


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
        if _tells_success(tasks[names[0]]) and (several or len(group) > 1):
            middle, mean = interquartile_means(last), means(last)
            panels = {"interquartile mean": _single(middle), "mean": _single(mean)}
            caption = f"{where}: success at the end, with 95 % bootstrap intervals."
            figures.append(across.aggregates(f"{short}-aggregate", caption, panels, looks))
            rows = [
                [label, sum(len(runs) for runs in group[label]), *_two(middle[label]), *_two(mean[label])]
                for label in group
            ]
            head = ("arm", "runs", "interquartile mean", "95 % interval", "mean", "95 % interval of the mean")
            tables.append(Table(caption, head, rows, f"{short}-aggregate"))
        if several:
            found = profiles(last, THRESHOLDS)
            figures.append(across.profile_curves(f"{short}-profile", THRESHOLDS, found, looks))
        if len(group) > 1:
            figures.append(across.improvements(f"{short}-improvement", where, improvement(last), list(group)))
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
        task: {label: done for label, runs in arms.items() if (done := _finished(runs))} for task, arms in tasks.items()
    }
    sets: set[tuple[str, ...]] = set()
    for label in {label for arms in ended.values() for label in arms}:
        having = [task for task in ended if label in ended[task]]
        sets.add(tuple(task for task in having if _tells_success(tasks[task])))
        sets |= {(task,) for task in having if not _tells_success(tasks[task])}
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


# The reward model.


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
            if accuracy or linear:
                rows.append([task, label, len(told), _pm(accuracy), _pm(linear), _pm(ranks)])
    if not rows:
        return None
    head = ("task", "arm", "runs", f"right of the last {across.PAIRS} pairs", "correlation", "rank correlation")
    caption = "Prospective accuracy at the end of asking, and how learned and true return of an episode go together."
    text = (
        "Prospective accuracy is of pairs that the reward model has not seen: it judges a session's pairs before it is "
        "fitted to them. Correlations are over the episodes of the main phase, each with the return that the model of "
        "its time gave it, and are means ± standard deviations over seeds. A chosen pair may be harder than a random "
        "one: accuracies of methods that choose differently do not rank their reward models."
    )
    return Section(
        "Reward model", (text,), (Table(caption, head, rows, "reward-model", len(rows) > LONG),), tuple(figures)
    )


def _agreement(run: Run, measure: Callable[[np.ndarray, np.ndarray], float]) -> float:
    """Of learned and true returns, over the episodes of the main phase."""
    assert run.episodes is not None
    told = run.episodes
    main = (told.step > run.main_phase) & np.isfinite(told.learned_return) & np.isfinite(told.episode_return)
    return measure(told.learned_return[main], told.episode_return[main])


# The cost.


def cost(tasks: Tasks) -> Section:
    """Wall time, speed and labels."""
    rows: list[list[Cell]] = []
    total, untold = 0.0, 0
    for task, arms in tasks.items():
        for label, runs in arms.items():
            seconds = [run.seconds for run in runs if run.seconds]
            total, untold = total + sum(seconds), untold + len(runs) - len(seconds)
            speeds = [run.step / run.seconds for run in runs if run.seconds]
            asked = _range([float(run.evaluation.queried[-1]) for run in runs if run.asks])
            answered = _range([float(run.evaluation.labels[-1]) for run in runs if run.asks])
            devices = ", ".join(sorted({str(run.protocol.get("device", "not told")) for run in runs}))
            hours = [second / 3600 for second in seconds]
            cells = [_range(hours), sum(hours) if hours else None, _range(speeds), asked, answered, devices]
            rows.append([task, label, len(runs), *cells])
    head = ("task", "arm", "runs", "hours a run", "hours in all", "steps/s", "pairs asked", "labels", "device")
    text = []
    if total:
        text.append(
            f"{shown(total / 3600)} hours of wall time in all. Hours are counted run by run, evaluations included; "
            "runs that shared a program or a machine each count the whole time, so the machine was busy for less."
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
                cells.append(mean_over(told.step, run.score))
                cells.append(mean_over(*by_labels(told.queried, run.score)) if run.asks else None)
                cells += [int(told.labels[-1]), run.seconds, run.step, run.steps, str(run.path)]
                rows.append(cells)
    head = ("task", "arm", "seed", "at 500K or half", "at 1000K or the end", "area by steps", "area by labels")
    return Table("Every run.", (*head, "labels", "seconds", "step", "of", "path"), rows, "every-run", folded=True)


# Cells.


def _finished(runs: Sequence[Run]) -> list[Run]:
    return [run for run in runs if run.finished]


def _tells_success(arms: Mapping[str, Sequence[Run]]) -> bool:
    return across.measure(arms) == "success rate"


def _at(runs: Sequence[Run], step: int) -> np.ndarray:
    """Scores at a step ``[runs]``; without runs that were not evaluated until then."""
    values = np.array([run.score_at(step) for run in runs])
    return values[np.isfinite(values)]


def _mean(values: Sequence[float] | np.ndarray) -> float:
    return mean_and_deviation(values)[0]


def _mean_interval(runs: Sequence[Run], step: int) -> Interval | None:
    if runs[0].evaluation.success is None:
        return None
    episodes = min(int(run.evaluation.episodes[-1]) for run in runs)
    return mean_interval(list(_at(runs, step)), episodes)


def _single(found: Mapping[str, Intervals]) -> dict[str, Interval]:
    return {label: Interval(*(float(bound[0]) for bound in own)) for label, own in found.items()}


def _two(found: Intervals) -> tuple[str, str | None]:
    """An estimate, and its interval."""
    interval = Interval(*(float(bound[0]) for bound in found))
    return _number(interval.mean), _bracketed(interval)


def _count(runs: Sequence[Run]) -> Cell:
    done = len(_finished(runs))
    return done if done == len(runs) else f"{done} of {len(runs)} finished"


def _pm(values: Sequence[float] | np.ndarray) -> str | None:
    """Mean ± deviation; None of nothing."""
    mean, deviation = mean_and_deviation(values)
    if math.isnan(mean):
        return None
    return _number(mean) if math.isnan(deviation) else f"{_number(mean)} ± {_number(deviation)}"


def _number(value: float) -> str:
    """Rates to hundredths, larger numbers to three digits."""
    return f"{value:.2f}" if abs(value) < 10 else shown(float(value))


def _bracketed(interval: Interval | None) -> str | None:
    if interval is None or math.isnan(interval.low):
        return None
    return f"[{_number(interval.low)}, {_number(interval.high)}]"


def _range(values: Sequence[float]) -> str | None:
    """From the least to the most, or the one that all are."""
    if not values:
        return None
    ends = [_whole(value) for value in (min(values), max(values))]
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


def _whole(value: float) -> str:
    return f"{value:,.0f}" if float(value).is_integer() else shown(value)


def _listed(words: Sequence[str]) -> str:
    """With commas and an "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
