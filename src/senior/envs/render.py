"""Videos of episodes: ``python -m senior.envs.render REQUEST.npz OUT.mp4``, or `record` from a program.

An episode is lived through again from its seed and its actions, and drawn on the way. This happens in a
process of its own, because OpenGL's backend is chosen when MuJoCo is imported, and training chooses none.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import gymnasium
import numpy as np

from senior.envs import make
from senior.envs.metaworld import TASKS, MetaWorld
from senior.types import BadInput

SIDE = 480  # pixels of a Meta-World frame
MOST_FPS = 40
NO_VIDEO = 3  # exit code
INSTALL = (
    "install libegl1 and libgl1-mesa-dri (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri) "
    "and leave MUJOCO_GL unset."
)
NO_OPENGL = f"There is no video because no OpenGL library was found; {INSTALL}"
BACKENDS = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}


class NoVideo(Exception):
    """There can be no video; the text is one sentence that tells why."""


@dataclass(frozen=True)
class Request:
    """One episode to be drawn: the arguments of `senior.envs.make`, its seed, its actions float32 [T, a]."""

    task: str | None
    seed: int
    actions: np.ndarray
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
            np.savez(file, environment=np.array(json.dumps(given)), seed=self.seed, actions=self.actions)

    @classmethod
    def read(cls, path: Path) -> Request:
        with np.load(path, allow_pickle=False) as file:
            given = json.loads(str(file["environment"]))
            return cls(seed=int(file["seed"]), actions=file["actions"].astype(np.float32), **given)


def record(request: Request, out: Path, seconds: float = 600) -> str | None:
    """Write the episode to ``out`` as an MP4 (H.264). Returns None, or one sentence: why there is no video.

    ``seconds``: give up after so long.
    """
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder) / "request.npz"
        request.write(asked)
        command = [sys.executable, "-m", "senior.envs.render", str(asked), str(out)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
        except subprocess.TimeoutExpired:
            return f"There is no video because drawing it took more than {seconds:g} seconds."
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines() or ["it said nothing"]
    if done.returncode == NO_VIDEO:
        return lines[-1]
    return f"There is no video because its process ended with code {done.returncode}: {lines[-1]}"


def choose_backend(wanted: str | None, loads: Callable[[str], bool], platform: str) -> str | None:
    """The value for ``MUJOCO_GL``; None leaves the choice to MuJoCo (as on macOS).

    wanted: what the user set. loads: whether a shared library can be loaded. platform: as ``sys.platform``.
    Raises `NoVideo` where there is no OpenGL.
    """
    if wanted in ("egl", "osmesa", "glfw"):
        return wanted
    if platform != "linux":
        return None
    for backend, library in BACKENDS.items():
        if loads(library):
            return backend
    raise NoVideo(NO_OPENGL)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _prepare_opengl() -> None:
    """Set ``MUJOCO_GL``, which must happen before MuJoCo is imported."""
    backend = choose_backend(os.environ.pop("MUJOCO_GL", None), _loads, sys.platform)
    if backend is not None:
        os.environ["MUJOCO_GL"] = backend


def _does_not_start(error: Exception) -> NoVideo:
    told = " ".join(str(error).split())
    backend = os.environ.get("MUJOCO_GL", "of MuJoCo's choice")
    return NoVideo(f"There is no video because OpenGL {backend} does not start ({told}); {INSTALL}")


class _MetaWorldCamera:
    """Draws a Meta-World scene as [480, 480, 3] uint8, from a free camera that shows arm and object upright.

    Shadows, reflections and multisampling are off: without a GPU they cost nine tenths of the time.
    """

    def __init__(self, env: MetaWorld) -> None:
        import mujoco
        from mujoco import MjvCamera, mjtCamera, mjtRndFlag  # pyright: ignore[reportAttributeAccessIssue]

        model = env.stock.model
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
        try:
            self.renderer = mujoco.Renderer(model, SIDE, SIDE)
        except Exception as error:
            raise _does_not_start(error) from error
        for flag in (mjtRndFlag.mjRND_SHADOW, mjtRndFlag.mjRND_REFLECTION):
            self.renderer.scene.flags[flag] = 0
        self.data = env.stock.data
        self.camera = MjvCamera()
        self.camera.type = mjtCamera.mjCAMERA_FREE
        self.camera.lookat[:] = (0, 0.65, 0.15)
        self.camera.distance = 1.1
        self.camera.azimuth = 140
        self.camera.elevation = -25

    def frame(self) -> np.ndarray:
        self.renderer.update_scene(self.data, self.camera)
        return self.renderer.render()

    def close(self) -> None:
        self.renderer.close()  # else EGL complains when the process ends


class _OwnCamera:
    """Frames as the environment draws them itself."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self.env = env

    def frame(self) -> np.ndarray:
        frame: Any = self.env.render()
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.shape[2:] != (3,):
            raise NoVideo("There is no video because the environment draws no rgb_array frames.")
        return frame

    def close(self) -> None:
        pass


def _frames(env: gymnasium.Env[Any, Any], request: Request, stride: int) -> Iterator[np.ndarray]:
    """Every ``stride``-th frame of the episode, the first and the last included."""
    env.reset(seed=request.seed)
    camera = _MetaWorldCamera(env) if isinstance(env, MetaWorld) else _OwnCamera(env)
    try:
        yield camera.frame()
        for number, action in enumerate(request.actions, start=1):
            _, _, terminated, truncated, _ = env.step(action)
            ended = terminated or truncated or number == len(request.actions)
            if number % stride == 0 or ended:
                yield camera.frame()
            if ended:
                return
    finally:
        camera.close()


def _write(frames: Iterator[np.ndarray], fps: int, out: Path) -> None:
    """Encode frames [h, w, 3] uint8 as H.264; an odd last row or column is cut off, as yuv420p demands."""
    first = next(frames)
    height, width = (side // 2 * 2 for side in first.shape[:2])
    with av.open(str(out), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "23", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

        def encode(frame: np.ndarray) -> None:
            even = np.ascontiguousarray(frame[:height, :width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        encode(first)
        for frame in frames:
            encode(frame)
        container.mux(stream.encode(None))


def draw(request: Request, out: Path) -> None:
    """Live the episode through again in this process and write it to ``out``, at the speed it had.

    Raises `NoVideo`, or `BadInput` where the environment cannot be made.
    """
    by_mujoco = request.env is None and request.task in TASKS
    try:
        _prepare_opengl()
        if by_mujoco:
            import mujoco  # noqa: F401  (this is where a missing library shows itself)
    except NoVideo:
        if by_mujoco:
            raise  # others may draw without
    except Exception as error:
        raise _does_not_start(error) from error
    env, _ = make(request.task, request.env, request.position, request.length_scale, request.horizon, render=True)
    fps = int(env.metadata.get("render_fps") or 30)
    stride = max(1, round(fps / MOST_FPS))
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_name(out.name + ".part")
    try:
        _write(_frames(env, request, stride), fps // stride, unfinished)
        unfinished.replace(out)
    finally:
        unfinished.unlink(missing_ok=True)
        env.close()


def main(arguments: list[str]) -> int:
    """The subprocess: 0, or 3 with one sentence on standard error."""
    if len(arguments) != 2:
        print("Usage: python -m senior.envs.render REQUEST.npz OUT.mp4", file=sys.stderr)
        return 2
    try:
        draw(Request.read(Path(arguments[0])), Path(arguments[1]))
    except (NoVideo, BadInput) as error:
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
