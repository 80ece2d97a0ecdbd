"""Videos: drawn in a process of their own, upright, and a clear sentence where there can be none."""

from __future__ import annotations

import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from senior import envs
from senior.envs import drawing, render
from senior.envs.drawing import USUAL_FPS, NoVideo, choose_backend, own_fps
from senior.envs.render import Request, record

NOTHING = Request(0, np.zeros((1, 4), np.float32), np.zeros((1, 39), np.float32), "door-lock")
"""One step of an episode that nobody has lived through."""


def frames_of(path: Path) -> tuple[np.ndarray, float]:
    """Decoded frames [n, h, w, 3] uint8 and their rate."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        rate = stream.average_rate
        assert rate is not None
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]), float(rate)


def opengl() -> bool:
    try:
        choose_backend(None, drawing._loads, sys.platform)
    except NoVideo:
        return False
    return True


def lived(seed: int, actions: np.ndarray, task: str | None = None, **made_by: Any) -> Request:
    """An episode that was lived through; actions beyond its end were not taken."""
    env, spec = envs.make(task, **made_by)
    env.reset(seed=seed)
    seen = np.zeros((len(actions), spec.observation_size), np.float32)
    for step, action in enumerate(actions):
        seen[step], _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    env.close()
    return Request(seed, actions, seen, task, **made_by)


def test_meta_world_video(tmp_path: Path):
    actions = np.tile(np.array([0, 0, 1, -1], np.float32), (41, 1))  # the arm rises
    out = tmp_path / "new" / "episode.mp4"
    why = record(lived(3, actions, "door-close"), out)
    if not opengl():
        assert why == f"There is no video because {drawing.NO_OPENGL}"
        return
    assert why is None
    frames, rate = frames_of(out)
    assert frames.shape == (1 + 20 + 1, 480, 480, 3)
    assert rate == 40
    assert [path.name for path in out.parent.iterdir()] == ["episode.mp4"]
    content = out.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # plays while it loads

    assert frames[0].mean() > 30
    assert frames[0].std() > 20
    # upright: the table's wood is below, the grey background above, and the red arm moves upwards
    top, bottom = frames[0][:60, 200:440].mean((0, 1)), frames[0][-60:, 200:440].mean((0, 1))
    assert np.ptp(top) < 25
    assert bottom[0] > bottom[2] + 20
    red = (frames[..., 0] > 90) & (frames[..., 1] < 60) & (frames[..., 2] < 60)
    lowest = [np.flatnonzero(image.sum(1) > 5).max() for image in red[[0, -1]]]
    assert lowest[1] < lowest[0] - 10


def test_toy_video_needs_no_opengl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setattr(drawing, "_loads", lambda library: False)
    right = np.tile(np.array([1, 0], np.float32), (9, 1))
    render.draw(lived(0, right, "point"), tmp_path / "toy.mp4")
    frames, rate = frames_of(tmp_path / "toy.mp4")
    assert frames.shape == (10, 96, 96, 3)
    assert rate == 20
    red = (frames[..., 0] > 150) & (frames[..., 1] < 100)
    columns = [np.flatnonzero(image.any(0)).mean() for image in red[[0, -1]]]
    assert columns[1] > columns[0] + 20


def test_an_episode_ends_where_it_ended(tmp_path: Path):
    render.draw(lived(0, np.zeros((200, 2), np.float32), "point"), tmp_path / "toy.mp4")
    assert len(frames_of(tmp_path / "toy.mp4")[0]) == 51


def test_request_survives_the_file(tmp_path: Path):
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)
    observations = np.random.default_rng(1).normal(size=(5, 4)).astype(np.float32)
    asked = Request(2**31 - 1, actions, observations, None, "module:Robot", "0:3", 0.5, 100)
    asked.write(tmp_path / "request.npz")
    back = Request.read(tmp_path / "request.npz")
    np.testing.assert_array_equal(back.actions, actions)
    np.testing.assert_array_equal(back.observations, observations)
    assert back.actions.dtype == back.observations.dtype == np.float32
    assert (back.task, back.seed, back.env, back.position, back.length_scale, back.horizon) == (
        None,
        2**31 - 1,
        "module:Robot",
        "0:3",
        0.5,
        100,
    )


def test_backend():
    assert choose_backend("osmesa", lambda library: False, "linux") == "osmesa"
    assert choose_backend("glfw", lambda library: True, "linux") == "glfw"
    for ignored in (None, "off", "nonsense"):
        assert choose_backend(ignored, lambda library: True, "linux") == "egl"
    assert choose_backend(None, lambda library: "OSMesa" in library, "linux") == "osmesa"
    assert choose_backend("off", lambda library: False, "darwin") is None
    with pytest.raises(NoVideo, match="apt-get install libegl1 libgl1-mesa-dri"):
        choose_backend("off", lambda library: False, "linux")


def test_no_opengl_is_one_sentence(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setattr(drawing, "_loads", lambda library: False)
    monkeypatch.setattr(sys, "platform", "linux")
    NOTHING.write(tmp_path / "request.npz")
    assert render.main([str(tmp_path / "request.npz"), str(tmp_path / "out.mp4")]) == render.NO_VIDEO
    assert capsys.readouterr().err.strip() == f"There is no video because {drawing.NO_OPENGL}"
    assert not (tmp_path / "out.mp4").exists()


def test_opengl_that_does_not_start_is_one_sentence(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")  # which needs a display
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    why = record(NOTHING, tmp_path / "out.mp4")
    assert why is not None
    assert why.startswith("There is no video because OpenGL glfw does not start")
    assert why.endswith(drawing.INSTALL)


@pytest.mark.parametrize("render", ["return None", "raise NotImplementedError"])
def test_an_environment_that_draws_nothing(render: str, tmp_path: Path, monkeypatch):
    (tmp_path / "blind.py").write_text(
        f"from senior.envs.point import Point\nclass Blind(Point):\n    def render(self): {render}\n"
    )
    monkeypatch.chdir(tmp_path)
    zeros = np.zeros((3, 2), np.float32)
    request = Request(0, zeros, np.zeros((3, 4), np.float32), env="blind:Blind", position="0:2", horizon=5)
    out = tmp_path / "out.mp4"
    why = record(request, out)
    assert why == "There is no video because the environment draws no rgb_array frames."
    assert list(tmp_path.glob("out*")) == []


def test_what_was_not_lived_through_is_not_shown(tmp_path: Path):
    request = lived(0, np.ones((9, 2), np.float32), "point")
    request.observations[5] += 1
    assert record(request, tmp_path / "out.mp4") == (
        "There is no video because the environment does not repeat an episode from its seed and actions; its reset "
        "must honour the seed it is given."
    )
    assert list(tmp_path.glob("out*")) == []


def test_what_can_be_imported_here_can_be_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "beside.py").write_text("from senior.envs.point import Point\nclass Mine(Point): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    request = lived(0, np.ones((9, 2), np.float32), env="beside:Mine", position="0:2", horizon=20)
    assert record(request, tmp_path / "out.mp4") is None


@pytest.mark.parametrize(
    ("told", "fps"),
    [(12.5, Fraction(25, 2)), (0.5, Fraction(1, 2)), (np.float32(20), 20), (0, USUAL_FPS), (-3, USUAL_FPS)]
    + [(wrong, USUAL_FPS) for wrong in (None, "fast", float("nan"), float("inf"))],
)
def test_the_speed_that_an_environment_tells(told: Any, fps: Fraction):
    env, _ = envs.make("point")
    env.metadata = {"render_fps": told}
    assert own_fps(env) == fps


def test_bad_requests_are_one_sentence(tmp_path: Path):
    why = record(replace(NOTHING, task="dor-lock"), tmp_path / "out.mp4")
    assert why is not None
    assert "did you mean door-lock" in why
    assert "\n" not in why
