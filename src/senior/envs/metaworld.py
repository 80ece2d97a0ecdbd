"""Meta-World (Yu et al. 2019; v3 simulator), as preference-based RL uses it.

One environment is one task, with the object elsewhere in every episode.

The stock environment is the truth: observations, rewards and success are its own, bit for bit (`senior.envs.lean`
makes them in less time). Known peculiarities of it are kept, because published numbers contain them:

* several "initial" positions in the rewards are live views of the simulator's state, not copies, so that
  the reach term of door-lock is measured against the current distance (about 1.08 at the first step);
* window-open and window-close show the handle at the previous draw's place in the first observation;
* handle-press starts from a state that depends on the first of the two draws which a reset makes.

Two things the stock environment does not do by itself. Its ``reset(seed=...)`` ignores the seed and draws the
object's place from NumPy's global generator; here a seed decides the whole episode, whatever ran before. And
box-close hides the box together with the goal (the box is seen nowhere else), so there the goal is shown; in
all other tasks ``observation[36:39]`` is zero, as in the papers, and the goal follows from the object.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from senior.types import BadInput, EnvSpec

HORIZON = 500
POSITION = slice(0, 3)  # of the end-effector: MuJoCo's body "hand", in metres
REWARD_FUNCTION_VERSION = "v2"


@dataclass(frozen=True)
class Task:
    """One task of Meta-World."""

    sentence: str
    """What the robot is to do."""
    goal_observable: bool = False
    """Whether the goal is seen in ``observation[36:39]``; zeros otherwise."""


TASKS = {
    "door-lock": Task("Turn the door lock"),
    "door-unlock": Task("Turn the door lock back"),
    "door-open": Task("Pull the door open by its handle"),
    "door-close": Task("Push the open door shut"),
    "window-open": Task("Slide the window open"),
    "window-close": Task("Slide the window shut"),
    "handle-press": Task("Press the handle down"),
    "box-close": Task("Put the lid on the box", goal_observable=True),
}


class MetaWorld(gymnasium.Env[np.ndarray, np.ndarray]):
    """One task of Meta-World with a random object position in every episode.

    Observation: 39 float64, the end-effector's position (metres) first. Action: 4 numbers in [-1, 1], the
    hand's motion (1 is 1 cm) and the gripper's effort. Reward: 0 to 10 per step, ``info["success"]`` 0 or 1.
    An episode never terminates and is truncated at step 500.
    """

    metadata = {"render_modes": [], "render_fps": 80}  # noqa: RUF012  (Gymnasium's declaration)

    def __init__(self, task: str, reward_function_version: str = REWARD_FUNCTION_VERSION, render: bool = False) -> None:
        """``render``: keep what is only there to be seen. Raises `BadInput` for an unknown task, any reward but v2."""
        if task not in TASKS:
            raise BadInput.unknown("task", task, TASKS)
        if reward_function_version != REWARD_FUNCTION_VERSION:
            raise BadInput(
                f"Reward version {reward_function_version!r} is not supported; "
                f"did you mean {REWARD_FUNCTION_VERSION}, the dense reward of 0 to 10 per step?"
            )
        # MuJoCo loads OpenGL when it is imported. Training draws nothing; `render` has a process of its own.
        os.environ.setdefault("MUJOCO_GL", "off")
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS

        from senior.envs.lean import lean

        kind: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]
        stock = (kind if render else lean(task, kind))(reward_function_version=reward_function_version)
        if TASKS[task].goal_observable:
            stock._partially_observable = False
            del stock.sawyer_observation_space  # cached with bounds that clip the goal to zero
            stock.observation_space = stock.sawyer_observation_space
        stock._freeze_rand_vec = False
        stock.seeded_rand_vec = True
        stock._set_task_called = True
        self.stock = stock
        self.action_space = stock.action_space
        self.observation_space = stock.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode, decided by ``seed`` alone where one is given. Returns observation [39], info."""
        super().reset(seed=seed)
        if seed is not None:
            self.stock.seed(seed)
        return self.stock.reset()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, SupportsFloat, bool, bool, dict[str, Any]]:
        """One control step of 12.5 ms. float32 and float64 actions give slightly different trajectories."""
        return self.stock.step(action)

    def close(self) -> None:
        self.stock.close()


def make(task: str, render: bool = False) -> tuple[MetaWorld, EnvSpec]:
    """The environment of a task, to be drawn or not, and its `EnvSpec`, in metres. `BadInput` for an unknown task."""
    env = MetaWorld(task, render=render)
    spec = EnvSpec(
        name=task,
        observation_size=39,
        action_size=4,
        position=POSITION,
        horizon=HORIZON,
        length_scale=1.0,
        tells_success=True,
    )
    return env, spec
