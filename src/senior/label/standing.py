"""How a run stands, in words and numbers for the people who teach it. Imports no JAX."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from senior.config import Config
from senior.envs.metaworld import TASKS
from senior.label.desk import Assignment, Desk
from senior.rundir import status


@dataclass(frozen=True)
class Standing:
    """What there is to tell of one run."""

    path: Path
    config: Config
    desk: Desk

    @property
    def title(self) -> str:
        """Which run it is, in a few words."""
        return f"{self.config.environment}, {self.config.method.name}, seed {self.config.seed}"

    @property
    def goal(self) -> str:
        """What the robot is to do: as somebody wrote it for this run, else the task's own sentence."""
        task = None if self.config.env else TASKS.get(self.config.task)
        return self.desk.note("goal") or (task.sentence if task else "Reach the goal")

    def state(self, annotator: str | None) -> dict[str, Any]:
        """How everything stands, for one person."""
        progress = self.desk.progress()
        progress["labels"]["budget"] = self.config.queries.budget
        doing, session = trainer(self.path), progress["labels"]["session"]
        if doing["phase"] == "waiting" and session and session["done"] >= session["size"]:
            doing["text"] = "All of this session is answered; training goes on in a moment."
        people = [{"name": who["name"], "answers": who["answers"]} for who in self.desk.annotators()]
        told = {
            "run": self.title,
            "identity": self.desk.identity(),
            "goal": self.goal,
            **progress,
            "trainer": doing,
            "annotators": people,
            "strength": True,
        }
        return told if annotator is None else {**told, "you": self.desk.own(annotator)}

    def turn(self, annotator: str, said: dict[str, Any] | None = None) -> dict[str, Any]:
        """The pair that somebody is to look at, or why there is none."""
        state = self.state(annotator)
        phase, labels, why = state["trainer"]["phase"], state["labels"], None
        # a session that nobody waited for may be left when training ends; its answers would teach nobody
        assignment = Assignment(None, [], "finished") if phase == "finished" else self.desk.assign(annotator)
        kind = assignment.kind
        if kind is not None:
            kind = phase if kind == "waiting" and phase in ("finished", "stopped") else kind
            why = {
                "drawing": "The next clips are being drawn.",
                "others": "The pairs that are left are for others to answer.",
                "waiting": "Training goes on with them by itself."
                if labels["done"] >= labels["budget"]
                else "There is nothing to answer now. The next pairs come when training has gone on.",
                "finished": "All is done: training has finished.",
                "stopped": state["trainer"]["text"],
            }[kind]
        return {
            "pair": assignment.pair,
            "ahead": assignment.ahead,
            "kind": kind,
            "why": why,
            "state": state,
            "said": said,
        }

    def overview(self) -> dict[str, Any]:
        """Who answered, how far people agree, and how the run learns."""
        from senior.label import agreement  # brings statistics that take seconds to import

        steps, success, returns = _curve(self.path / "eval.csv")
        sessions = self.desk.foretold()
        return {
            "run": self.title,
            "goal": self.goal,
            "agreement": agreement.summary(self.desk.said()),
            "annotators": self.desk.annotators(),
            "curve": {"step": steps, "success": success, "return": returns},
            "prospective": {
                "step": [one.step for one in sessions],
                "accuracy": [one.right / one.decided for one in sessions],
                "pairs": [one.decided for one in sessions],
            },
        }


def trainer(run: Path) -> dict[str, Any]:
    """What the trainer is doing: phase and a sentence."""
    try:
        told = status(run)
        phase, step, steps = told["phase"], told["step"], told["steps"]
    except KeyError:
        return {"phase": "starting", "text": "The run has not begun."}
    if phase == "finished":
        return {"phase": phase, "text": f"Training has finished, after {step:,} steps."}
    if phase == "stopped" or not _is_alive(told.get("process")):
        why = f" ({told['failure']})" if told.get("failure") else ""
        text = (
            f"Training stands still at step {step:,}{why}. Answers are kept; they are learned from when it goes on: "
            f"senior resume {run}"
        )
        return {"phase": "stopped", "text": text}
    rate = f", {told['steps_per_second']:,.0f} a second" if told.get("steps_per_second") else ""
    words = {
        "starting": "The run is starting.",
        "pretraining": f"The robot is trying things out: step {step:,} of {steps:,}{rate}.",
        "training": f"Training: step {step:,} of {steps:,}{rate}.",
        "waiting": f"Training waits for your answers at step {step:,} of {steps:,}.",
        "evaluating": f"The policy is being judged at step {step:,} of {steps:,}.",
    }
    return {"phase": phase, "text": words.get(phase, phase)}


def _is_alive(process: Any) -> bool:
    try:
        os.kill(int(process), 0)
    except PermissionError:
        return True
    except (OSError, ValueError, TypeError):
        return False
    return True


def _curve(path: Path) -> tuple[list[int], list[float] | None, list[float]]:
    """Steps, success rates (None if none is told) and returns of the evaluations so far."""
    try:
        with open(path, newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["return_mean"]]
        told = all(row["success_rate"] for row in rows)
        return (
            [int(row["step"]) for row in rows],
            [float(row["success_rate"]) for row in rows] if told else None,
            [float(row["return_mean"]) for row in rows],
        )
    except (OSError, ValueError, KeyError):  # a row that is being written
        return [], None, []
