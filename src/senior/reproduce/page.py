"""The paper's numbers and sentences beside ours, as the first sections of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from senior.report.page import Section, Table
from senior.report.statistics import Interval
from senior.report.tables import Cell
from senior.reproduce.studies import AVERAGES, CLAIMS, MAIN, TASKS, Quantity, Scale, Study
from senior.reproduce.studies import Table as Which
from senior.reproduce.verdicts import Judged, Runs, Verdict, When, judge_claim, judge_number

RULE = (
    "Rule, fixed before the runs: a number is reproduced if the 90 % interval of our mean lies within 10 points of the "
    "paper's, not reproduced if it lies wholly outside of that, undecided otherwise; in brackets then how many seeds "
    "would decide if mean and spread stayed as they are."
)
CLAIM_RULE = (
    "Each sentence is a set of comparisons, each the 90 % interval of a difference: confirmed if all lie above their "
    "margins, refuted if one lies wholly below, undecided otherwise. They are not corrected for their number."
)
SCALES: dict[Scale, str] = {
    "paper": "The paper's numbers of steps, labels, units and seeds.",
    "quick": "The preset quick: smaller networks, 100,000 steps, 250 labels on every task. It is not the paper's "
    "protocol, so its numbers neither reproduce nor refute the paper's; they stand beside them at half of the steps "
    "and at the end.",
    "smoke": "Toy sizes, which show that everything works. The numbers mean nothing.",
}
WHEN: dict[When, str] = {"half": "500K", "end": "1000K"}


def sections(tables: Sequence[Which], studies: dict[Which, Study], scale: Scale, runs: Runs) -> list[Section]:
    """What the report of these studies begins with. ``runs``: those that are finished, by arm and task."""
    found = []
    if "main" in tables:
        found.append(_numbers(studies["main"], scale, runs))
    claims = [judge_claim(claim, runs) for claim in CLAIMS if claim.table in tables]
    found.append(_claims(claims, scale))
    return found


def _numbers(study: Study, scale: Scale, runs: Runs) -> Section:
    verdicts = {
        (arm, task, when): judge_number(MAIN[arm][TASKS.index(task)][place] / 100, runs, arm, (task,), when)
        for arm in MAIN
        for task in study.tasks
        for place, when in enumerate(WHEN)
    }
    if study.tasks == TASKS:
        verdicts |= {
            (arm, "average", when): judge_number(AVERAGES[arm][place] / 100, runs, arm, TASKS, when)
            for arm in MAIN
            for place, when in enumerate(WHEN)
        }
    columns = [*study.tasks, *(["average"] if study.tasks == TASKS else [])]
    tables = [
        Table(
            f"Success at {steps} steps, in percent: the paper's | ours [its 90 % interval].",
            ["method", *columns],
            [[arm, *(_cell(verdicts[arm, column, when]) for column in columns)] for arm in MAIN],
            name=f"beside-the-paper-{when}",
        )
        for when, steps in (WHEN if scale == "paper" else {"half": "half of the", "end": "all"}).items()
    ]
    rows = [_row(*key, verdict) for key, verdict in verdicts.items()]
    head = ["method", "task", "when", "paper", "ours", "low", "high", "seeds", "verdict", "seeds that would decide"]
    tables.append(Table("The same, a row per number.", head, rows, name="beside-the-paper", folded=True))
    counts = Counter(verdict.verdict for verdict in verdicts.values())
    told = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    return Section(
        "Beside the paper's main table", (SCALES[scale], RULE, f"Of {len(verdicts)} numbers: {told}."), tuple(tables)
    )


def _cell(verdict: Verdict) -> str:
    if verdict.ours is None:
        return f"{100 * verdict.paper:.0f} | -"
    needed = f" ({verdict.needed or 'over 1,000'})" if verdict.verdict == "undecided" and verdict.seeds > 1 else ""
    return f"{100 * verdict.paper:.0f} | {_interval(verdict.ours)} {verdict.verdict}{needed}"


def _interval(interval: Interval) -> str:
    return "{:.0f} [{:.0f}, {:.0f}]".format(*(100 * bound for bound in interval))


def _row(arm: str, task: str, when: str, verdict: Verdict) -> list[Cell]:
    ours = verdict.ours or (None, None, None)
    return [arm, task, when, verdict.paper, *ours, verdict.seeds, verdict.verdict, verdict.needed]


def _claims(claims: Sequence[Judged], scale: Scale) -> Section:
    rows = [
        [
            judged.claim.sentence,
            judged.claim.where,
            judged.verdict,
            judged.holding,
            judged.failing,
            judged.open,
            judged.missing,
        ]
        for judged in claims
    ]
    counts = Counter(judged.verdict for judged in claims)
    told = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    return Section(
        "Beside the paper's sentences",
        (SCALES[scale], CLAIM_RULE, f"Of {len(claims)} sentences: {told}."),
        (
            Table("", ["sentence", "where", "verdict", "hold", "fail", "open", "missing"], rows, name="claims"),
            Table(
                "Every comparison: how much higher the first is, with its interval, and by how much it should be.",
                ["table", "higher", "lower", "difference", "low", "high", "margin"],
                [row for judged in claims for row in _comparisons(judged)],
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


def summary(tables: Sequence[Which], studies: dict[Which, Study], scale: Scale, runs: Runs) -> str:
    """The verdicts in lines for a terminal."""
    lines = [SCALES[scale]]
    for section in sections(tables, studies, scale, runs):
        lines += [f"{section.title}. {section.text[-1]}"]
    for judged in (judge_claim(claim, runs) for claim in CLAIMS if claim.table in tables):
        lines.append(f"  {judged.verdict:10} {judged.claim.sentence}")
    return "\n".join(lines)
