"""Methods side by side: success against steps and against labels, with intervals, as a table and a figure.

    python -m senior.report.compare runs/methods --out results/methods

reads every finished run at or below the directories, groups them by method, and writes ``table.md``, ``table.csv`` (one
row per run) and ``curves.png``. Runs of one method must be alike but for their seeds. An area under a curve is the mean
success over it, in [0, 1]; against labels it counts asked pairs, skipped ones too, and ends at the budget. Intervals
are of the mean over seeds, 95 %, by the bootstrap (percentiles, 10,000 resamples, seed 0).
"""

from __future__ import annotations

import argparse
import csv
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from scipy import stats

matplotlib.use("Agg")

from matplotlib.figure import Figure

from senior.report.curves import read_table
from senior.types import BadInput


@dataclass(frozen=True)
class Run:
    """What is compared of one finished run."""

    path: Path
    method: str
    task: str
    seed: int
    config: dict[str, Any]
    steps: np.ndarray
    queried: np.ndarray
    success: np.ndarray

    @property
    def asks(self) -> bool:
        return self.config["method"]["select"] != "none"

    @property
    def area_by_steps(self) -> float:
        """Mean success over the steps from the first evaluation to the last."""
        return _mean_over(self.steps, self.success)

    @property
    def area_by_labels(self) -> float:
        """Mean success over the asked pairs from none to the budget; NaN if none are asked.

        With each number of pairs counts the success at the first evaluation that had so many.
        """
        if not self.asks:
            return float("nan")
        queried, first = np.unique(self.queried, return_index=True)
        return _mean_over(queried, self.success[first])


def _mean_over(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.trapezoid(y, x) / (x[-1] - x[0])) if x[-1] > x[0] else float(y[-1])


def read(path: Path) -> Run | None:
    """A run directory as a `Run`; None if it is not finished or tells no success."""
    config = json.loads((path / "config.json").read_text())["config"]
    table = {name: np.array(column) for name, column in read_table(path / "eval.csv").items()}
    if not table or table["step"][-1] != config["steps"] or np.isnan(table["success_rate"]).any():
        return None
    return Run(
        path,
        config["method"]["name"],
        config["env"] or config["task"],
        config.pop("seed"),
        config,
        table["step"],
        table["queried"],
        table["success_rate"],
    )


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean over seeds, and the 95 % bootstrap interval of it (the mean thrice if all values are equal or one)."""
    mean = float(np.mean(values))
    if len(set(values)) < 2:
        return mean, mean, mean
    found = stats.bootstrap((np.asarray(values),), np.mean, n_resamples=10_000, method="percentile", rng=0)
    return mean, float(found.confidence_interval.low), float(found.confidence_interval.high)


def compare(places: Sequence[Path], out: Path) -> str:
    """Write table and figure of all finished runs below ``places`` into ``out``; returns the table.

    Raises `BadInput` if there are none, or if they are of several tasks.
    """
    found = [read(file.parent) for place in places for file in sorted(place.glob("**/config.json"))]
    runs = [run for run in found if run is not None]
    if not runs:
        raise BadInput(f"There is no finished run with a success rate in {', '.join(map(str, places))}.")
    tasks = sorted({run.task for run in runs})
    if len(tasks) > 1:
        raise BadInput(f"These runs are of several tasks ({', '.join(tasks)}); compare those of one.")
    groups: dict[str, list[Run]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.seed):
        groups[run.method].append(run)
        first = groups[run.method][0]
        for name in run.config:
            if run.config[name] != first.config.get(name):
                raise BadInput(f"{first.path} and {run.path} differ in {name}; only runs that are alike make one row.")
    out.mkdir(parents=True, exist_ok=True)
    _write_rows(runs, out / "table.csv")
    text = _table(groups)
    (out / "table.md").write_text(text)
    _draw(groups, tasks[0], out / "curves.png")
    return text


def _write_rows(runs: Sequence[Run], path: Path) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("method", "seed", "last_success", "area_by_steps", "area_by_labels"))
        for run in sorted(runs, key=lambda run: (run.method, run.seed)):
            areas = (f"{area:.4f}" for area in (run.area_by_steps, run.area_by_labels))
            writer.writerow((run.method, run.seed, f"{run.success[-1]:.2f}", *areas))


def _table(groups: dict[str, list[Run]]) -> str:
    lines = ["| method | seeds | last success | area by steps | area by labels |", "|---|---|---|---|---|"]

    def cell(values: list[float]) -> str:
        if np.isnan(values).any():
            return "-"
        return "{:.2f} [{:.2f}, {:.2f}]".format(*interval(values))

    for method, runs in _by_area(groups):
        cells = [
            cell([float(run.success[-1]) for run in runs]),
            cell([run.area_by_steps for run in runs]),
            cell([run.area_by_labels for run in runs]),
        ]
        lines.append(f"| `{method}` | {', '.join(str(run.seed) for run in runs)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _draw(groups: dict[str, list[Run]], task: str, path: Path) -> None:
    """A row of panels against steps and one against labels, a column per method: every run, their mean and interval."""
    figure = Figure(figsize=(2.1 * len(groups) + 0.8, 4.8), layout="constrained")
    panels = figure.subplots(2, len(groups), sharex="row", sharey=True, squeeze=False)
    for (method, runs), by_steps, by_labels in zip(_by_area(groups), *panels, strict=True):
        shared = runs[0].steps
        if any(list(run.steps) != list(shared) for run in runs):
            raise BadInput(f"The runs of {method} were not evaluated at the same steps.")
        success = np.array([run.success for run in runs])
        _panel(by_steps, shared / 1000, success)
        by_steps.set_title(f"{method} ({len(runs)})")
        if runs[0].asks:
            labels, first = np.unique(runs[0].queried, return_index=True)
            _panel(by_labels, labels, success[:, first])
        else:
            by_labels.text(0.5, 0.5, "asks nobody", transform=by_labels.transAxes, ha="center", color="gray")
    panels[0, 0].set(ylabel="success rate", ylim=(-0.03, 1.03))
    panels[1, 0].set(ylabel="success rate")
    figure.supxlabel("above: thousand environment steps; below: pairs asked, at the first evaluation with so many")
    figure.suptitle(f"{task}: every run, their mean and its 95 % interval")
    figure.savefig(path, dpi=110)


def _panel(axis: Any, x: np.ndarray, success: np.ndarray) -> None:
    """``success``: [run, point]."""
    points = np.array([interval(list(column)) for column in success.T])
    axis.plot(x, success.T, color="C0", alpha=0.3, linewidth=0.8)
    axis.plot(x, points[:, 0], color="C0", linewidth=2)
    axis.fill_between(x, points[:, 1], points[:, 2], color="C0", alpha=0.15, linewidth=0)
    axis.grid(alpha=0.3)


def _by_area(groups: dict[str, list[Run]]) -> list[tuple[str, list[Run]]]:
    """Methods by their mean area over the steps, the largest first."""
    return sorted(groups.items(), key=lambda group: -interval([run.area_by_steps for run in group[1]])[0])


def main() -> None:
    """The command line above."""
    parser = argparse.ArgumentParser(description="Methods side by side: a table and a figure.")
    parser.add_argument("runs", nargs="+", type=Path, help="run directories, or directories that hold some")
    parser.add_argument("--out", type=Path, required=True, help="directory for table.md, table.csv and curves.png")
    options = parser.parse_args()
    try:
        print(compare(options.runs, options.out), end="")
    except BadInput as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
