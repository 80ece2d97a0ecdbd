"""What the numbers of a run depend on beside its configuration: the environment as it is, the machine, the programs.

It stands in ``config.json`` beside the configuration. Imports no JAX.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from senior.envs import metaworld
from senior.types import EnvSpec

PACKAGES = ("senior-rl", "jax", "jaxlib", "optax", "numpy", "gymnasium", "metaworld", "mujoco")


def read(path: Path) -> dict[str, Any]:
    """The protocol in a run's ``config.json``."""
    return json.loads((path / "config.json").read_text()).get("protocol", {})


def of_environment(spec: EnvSpec) -> dict[str, Any]:
    """What a number of a run depends on of its environment."""
    return {
        "environment": spec.name,
        "reward_version": metaworld.REWARD_FUNCTION_VERSION if spec.name in metaworld.TASKS else None,
        "horizon": spec.horizon,
        "observation_size": spec.observation_size,
        "action_size": spec.action_size,
        "position": [spec.position.start, spec.position.stop],
    }


def of(spec: EnvSpec, device: str) -> dict[str, Any]:
    """What a number of this run depends on beside its configuration."""
    return {
        **of_environment(spec),
        "device": device,
        "threads": threads(),
        "machine": f"{platform.system()} {platform.machine()}, {_processor()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "git_commit": _commit(),
    }


def threads() -> int:
    """Processors this process may use; XLA's thread pool has as many."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown processor"


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of the source tree this package runs from, if it is one; "-changed" where its files differ from it
    or one is not in it."""
    source = Path(__file__).resolve().parent
    if source.parent.name != "src":
        return None
    try:
        changed = _git(source, "--no-optional-locks", "status", "--porcelain", "--", ".")
        return _git(source, "rev-parse", "HEAD") + ("-changed" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(place: Path, *arguments: str) -> str:
    command = ["git", "-C", str(place), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
