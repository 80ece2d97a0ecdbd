"""Success at step 45,000 of every door-close run, of the CPU and of the GPU: python pooled.py, in this folder.

A seed that was trained on both counts twice: its runs share no more than their number.
"""

import csv
from itertools import combinations
from pathlib import Path

import numpy as np

from senior.report.statistics import improvement, mean_interval

STEP, EPISODES = 45_000, 10
PLACES = [Path(name) / "door-close" for name in ("runs", "gpu-runs")]


def scores(arm: str) -> list[float]:
    """Success rates, one per run."""
    found = []
    for file in sorted(file for place in PLACES for file in (place / arm).glob("seed-*/eval.csv")):
        with file.open(newline="") as lines:
            found += [float(row["success_rate"]) for row in csv.DictReader(lines) if int(row["step"]) == STEP]
    return found


arms = {arm.name: scores(arm.name) for arm in sorted(PLACES[0].iterdir())}
better = improvement({name: [np.array(found)] for name, found in arms.items()})
with open("door-close-45k-pooled.csv", "w", newline="") as file:
    table = csv.writer(file, lineterminator="\n")
    table.writerow(("arm", "runs", "success", "low, 90 %", "high, 90 %"))
    for name, found in sorted(arms.items(), key=lambda arm: -np.mean(arm[1])):
        table.writerow((name, len(found), *(f"{number:.3f}" for number in mean_interval(found, EPISODES))))
with open("door-close-45k-pooled-improvement.csv", "w", newline="") as file:
    table = csv.writer(file, lineterminator="\n")
    table.writerow(("better", "worse", "probability", "low, 95 %", "high, 95 %"))
    for pair in combinations(arms, 2):
        table.writerow((*pair, *(f"{number:.3f}" for number in better[pair])))
