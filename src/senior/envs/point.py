"""A point that is to be moved to a goal: a toy, for tests and first steps.

The observation holds the way to the goal, so a linear policy solves it.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from senior.types import EnvSpec

STEP = 0.1
RADIUS = 0.1
HORIZON = 50
SIDE = 96  # pixels of a rendered frame


class Point(gymnasium.Env[np.ndarray, np.ndarray]):
    """A point in the square [-1, 1]^2, moved by at most 0.1 per axis and step.

    Observation: 4 float32, the position and the goal minus the position. Action: 2 numbers in [-1, 1].
    Reward: ``10 exp(-2 distance)``, in (0, 10]. Success: the distance is at most 0.1. The point starts near
    the middle, the goal lies at least 0.5 from it on one axis.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012  (Gymnasium's declaration)
    render_mode = "rgb_array"
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Box(np.array([-1, -1, -2, -2], np.float32), np.array([1, 1, 2, 2], np.float32))

    def __init__(self, horizon: int = HORIZON, terminate_at_goal: bool = False, tell_success: bool = True) -> None:
        """``horizon``: steps after which an episode is truncated. ``terminate_at_goal``: the episode really
        ends at success. ``tell_success``: whether ``info`` holds ``success``."""
        self.horizon = horizon
        self.terminate_at_goal = terminate_at_goal
        self.tell_success = tell_success
        self.position = np.zeros(2)
        self.goal = np.zeros(2)
        self.elapsed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Returns observation [4] and an empty info."""
        super().reset(seed=seed)
        self.elapsed = 0
        self.position = self.np_random.uniform(-0.1, 0.1, 2)
        self.goal = self.np_random.uniform(-0.9, 0.9, 2)
        axis = self.np_random.integers(2)
        self.goal[axis] = self.np_random.choice([-1, 1]) * self.np_random.uniform(0.6, 0.9)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Action [2]; returns observation [4], reward, terminated, truncated and info."""
        self.elapsed += 1
        move = STEP * np.clip(np.asarray(action, np.float64), -1, 1)
        self.position = np.clip(self.position + move, -1, 1)
        distance = float(np.linalg.norm(self.goal - self.position))
        success = distance <= RADIUS
        info = {"success": float(success)} if self.tell_success else {}
        terminated = self.terminate_at_goal and success
        return (
            self._observation(),
            10 * float(np.exp(-2 * distance)),
            terminated,
            self.elapsed >= self.horizon,
            info,
        )

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.position, self.goal - self.position]).astype(np.float32)

    def render(self) -> np.ndarray:
        """The square from above, [96, 96, 3] uint8: the goal green, the point red, y upwards."""
        ticks = (np.arange(SIDE) + 0.5) / SIDE * 2.4 - 1.2
        x, y = ticks[None, :], -ticks[:, None]
        frame = np.full((SIDE, SIDE, 3), 40, np.uint8)
        frame[(np.abs(x) <= 1) & (np.abs(y) <= 1)] = 235
        for centre, colour in ((self.goal, (60, 160, 60)), (self.position, (200, 40, 40))):
            frame[(x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= RADIUS**2] = colour
        return frame


def make(horizon: int = HORIZON, terminate_at_goal: bool = False, tell_success: bool = True) -> tuple[Point, EnvSpec]:
    """The toy and its `EnvSpec`. The square is 2 wide and stands for Meta-World's metre-wide table, so what
    is one metre there is 2 here."""
    env = Point(horizon, terminate_at_goal, tell_success)
    spec = EnvSpec(
        name="point",
        observation_size=4,
        action_size=2,
        position=slice(0, 2),
        horizon=horizon,
        length_scale=2.0,
        tells_success=tell_success,
    )
    return env, spec
