"""Any Gymnasium environment with vector observations and bounded continuous actions.

What the library assumes of it: equal seeds and actions give equal episodes (runs are resumed and videos made
by replaying them), and ``info["success"]`` or ``info["is_success"]``, if told at all, is told at every step.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, TimeLimit, TransformAction

from senior.envs.numbers import BadNumber, cause, checked, finite
from senior.processes import look_here
from senior.types import BadInput, EnvSpec


class ProgramEnded(Exception):
    """An environment wanted to end the program, as some do when their window is closed."""


@contextmanager
def _staying() -> Iterator[None]:
    try:
        yield
    except SystemExit as end:
        raise ProgramEnded(str(end)) from end


class Staying(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Raises `ProgramEnded` where the environment would end the program. What its `close` raises is heard by nobody."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        with _staying():
            return self.env.step(action)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        with _staying():
            return self.env.reset(**options)

    def render(self) -> Any:
        with _staying():
            return self.env.render()

    def close(self) -> None:
        with suppress(Exception, SystemExit):
            self.env.close()


class IsSuccess(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Tells ``info["is_success"]`` as ``info["success"]``."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, _with_success(info)


def parse_position(text: str) -> slice:
    """``"0:3"`` as ``slice(0, 3)``. Raises `BadInput` for anything but two increasing indices."""
    match = re.fullmatch(r"\s*(\d+)\s*:\s*(\d+)\s*", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise BadInput(
            f"--position {text!r} is not a range of observation indices; give it as first:end, for instance 0:3."
        )
    return slice(int(match[1]), int(match[2]))


def make(
    name: str,
    position: slice | None,
    length_scale: float | None = None,
    horizon: int | None = None,
    render: bool = False,
) -> tuple[gymnasium.Env[Any, Any], EnvSpec]:
    """The environment ``name`` and its `EnvSpec`.

    name: ``module:Name``, a class or function called without arguments (the current directory is searched
    too), or an id registered with Gymnasium, for instance ``Pendulum-v1``.
    position: where the end-effector position lies in the observation.
    length_scale: what one metre is in Meta-World, or None where nobody knows.
    horizon: the most steps of an episode; where the environment has a limit of its own, the smaller counts.
    render: ask it for ``render_mode="rgb_array"``.

    Observations are [o]; actions are [a] in [-1, 1], whatever the environment's own bounds.
    Raises `BadInput` where any of this does not fit together.
    """
    construct = _constructor(name)
    env = _started(name, construct, render)
    try:
        return _fitted(name, construct, env, position, length_scale, horizon)
    except BaseException:
        env.close()
        raise


def _fitted(
    name: str,
    construct: Callable[..., Any],
    env: gymnasium.Env[Any, Any],
    position: slice | None,
    length_scale: float | None,
    horizon: int | None,
) -> tuple[gymnasium.Env[Any, Any], EnvSpec]:
    """`make`, of an environment that is built."""
    size = _observation_size(name, _space(name, env, "observation_space"))
    if position is None:
        raise BadInput(
            f"--env {name} needs --position, the part of the observation that is the end-effector's "
            "position, for instance 0:3."
        )
    first, end = position.start or 0, position.stop
    if end is None or not 0 <= first < end <= size:
        raise BadInput(f"--position {first}:{end} lies outside the {size} numbers that {name} observes.")
    if length_scale is not None and not 0 < length_scale < np.inf:
        raise BadInput(f"--length-scale {length_scale} must be a positive number.")
    env = _rescaled(name, env)
    told = _probe(name, construct, size)
    if "success" not in told and "is_success" in told:
        env = IsSuccess(env)
    spec = EnvSpec(
        name=name,
        observation_size=size,
        action_size=env.action_space.shape[0],  # pyright: ignore[reportOptionalSubscript]
        position=slice(first, end),
        horizon=_horizon(name, env, horizon),
        length_scale=length_scale,
        tells_success="success" in _with_success(told),
    )
    return env, spec


def _with_success(info: dict[str, Any]) -> dict[str, Any]:
    if "success" in info or "is_success" not in info:
        return info
    return {**info, "success": info["is_success"]}


def _constructor(name: str) -> Callable[..., Any]:
    """What is called to build the environment: by ``module:Name`` or by a registered id."""
    if ":" not in name:
        return _registered(name)
    module_name, _, attribute = name.partition(":")
    look_here()
    try:
        with _staying():
            module = importlib.import_module(module_name)
    except Exception as error:
        raise BadInput(f"The module of --env {name} cannot be imported: {cause(error)}") from error
    if attribute in gymnasium.registry:
        return _registered(attribute)
    construct: Any = getattr(module, attribute, None)
    if construct is None:
        raise BadInput.unknown(f"name in module {module_name}", attribute, _public(module))
    if not callable(construct):
        raise BadInput(f"--env {name} is not a class or a function, so no environment can be built from it.")
    return construct


def _public(module: Any) -> list[str]:
    return [name for name in vars(module) if not name.startswith("_")]


def _registered(name: str) -> Callable[..., Any]:
    if name not in gymnasium.registry:
        otherwise = (
            "give an id that is registered with Gymnasium, or a class or function of a module of yours: "
            f"{name.removesuffix('.py')}:Name."
        )
        raise BadInput.unknown("environment", name, gymnasium.registry, otherwise)
    return lambda **options: gymnasium.make(name, disable_env_checker=True, **options)


def _started(name: str, construct: Callable[..., Any], render: bool) -> gymnasium.Env[Any, Any]:
    try:
        with _staying():
            if render:
                try:
                    env = construct(render_mode="rgb_array")
                except TypeError:  # it takes no such argument; it may draw all the same
                    env = construct()
            else:
                env = construct()
    except Exception as error:
        raise BadInput(f"The environment {name} cannot be built: {cause(error)}") from error
    if not isinstance(env, gymnasium.Env):
        raise BadInput(f"--env {name} gives a {type(env).__name__}, not a Gymnasium environment.")
    return Staying(env)


def _space(name: str, env: gymnasium.Env[Any, Any], which: str) -> spaces.Space[Any]:
    try:
        return getattr(env, which)
    except Exception as error:
        raise BadInput(f"The environment {name} has no {which}: {cause(error)}") from error


def _observation_size(name: str, space: spaces.Space[Any]) -> int:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise BadInput(
            f"{name} observes {space}, but only a Box of one dimension works here; "
            "wrap it, for instance in gymnasium.wrappers.FlattenObservation."
        )
    return space.shape[0]


def _rescaled(name: str, env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """The environment with actions in [-1, 1]."""
    space = _space(name, env, "action_space")
    if (
        not isinstance(space, spaces.Box)
        or len(space.shape) != 1
        or not np.issubdtype(space.dtype, np.floating)
        or not (space.is_bounded() and (space.low < space.high).all())
    ):
        raise BadInput(f"{name} acts in {space}, but only a bounded Box of one dimension works here.")
    low, high = space.low, space.high
    if (low == -1).all() and (high == 1).all():
        return env
    # Rescaling may round past a bound, at which some environments raise.
    inside = TransformAction(env, lambda action: np.clip(action, low, high), space)
    ones = np.ones(space.shape, space.dtype)
    return RescaleAction(inside, -ones, ones)


def _horizon(name: str, env: gymnasium.Env[Any, Any], asked: int | None) -> int:
    if asked is not None and asked < 1:
        raise BadInput(f"--horizon {asked} must be at least 1.")
    limits = [] if asked is None else [asked]
    if env.spec is not None and env.spec.max_episode_steps is not None:
        limits.append(env.spec.max_episode_steps)
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    if not limits:
        raise BadInput(f"{name} does not tell how long an episode may last; give --horizon, the most steps of one.")
    return min(limits)


def _probe(name: str, construct: Callable[..., Any], size: int) -> dict[str, Any]:
    """The info of one step, taken on an instance of its own so that the returned one is untouched."""
    env = _started(name, construct, render=False)
    try:
        env.reset(seed=0)
        middle = (env.action_space.low + env.action_space.high) / 2  # pyright: ignore[reportAttributeAccessIssue]
        observation, reward, _, _, info = env.step(middle.astype(env.action_space.dtype))
        checked(observation, size)
        finite("reward", reward)
        if not isinstance(info, dict):
            raise BadNumber(f"the info of a step is {info!r}, not a dict.")
        return info
    except Exception as error:
        raise BadInput(f"The environment {name} fails at its first step: {cause(error)}") from error
    finally:
        env.close()
