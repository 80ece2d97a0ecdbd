"""Stock Meta-World in less time, to the last bit (``tests/test_envs.py`` holds every task to the stock one).

What is saved (benchmarks/README.md has the figures):

* the model that is stepped holds no visual geoms, where the task reads none of them;
* of the two hand resets that a reset makes, the first is left out: all that remains of it is what it drew
  and wrote into the model, because the second begins by resetting the simulator's state;
* observations are read from views that are looked up once, and written into one array; sites are not put right
  before a computation that puts them right; rotation matrices that MuJoCo made are not checked to be ones.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from mujoco import MjData, MjSpec, mj_forward, mj_step  # pyright: ignore[reportAttributeAccessIssue]
from scipy.spatial.transform import Rotation

READS_VISUAL_GEOMS = ("door-open", "door-close")
"""Tasks that observe a geom which is only there to be seen: the door's handle."""

_DOWN = np.array([1.0, 0.0, 1.0, 0.0])  # the hand's orientation, as a quaternion


@functools.cache
def lean(task: str, stock: Any) -> Any:
    """A subclass of the class ``stock`` of that task which does the same with less work."""

    class Lean(stock):
        def _initialize_simulation(self) -> tuple[Any, Any]:
            if task in READS_VISUAL_GEOMS:
                return super()._initialize_simulation()
            spec = MjSpec.from_file(self.fullpath)
            spec.compiler.discardvisual = True
            model = spec.compile()
            return model, MjData(model)

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            self._first_pass = True
            return super().reset(seed=seed, options=options)

        def _reset_hand(self, steps: int = 50) -> None:
            first, self._first_pass = self._first_pass, False
            if not first:
                super()._reset_hand(steps=steps)

        def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
            if self.curr_path_length >= self.max_path_length:
                raise ValueError("The episode is over: reset the environment.")
            data = self.data
            moved = data.mocap_pos[0] + np.clip(action[:3], -1, 1) * self.action_scale
            data.mocap_pos[0] = np.minimum(np.maximum(moved, self.mocap_low), self.mocap_high)
            data.mocap_quat[0] = _DOWN
            data.ctrl[:] = action[3], -action[3]
            mj_step(self.model, data, nstep=self.frame_skip)
            mj_forward(self.model, data)
            self.curr_path_length += 1
            low, high = self._bounds
            observation = np.minimum(np.maximum(self._get_obs(), low), high)
            reward, info = self.evaluate_state(observation, action)
            return observation, reward, False, self.curr_path_length == self.max_path_length, info

        @functools.cached_property
        def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
            space = self.sawyer_observation_space
            return space.low, space.high

        @functools.cached_property
        def _places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Live views of where the hand and its fingers are."""
            hand, right, left = (self.data.body(name).xpos for name in ("hand", "rightclaw", "leftclaw"))
            return hand, right, left

        def _get_obs(self) -> np.ndarray:
            now = self._get_curr_obs_combined_no_goal()
            observation = np.zeros(39)
            observation[:18] = now
            observation[18:36] = self._prev_obs
            if not self._partially_observable:
                observation[36:] = self._get_pos_goal()
            self._prev_obs = now
            return observation

        def _get_curr_obs_combined_no_goal(self) -> np.ndarray:
            hand, right, left = self._places
            observation = np.zeros(18)
            observation[:3] = hand
            observation[3] = min(max(np.linalg.norm(right - left) / 0.1, 0.0), 1.0)
            observation[4:7] = self._get_pos_objects()
            observation[7:11] = self._get_quat_objects()
            return observation

        def _get_quat_objects(self) -> np.ndarray:
            if task not in READS_VISUAL_GEOMS:
                return super()._get_quat_objects()
            matrix = self.data.geom("handle").xmat.reshape(3, 3)
            return Rotation.from_matrix(matrix, assume_valid=True).as_quat()

    Lean._first_pass = False
    return Lean
