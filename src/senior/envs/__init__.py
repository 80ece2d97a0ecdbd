"""Environments: the Meta-World tasks, a toy, and any Gymnasium environment. Nothing here imports JAX."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gymnasium import Env  # the bare name belongs to our own module here

from senior.envs import gymnasium as custom
from senior.envs import metaworld, point
from senior.types import BadInput, EnvSpec


def names() -> list[str]:
    """The tasks that need no further options, as listed by ``senior tasks``."""
    return [*metaworld.TASKS, "point"]


def tasks_table() -> list[tuple[str, str, str]]:
    """Rows of ``senior tasks``: name, what is to be done, whether the goal is seen."""
    rows = [
        (name, task.sentence, "visible" if task.goal_observable else "hidden") for name, task in metaworld.TASKS.items()
    ]
    return [*rows, ("point", "Move a point to the goal (a toy)", "visible")]


def make(
    task: str | None,
    env: str | None = None,
    position: str | slice | None = None,
    length_scale: float | None = None,
    horizon: int | None = None,
    render: bool = False,
) -> tuple[Env[Any, Any], EnvSpec]:
    """The environment that a configuration asks for, and its `EnvSpec`.

    ``env`` (see `senior.envs.gymnasium.make`) is taken where it is given, else ``task``. A task knows its own
    position and length scale; ``horizon`` may only shorten a Meta-World episode. ``render``: build it so that
    it can be drawn. Raises `BadInput`.
    """
    if env is not None:
        where = custom.parse_position(position) if isinstance(position, str) else position
        return custom.make(env, where, length_scale, horizon, render)
    if task is None:
        raise BadInput("Give a --task, or any Gymnasium environment by --env.")
    if task not in names():
        raise BadInput.unknown("task", task, names())
    if position is not None or length_scale is not None:
        raise BadInput(f"--position and --length-scale belong to --env; the task {task} has its own.")
    if horizon is not None and horizon < 1:
        raise BadInput(f"--horizon {horizon} must be at least 1.")
    if task == "point":
        return point.make(horizon or point.HORIZON)
    if horizon is not None and horizon > metaworld.HORIZON:
        raise BadInput(f"--horizon {horizon} is more than the {metaworld.HORIZON} steps of a Meta-World episode.")
    built, spec = metaworld.make(task, render)
    return built, replace(spec, horizon=horizon or spec.horizon)
