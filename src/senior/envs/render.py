"""Videos of episodes: ``python -m senior.envs.render REQUEST.npz OUT.mp4``, or `record` from a program.

An episode is lived through again from its seed and its actions, and drawn on the way. This happens in a
process of its own, because OpenGL's backend is chosen when MuJoCo is imported, and training chooses none.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from senior.envs.drawing import Film, NoVideo, camera, drawable, own_fps
from senior.processes import PYTHON, importing_alike
from senior.types import BadInput

SIDE = 480  # pixels of a Meta-World frame
MOST_FPS = 40
NO_VIDEO = 3  # exit code


@dataclass(frozen=True)
class Request:
    """One episode to be drawn: its seed, its actions and what was observed after each, and the arguments of
    `senior.envs.make`."""

    seed: int
    actions: np.ndarray  # float32 [T, a]
    observations: np.ndarray  # float32 [T, o]
    task: str | None = None
    env: str | None = None
    position: str | None = None
    length_scale: float | None = None
    horizon: int | None = None

    def write(self, path: Path) -> None:
        """Write it as an NPZ file, without pickle."""
        given = {
            "task": self.task,
            "env": self.env,
            "position": self.position,
            "length_scale": self.length_scale,
            "horizon": self.horizon,
        }
        with path.open("wb") as file:
            lived = {"seed": self.seed, "actions": self.actions, "observations": self.observations}
            np.savez(file, environment=np.array(json.dumps(given)), **lived)

    @classmethod
    def read(cls, path: Path) -> Request:
        with np.load(path, allow_pickle=False) as file:
            given = json.loads(str(file["environment"]))
            return cls(int(file["seed"]), file["actions"], file["observations"], **given)


def record(request: Request, out: Path, seconds: float = 600) -> str | None:
    """Write the episode to ``out`` as an MP4 (H.264). Returns None, or one sentence: why there is no video.

    ``seconds``: give up after so long.
    """
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder) / "request.npz"
        request.write(asked)
        command = [*PYTHON, "-m", "senior.envs.render", str(asked), str(out)]
        try:
            done = subprocess.run(
                command, env=importing_alike(), capture_output=True, text=True, timeout=seconds, check=False
            )
        except subprocess.TimeoutExpired:
            return f"There is no video because drawing it took more than {seconds:g} seconds."
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines() or ["it said nothing"]
    if done.returncode == NO_VIDEO:
        return lines[-1]
    return f"There is no video because its process ended with code {done.returncode}: {lines[-1]}"


def _frames(env: gymnasium.Env[Any, Any], request: Request, stride: int) -> Iterator[np.ndarray]:
    """Every ``stride``-th frame of the episode, the first and the last included.

    Raises `NoVideo` where it is not the episode that was lived through.
    """
    env.reset(seed=request.seed)
    eye = camera(env, SIDE)
    try:
        yield eye.frame()
        for number, (action, seen) in enumerate(zip(request.actions, request.observations, strict=True), start=1):
            observation, _, terminated, truncated, _ = env.step(action)
            if not np.array_equal(np.asarray(observation, np.float32), seen):
                raise NoVideo(
                    "the environment does not repeat an episode from its seed and actions; its reset must honour the "
                    "seed it is given."
                )
            ended = terminated or truncated or number == len(request.actions)
            if number % stride == 0 or ended:
                yield eye.frame()
            if ended:
                return
    finally:
        eye.close()


def draw(request: Request, out: Path) -> None:
    """Live the episode through again in this process and write it to ``out``, at the speed it had.

    Raises `NoVideo`, or `BadInput` where the environment cannot be made.
    """
    env = drawable(request.task, request.env, request.position, request.length_scale, request.horizon)
    fps = own_fps(env)
    stride = max(1, round(fps / MOST_FPS))
    try:
        with Film(out, fps / stride) as film:
            for frame in _frames(env, request, stride):
                film.add(frame)
    finally:
        env.close()


def main(arguments: list[str]) -> int:
    """The subprocess: 0, or 3 with one sentence on standard error."""
    if len(arguments) != 2:
        print("Usage: python -m senior.envs.render REQUEST.npz OUT.mp4", file=sys.stderr)
        return 2
    try:
        draw(Request.read(Path(arguments[0])), Path(arguments[1]))
    except NoVideo as error:
        print(f"There is no video because {error}", file=sys.stderr)
        return NO_VIDEO
    except BadInput as error:
        print(error, file=sys.stderr)
        return NO_VIDEO
    except Exception as error:  # whatever an environment raises: one sentence, as promised
        told = " ".join(str(error).split())
        print(f"There is no video because the episode failed ({type(error).__name__}: {told}).", file=sys.stderr)
        return NO_VIDEO
    return 0


if __name__ == "__main__":
    sys.unraisablehook = lambda _: None  # a half-built renderer, when it is collected, talks after our sentence
    raise SystemExit(main(sys.argv[1:]))
