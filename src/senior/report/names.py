"""What an arm is called: its method, and how its configuration differs from the preset, as the options would say it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields, is_dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, get_type_hints

import tyro

from senior import parts
from senior.config import Config, differences
from senior.presets import preset, release, with_budget
from senior.teachers import recorded, scripted
from senior.types import BadInput

UNNAMED = ("seed", "device", "steps", "evaluation", "checkpoint_every", "snapshot_every", "task", "preset")
"""Fields of a configuration, or groups of them, that make no name."""
OF_ENVIRONMENT = ("env", "position", "length_scale", "horizon")
"""Neither do these where the environment is the user's own: they say which it is."""

_ARGUMENT: Any = type(tyro.conf.arg(name=""))


class Option(NamedTuple):
    """A field on the command line."""

    name: str
    """With its two dashes."""
    flag: bool
    """Given without a value: ``--wait``, ``--no-wait``."""

    def said(self, value: Any) -> str:
        """With that value, as one would type it."""
        if self.flag:
            return self.name if value else f"--no-{self.name[2:]}"
        return f"{self.name} {format(value, 'g') if isinstance(value, float) else value}"


@lru_cache
def options() -> dict[str, Option]:
    """The option of every field of a configuration, by its dotted name."""
    return dict(_options(Config, "", ""))


def _options(kind: type[Any], dotted: str, prefix: str) -> Iterator[tuple[str, Option]]:
    hints = get_type_hints(kind, include_extras=True)
    entry: Field[Any]
    for entry in fields(kind):
        hint, name, before = hints[entry.name], entry.name, prefix
        notes: tuple[Any, ...] = getattr(hint, "__metadata__", ())
        for note in notes:
            if isinstance(note, _ARGUMENT):
                name = entry.name if note.name is None else note.name
                before = "" if note.prefix_name is False else prefix
        bare = hint.__origin__ if notes else hint
        if is_dataclass(bare):
            group = f"{before}{name}." if name else before
            yield from _options(bare, f"{dotted}{entry.name}.", group)  # pyright: ignore[reportArgumentType]
        else:
            flag = bare is bool and tyro.conf.FlagConversionOff not in notes
            yield dotted + entry.name, Option("--" + (before + name).replace("_", "-"), flag)


def label(config: Config) -> str:
    """The method's name and its `words`."""
    return " ".join([config.method.name, *words(config)])


def words(config: Config) -> tuple[str, ...]:
    """The options that the preset of the method would need to become this configuration.

    Left out is what is no part of a method: seed, device, and how long a run lasts, is evaluated and is saved. A budget
    brings its pairs per session with it, ``--compat release`` all that it means, and a teacher its numbers.
    """
    try:
        start = preset(config.preset, config.task, config.method.name)
    except BadInput:  # a row that is gone
        return ()
    said, own = [], normal(config)
    if own.queries.budget != start.queries.budget:
        start = with_budget(start, own.queries.budget)
        said.append(options()["queries.budget"].said(own.queries.budget))
    if own.compat == "release":
        start = replace(release(start), compat="none")
    start = replace(start, answering=normal(replace(start, teacher=own.teacher)).answering)
    silent = (*UNNAMED, *(OF_ENVIRONMENT if own.env else ()))
    for dotted, _, value in differences(start, own):
        if dotted.split(".")[0] not in silent:
            said.append(options()[dotted].said(_short(dotted, value)))
    return tuple(said)


def normal(config: Config) -> Config:
    """With the numbers of a scripted teacher filled in, as a run's ``config.json`` has them."""
    return replace(config, answering=parts.answering(config)) if config.teacher in scripted.TEACHERS else config


def _short(dotted: str, value: Any) -> Any:
    """A file of labels by its name alone."""
    if dotted == "teacher" and str(value).endswith(recorded.SUFFIX):
        return str(value).replace("\\", "/").rsplit("/", 1)[-1]
    return value
