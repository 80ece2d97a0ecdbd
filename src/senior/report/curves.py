"""The learning curve of one run as a picture."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from matplotlib.figure import Figure


def read_table(path: Path) -> dict[str, list[float]]:
    """A CSV file of a run directory by column; empty cells are NaN."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    names = rows[0] if rows else {}
    return {name: [float(row[name] or "nan") for row in rows] for name in names}


def learning_curve(run: Path, out: Path | None = None) -> Path:
    """Success (or true return) of every evaluation and the labels spent by then, as PNG.

    ``out`` defaults to ``run/plots/learning-curve.png``; returns it.
    """
    out = out or run / "plots" / "learning-curve.png"
    out.parent.mkdir(parents=True, exist_ok=True)
    evaluations = read_table(run / "eval.csv")
    config = json.loads((run / "config.json").read_text())["config"]
    told = any(value == value for value in evaluations.get("success_rate", []))

    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axis = figure.subplots()
    column, label = ("success_rate", "success rate") if told else ("return_mean", "mean true return")
    axis.plot(evaluations.get("step", []), evaluations.get(column, []), color="tab:blue", marker=".", label=label)
    axis.set(xlabel="environment steps", ylabel=label, xlim=(0, config["steps"]))
    if told:
        axis.set_ylim(-0.03, 1.03)
    axis.grid(alpha=0.3)
    if config["method"]["select"] != "none":
        labels = axis.twinx()
        labels.step(
            evaluations.get("step", []),
            evaluations.get("labels", []),
            where="post",
            color="tab:gray",
            alpha=0.7,
        )
        labels.set_ylabel("labels", color="tab:gray")
        labels.set_ylim(0, config["queries"]["budget"] * 1.03)
    task = config["env"] or config["task"]
    episodes = int(evaluations["episodes"][-1]) if evaluations else 0
    axis.set_title(f"{config['method']['name']} on {task}, seed {config['seed']} ({episodes} episodes a point)")
    figure.savefig(out, dpi=150)
    return out
