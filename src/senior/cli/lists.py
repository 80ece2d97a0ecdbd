"""`senior tasks` and `senior methods`: what there is."""

from __future__ import annotations

from senior.cli.display import table
from senior.cli.shared import DONE, NoOptions
from senior.options import parse
from senior.presets import preset


def tasks(arguments: list[str]) -> int:
    parse(NoOptions, arguments, None, "tasks")
    from senior import envs

    print(table(("task", "what is to be done", "goal"), envs.tasks_table()))
    return DONE


def methods(arguments: list[str]) -> int:
    parse(NoOptions, arguments, None, "methods")
    from senior.methods import METHODS

    rows = []
    for row in METHODS.values():
        config = preset("paper", "door-lock", row.name)
        mixes = {
            "uniform": "uniform",
            "curiosity": f"{config.pge.share:.0%} curiosity",
            "recent": f"{config.qpa.share:.0%} recent",
        }
        outer = f"{row.outer} every {config.bilevel.every:,} steps"
        reward = config.reward
        fit = f"{reward.members} member{'s' if reward.members > 1 else ''}" + (", snippets" if reward.snippets else "")
        cells = (row.name, row.select, row.explore, mixes[row.mix], outer if row.outer != "none" else "none")
        rows.append([cell if cell != "none" else "-" for cell in cells] + [fit if row.learns_reward else "true reward"])
    print(table(("method", "select", "explore", "replay mix", "outer step", "reward fit"), rows))
    return DONE
