"""The paper's numbers and sentences beside ours, as the first sections of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from senior.report.page import Section, Table
from senior.report.statistics import Interval
from senior.report.tables import Cell
from senior.reproduce.studies import AVERAGES, CLAIMS, MAIN, TASKS, Quantity, Scale, Study, When
from senior.reproduce.studies import Table as Which
from senior.reproduce.verdicts import Judged, Runs, Verdict, judge_claim, judge_number

WHAT = (
    "The paper: SENIOR, efficient query selection and preference-guided exploration in preference-based reinforcement "
    "learning (Ni et al. 2025, arXiv 2506.14648). Its numbers are of its main table, its sentences of Section V."
)
RULE = (
    "Rule, fixed before the runs: a number is reproduced if the 90 % interval of our mean lies within 10 points of the "
    "paper's, not reproduced if it lies wholly outside of that, undecided otherwise; in brackets then how many seeds "
    "would decide if mean and spread stayed as they are."
)
CLAIM_RULE = (
    "Each sentence is a set of comparisons, each the 90 % interval of a difference: confirmed if all lie above their "
    "margins, refuted if one lies wholly below, missing if there are runs for none, undecided otherwise. They are not "
    "corrected for their number."
)
SENTENCES = (
    "The paper's sentences, in our words, and how many of their comparisons hold, fail, are open, and are missing for "
    "want of runs."
)
SCALES: dict[Scale, str] = {
    "paper": "The paper's numbers of steps, labels and units. It ran five seeds, and reports the best of three rates "
    "at which PGE's bonus decays; here it is the first, 0.01.",
    "quick": "The preset quick: smaller networks, 100,000 steps, 250 labels unless told. It is not the paper's "
    "protocol, so its numbers neither reproduce nor refute the paper's: they stand beside them, at half of the steps "
    "and at the end, and what is said of a sentence holds at this scale.",
    "smoke": "Toy sizes, which show that everything works. The numbers mean nothing.",
}
WHEN: dict[When, str] = {"half": "500K", "end": "1000K"}


class Judgement(NamedTuple):
    """The paper beside our runs."""

    numbers: dict[tuple[str, str, When], Verdict]
    """By arm, task or "average", and when."""
    claims: list[Judged]


def judge(tables: Sequence[Which], studies: dict[Which, Study], runs: Runs) -> Judgement:
    """Judge what the tables say. ``runs``: those that are finished, by arm and task."""
    numbers: dict[tuple[str, str, When], Verdict] = {}
    if "main" in tables:
        tasks = studies["main"].tasks
        for arm in MAIN:
            for place, when in enumerate(WHEN):
                for task in tasks:
                    paper = MAIN[arm][TASKS.index(task)][place] / 100
                    numbers[arm, task, when] = judge_number(paper, runs, arm, (task,), when)
                if tasks == TASKS:
                    numbers[arm, "average", when] = judge_number(AVERAGES[arm][place] / 100, runs, arm, TASKS, when)
    return Judgement(numbers, [judge_claim(claim, runs) for claim in CLAIMS if claim.table in tables])


def sections(judged: Judgement, scale: Scale, notes: Sequence[str]) -> list[Section]:
    """What the report begins with. ``notes``: sentences on tasks and runs that do not count."""
    first, *rest = [*([_numbers(judged, scale)] if judged.numbers else []), _claims(judged.claims)]
    return [replace(first, text=(WHAT, SCALES[scale], *first.text, *notes)), *rest]


def _numbers(judged: Judgement, scale: Scale) -> Section:
    columns = list(dict.fromkeys(task for _, task, _ in judged.numbers))
    decides = scale == "paper"
    tables = [
        Table(
            f"Success at {steps} steps, in percent: the paper's | ours [its 90 % interval].",
            ["method", *columns],
            [[arm, *(_cell(judged.numbers[arm, column, when], decides) for column in columns)] for arm in MAIN],
            name=f"beside-the-paper-{when}",
        )
        for when, steps in zip(WHEN, WHEN.values() if decides else ("half of the", "all"), strict=True)
    ]
    head = ["method", "task", "when", "paper", "ours", "low", "high", "seeds", "hours in all"]
    rows = [
        [*key, verdict.paper, *(verdict.ours or (None, None, None)), verdict.seeds, verdict.hours]
        + ([verdict.verdict, verdict.needed] if decides else [])
        for key, verdict in judged.numbers.items()
    ]
    head += ["verdict", "seeds that would decide"] if decides else []
    tables.append(Table("The same, a row per number.", head, rows, name="beside-the-paper", folded=True))
    text = (RULE, _counted(judged.numbers.values(), "numbers")) if decides else ()
    return Section("Beside the paper's main table", text, tuple(tables))


def _counted(verdicts: Iterable[Verdict | Judged], what: str) -> str:
    counts = Counter(verdict.verdict for verdict in verdicts)
    return f"Of {counts.total()} {what}: " + ", ".join(f"{count} {kind}" for kind, count in counts.most_common()) + "."


def _cell(verdict: Verdict, decides: bool) -> str:
    if verdict.ours is None:
        return f"{100 * verdict.paper:.0f} | -"
    needed = f" ({verdict.needed or 'over 1,000'})" if verdict.verdict == "undecided" and verdict.seeds > 1 else ""
    told = f" {verdict.verdict}{needed}" if decides else ""
    return f"{100 * verdict.paper:.0f} | {_interval(verdict.ours)}{told}"


def _interval(interval: Interval) -> str:
    return "{:.0f} [{:.0f}, {:.0f}]".format(*(100 * bound for bound in interval))


def _claims(claims: Sequence[Judged]) -> Section:
    rows = [
        [one.claim.sentence, one.claim.where, one.verdict, one.holding, one.failing, one.open, one.missing]
        for one in claims
    ]
    return Section(
        "Beside the paper's sentences",
        (CLAIM_RULE, _counted(claims, "sentences")),
        (
            Table(SENTENCES, ["sentence", "where", "verdict", "hold", "fail", "open", "missing"], rows, name="claims"),
            Table(
                "Every comparison: how much higher the first is, with its interval, and by how much it should be.",
                ["table", "higher", "lower", "difference", "low", "high", "margin"],
                [row for one in claims for row in _comparisons(one)],
                name="comparisons",
                folded=True,
            ),
        ),
    )


def _comparisons(judged: Judged) -> Iterable[list[Cell]]:
    for comparison, interval in judged.differences:
        lower = comparison.lower
        yield [
            judged.claim.table,
            _named(comparison.higher),
            _named(lower) if isinstance(lower, Quantity) else f"{lower:.0%}",
            *(interval or (None, None, None)),
            comparison.margin,
        ]


def _named(quantity: Quantity) -> str:
    where = "average" if quantity.tasks == TASKS else ", ".join(quantity.tasks)
    return f"{quantity.arm}, {where}, {quantity.when}"


def summary(judged: Judgement, scale: Scale) -> str:
    """Every number and sentence in a line, for a terminal."""
    lines = [SCALES[scale]]
    for (arm, task, when), verdict in judged.numbers.items():
        if verdict.ours is not None:
            cost = "" if verdict.hours is None else f", {verdict.hours:,.1f} h"
            cell = _cell(verdict, scale == "paper")
            lines.append(f"  {arm:10} {task:13} {when:5} {cell}; {verdict.seeds} seeds{cost}")
    lines += [f"  {one.verdict:10} {one.claim.sentence}" for one in judged.claims]
    if judged.numbers and scale == "paper":
        lines.append(_counted(judged.numbers.values(), "numbers"))
    return "\n".join([*lines, _counted(judged.claims, "sentences")])
