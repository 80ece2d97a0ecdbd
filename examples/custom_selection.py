"""Ask about pairs of your own choice: here, of those whose hands end farthest apart.

    python examples/custom_selection.py

takes half a minute, enough to see that everything fits together. A selection rule is any function like `far_apart`,
and is named as module:name, on the command line too, in the directory of this file:

    senior train --task door-close --method pebble --select custom_selection:far_apart --out runs/far-apart
"""

import sqlite3
from dataclasses import replace

import numpy as np

from senior import METHODS, Context, Selection, preset, train


def far_apart(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """Choose n rows of the pool of candidate pairs; the first session of a run is uniform, whatever the rule."""
    ends = context.positions[:, :, -1]  # [pairs, 2, d]: the hand at the end of both segments
    distance = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1)
    best = np.argsort(-distance)[:n]
    return Selection(best, {"distance": distance[best]})  # scores are kept with the pairs


if __name__ == "__main__":
    config = preset("quick", "point", "pebble")
    config = replace(
        config,
        method=replace(METHODS["pebble"], select="custom_selection:far_apart"),
        steps=1200,
        pretraining=replace(config.pretraining, random_steps=200, until=500),
        queries=replace(config.queries, budget=40, per_session=20, every=500),
    )
    (result,) = train(config, out="runs/far-apart")

    with sqlite3.connect(result.path / "preferences.sqlite") as pairs:
        asked = pairs.execute("SELECT session, scores FROM pairs ORDER BY id").fetchall()
    print(f"{result.path}: {result.labels} labels; the last pair was asked in session {asked[-1][0]}: {asked[-1][1]}")
