"""What each saving of `senior.envs.lean` is worth: python benchmarks/lean.py [TASK ...]

CPU time per step and per reset of stock Meta-World, of ours, and of ours with one saving taken back at a time, in turn;
medians of 7 episodes of random actions. Run it pinned to one core. ``physics`` is five mj_step and one mj_forward.
"""

from __future__ import annotations

import statistics
import sys
import time
from typing import Any

import numpy as np

from senior.envs.metaworld import TASKS, MetaWorld

TURNS = 7


def kinds(task: str) -> dict[str, Any]:
    """Classes to compare, by name."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    from mujoco import mj_rnePostConstraint  # pyright: ignore[reportAttributeAccessIssue]

    from senior.envs.lean import lean

    stock: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]

    def ours(*without: str) -> Any:
        built = lean.__wrapped__(task, stock)  # not the cached one: it is changed
        for name in without:
            delattr(built, name)
        return built

    class WithForces(ours()):
        def _get_obs(self) -> np.ndarray:
            mj_rnePostConstraint(self.model, self.data)
            return super()._get_obs()

    return {
        "stock": stock,
        "ours": ours(),
        "visual geoms kept": ours("_initialize_simulation"),
        "both hand resets": ours("_reset_hand"),
        "stock's reading of the observation": ours("_get_obs", "_get_curr_obs_combined_no_goal"),
        "stock's step": ours("step"),
        "rotation matrices checked": ours("_get_quat_objects"),
        "mj_rnePostConstraint kept": WithForces,
    }


def built(kind: Any, task: str) -> Any:
    """An environment as the papers set it up."""
    env = kind(reward_function_version="v2")
    if TASKS[task].goal_observable:
        env._partially_observable = False
        del env.sawyer_observation_space
    env._freeze_rand_vec, env.seeded_rand_vec, env._set_task_called = False, True, True
    return env


def main(tasks: list[str]) -> None:
    """Print a line per task and kind."""
    MetaWorld(tasks[0]).close()  # imports Meta-World the way the library does
    from mujoco import mj_forward, mj_step  # pyright: ignore[reportAttributeAccessIssue]

    actions = np.random.default_rng(0).uniform(-1, 1, (500, 4)).astype(np.float32)
    for task in tasks:
        envs = {name: built(kind, task) for name, kind in kinds(task).items()}
        spent: dict[str, list[tuple[float, float]]] = {name: [] for name in envs}
        physics = []
        for _ in range(TURNS):
            for name, env in envs.items():
                env.seed(1)
                began = time.process_time()
                env.reset()
                begun = time.process_time()
                for action in actions:
                    env.step(action)
                spent[name].append((begun - began, time.process_time() - begun))
            model, data = envs["ours"].model, envs["ours"].data
            began = time.process_time()
            for _ in actions:
                mj_step(model, data, nstep=5)
                mj_forward(model, data)
            physics.append(time.process_time() - began)
        print(f"{task}: physics {1e6 * statistics.median(physics) / len(actions):.0f} us", flush=True)
        for name, seconds in spent.items():
            reset, steps = (statistics.median(column) for column in zip(*seconds, strict=True))
            print(f"  {1e6 * steps / len(actions):4.0f} us a step, {1e3 * reset:5.1f} ms a reset: {name}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or list(TASKS))
