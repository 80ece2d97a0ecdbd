"""From options with several values, given on the command line or in a TOML file, to the cells of a sweep."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import tyro

from senior.config import Asking, Config
from senior.files import slug
from senior.options import parse, starting_from
from senior.sweep.cells import Cell
from senior.types import BadInput

Grid = dict[str, list[str]]
"""Options of `senior train`, without dashes, and the values that each takes; ``arm``: methods with options."""

FLAGS = {entry.name.replace("_", "-") for entry in fields(Asking) if entry.type == "bool"}
"""Options without a value: --wait, --no-wait."""


@dataclass(frozen=True)
class _CellOptions:
    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)


def split(arguments: Sequence[str], own: Sequence[str]) -> tuple[list[str], Grid]:
    """Divide a command's arguments into its ``own`` options, with their values, and a grid."""
    mine: list[str] = []
    grid: Grid = {}
    values: list[str] = mine
    for argument in arguments:
        if not argument.startswith("--"):
            values.append(argument)
            continue
        name, given, value = argument[2:].partition("=")
        name = name.replace("_", "-")
        if name in own:
            values = mine
            mine.append(argument)
        else:
            values = grid.setdefault(name, [])
            values += [value] if given else []
    return mine, grid


def read(file: Path) -> Grid:
    """The grid in a TOML file: a key per option, whose value is one or a list. `BadInput` if it cannot be read."""
    try:
        content = tomllib.loads(file.read_text())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BadInput(f"{file} cannot be read: {reason}.") from error
    grid: Grid = {}
    for key, value in _flat(content, ""):
        name = key.replace("_", "-")
        values = value if isinstance(value, list) else [value]
        if any(isinstance(one, (list, dict)) for one in values):
            raise BadInput(f"{file}: {name} must be a value or a list of values.")
        if name in FLAGS:
            if len(values) != 1 or not isinstance(values[0], bool):
                raise BadInput(f"{file}: {name} must be true or false.")
            grid[name if values[0] else f"no-{name}"] = []
        else:
            grid[name] = [str(one) for one in values]
    return grid


def _flat(content: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    found = []
    for name, value in content.items():
        found += _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, value)]
    return found


def merged(grid: Grid, over: Grid) -> Grid:
    """A grid with the options of another in place of its own; --wait is one with --no-wait, --arm with --method."""
    replaced = {_kind(name) for name in over}
    return {**{name: values for name, values in grid.items() if _kind(name) not in replaced}, **over}


def _kind(name: str) -> str:
    return "arm" if name == "method" else name.removeprefix("no-") if name.removeprefix("no-") in FLAGS else name


def cells_of(grid: Grid, out: Path) -> list[Cell]:
    """A cell for every choice of one value per option, in ``out/TASK/ARM/seed-N``.

    An arm is a method and its options in one string, ``m-senior --select disagreement``. Options with one value hold
    for all cells; further ones with several stand in the name of the arm's directory. `BadInput` for what makes no
    sense.
    """
    axes = {name: values or [""] for name, values in grid.items()}
    if "arm" in axes and "method" in axes:
        raise BadInput("Give --arm or --method, not both: an arm begins with its method.")
    axes["arm"] = axes.pop("arm", axes.pop("method", ["m-senior"]))
    axes.setdefault("task", ["door-lock"])
    for arm in axes["arm"]:
        own = {word[2:].partition("=")[0].replace("_", "-") for word in arm.split() if word.startswith("--")}
        for name in sorted(own & {*axes} - {"task", "seed"}):
            raise BadInput(
                f"The arm {arm!r} and the sweep both have --{name}; give it to the arms that need it, or to the sweep "
                "for all of them."
            )
        for name in sorted(own & {"task", "seed"}):
            raise BadInput(f"The arm {arm!r} has a --{name} of its own; give it to the sweep, for all arms.")
    axes = {"seed": axes.pop("seed", ["0"]), **axes}  # the first seed of every arm comes before the second of any
    varied = [name for name, values in axes.items() if len(values) > 1 and name not in ("arm", "task", "seed", "env")]
    cells = []
    for values in product(*axes.values()):
        chosen = dict(zip(axes, values, strict=True))
        arm = chosen.pop("arm")
        config = configured(arm, chosen)
        name = "-".join([arm, *(f"{option}-{_word(chosen[option])}" for option in varied)])
        cells.append(Cell(config, place(out, config, name)))
    return cells


def _word(value: str) -> str:
    """A value in the name of a directory, where a dash says nothing."""
    return f"minus-{value[1:]}" if value.startswith("-") else value


def configured(arm: str, options: Mapping[str, str]) -> Config:
    """The configuration of an arm with options; those without a value are flags. `BadInput` for what makes no sense."""
    try:
        method, *own = shlex.split(arm)
    except ValueError as error:
        raise BadInput(f"The arm {arm!r} is no method with options.") from error
    arguments = ["--method", method, *own]
    for name, value in options.items():
        arguments += [f"--{name}", value] if value else [f"--{name}"]
    return parse(_CellOptions, arguments, _CellOptions(starting_from(arguments)), "train").config


def place(out: Path, config: Config, arm: str) -> Path:
    """The directory of a run of an arm."""
    return out / slug(config.environment) / slug(arm) / f"seed-{config.seed}"
