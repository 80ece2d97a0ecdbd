"""From a name in the configuration to the part it means: a built-in's or anybody's ``module:Name``."""

from __future__ import annotations

import importlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from senior.config import Answering, Config
from senior.explore import BONUSES, Bonus
from senior.processes import look_here
from senior.select import RULES, Rule
from senior.teachers import TEACHERS, Teacher, recorded, scripted
from senior.types import BadInput, EnvSpec


def load(name: str, known: dict[str, str], kind: str) -> Any:
    """What ``name`` stands for: an entry of ``known`` or ``module:Name`` found from the working directory."""
    path = known.get(name, name)
    if ":" not in path:
        raise BadInput.unknown(kind, name, known)
    module, _, attribute = path.partition(":")
    look_here()
    try:
        holder = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever the user's module raises
        raise BadInput(f"The {kind} {name!r} cannot be imported: {' '.join(str(error).split())}.") from error
    found = getattr(holder, attribute, None)
    if found is None:
        raise BadInput(f"The {kind} {name!r} does not exist: {module} holds no {attribute}.")
    if not callable(found):
        raise BadInput(f"The {kind} {name!r} is a {type(found).__name__}, not a class or a function.")
    return found


def selection(config: Config) -> Rule:
    """The selection rule of a run."""
    rule = load(config.method.select, RULES, "selection rule")
    return rule(**asdict(config.mds)) if config.method.select == "motion_distinction" else rule


def first_selection() -> Rule:
    """The rule of every session before the first label, whatever the scheme: nothing is known yet."""
    return load("uniform", RULES, "selection rule")


def bonus(config: Config, spec: EnvSpec) -> Bonus:
    """The exploration bonus of a run."""
    make, pge = load(config.method.explore, BONUSES, "bonus"), config.pge
    match config.method.explore:
        case "preference_guided":
            return make(spec, pge.capacity, pge.bandwidth, pge.beta, pge.decay, pge.clock)
        case "disagreement":
            return make(spec, config.rune.beta, config.rune.decay)
    return make(spec)


def answering(config: Config) -> Answering:
    """The five numbers of a run's teacher: those asked for, else its own. `BadInput` if it is not a scripted one."""
    asked = {name: value for name, value in asdict(config.answering).items() if value is not None}
    own = scripted.TEACHERS.get(config.teacher)
    if own is None:
        if not is_recorded(config):
            load(config.teacher, TEACHERS, "teacher")
        if asked:
            raise BadInput(f"--{next(iter(asked))} is a number of scripted teachers, and {config.teacher} is none.")
        return config.answering
    return Answering(**{**own._asdict(), **asked})


def resolved(config: Config) -> Config:
    """The configuration as ``config.json`` keeps it: the teacher's numbers filled in, a label file's path absolute."""
    own = replace(config, answering=answering(config))
    return replace(own, teacher=str(Path(own.teacher).resolve())) if is_recorded(own) else own


def takes_time(config: Config) -> bool:
    """Whether a run's teacher may let it wait: whoever is neither scripted nor recorded."""
    return config.teacher not in scripted.TEACHERS and not is_recorded(config)


def is_recorded(config: Config) -> bool:
    """Whether the teacher of a run is a file of labels."""
    return config.teacher.endswith(recorded.SUFFIX)


def teacher(config: Config) -> Teacher:
    """Who answers in a run."""
    if is_recorded(config):
        return recorded.Recorded()
    make = load(config.teacher, TEACHERS, "teacher")
    if config.teacher not in scripted.TEACHERS:
        return make()
    return make(scripted.Numbers(**asdict(answering(config))), config.seed)
