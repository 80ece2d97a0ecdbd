"""How fast several environments of a task are stepped, without any learning: stock, here, and in worker processes.

All three take the same actions through whole episodes, resets included, in turn, and the median of the turns counts.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from senior import envs, protocol
from senior.envs import metaworld
from senior.envs.episodes import TRAINING, Episodes, Failure, Local
from senior.envs.workers import Remote, Workers
from senior.types import BadInput

TURNS = 3


def stock(task: str, count: int) -> gymnasium.vector.SyncVectorEnv:
    """Gymnasium's SyncVectorEnv of stock Meta-World, set up as the papers do."""
    metaworld.MetaWorld(task).close()  # imports Meta-World the way the library does
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    def one() -> Any:
        built: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
        built._freeze_rand_vec = False
        built._set_task_called = True
        return built

    return gymnasium.vector.SyncVectorEnv([one] * count)


def step_all(places: list[Episodes], actions: np.ndarray) -> None:
    """One step of every place."""
    for place, action in zip(places, actions, strict=True):
        place.send(action)
    for place in places:
        result = place.receive()
        assert not isinstance(result, Failure), result.message


def measure(task: str, count: int, processes: int) -> dict[str, Any]:
    """Environment steps per second of ``count`` environments, in each of three ways."""
    made = {"task": task}
    _, spec = envs.make(task)
    actions = np.random.default_rng(0).uniform(-1, 1, (spec.horizon, count, spec.action_size)).astype(np.float32)
    pool = Workers(processes)
    vector = stock(task, count)
    here: list[Episodes] = [Local(lambda: envs.make(task), seed, TRAINING) for seed in range(count)]
    there: list[Episodes] = [Remote(pool.next(), made, spec, seed, TRAINING) for seed in range(count)]
    vector.reset()
    for place in (*here, *there):
        place.begin(0)
    ways: dict[str, Callable[[np.ndarray], Any]] = {
        "sync_vector_env": vector.step,
        "in_process": lambda acts: step_all(here, acts),
        "workers": lambda acts: step_all(there, acts),
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    try:
        for _ in range(TURNS):
            for name, step in ways.items():
                began = time.perf_counter()
                for acts in actions:
                    step(acts)
                seconds[name].append(time.perf_counter() - began)
    finally:
        pool.close()
        vector.close()
        for place in here:
            place.close()
    steps = spec.horizon * count
    return {
        "task": task,
        "environments": count,
        "processes": processes,
        "steps_per_second": {name: steps / statistics.median(taken) for name, taken in seconds.items()},
    }


def run(task: str, count: int) -> dict[str, Any]:
    """`senior bench --environments N`: print the figures of one task."""
    if task not in metaworld.TASKS:
        raise BadInput.unknown("task", task, metaworld.TASKS)
    figures = measure(task, count, min(protocol.threads(), count))
    rates = figures["steps_per_second"]
    print(f"{count} environments of {task}, random actions, whole episodes with their resets; steps per second:")
    for name, told in (
        ("sync_vector_env", "Gymnasium's SyncVectorEnv of stock Meta-World"),
        ("in_process", "ours, one after the other in this process"),
        ("workers", f"ours, in {figures['processes']} worker processes"),
    ):
        print(f"  {rates[name]:8.0f}  {rates[name] / rates['sync_vector_env']:5.2f}x  {told}", flush=True)
    return figures
