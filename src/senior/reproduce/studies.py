"""The studies of the SENIOR paper (Section V) as data: what is trained, what it reports, what it says.

Its main table gives numbers, ``MAIN``. Its figures give none, so there its sentences are what can be tested,
``CLAIMS``: in our words, with the place where the paper has them. Not among them: that PGE comes to explore around the
lock within 200,000 steps and RUNE does not (Fig. 7), which the report's maps show and no number decides; that other
methods do not always improve with more answers, which names neither methods nor budgets; and what Section V.E tells of
a physical robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Literal, NamedTuple

from senior.config import Config, Evaluation, Networks, Pretraining
from senior.sweep.grid import configured

Scale = Literal["paper", "quick", "smoke"]
Table = Literal["main", "feedback", "ablation", "quality"]
When = Literal["half", "end", "curve"]
"""After half of the steps, at the end, or over the whole curve."""

TASKS = ("door-lock", "window-close", "handle-press", "window-open", "door-open", "door-unlock")
BASELINES = ("pebble", "mrn", "rune", "m-rune", "qpa")
BUDGETS = (150, 250, 500, 1000)

MAIN: dict[str, tuple[tuple[int, int], ...]] = {
    # success in percent at 500,000 and 1,000,000 steps, task by task as in TASKS
    "pebble": ((60, 82), (60, 60), (36, 42), (20, 20), (58, 60), (56, 52)),
    "mrn": ((41, 60), (62, 66), (66, 62), (52, 44), (24, 38), (54, 52)),
    "rune": ((34, 54), (80, 80), (58, 58), (70, 60), (58, 60), (38, 48)),
    "m-rune": ((60, 76), (80, 80), (76, 76), (62, 78), (26, 42), (48, 66)),
    "qpa": ((76, 90), (20, 26), (56, 80), (40, 36), (48, 60), (30, 28)),
    "p-senior": ((86, 92), (88, 98), (90, 94), (68, 68), (60, 80), (64, 84)),
    "m-senior": ((92, 98), (100, 100), (98, 100), (88, 90), (72, 100), (76, 96)),
}
"""The paper's main table (Table I): five seeds, ten episodes each."""
AVERAGES: dict[str, tuple[int, int]] = {
    "pebble": (48, 53),
    "mrn": (50, 54),
    "rune": (56, 60),
    "m-rune": (59, 70),
    "qpa": (45, 53),
    "p-senior": (76, 86),
    "m-senior": (88, 97),
}
"""Its last column."""


class Arm(NamedTuple):
    """A method as a study trains it."""

    name: str
    """What it is called in tables and claims."""
    options: str
    """The method with its options, as ``senior sweep --arm`` takes it."""


def _plain(*methods: str) -> tuple[Arm, ...]:
    return tuple(Arm(name, name) for name in methods)


WITHOUT_PGE = Arm("m-senior-without-pge", "m-senior --explore none --mix uniform")
WITHOUT_MDS = Arm("m-senior-without-mds", "m-senior --select disagreement")


@dataclass(frozen=True)
class Study:
    """One of the paper's tables or figures."""

    tasks: tuple[str, ...]
    arms: tuple[Arm, ...]


STUDIES: dict[str, Study] = {
    "main": Study(TASKS, _plain("sac", *BASELINES, "p-senior", "m-senior")),  # Fig. 3 and Table I
    "feedback": Study(  # Fig. 4
        ("door-lock", "window-open"),
        tuple(
            Arm(f"{method}-{budget}", f"{method} --budget {budget}")
            for budget in BUDGETS
            for method in (*BASELINES, "p-senior", "m-senior")
        ),
    ),
    "ablation": Study(TASKS, (*_plain("mrn", "m-senior"), WITHOUT_PGE, WITHOUT_MDS)),  # Fig. 5
    "quality": Study(  # Fig. 6
        ("door-lock", "handle-press"),
        (
            WITHOUT_PGE,  # what that figure calls MDS
            Arm("mds-fn", f"{WITHOUT_PGE.options} --teacher mistake"),
            Arm("mds-ff", f"{WITHOUT_PGE.options} --teacher skip"),
            *_plain("qpa"),
            Arm("qpa-fn", "qpa --teacher mistake"),
            Arm("qpa-ff", "qpa --teacher skip"),
        ),
    ),
}


@dataclass(frozen=True)
class Quantity:
    """The success of an arm, averaged over tasks: at half of the steps, at the end, or over the whole curve."""

    arm: str
    tasks: tuple[str, ...]
    when: When = "end"


@dataclass(frozen=True)
class Comparison:
    """That one quantity is higher than another, or than a number, by more than a margin (negative: hardly lower)."""

    higher: Quantity
    lower: Quantity | float
    margin: float = 0.0


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper, and what would confirm or refute it: all of its comparisons."""

    table: Table
    sentence: str
    where: str
    comparisons: tuple[Comparison, ...]


def _above(arm: str, others: tuple[str, ...], tasks: tuple[str, ...], when: When = "end") -> tuple[Comparison, ...]:
    """On every task by itself."""
    return tuple(
        Comparison(Quantity(arm, (task,), when), Quantity(other, (task,), when)) for task in tasks for other in others
    )


BUDGET_TASKS = ("door-lock", "window-open")
AS_WELL = -0.1
"""A difference that still is "as well": ten points less."""
MUCH = 0.1
"""And one that is "much": ten points more."""

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "main",
        "On every task M-SENIOR ends with more success than the five other methods.",
        "V.C, Fig. 3",
        _above("m-senior", BASELINES, TASKS),
    ),
    Claim(
        "main",
        "On every task M-SENIOR converges faster: there is more success below its whole curve.",
        "V.C, Fig. 3",
        _above("m-senior", BASELINES, TASKS, "curve"),
    ),
    Claim(
        "main",
        "P-SENIOR ends above the five other methods in most cases; tested on average over the tasks.",
        "V.C",
        tuple(Comparison(Quantity("p-senior", TASKS), Quantity(other, TASKS)) for other in BASELINES),
    ),
    Claim(
        "main",
        "P-SENIOR ends below M-SENIOR on average.",
        "V.C",
        (Comparison(Quantity("m-senior", TASKS), Quantity("p-senior", TASKS)),),
    ),
    Claim(
        "main",
        "After half of the steps M-SENIOR is far above the five other methods on average.",
        "V.C; far: more than 10 points",
        tuple(Comparison(Quantity("m-senior", TASKS, "half"), Quantity(o, TASKS, "half"), MUCH) for o in BASELINES),
    ),
    Claim(
        "main",
        "On average M-SENIOR has more success after half of the steps than the five other methods at the end.",
        "V.C",
        tuple(Comparison(Quantity("m-senior", TASKS, "half"), Quantity(other, TASKS)) for other in BASELINES),
    ),
    Claim(
        "main",
        "On Door Open M-SENIOR ends 40 points above the five other methods.",
        "V.C; tested with 10 points less",
        tuple(
            Comparison(Quantity("m-senior", ("door-open",)), Quantity(other, ("door-open",)), 0.3)
            for other in BASELINES
        ),
    ),
    Claim(
        "main",
        "P-SENIOR ends 33 points above PEBBLE on average.",
        "V.C; tested with 10 points less",
        (Comparison(Quantity("p-senior", TASKS), Quantity("pebble", TASKS), 0.23),),
    ),
    Claim(
        "main",
        "On Window Open P-SENIOR ends below M-RUNE.",
        "V.C",
        (Comparison(Quantity("m-rune", ("window-open",)), Quantity("p-senior", ("window-open",))),),
    ),
    Claim(
        "feedback",
        "With every budget M-SENIOR has the highest success.",
        "V.C, Fig. 4",
        tuple(
            Comparison(Quantity(f"m-senior-{budget}", (task,)), Quantity(f"{other}-{budget}", (task,)))
            for task in BUDGET_TASKS
            for budget in BUDGETS
            for other in BASELINES
        ),
    ),
    Claim(
        "feedback",
        "It is at least four times as feedback-efficient: with 250 answers it does as well as others with 1,000, and "
        "much better than they with 500.",
        "V.C; as well: not more than 10 points lower",
        tuple(
            comparison
            for task in BUDGET_TASKS
            for other in BASELINES
            for comparison in (
                Comparison(Quantity("m-senior-250", (task,)), Quantity(f"{other}-1000", (task,)), AS_WELL),
                Comparison(Quantity("m-senior-250", (task,)), Quantity(f"{other}-500", (task,)), MUCH),
            )
        ),
    ),
    Claim(
        "feedback",
        "M-SENIOR reaches nearly 100 % on Door Lock with 250 answers.",
        "V.C; nearly: above 90 %",
        (Comparison(Quantity("m-senior-250", ("door-lock",)), 0.9),),
    ),
    Claim(
        "feedback",
        "M-SENIOR does not get worse with any larger budget, and is better with 1,000 answers than with 150.",
        "V.C (improves continuously); worse: more than 10 points lower",
        tuple(
            Comparison(Quantity("m-senior-1000", (task,)), Quantity("m-senior-150", (task,))) for task in BUDGET_TASKS
        )
        + tuple(
            Comparison(Quantity(f"m-senior-{more}", (task,)), Quantity(f"m-senior-{less}", (task,)), AS_WELL)
            for task in BUDGET_TASKS
            for less, more in pairwise(BUDGETS)
        ),
    ),
    Claim(
        "ablation",
        "Without PGE, and without MDS, it still does better than MRN.",
        "V.D, Fig. 5",
        _above(WITHOUT_PGE.name, ("mrn",), TASKS) + _above(WITHOUT_MDS.name, ("mrn",), TASKS),
    ),
    Claim(
        "ablation",
        "Both together learn the fastest.",
        "V.D, Fig. 5",
        _above("m-senior", (WITHOUT_PGE.name, WITHOUT_MDS.name), TASKS, "curve"),
    ),
    Claim(
        "ablation",
        "On Door Lock it is MDS that matters more, on Handle Press PGE.",
        "V.D",
        _above(WITHOUT_PGE.name, (WITHOUT_MDS.name,), ("door-lock",), "curve")
        + _above(WITHOUT_MDS.name, (WITHOUT_PGE.name,), ("handle-press",), "curve"),
    ),
    Claim(
        "quality",
        "A tenth of wrong answers makes both MDS and QPA much worse.",
        "V.D, Fig. 6; much: more than 10 points",
        tuple(
            Comparison(Quantity(arm, (task,)), Quantity(noisy, (task,)), MUCH)
            for arm, noisy in ((WITHOUT_PGE.name, "mds-fn"), ("qpa", "qpa-fn"))
            for task in ("door-lock", "handle-press")
        ),
    ),
    Claim(
        "quality",
        "Leaving queries of low return out makes MDS worse on both tasks.",
        "V.D, Fig. 6 (the text says MDS-FN twice; the second must be MDS-FF)",
        _above(WITHOUT_PGE.name, ("mds-ff",), ("door-lock", "handle-press")),
    ),
    Claim(
        "quality",
        "Leaving them out makes QPA better on Handle Press.",
        "V.D, Fig. 6 (as above)",
        _above("qpa-ff", ("qpa",), ("handle-press",)),
    ),
)

SEEDS: dict[str, int] = {"paper": 5, "quick": 8, "smoke": 2}
"""How many seeds, from 0 on, where it is not said."""


def configuration(arm: Arm, task: str, seed: int, scale: Scale) -> Config:
    """What a study trains.

    paper: with the paper's numbers. quick: with those of the preset ``quick``, for 100,000 steps. smoke: in a size that
    shows that everything works, and nothing else.
    """
    return replace(_first(arm, task, scale), seed=seed)


@cache
def _first(arm: Arm, task: str, scale: Scale) -> Config:
    """Of seed 0."""
    options = {"task": task, "preset": "paper" if scale == "paper" else "quick"}
    if scale == "quick":
        options["steps"] = "100000"
    config = configured(arm.options, options)
    return _smoke(config) if scale == "smoke" else config


def _smoke(config: Config) -> Config:
    """Episodes of 100 steps, networks of 16 units, three sessions."""
    share = config.queries.budget / 250  # budgets stay different
    config = replace(
        config,
        steps=600,
        horizon=100,
        networks=Networks(layers=1, width=16, reward_layers=1, reward_width=16),
        sac=replace(config.sac, batch=32, updates=1, reset_updates=10),
        reward=replace(config.reward, epochs=5, batch=16),
        bilevel=replace(config.bilevel, every=100),
        pge=replace(config.pge, capacity=100, every=100),
        evaluation=Evaluation(every=300, episodes=2),
        checkpoint_every=300,
        snapshot_every=300,
    )
    if not config.method.learns_reward:
        return replace(config, pretraining=Pretraining(random_steps=100, until=0))
    return replace(
        config,
        pretraining=Pretraining(random_steps=100, until=200),
        queries=replace(
            config.queries, budget=max(3, round(12 * share)), per_session=max(1, round(4 * share)), every=100
        ),
    )


def chosen(table: Table, tasks: tuple[str, ...] | None) -> Study:
    """A study, on those of its tasks that are among ``tasks``."""
    study = STUDIES[table]
    return replace(study, tasks=tuple(task for task in study.tasks if tasks is None or task in tasks))
