"""A method is a row of data. An ablation is the row with a cell replaced."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from senior import explore, select
from senior.types import BadInput

MIXES = ("uniform", "curiosity", "recent")
OUTER_STEPS = ("none", "bilevel")


def _one_of(what: str, known: Iterable[str]) -> Any:
    """An option's help, with the names that can be given."""
    return tyro.conf.arg(help=f"{what}: {', '.join(known)}, or module:Name.")


_SELECT = _one_of("Which pairs to ask", (*select.RULES, "none"))
_EXPLORE = _one_of("Bonus on top of the learned reward", explore.BONUSES)


@dataclass(frozen=True)
class Method:
    """One row of `senior methods`; every cell is an option of `senior train`."""

    name: Annotated[str, tyro.conf.arg(name="method")] = "m-senior"
    """Name of the row that the cells below start from."""
    select: Annotated[str, _SELECT] = "motion_distinction"
    explore: Annotated[str, _EXPLORE] = "preference_guided"
    mix: str = "curiosity"
    """Where batches come from: uniform, the whole replay; curiosity, a share of them from PGE's curiosity buffer;
    recent, a share of them from the latest episodes while there is budget (QPA)."""
    outer: str = "bilevel"
    """Outer step on the reward model: bilevel (Meta-Reward-Net), none."""

    @property
    def learns_reward(self) -> bool:
        """False for plain SAC, which sees the true reward and asks nobody."""
        return self.select != "none"

    @property
    def refreshes(self) -> bool:
        """Whether there is a bonus that changes every Q steps. RUNE's is made of what the replay holds."""
        return self.explore not in ("none", "disagreement")

    def check(self) -> None:
        """Refuse cells that do not exist or do not go together."""
        for cell, value, known in (
            ("--select", self.select, (*select.RULES, "none")),
            ("--explore", self.explore, (*explore.BONUSES, "none")),
        ):
            if value not in known and ":" not in value:
                raise BadInput.unknown(cell, value, known)
        for cell, value, known in (("--mix", self.mix, MIXES), ("--outer", self.outer, OUTER_STEPS)):
            if value not in known:
                raise BadInput.unknown(cell, value, known)
        if not self.learns_reward:
            for cell, value, idle in (
                ("an outer step", self.outer, "none"),
                ("a bonus", self.explore, "none"),
                ("a mix of sources", self.mix, "uniform"),
            ):
                if value != idle:
                    raise BadInput(
                        f"A method that asks nothing (--select none) has no reward model, so {cell} ({value}) "
                        "makes no sense."
                    )
        if self.explore == "preference_guided" and self.mix != "curiosity":
            raise BadInput(
                "The bonus of PGE is paid on rows of the curiosity buffer, so --explore preference_guided needs "
                "--mix curiosity."
            )
        if self.mix == "curiosity" and self.explore != "preference_guided":
            raise BadInput(
                "The curiosity buffer is filled by PGE, so --mix curiosity needs --explore preference_guided; "
                "without PGE use --explore none --mix uniform."
            )


METHODS: dict[str, Method] = {
    row.name: row
    for row in (
        Method("sac", select="none", explore="none", mix="uniform", outer="none"),
        Method("pebble", select="entropy", explore="none", mix="uniform", outer="none"),
        Method("mrn", select="disagreement", explore="none", mix="uniform", outer="bilevel"),
        Method("rune", select="disagreement", explore="disagreement", mix="uniform", outer="none"),
        Method("m-rune", select="disagreement", explore="disagreement", mix="uniform", outer="bilevel"),
        Method("qpa", select="policy_aligned", explore="none", mix="recent", outer="none"),
        Method(
            "p-senior",
            select="motion_distinction",
            explore="preference_guided",
            mix="curiosity",
            outer="none",
        ),
        Method(
            "m-senior",
            select="motion_distinction",
            explore="preference_guided",
            mix="curiosity",
            outer="bilevel",
        ),
    )
}


def method(name: str) -> Method:
    """The row of that name; `BadInput` with the nearest one if there is none."""
    if name not in METHODS:
        raise BadInput.unknown("method", name, METHODS)
    return METHODS[name]
