"""One run directory as data: what it is, what it scored, and what its numbers depend on.

An *arm* is what is averaged over seeds: runs of one task and method with its options, whose *fingerprint* agrees, which
holds all else that a number depends on (`APART`, `PROTOCOL` and `PACKAGES`; docs/report.md says what it leaves out).

Imports no JAX.
"""

from __future__ import annotations

import csv
import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from senior.config import Config, from_json, to_json
from senior.preference_file import BUSY_SECONDS, SCHEMA_VERSION, Foretold, foretold
from senior.report.names import label, normal, options
from senior.types import BadInput

APART = ("seed", "device", "checkpoint_every", "snapshot_every")
"""Fields of the configuration that no number depends on."""
PROTOCOL = ("reward_version", "horizon", "observation_size")
"""Of the protocol, what numbers depend on,"""
PACKAGES = ("senior-rl", "metaworld", "mujoco")
"""and the packages whose versions do."""
PREFERENCES = "preferences.sqlite"
NOT_TOLD = "not told"
Fingerprint = tuple[tuple[str, str], ...]
"""All that a number depends on, as names and values."""


class Unusable(Exception):
    """Why a run or a file of it is left out, in a sentence."""


class LeftOut(NamedTuple):
    """A run, or a file of one, that is not in the report."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Arm:
    """What is averaged over seeds."""

    task: str
    """Or the environment."""
    name: str
    """The method with its options."""
    fingerprint: Fingerprint
    suffix: str = ""
    """What tells it apart from other arms of that name on its task."""

    @property
    def label(self) -> str:
        """What it is called. It stands for the same in all tasks."""
        return f"{self.name} [{self.suffix}]" if self.suffix else self.name

    def __str__(self) -> str:
        return f"{self.label} on {self.task}"


class Evaluations(NamedTuple):
    """Columns of ``eval.csv``, each ``[evaluations]``."""

    step: np.ndarray
    labels: np.ndarray
    queried: np.ndarray
    episodes: np.ndarray
    success: np.ndarray | None
    """Share of the episodes, in [0, 1]; None where the environment tells no success."""
    returns: np.ndarray
    """Mean true return."""


class Episodes(NamedTuple):
    """Columns of ``train.csv``, each ``[episodes]``; NaN where a cell is empty."""

    step: np.ndarray
    """At its end."""
    episode_return: np.ndarray
    episode_success: np.ndarray
    learned_return: np.ndarray
    queried: np.ndarray


Told = TypeVar("Told", Evaluations, Episodes)


@dataclass(frozen=True, eq=False)
class Run:
    """A run directory."""

    path: Path
    arm: Arm
    seed: int
    method: str
    """Name of its row, without options."""
    steps: int
    """That it is to take, or up to which it is looked at."""
    main_phase: int
    """The step at which pre-training ends."""
    asks: bool
    """False for plain SAC."""
    config: Config | None
    """None where this version cannot read it."""
    protocol: Mapping[str, Any]
    evaluation: Evaluations
    episodes: Episodes | None
    """None where ``train.csv`` cannot be read."""
    foretold: Sequence[Foretold] | None
    """None where nobody is asked, or ``preferences.sqlite`` cannot be read; empty where it is not there."""
    seconds: float | None
    """Wall time of training up to the last evaluation, pauses between processes left out; None where not told."""

    @property
    def step(self) -> int:
        """Of the last evaluation."""
        return int(self.evaluation.step[-1])

    @property
    def finished(self) -> bool:
        return self.step >= self.steps

    @property
    def score(self) -> np.ndarray:
        """What is compared ``[evaluations]``: success rates, or true returns where success is not told."""
        return self.evaluation.returns if self.evaluation.success is None else self.evaluation.success

    def score_at(self, step: int) -> float:
        """Of the last evaluation up to that step; NaN if the run has not come so far or was not evaluated yet."""
        place = int(np.searchsorted(self.evaluation.step, step, side="right")) - 1
        return float(self.score[place]) if place >= 0 and self.step >= step else math.nan


def read_run(path: Path, known: dict[str, Config | None], left_out: list[LeftOut]) -> Run:
    """The run in a directory.

    known: configurations that were read before, of other seeds; more are added. left_out: files of the run that a
    report can do without are added where they cannot be read. Raises `Unusable` where the run cannot be reported.
    """
    try:
        content = json.loads((path / "config.json").read_bytes())
        given, protocol = content["config"], content["protocol"] or {}
        seed, steps, method = int(given["seed"]), int(given["steps"]), str(given["method"]["name"])
        task = str(given.get("env") or given["task"])
        asks = given["method"]["select"] != "none"
        main_phase = int(given["pretraining"]["until"])
        config = _config(given, known)
        fingerprint = _fingerprint(given if config is None else to_json(normal(config)), protocol)
    except OSError as error:
        raise Unusable(f"config.json cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise Unusable(f"config.json is damaged: {error}") from error
    arm = Arm(task, method if config is None else label(config), fingerprint)
    evaluation = _evaluations(path / "eval.csv")
    return Run(
        path,
        arm,
        seed,
        method,
        steps,
        main_phase,
        asks,
        config,
        protocol,
        evaluation,
        _or_none(_episodes, path / "train.csv", left_out),
        _or_none(_foretold, path / PREFERENCES, left_out) if asks else None,
        _or_none(_seconds, path / "timing.csv", left_out),
    )


def up_to(run: Run, step: int, left_out: list[LeftOut]) -> Run:
    """A run as if it had ended at that step. Raises `Unusable` where it was not evaluated there."""
    told, episodes, seconds = run.evaluation, run.episodes, run.seconds
    if run.step < step:
        raise Unusable(f"it stands at step {run.step:,}, before {step:,}")
    if step not in told.step:
        raise Unusable(f"it was not evaluated at step {step:,}")
    if seconds is not None:
        seconds = _or_none(lambda path: _seconds(path, step), run.path / "timing.csv", left_out)
    return replace(
        run,
        steps=step,
        evaluation=_rows(told, told.step <= step),
        episodes=None if episodes is None else _rows(episodes, episodes.step <= step),
        foretold=None if run.foretold is None else [one for one in run.foretold if one.step < step],
        seconds=seconds,
    )


def _rows(told: Told, chosen: np.ndarray) -> Told:
    return told._make(None if column is None else column[chosen] for column in told)


def _config(given: dict[str, Any], known: dict[str, Config | None]) -> Config | None:
    """The configuration, read once for all seeds; None if it is of another version's form."""
    key = json.dumps({**given, "seed": 0}, sort_keys=True)
    if key not in known:
        try:
            known[key] = from_json(given)
        except BadInput:
            known[key] = None
    found = known[key]
    return None if found is None else replace(found, seed=int(given["seed"]))


def _fingerprint(config: dict[str, Any], protocol: dict[str, Any]) -> Fingerprint:
    """Options by their names, then what the protocol adds."""
    entries = []
    for dotted, value in _flat(config, ""):
        if dotted not in APART:
            option = options().get(dotted)
            entries.append((option.name if option else f"--{dotted}", str(value)))
    versions = protocol.get("packages") or {}
    entries += [(name.replace("_", " "), _text(protocol.get(name))) for name in PROTOCOL]
    entries += [(name, _text(versions.get(name))) for name in PACKAGES]
    return tuple(entries)


def _flat(group: dict[str, Any], before: str) -> Iterator[tuple[str, Any]]:
    for name, value in sorted(group.items()):
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield before + name, value


def _text(value: Any) -> str:
    return NOT_TOLD if value is None else str(value)


def _or_none(read_file: Any, path: Path, left_out: list[LeftOut]) -> Any:
    """What a file holds that a report can do without; None, and told, where it cannot be read."""
    try:
        return read_file(path)
    except Unusable as reason:
        left_out.append(LeftOut(path, str(reason)))
        return None


def columns(path: Path, needed: Sequence[str], welcome: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Columns of a CSV file as numbers, NaN where a cell is empty, or of a ``welcome`` column that is missing.

    A last line without an end is being written, and does not count. Raises `Unusable` with the reason.
    """
    try:
        text = path.read_text()
        lines = text.split("\n")[:-1]
        rows = list(csv.reader(lines))
    except FileNotFoundError:
        raise Unusable(f"{path.name} is missing") from None
    except OSError as error:
        raise Unusable(f"{path.name} cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise Unusable(f"{path.name} is damaged: {error}") from error
    if not rows:
        raise Unusable(f"{path.name} is empty")
    head, *rows = rows
    missing = [name for name in needed if name not in head]
    if missing:
        raise Unusable(f"{path.name} is damaged: it has no column {missing[0]}")
    for number, row in enumerate(rows, 2):
        if len(row) != len(head):
            raise Unusable(f"{path.name} is damaged: line {number} has {len(row)} cells, not {len(head)}")
    try:
        return {
            name: np.array([float(row[place]) if row[place] else math.nan for row in rows])
            if (place := head.index(name) if name in head else -1) >= 0
            else np.full(len(rows), math.nan)
            for name in (*needed, *welcome)
        }
    except ValueError as error:
        raise Unusable(f"{path.name} is damaged: {error}") from error


@contextmanager
def preferences_in(path: Path) -> Iterator[sqlite3.Connection]:
    """A preference file, to be read: nothing is left beside it. Whatever is wrong with it is raised as `Unusable`."""
    # while a run writes it there is a log beside it; without one, opening it would make one
    how = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True, timeout=BUSY_SECONDS)) as db:
            version = db.execute("PRAGMA user_version").fetchone()[0]
            if version != SCHEMA_VERSION:
                raise Unusable(f"{path.name} has schema version {version}; this program reads {SCHEMA_VERSION}")
            yield db
    except (sqlite3.Error, ValueError, TypeError, AttributeError) as error:
        raise Unusable(f"{path.name} is damaged: {error}") from error


def _foretold(path: Path) -> list[Foretold]:
    if not path.exists():
        return []
    with preferences_in(path) as db:
        return foretold(db)


def _evaluations(path: Path) -> Evaluations:
    needed = ("step", "labels", "queried", "episodes", "return_mean", "success_rate")
    found = columns(path, needed)
    step, success = found["step"], found["success_rate"]
    if not len(step):
        raise Unusable("it was not evaluated yet")
    if not all(np.isfinite(found[name]).all() for name in needed[:-1]):
        raise Unusable(f"{path.name} is damaged: cells are missing")
    if not (found["episodes"] >= 1).all():
        raise Unusable(f"{path.name} is damaged: an evaluation has no episode")
    if not (np.diff(step) > 0).all():
        raise Unusable(f"{path.name} is damaged: its steps do not increase")
    told = ~np.isnan(success)
    if told.any() and not (told.all() and ((success >= 0) & (success <= 1)).all()):
        raise Unusable(f"{path.name} is damaged: success rates are missing or not between 0 and 1")
    return Evaluations(
        step,
        found["labels"],
        found["queried"],
        found["episodes"],
        success if told.any() else None,
        found["return_mean"],
    )


def _episodes(path: Path) -> Episodes:
    found = columns(path, ("step", "episode_return"), Episodes._fields)
    return Episodes(*(found[name] for name in Episodes._fields))


def _seconds(path: Path, until: float = math.inf) -> float:
    """The clock begins anew with every process that goes on with the run, and then does not fit the rate.

    What the process before it took after its last row is not told; such steps count at the rate of the new one.
    """
    told = columns(path, ("step", "seconds"), ("steps_per_second",))
    told = {name: column[told["step"] <= until] for name, column in told.items()}
    clock = told["seconds"]
    if not len(clock) or not np.isfinite(clock).all():
        raise Unusable(f"{path.name} tells no time")
    gone, expected = np.diff(clock, prepend=0.0), np.diff(told["step"], prepend=0.0) / told["steps_per_second"]
    went_on = np.where(np.isnan(expected), gone >= 0, np.isclose(gone, expected, rtol=1e-3))
    return float(np.where(went_on, gone, np.where(np.isfinite(expected), expected, clock)).sum())
