"""SENIOR: teach robots by preference.

    from senior import preset, train, evaluate_run
    results = train(preset("quick", "door-close", "m-senior"), out="runs/first")
    print(evaluate_run(results[0].path, episodes=50).success_rate)

Names are imported when they are first used, so that ``import senior`` is cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from senior.config import Config
    from senior.judgement import Judgement, evaluate_run
    from senior.loop import Watcher
    from senior.methods import METHODS, Method
    from senior.policy import Policy, load_policy
    from senior.presets import preset, release, with_budget
    from senior.program import Quiet, resume, train, train_all
    from senior.schedule import plan
    from senior.select import Context, Selection
    from senior.together import Result
    from senior.types import Answers, BadInput, EnvSpec, Pairs, Query

_HOME = {
    "METHODS": "methods",
    "Answers": "types",
    "BadInput": "types",
    "Config": "config",
    "Context": "select",
    "EnvSpec": "types",
    "Judgement": "judgement",
    "Method": "methods",
    "Pairs": "types",
    "Policy": "policy",
    "Query": "types",
    "Quiet": "program",
    "Result": "together",
    "Selection": "select",
    "Watcher": "loop",
    "evaluate_run": "judgement",
    "load_policy": "policy",
    "plan": "schedule",
    "preset": "presets",
    "release": "presets",
    "resume": "program",
    "train": "program",
    "train_all": "program",
    "with_budget": "presets",
}

__all__ = [
    "METHODS",
    "Answers",
    "BadInput",
    "Config",
    "Context",
    "EnvSpec",
    "Judgement",
    "Method",
    "Pairs",
    "Policy",
    "Query",
    "Quiet",
    "Result",
    "Selection",
    "Watcher",
    "evaluate_run",
    "load_policy",
    "plan",
    "preset",
    "release",
    "resume",
    "train",
    "train_all",
    "with_budget",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'senior' has no attribute {name!r}")
    return getattr(importlib.import_module(f"senior.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
