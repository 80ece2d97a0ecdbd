"""A run's directory: its files, their columns, and how long each was at a checkpoint (docs/run-directory.md).

CSV files are the truth; TensorBoard mirrors them. Nothing that depends on the clock is written outside
``timing.csv`` (whose length checkpoints remember), ``tensorboard/``, ``status.json`` and the time of an answer, so
equal seeds give equal files.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from senior import protocol
from senior.config import Config, differences, load, to_json
from senior.files import Damaged, hold, json_object, pack, unpack, write_atomically
from senior.tensorboard import Board
from senior.types import BadInput, EnvSpec

EVAL = ("step", "labels", "queried", "episodes", "success_rate", "return_mean", "return_std")
TRAIN = (
    "step",
    "episode",
    "episode_length",
    "episode_return",
    "episode_success",
    "learned_return",
    "queried",
    "labels",
    "reward_accuracy",
    "fit_accuracy",
    "fit_epochs",
    "outer_steps",
    "outer_loss",
    "refreshes",
    "beta",
    "intrinsic_mean",
    "bonus_mean",
    "curiosity_share",
    "recent_share",
    "batch_reward",
    "critic_loss",
    "actor_loss",
    "q",
    "alpha",
    "entropy",
)
TIMING = (
    "step",
    "seconds",
    "steps_per_second",
    "act",
    "environment",
    "update",
    "store",
    "session",
    "evaluate",
    "checkpoint",
)
TABLES = {"eval.csv": EVAL, "train.csv": TRAIN, "timing.csv": TIMING}
_CHECKPOINT = re.compile(r"step-(\d{10})\.npz")
HELD = "is being trained by another process"
"""Said of a run whose lock another process holds."""


class RunDirectory:
    """The open files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self._board: Board | None = None
        self._lock: int | None = None

    @property
    def preferences(self) -> Path:
        return self.path / "preferences.sqlite"

    @property
    def films(self) -> Path:
        """Where episodes are filmed that could not be lived through again."""
        return self.path / "label" / "live"

    def check_free(self) -> None:
        """`BadInput` if there is something in its place, beside what `create` leaves where it is killed."""
        with told(self.path):
            files = self.path.iterdir() if self.path.is_dir() else [self.path] if self.path.exists() else []
            taken = any(file.name != "config.json.tmp" for file in files)
        if taken:
            raise BadInput(f"{self.path} exists and is not empty; choose another --out, or resume the run in it.")

    def create(self, config: Config, protocol: Mapping[str, Any]) -> None:
        """A new directory; `BadInput` if there is something in its place or it cannot be written.

        ``config.json`` comes first: what is killed after it can be resumed.
        """
        self.check_free()
        with told(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            self.lock()
            content = {"config": to_json(config), "protocol": dict(protocol)}
            write_atomically(self.path / "config.json", (json.dumps(content, indent=2) + "\n").encode())

    def lock(self) -> None:
        """Keep other processes from training the same run; the lock goes with the process. `BadInput` if one does."""
        if self._lock is None:
            try:
                self._lock = hold(self.path)
            except BlockingIOError:
                self.close()
                raise BadInput(f"The run in {self.path} {HELD}.") from None

    def check_holds(self, config: Config) -> None:
        """`BadInput` if the run that is there is another one. Where it is computed may differ."""
        held = load(self.path / "config.json")
        differing = differences(replace(held, device=config.device), config)
        if differing:
            name, there, here = differing[0]
            others = f"; {', '.join(other for other, *_ in differing[1:])} differ too" if differing[1:] else ""
            raise BadInput(f"{self.path} holds another run: its {name} is {there}, not {here}{others}.")

    def check_beginning(self, first: int) -> None:
        """`BadInput` if the run was beyond its ``first`` checkpoint: it was not killed before it, but lost it."""
        at = 0
        with suppress(OSError, KeyError, ValueError), open(self.path / "eval.csv", newline="") as file:
            at = max([int(row["step"]) for row in csv.DictReader(file)], default=0)
        if at > first or is_finished(self.path):
            raise BadInput(
                f"The checkpoints of the run in {self.path} are gone, so it cannot go on. Its results are kept; to "
                "train it anew, name another directory."
            )

    def check_fits(self, spec: EnvSpec) -> None:
        """`BadInput` if the environment is no longer what the run began with."""
        now = protocol.of_environment(spec)
        for name, held in protocol.read(self.path).items():
            if name in now and now[name] != held:
                raise BadInput(
                    f"The environment {spec.name} has changed since the run in {self.path} began: its "
                    f"{name.replace('_', ' ')} was {held} and is {now[name]}."
                )

    def append(self, table: str, row: Mapping[str, Any]) -> None:
        """One row; numbers that are missing or None stay empty."""
        columns = TABLES[table]
        unknown = set(row) - set(columns)
        assert not unknown, f"{table} has no column {unknown}"
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow([_text(row.get(name)) for name in columns])
        with open(self.path / table, "a") as file:
            file.write(line.getvalue())
        if self._board is None:
            self._board = Board(self.path / "tensorboard")
        kind = table.removesuffix(".csv")
        self._board.add({f"{kind}/{name}": value for name, value in row.items() if name != "step"}, int(row["step"]))

    def warn(self, sentence: str) -> None:
        """Keep a health warning."""
        with open(self.path / "warnings.log", "a") as file:
            file.write(sentence + "\n")

    def note(self, sentence: str) -> None:
        """Keep what befell this machine and not the run: a worker that was replaced."""
        with open(self.path / "workers.log", "a") as file:
            file.write(f"{datetime.now(UTC).isoformat(timespec='seconds')} {sentence}\n")

    def tell(self, status: Mapping[str, Any]) -> None:
        """What the run is doing now, for whoever looks on. It need not outlive a crash of the machine."""
        new = self.path / "status.json.tmp"
        with suppress(OSError):  # what matters is told elsewhere
            new.write_text(json.dumps(status))
            os.replace(new, self.path / "status.json")

    def lengths(self) -> dict[str, int]:
        """Bytes in every append-only file, which are then on the disk."""
        found = {}
        for name in (*TABLES, "warnings.log"):
            with open(self.path / name, "rb+") as file:
                os.fsync(file.fileno())
                found[name] = file.seek(0, os.SEEK_END)
        return found

    def truncate(self, lengths: Mapping[str, int], step: int) -> None:
        """Cut the append-only files back to a checkpoint's lengths and forget snapshots after its step."""
        for name, columns in TABLES.items():
            if name in lengths:
                if (self.path / name).stat().st_size < lengths[name]:
                    raise BadInput(
                        f"{self.path / name} is shorter than it was at step {step}; it cannot be gone on with."
                    )
                os.truncate(self.path / name, lengths[name])
            else:
                (self.path / name).write_text(",".join(columns) + "\n")
        (self.path / "warnings.log").touch()
        os.truncate(self.path / "warnings.log", lengths.get("warnings.log", 0))
        for path in (self.path / "bonus").glob("step-*.npz"):
            if int(path.stem.removeprefix("step-")) > step:
                path.unlink()
        self._board = Board(self.path / "tensorboard", purge=step + 1)

    def snapshot(self, step: int, positions: np.ndarray, bonus: Mapping[str, np.ndarray]) -> None:
        """Add visited positions ``[n, d]`` to ``positions.npz``; what is behind f_P and f_E goes to ``bonus/``."""
        path = self.path / "positions.npz"
        try:
            kept = unpack(path) if path.exists() else {}
        except Damaged:
            kept = {}
        kept = {name: array for name, array in kept.items() if int(name.removeprefix("step-")) < step}
        write_atomically(path, pack({**kept, f"step-{step:010d}": positions}))
        if bonus:
            (self.path / "bonus").mkdir(exist_ok=True)
            write_atomically(self.path / "bonus" / f"step-{step:010d}.npz", pack(dict(bonus)))

    def save_policy(self, actor: Mapping[str, np.ndarray]) -> None:
        """The policy as it is now: weights and biases per layer."""
        (self.path / "policy").mkdir(exist_ok=True)
        write_atomically(self.path / "policy" / "actor.npz", pack(dict(actor)))

    def forget_everything(self) -> None:
        """Empty tables and nothing else: the beginning of a run, or of one killed before its first checkpoint."""
        self.truncate({}, -1)
        (self.path / "positions.npz").unlink(missing_ok=True)
        for name in ("checkpoints", "bonus", "policy"):
            shutil.rmtree(self.path / name, ignore_errors=True)

    def close(self) -> None:
        """Close the files and let go of the lock."""
        if self._board is not None:
            self._board.close()
            self._board = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Whatever the file system refuses there becomes a sentence."""
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        raise BadInput(f"{path} is, or lies in, a file where a directory should be.") from error
    except OSError as error:
        raise BadInput(f"{path} cannot be opened: {error.strerror or error}.") from error


def make_room(file: Path) -> None:
    """Make the folder of a file that will be written when work is done; `BadInput` now if that cannot be."""
    with told(file.parent):
        if file.is_dir():
            raise BadInput(f"{file} is a directory; name a file.")
        file.parent.mkdir(parents=True, exist_ok=True)


def is_run(path: Path) -> bool:
    """Whether there is a ``config.json`` of ours. One that is damaged may be, and is told when it is read."""
    try:
        content = json.loads((path / "config.json").read_bytes())
    except FileNotFoundError:
        return False
    except (OSError, ValueError, RecursionError):
        return True
    return isinstance(content, dict) and {"config", "protocol"} <= content.keys()


def find_runs(path: Path | str) -> list[Path]:
    """The run directories at or under a path, in order; `BadInput` if there is none."""
    path = Path(path)
    with told(path):
        if (path / "config.json").is_file():
            return [path]
        found = sorted(file.parent for file in path.glob("**/config.json") if is_run(file.parent))
    if not found:
        raise BadInput(f"There is no run in {path}: no config.json of a run at or below it.")
    return found


def only_run(path: Path | str) -> Path:
    """The run directory at or under a path; `BadInput` if there is none, or several."""
    found = find_runs(path)
    if len(found) > 1:
        raise BadInput(f"There are {len(found)} runs under {path}; name one of them.")
    return found[0]


def saved_steps(checkpoints: Path) -> list[int]:
    """Steps at which there are checkpoints in that folder of a run, newest first."""
    found = (_CHECKPOINT.fullmatch(path.name) for path in checkpoints.glob("step-*.npz"))
    return sorted((int(match[1]) for match in found if match), reverse=True)


def saved_step(path: Path) -> int:
    """The step of a run's newest checkpoint; -1: there is none."""
    return next(iter(saved_steps(path / "checkpoints")), -1)


def status(path: Path) -> dict[str, Any]:
    """What a run says that it is doing: phase, step, labels, success and so on; empty if nothing can be read."""
    return json_object(path / "status.json")


def is_finished(path: Path) -> bool:
    """Whether a run says that it is finished. One that is and does not say so is found out when it is opened."""
    return status(path).get("phase") == "finished"


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, (int, np.integer, str)):
        return str(value)
    return format(float(value), ".9g")
