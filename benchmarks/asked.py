"""What runs on handle-press asked about after their first session, a row a run.

    python benchmarks/asked.py runs/evidence/handle-press > asked.csv

of_pretraining: share of the segments that are of the first 20 episodes. pairs_with_one_pressed: pairs of which exactly
one segment ends with the handle pressed (its last true reward is 10). segments_pressed_after_pretraining: share of
those that do, of the segments of later episodes.
"""

from __future__ import annotations

import csv
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np

EPISODES = 20
"""Of 500 steps, in 10,000 of pre-training."""
PRESSED = 9.99

rows = csv.writer(sys.stdout, lineterminator="\n")
head = ("arm", "seed", "pairs", "of_pretraining", "pairs_with_one_pressed", "segments_pressed_after_pretraining")
rows.writerow(head)
for run in sorted(Path(sys.argv[1]).glob("*/seed-*")):
    with closing(sqlite3.connect(f"file:{run.resolve()}/preferences.sqlite?mode=ro", uri=True)) as db:
        asked = db.execute("SELECT episode_0, episode_1, reward FROM pairs WHERE session > 0 ORDER BY id").fetchall()
    if not asked:
        continue
    early = np.array([row[:2] for row in asked]) < EPISODES
    pressed = np.stack([np.frombuffer(row[2], "<f4").reshape(2, -1)[:, -1] for row in asked]) > PRESSED
    counted = len(asked), f"{early.mean():.3f}", int((pressed.sum(axis=1) == 1).sum()), f"{pressed[~early].mean():.3f}"
    rows.writerow((run.parent.name, run.name[5:], *counted))
