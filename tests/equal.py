"""The small run that tests repeat, and whether two run directories hold the same, bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from senior.config import Config, Queries
from senior.files import unpack
from senior.rundir import saved_steps
from tests.small import preferences_dump, small


def short(task: str = "point", **changes: Any) -> Config:
    """Pre-training until 400, sessions at 400 and 600 and a cut one at 800, evaluations at 500 and 1000.

    Snapshots are taken at 300, 600, 900 and 1000. Episodes have 50 steps: of the checkpoints, every 130 steps and at
    the end, all but 650 and the last lie in the middle of one. The replay overwrites its oldest rows from step 700 on.
    """
    config = small(
        task=task,
        steps=1000,
        horizon=50,
        replay_capacity=700,
        checkpoint_every=130,
        snapshot_every=300,
        queries=Queries(budget=25, per_session=10, every=200, segment=10, episodes=12, pool=10),
    )
    return replace(config, **changes)


_OPTIONS = """
--task point --method m-senior --steps 1000 --horizon 50 --replay-capacity 700 --checkpoint-every 130
--snapshot-every 300 --budget 25 --per-session 10 --session-every 200 --segment 10 --candidate-episodes 12
--pool 10 --networks.layers 1 --networks.width 32 --networks.reward-layers 1 --networks.reward-width 32
--sac.batch 64 --sac.actor-rate 3e-3 --sac.critic-rate 3e-3 --sac.alpha-rate 3e-3 --sac.tau 0.02
--sac.discount 0.9 --sac.reset-updates 20 --pretraining.random-steps 100 --pretraining.until 400
--reward.epochs 50 --reward.rate 3e-3 --reward.batch 16 --pge.capacity 100 --refresh-every 100
--outer-every 200 --evaluation.every 500 --evaluation.episodes 5 --device cpu
"""
OPTIONS = _OPTIONS.split()
"""What `senior train` is given for `short`."""


def arrays_of(run: Path) -> dict[str, np.ndarray]:
    """What the newest checkpoint holds, by name."""
    return unpack(run / "checkpoints" / f"step-{saved_steps(run / 'checkpoints')[0]:010d}.npz")


def progress_of(run: Path) -> dict[str, Any]:
    """What the newest checkpoint knows of a run beside its arrays."""
    return json.loads(arrays_of(run)["about"].tobytes())["progress"]


def assert_same_run(one: Path, other: Path, interrupted: bool) -> None:
    """All that both runs wrote is equal, but for what the clock says.

    ``interrupted``: one of them was, so that it may have cut its replay into other chunks, and only what its newest
    checkpoint holds is compared.
    """
    for name in ("eval.csv", "train.csv", "warnings.log"):
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    assert preferences_dump(one) == preferences_dump(other)
    assert _progress(one, interrupted) == _progress(other, interrupted)
    left, right = _arrays(one, interrupted), _arrays(other, interrupted)
    assert left.keys() == right.keys()
    for name, array in left.items():
        assert array.dtype == right[name].dtype, name
        assert array.tobytes() == right[name].tobytes(), f"{name} differs between {one} and {other}"


def _progress(run: Path, interrupted: bool) -> dict[str, Any]:
    progress = progress_of(run)
    del progress["lengths"]["timing.csv"]
    if interrupted:
        del progress["written"]
    return progress


def _arrays(run: Path, interrupted: bool) -> dict[str, np.ndarray]:
    last = f"step-{saved_steps(run / 'checkpoints')[0]:010d}.npz"
    found, facts = {}, []
    for path in sorted(run.rglob("*.npz")):
        where = str(path.relative_to(run))
        if path.name.startswith("facts-") and interrupted:
            facts.append((int(path.stem.split("-")[1]), unpack(path)))
        elif not (interrupted and path.parent.name == "checkpoints" and path.name != last):
            found.update({f"{where}/{name}": array for name, array in unpack(path).items() if name != "about"})
    for first, chunk in facts:
        for name, column in chunk.items():
            found.update({f"facts/{first + i}/{name}": row for i, row in enumerate(column)})
    return found
