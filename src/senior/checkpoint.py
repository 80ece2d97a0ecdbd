"""Checkpoints: one pytree, the host's progress, and the facts of the replay in append-only chunks.

A checkpoint is whole or absent (`senior.files`). The two newest are kept: if the newest is damaged, the one before
serves. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from senior.files import Damaged, pack, unpack, write_atomically
from senior.learner import Run
from senior.replay import Fact
from senior.rundir import saved_steps

KEPT = 2
FORMAT = 3
_CHUNK = re.compile(r"facts-(\d{10})-(\d{10})\.npz")


def save(directory: Path, step: int, run: Run, progress: dict[str, Any], written: int) -> int:
    """Write a checkpoint of a run at the beginning of ``step``.

    ``written`` facts are in chunks already; returns the number that is now.
    """
    directory.mkdir(exist_ok=True)
    replay = run.replay
    count, capacity = int(replay.count), replay.capacity
    first = max(written, count - capacity)
    if count > first:
        rows = np.arange(first, count) % capacity
        facts = {name: np.asarray(column)[rows] for name, column in replay.facts._asdict().items()}
        write_atomically(directory / f"facts-{first:010d}-{count:010d}.npz", pack(facts, compress=True))
    filled = min(count, capacity)
    leaves = _leaves(run._replace(replay=None))
    leaves["replay/learned_reward"] = np.asarray(replay.learned_reward)[:filled]
    leaves["replay/spread"] = np.asarray(replay.spread)[:filled]
    about = {"format": FORMAT, "step": step, "count": count, "progress": progress}
    leaves["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    write_atomically(directory / f"step-{step:010d}.npz", pack(leaves))
    for old in saved_steps(directory)[KEPT:]:
        (directory / f"step-{old:010d}.npz").unlink()
    return count


def restore(directory: Path, step: int, template: Run) -> tuple[Run, dict[str, Any]]:
    """The run and the progress saved at ``step``. ``template`` is a new run of the same configuration."""
    path = directory / f"step-{step:010d}.npz"
    saved = unpack(path)
    try:
        about = json.loads(saved["about"].tobytes())
        if about["format"] != FORMAT:
            raise ValueError(f"it has format {about['format']}, and this version reads format {FORMAT}")
        replay, count = template.replay, about["count"]
        facts = {name: np.array(column) for name, column in replay.facts._asdict().items()}
        for first, last, chunk in _chunks(directory, count, replay.capacity):
            rows = np.arange(first, last) % replay.capacity
            for name, column in facts.items():
                column[rows] = chunk[name]
        derived = []
        for name in ("learned_reward", "spread"):
            column = np.zeros(replay.capacity, np.float32)
            column[: min(count, replay.capacity)] = saved[f"replay/{name}"]
            derived.append(jax.numpy.array(column))
        replay = replay._replace(
            facts=Fact(**{name: jax.numpy.array(column) for name, column in facts.items()}),
            learned_reward=derived[0],
            spread=derived[1],
            count=jax.numpy.int32(count),
        )
        run = _fill(template._replace(replay=None), saved)._replace(replay=replay)
    except (KeyError, ValueError, TypeError) as error:
        raise Damaged(f"{path.name} is damaged ({error})") from error
    return run, about["progress"]


def standing(directory: Path) -> dict[str, Any] | None:
    """The progress in the newest checkpoint that can be read, without the rest of it; None if there is none."""
    for step in saved_steps(directory):
        with contextlib.suppress(Damaged, OSError, KeyError, ValueError):
            return json.loads(unpack(directory / f"step-{step:010d}.npz")["about"].tobytes())["progress"]
    return None


def newest(
    directory: Path, template: Callable[[], Run], tell: Callable[[str], None]
) -> tuple[int, Run, dict[str, Any]] | None:
    """The newest checkpoint that can be read as (step, run, progress); None if there is none.

    A damaged one is named through ``tell``, and the one before is tried. What is newer than the one that is read
    is deleted: it will be written again, and must not count among those that are kept. Raises `OSError`, and deletes
    nothing, if the system does not give one.
    """
    for leftover in directory.glob("*.tmp"):
        leftover.unlink()
    for step in saved_steps(directory):
        try:
            run, progress = restore(directory, step, template())
        except Damaged as error:
            tell(f"Checkpoint {error}; trying the one before.")
            continue
        for newer in saved_steps(directory):
            if newer > step:
                (directory / f"step-{newer:010d}.npz").unlink()
        for path in directory.glob("facts-*.npz"):
            match = _CHUNK.fullmatch(path.name)
            if match and int(match[2]) > int(run.replay.count):
                path.unlink()
        return step, run, progress
    return None


def _chunks(directory: Path, count: int, capacity: int) -> list[tuple[int, int, dict[str, np.ndarray]]]:
    """The chunks that hold rows ``max(0, count - capacity)`` to ``count``, checked to be complete."""
    found = sorted(
        (int(match[1]), int(match[2]), path)
        for path in directory.glob("facts-*.npz")
        if (match := _CHUNK.fullmatch(path.name)) and int(match[2]) <= count
    )
    wanted = max(0, count - capacity)
    covered, chunks = wanted, []
    for first, last, path in found:
        if last <= covered:
            continue
        if first > covered:
            break
        data = unpack(path)
        keep = max(first, wanted)
        chunks.append((keep, last, {name: column[keep - first :] for name, column in data.items()}))
        covered = last
    if covered != count:
        raise ValueError(f"facts from row {covered} on are missing")
    return chunks


def _leaves(tree: Any) -> dict[str, np.ndarray]:
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {"run" + jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in flat}


def _fill(tree: Any, saved: dict[str, np.ndarray]) -> Any:
    flat, structure = jax.tree_util.tree_flatten_with_path(tree)
    leaves = []
    for path, leaf in flat:
        value = saved["run" + jax.tree_util.keystr(path)]
        if value.shape != leaf.shape or value.dtype != leaf.dtype:
            raise ValueError(f"{jax.tree_util.keystr(path)} has another shape than the configuration says")
        leaves.append(jax.numpy.array(value))
    return jax.tree_util.tree_unflatten(structure, leaves)
