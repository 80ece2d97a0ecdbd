"""What is needed to draw an environment without a screen: OpenGL's backend, a camera, an encoder of films.

OpenGL's backend is chosen when MuJoCo is imported, and training chooses none; so who draws Meta-World does it in a
process of its own (`senior.envs.render`, `senior.label.clips`).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import av
import gymnasium
import numpy as np

from senior.envs import make
from senior.envs.metaworld import TASKS, MetaWorld
from senior.files import put

INSTALL = (
    "install libegl1 and libgl1-mesa-dri (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri) "
    "and leave MUJOCO_GL unset."
)
NO_OPENGL = f"no OpenGL library was found; {INSTALL}"
BACKENDS = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
USUAL_FPS = Fraction(30)  # where an environment does not tell its own
CLIP_SIDE = 384  # pixels of a Meta-World frame that people compare; 14 ms each on one core (256: 10 ms, 480: 18 ms)
KEYFRAMES = 10  # frames from one that a player can begin at to the next, in films that are stepped through


class NoVideo(Exception):
    """Nothing can be drawn. The text tells why: it ends a sentence of which the last word so far is "because"."""


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


def prepare_opengl() -> None:
    """Set ``MUJOCO_GL``, which must happen before MuJoCo is imported. Raises `NoVideo` where there is no OpenGL."""
    backend = choose_backend(os.environ.pop("MUJOCO_GL", None), _loads, sys.platform)
    if backend is not None:
        os.environ["MUJOCO_GL"] = backend


def _does_not_start(error: Exception) -> NoVideo:
    told = " ".join(str(error).split())
    backend = os.environ.get("MUJOCO_GL", "of MuJoCo's choice")
    return NoVideo(f"OpenGL {backend} does not start ({told}); {INSTALL}")


def drawable(
    task: str | None,
    env: str | None = None,
    position: str | None = None,
    length_scale: float | None = None,
    horizon: int | None = None,
) -> gymnasium.Env[Any, Any]:
    """The environment of `senior.envs.make`, to be drawn, in a process in which MuJoCo is not imported yet.

    Raises `NoVideo`, or `BadInput` where the environment cannot be made.
    """
    by_mujoco = env is None and task in TASKS
    try:
        prepare_opengl()
        if by_mujoco:
            import mujoco  # noqa: F401  (this is where a missing library shows itself)
    except NoVideo:
        if by_mujoco:
            raise  # others may draw without
    except Exception as error:
        raise _does_not_start(error) from error
    return make(task, env, position, length_scale, horizon, render=True)[0]


def own_fps(env: gymnasium.Env[Any, Any]) -> Fraction:
    """Steps per second of an environment's own time; the usual number where it tells none that makes sense."""
    try:
        told = Fraction(float(env.metadata["render_fps"])).limit_denominator(1000)
    except (KeyError, TypeError, ValueError, OverflowError):
        told = Fraction(0)
    return told if told > 0 else USUAL_FPS


class Camera(Protocol):
    """Draws the scene that an environment is in."""

    def frame(self) -> np.ndarray:
        """[h, w, 3] uint8. Raises `NoVideo` where the environment draws no such thing."""
        ...

    def close(self) -> None:
        """Let go of OpenGL; the environment is left alone."""
        ...


def camera(env: gymnasium.Env[Any, Any], side: int) -> Camera:
    """``side``: pixels of a Meta-World frame, which is square; other environments draw in a size of their own.

    Raises `NoVideo` where OpenGL does not start.
    """
    return _MetaWorldCamera(env, side) if isinstance(env, MetaWorld) else _OwnCamera(env)


class _MetaWorldCamera:
    """Draws a Meta-World scene from a free camera that shows arm and object upright.

    Shadows, reflections and multisampling are off: without a GPU they cost nine tenths of the time.
    """

    def __init__(self, env: MetaWorld, side: int) -> None:
        import mujoco
        from mujoco import MjvCamera, mjtCamera, mjtRndFlag  # pyright: ignore[reportAttributeAccessIssue]

        model = env.stock.model
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
        try:
            self.renderer = mujoco.Renderer(model, side, side)
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
        try:
            frame: Any = self.env.render()
        except NotImplementedError:
            frame = None
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.shape[2:] != (3,):
            raise NoVideo("the environment draws no rgb_array frames.")
        return frame

    def close(self) -> None:
        pass


class Film:
    """An MP4 (H.264) in the making, which appears under its name when it is finished, on the disk.

    It plays in every browser (yuv420p) while it loads. Within a ``with`` it is finished at the end, and discarded
    where something was raised.
    """

    def __init__(self, out: Path, fps: Fraction, keyframes: int | None = None) -> None:
        """keyframes: at most so many frames from one that stands for itself to the next, and none that waits for a
        later one, so that a player is quickly at any frame. None: as the encoder likes, which is smaller."""
        self.out = out
        self.unfinished = out.with_name(out.name + ".part")
        self.frames = 0
        out.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self.unfinished), "w", format="mp4", options={"movflags": "faststart"})
        options = {"crf": "23", "preset": "veryfast"}
        if keyframes is not None:
            options |= {"g": str(keyframes), "bf": "0"}
        self._stream = self._container.add_stream("libx264", rate=fps, options=options)
        self._stream.pix_fmt = "yuv420p"

    def add(self, frame: np.ndarray) -> None:
        """Add [h, w, 3] uint8; an odd last row or column is cut off, as yuv420p demands. All have one size."""
        if not self.frames:
            self._stream.height, self._stream.width = (side // 2 * 2 for side in frame.shape[:2])
        even = np.ascontiguousarray(frame[: self._stream.height, : self._stream.width])
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        self.frames += 1

    def finish(self) -> None:
        """Put it in its place; there must be a frame."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        put(self.unfinished, self.out)

    def discard(self) -> None:
        """Forget it."""
        with contextlib.suppress(Exception):  # a film without a frame is no film to PyAV
            self._container.close()
        self.unfinished.unlink(missing_ok=True)

    def __enter__(self) -> Film:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self.discard()
