"""Clips show what was asked about, frame by frame, in the order of asking; what cannot be drawn gets a sentence."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import gymnasium
import numpy as np
import pytest

from senior import envs
from senior.config import Config, made_by, to_json
from senior.envs import drawing
from senior.envs.drawing import CLIP_SIDE, KEYFRAMES, Film
from senior.envs.episodes import TRAINING, Failure, Local, Step, episode_seed
from senior.envs.recording import Recording, film_of, observations_of, repeats_itself
from senior.label.clips import Store, clip_fps, draw_all
from senior.label.scenes import Stage
from senior.preferences import Preferences
from senior.presets import preset
from senior.types import BadInput, Pairs, Query

ROOT = Path(__file__).parents[1]
H = 10
HORIZON = 30
Cut = tuple[tuple[int, int], tuple[int, int]]
"""A pair: episode and first step of each segment."""


class Counting(gymnasium.Env[np.ndarray, np.ndarray]):
    """Shows the number of the step in white and black squares, on a colour of the episode's own, and a bar that is
    moved. Its frames have an odd number of rows and columns."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012  (Gymnasium's declaration)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    resets = 0

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        Counting.resets += 1
        self.place, self.elapsed = 0.0, 0
        self.colour = self.np_random.integers(60, 200, 3)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place += float(action[0])
        action[:] = 0  # some do such things
        self.elapsed += 1
        return self._observation(), self.place, False, False, {}

    def _observation(self) -> np.ndarray:
        return np.array([self.place, self.elapsed, self.colour[0]], np.float32)

    def render(self) -> Any:
        frame = np.full((65, 97, 3), self.colour, np.uint8)
        for bit in range(5):
            frame[8:24, 8 + 16 * bit : 24 + 16 * bit] = 255 * (self.elapsed >> bit & 1)
        column = 44 + round(6 * self.place)
        frame[40:60, max(0, column) : max(0, column + 8)] = 0
        return frame


class Slow(Counting):
    def render(self) -> Any:
        time.sleep(0.01)
        return super().render()


class Laborious(Counting):
    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        Path(os.environ["AT_WORK"]).touch()
        time.sleep(60)


class Blind(Counting):
    def render(self) -> Any:
        return None


class Fragile(Counting):
    """Breaks at step 20, when it is to be drawn, for ever."""

    broken = False

    def reset(self, **options: Any) -> Any:
        assert not self.broken
        return super().reset(**options)

    def step(self, action: np.ndarray) -> Any:
        if self.render_mode and self.elapsed == 19:
            self.broken = True
            raise RuntimeError("the motor\nis hot")
        return super().step(action)


class Forgetful(Counting):
    """Begins anywhere, whatever its seed."""

    def reset(self, **options: Any) -> Any:
        return super().reset(seed=time.monotonic_ns() % 2**31)


class Ageing(Counting):
    """Two new ones are alike, but what it lived through before shows."""

    age = 0.0

    def step(self, action: np.ndarray) -> Any:
        self.age += 1e-3
        self.place += self.age
        return super().step(action)


def configuration(env: type[Counting] | None, segment: int = H) -> Config:
    config = preset("quick", "door-close", "m-senior")
    config = replace(config, queries=replace(config.queries, segment=segment))
    if env is None:
        return config
    return replace(config, env=f"{__name__}:{env.__name__}", position="0:1", horizon=HORIZON)


def lived(config: Config, episodes: Sequence[int], steps: int) -> dict[int, list[Step]]:
    """Random actions, as in training."""
    place = Local(lambda: envs.make(**made_by(config)), config.seed, TRAINING)
    found = {}
    for episode in episodes:
        assert place.begin(episode) is None
        found[episode] = [acted(place, episode, step) for step in range(steps)]
    place.close()
    return found


def acted(place: Local | Recording, episode: int, step: int) -> Step:
    action = np.random.default_rng([episode, step]).uniform(-1, 1, 4 if place.observation.size == 39 else 1)
    place.send(action.astype(np.float32))
    came = place.receive()
    assert not isinstance(came, Failure), came
    return came


def asked(
    run: Path, config: Config, episodes: dict[int, list[Step]], cuts: Sequence[Cut], reserves: int = 0
) -> list[int]:
    """Write what the trainer writes when it asks pairs, and return their numbers."""
    steps = config.queries.segment
    run.mkdir(exist_ok=True)
    (run / "config.json").write_text(json.dumps({"config": to_json(config), "protocol": {}}))

    def of(name: str) -> np.ndarray:
        cut = [[[getattr(one, name) for one in episodes[e][start:][:steps]] for e, start in pair] for pair in cuts]
        return np.array(cut, np.float32)

    numbers = np.array(cuts)
    pairs = Pairs(of("observation"), of("action"), of("reward"), numbers[..., 0], numbers[..., 1])
    whole = {
        number: (episode_seed(config.seed, TRAINING, number), np.stack([step.action for step in episode]))
        for number, episode in episodes.items()
    }
    preferences = Preferences(
        run / "preferences.sqlite", 250, steps, *pairs.observation.shape[3:], pairs.action.shape[3]
    )
    with closing(preferences):
        return preferences.add(Query(pairs), 1, 100, config.seed, np.zeros(len(cuts), int), reserves, whole)


def here(run: Path, config: Config) -> Stage:
    """Draw all that is asked for, in this process; what it is drawn with comes back, closed."""
    (run / "label" / "clips").mkdir(parents=True, exist_ok=True)
    stage = Stage(made_by(config))
    store = Store(run)
    with closing(store.db):
        store.tidy()
        draw_all(store, stage)
    stage.clear()
    return stage


def clips(run: Path, condition: str = "1") -> list[dict[str, Any]]:
    """Rows of clips in the order of drawing."""
    with closing(sqlite3.connect(run / "preferences.sqlite", timeout=10)) as db:
        db.row_factory = sqlite3.Row
        return [dict(row) for row in db.execute(f"SELECT * FROM clips WHERE {condition} ORDER BY rowid")]


def order(run: Path) -> list[tuple[int, int]]:
    return [(row["pair"], row["side"]) for row in clips(run)]


def execute(run: Path, statement: str, *values: object) -> None:
    with closing(sqlite3.connect(run / "preferences.sqlite", timeout=10)) as db, db:
        db.execute(statement, values)


def file_of(run: Path, row: dict[str, Any]) -> Path:
    return run / "label" / "clips" / f"{row['name']}.mp4"


def decoded(path: Path) -> np.ndarray:
    """[n, h, w, 3] uint8."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def numbers_in(frames: np.ndarray) -> list[int]:
    """The steps that `Counting` shows."""
    squares = frames[:, 12:20, 8:88].reshape(len(frames), 8, 5, 16, 3)[:, :, :, 4:12].mean((1, 3, 4)) > 128
    return (squares @ (1 << np.arange(5))).tolist()


def apart(one: np.ndarray, other: np.ndarray, where: Any = ...) -> float:
    """Mean absolute difference in brightness of two frames, of the pixels ``where``."""
    return float(np.abs(one.mean(-1) - other.mean(-1))[where].mean())


def assert_shows(clip: np.ndarray, scenes: list[np.ndarray], start: int) -> None:
    """First and last frame are those of a fresh rendering, ``scenes``, and no neighbours of them."""
    rows, columns = clip.shape[1:3]
    for mine, number in ((clip[0], start), (clip[-1], start + len(clip) - 1)):
        right = scenes[number][:rows, :columns]
        assert apart(mine, right) < 5
        for neighbour in (scenes[number - 1][:rows, :columns], scenes[number + 1][:rows, :columns]):
            moved = np.abs(right.mean(-1) - neighbour.mean(-1)) > 40
            assert moved.sum() > 20
            assert apart(mine, right, moved) * 3 < apart(mine, neighbour, moved)


def rendered(config: Config, episode: int, steps: int) -> list[np.ndarray]:
    """The scenes of an episode of random actions, by an environment that draws nothing else."""
    env, _ = envs.make(**made_by(config), render=True)
    env.reset(seed=episode_seed(config.seed, TRAINING, episode))
    eye = drawing.camera(env, CLIP_SIDE)
    frames = [eye.frame()]
    size = env.action_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
    for step in range(steps - 1):
        env.step(np.random.default_rng([episode, step]).uniform(-1, 1, size).astype(np.float32))
        frames.append(eye.frame())
    eye.close()
    env.close()
    return frames


@pytest.fixture(autouse=True)
def _backend(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is chosen for drawing here is not chosen for other tests."""
    monkeypatch.setenv("MUJOCO_GL", "off")


@pytest.fixture
def process() -> Iterator[Callable[[Path], subprocess.Popen[bytes]]]:
    """Starts the process of a run; what still lives at the end is killed."""
    started: list[subprocess.Popen[bytes]] = []

    def start(run: Path) -> subprocess.Popen[bytes]:
        started.append(
            subprocess.Popen(
                [sys.executable, "-m", "senior.label.clips", str(run)],
                stdin=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd=ROOT,
            )
        )
        return started[-1]

    yield start
    for one in started:
        one.kill()
        one.wait()
        for pipe in (one.stdin, one.stderr):
            assert pipe is not None
            pipe.close()


def until(condition: Callable[[], Any], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_meta_world(tmp_path: Path, process: Callable[[Path], subprocess.Popen[bytes]]):
    config, start = configuration(None, 20), (13, 24)
    episodes = lived(config, (4, 7), 50)
    asked(tmp_path, config, episodes, [((4, start[0]), (7, start[1]))])
    drawer = process(tmp_path)
    until(lambda: len(clips(tmp_path)) == 2)
    rows = clips(tmp_path)
    drawer.stdin.close()  # pyright: ignore[reportOptionalMemberAccess]
    if not opengl():
        assert {row["failure"] for row in rows} == {f"The clips cannot be drawn because {drawing.NO_OPENGL}"}
        return
    assert drawer.wait(20) == 0
    fresh = tmp_path / "fresh.npz"
    program = (
        "import numpy as np\nfrom senior.envs import drawing\ndrawing.prepare_opengl()\n"
        "from tests.test_clips import configuration, rendered\n"
        f"np.savez({str(fresh)!r}, *(rendered(configuration(None), episode, 46) for episode in (4, 7)))"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, env={**os.environ, "JAX_PLATFORMS": "cpu"})
    scenes = list(np.load(fresh).values())
    for row in rows:
        assert (row["frames"], row["fps"], row["speed"], row["failure"]) == (20, 8, 0.1, None)
        clip = decoded(file_of(tmp_path, row))
        assert clip.shape == (20, CLIP_SIDE, CLIP_SIDE, 3)
        assert_shows(clip, scenes[row["side"]], start[row["side"]])


def opengl() -> bool:
    try:
        drawing.choose_backend(None, drawing._loads, sys.platform)
    except drawing.NoVideo:
        return False
    return True


def test_a_clip_and_its_file(tmp_path: Path):
    config = configuration(Counting)
    asked(tmp_path, config, lived(config, (0, 1), HORIZON), [((0, 1), (1, HORIZON - H - 1))])
    here(tmp_path, config)
    rows = clips(tmp_path)
    assert [row["side"] for row in rows] == [0, 1]
    for row, episode, start in zip(rows, (0, 1), (1, HORIZON - H - 1), strict=True):
        path = file_of(tmp_path, row)
        content = path.read_bytes()
        assert re.fullmatch("[0-9a-f]{32}", row["name"])
        assert row["sha256"] == hashlib.sha256(content).hexdigest()
        assert (row["frames"], row["fps"], row["speed"], row["failure"]) == (H, 8, 8 / 12, None)
        assert content.index(b"moov") < content.index(b"mdat")  # plays while it loads
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
            assert (stream.average_rate, stream.frames) == (8, H)
            assert not stream.codec_context.has_b_frames
        frames = decoded(path)
        assert frames.shape == (H, 64, 96, 3)  # the odd row and column are cut off
        assert numbers_in(frames) == list(range(start, start + H))
        assert_shows(frames, rendered(config, episode, HORIZON), start)
    assert len({row["name"] for row in rows}) == 2


def test_speed():
    assert clip_fps(Fraction(80), 50) == 20  # Meta-World: a quarter of its speed
    assert clip_fps(Fraction(80), 10) == 8
    assert clip_fps(Fraction(15), 50) == 15
    assert clip_fps(Fraction(60), 32) == Fraction(64, 5)


def test_films_can_be_stepped_through(tmp_path: Path):
    frames = np.random.default_rng(0).integers(255, size=(1, 64, 64, 3), dtype=np.uint8)
    with Film(tmp_path / "new" / "film.mp4", Fraction(20), KEYFRAMES) as film:
        for _ in range(45):
            film.add(frames[0])
    with av.open(str(tmp_path / "new" / "film.mp4")) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    keys = [number for number, packet in enumerate(packets) if packet.is_keyframe]
    assert keys[0] == 0 and max(np.diff([*keys, 45])) <= KEYFRAMES
    assert [packet.pts for packet in packets] == [packet.dts for packet in packets]  # none waits for a later one
    film = Film(tmp_path / "other.mp4", Fraction(20))
    film.add(frames[0])
    film.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_the_first_pair_is_ready_first(tmp_path: Path):
    config = configuration(Counting)
    episodes = lived(config, range(4), HORIZON)
    cuts: list[Cut] = [((0, 2), (1, 2)), ((2, 5), (2, 17)), ((3, 12), (3, 1)), ((0, 3), (0, 3))]
    asked(tmp_path, config, episodes, cuts, reserves=1)
    asked(tmp_path, config, episodes, [((1, 5), (0, 9)), ((1, 0), (0, 19))])
    asked(tmp_path, config, episodes, [((3, 0), (3, 2)), ((2, 0), (2, 9))], reserves=1)
    execute(tmp_path, "UPDATE pairs SET session = 0 WHERE id IN (1, 7, 8)")  # trained on, and a reserve left over
    execute(tmp_path, "UPDATE pairs SET collected_step = 100 WHERE id IN (1, 7)")
    Counting.resets = 0
    stage = here(tmp_path, config)
    # a pair's segments in the order in which its episodes go on, the one asked in place of another at last
    assert order(tmp_path) == [(2, 0), (2, 1), (3, 1), (3, 0), (5, 0), (5, 1), (6, 1), (6, 0), (4, 0), (4, 1)]
    # 7 times an episode is begun, where each clip on its own would need 10; `envs.make` tries one
    assert Counting.resets == 7 + 1
    assert stage.episode is None
    for row in clips(tmp_path):
        start = [*cuts, ((1, 5), (0, 9)), ((1, 0), (0, 19))][row["pair"] - 1][row["side"]][1]
        assert numbers_in(decoded(file_of(tmp_path, row))) == list(range(start, start + H))
    here(tmp_path, config)
    assert len(order(tmp_path)) == 10


def test_what_did_not_happen_is_not_shown(tmp_path: Path):
    config = configuration(Counting)
    asked(tmp_path, config, lived(config, (0,), HORIZON), [((0, 0), (0, 15)), ((0, 3), (0, 4))])
    with closing(sqlite3.connect(tmp_path / "preferences.sqlite")) as db:
        blob = db.execute("SELECT observation FROM pairs WHERE id = 1").fetchone()[0]
    observation = np.frombuffer(blob, "<f4").copy()
    last = observation.reshape(2, H, 3)[1, -1]
    last[0] = np.nextafter(last[0], np.float32(np.inf))
    execute(tmp_path, "UPDATE pairs SET observation = ? WHERE id = 1", observation.tobytes())
    here(tmp_path, config)
    assert [row["failure"] is None for row in clips(tmp_path)] == [True, False, True, True]
    assert clips(tmp_path, "pair = 1 AND side = 1") == [
        {
            **dict.fromkeys(("name", "frames", "fps", "speed", "sha256")),
            "pair": 1,
            "side": 1,
            "failure": f"The environment {__name__}:Counting does not repeat episode 0 from its seed and actions, "
            "and it was not filmed; its reset must honour the seed it is given.",
        }
    ]
    assert len(list((tmp_path / "label" / "clips").iterdir())) == 3
    execute(tmp_path, "DELETE FROM episodes")
    execute(tmp_path, "DELETE FROM clips WHERE pair = 2")
    here(tmp_path, config)
    assert clips(tmp_path, "pair = 2")[0]["failure"] == (
        "The actions of episode 0 were not kept, so it cannot be lived through again."
    )


@pytest.mark.parametrize(
    ("env", "sentences"),
    [
        (Fragile, [None, "The clip of episode 0 cannot be drawn: RuntimeError: the motor is hot"] * 2),
        (Blind, ["The clips cannot be drawn because the environment draws no rgb_array frames."] * 4),
    ],
)
def test_environments_that_fail(tmp_path: Path, env: type[Counting], sentences: list[str | None]):
    config = configuration(env)
    asked(tmp_path, config, lived(config, (0,), HORIZON), [((0, 0), (0, 15)), ((0, 3), (0, 11))])
    here(tmp_path, config)
    assert [row["failure"] for row in clips(tmp_path)] == sentences


def test_without_opengl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(drawing, "_loads", lambda library: False)
    monkeypatch.setattr(sys, "platform", "linux")
    config = configuration(None)
    asked(tmp_path, config, lived(config, (0,), 30), [((0, 0), (0, 15)), ((0, 3), (0, 4))])
    here(tmp_path, config)
    sentence = f"The clips cannot be drawn because {drawing.NO_OPENGL}"
    assert "apt-get install libegl1 libgl1-mesa-dri" in sentence
    assert [row["failure"] for row in clips(tmp_path)] == [sentence] * 4


def test_a_failure_is_tried_again_by_the_next_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = configuration(Counting)
    asked(tmp_path, config, lived(config, (0,), HORIZON), [((0, 0), (0, 15)), ((0, 3), (0, 4)), ((0, 5), (0, 6))])
    config = replace(config, env="nowhere:Robot")
    here(tmp_path, config)
    assert all("nowhere" in row["failure"] for row in clips(tmp_path)) and len(clips(tmp_path)) == 6
    execute(tmp_path, "UPDATE pairs SET session = 0, collected_step = 100 WHERE id = 2")
    here(tmp_path, configuration(Counting))
    assert [row["pair"] for row in clips(tmp_path, "failure IS NULL")] == [1, 1, 3, 3]
    assert [row["pair"] for row in clips(tmp_path, "failure IS NOT NULL")] == [2, 2]
    file_of(tmp_path, clips(tmp_path, "pair = 3")[0]).unlink()  # and what somebody deleted is drawn again
    here(tmp_path, configuration(Counting))
    assert all(file_of(tmp_path, row).exists() for row in clips(tmp_path, "failure IS NULL"))


def test_a_pair_that_changed_meanwhile_gets_no_clip(tmp_path: Path):
    config = configuration(Counting)
    asked(tmp_path, config, lived(config, (0,), HORIZON), [((0, 0), (0, 15))])
    folder = tmp_path / "label" / "clips"
    folder.mkdir(parents=True)
    store = Store(tmp_path)
    wanted = store.next(None, 0)
    assert wanted is not None
    execute(tmp_path, "UPDATE pairs SET observation = zeroblob(length(observation))")
    path = store.new()
    path.write_bytes(b"film")
    store.drawn(wanted, path, Fraction(8), Fraction(1))
    assert clips(tmp_path) == [] and list(folder.iterdir()) == []
    store.db.close()


def test_killed_at_any_moment(tmp_path: Path, process: Callable[[Path], subprocess.Popen[bytes]]):
    config = configuration(Slow)
    folder = tmp_path / "label" / "clips"
    (tmp_path / "config.json").write_text(json.dumps({"config": to_json(config)}))
    drawer = process(tmp_path)  # before there is anything to draw, or a preference file
    time.sleep(0.5)
    asked(tmp_path, config, lived(config, range(3), HORIZON), [((e, s), (e, s + 5)) for e in range(3) for s in (1, 8)])
    for count in (2, 7):
        until(lambda: len(clips(tmp_path)) >= count)  # noqa: B023  (called at once)
        drawer.kill()
        drawer.wait()
        assert len(clips(tmp_path)) < 12
        (folder / f"{'0' * 32}.mp4").write_bytes(b"a file whose row was not written any more")
        (folder / f"{'1' * 32}.mp4.part").write_bytes(b"a file that was not finished")
        drawer = process(tmp_path)
    waiting = process(tmp_path)  # two at once do not disturb each other
    until(lambda: len(clips(tmp_path)) == 12)
    asked(tmp_path, config, lived(config, (9,), HORIZON), [((9, 1), (9, 2))])
    until(lambda: len(clips(tmp_path)) == 14)
    drawer.send_signal(signal.SIGTERM)
    assert drawer.wait(10) == 0
    waiting.stdin.close()  # pyright: ignore[reportOptionalMemberAccess]
    assert waiting.wait(10) == 0
    rows = clips(tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == sorted(f"{row['name']}.mp4" for row in rows)
    for row in rows:
        assert hashlib.sha256(file_of(tmp_path, row).read_bytes()).hexdigest() == row["sha256"]
        assert len(decoded(file_of(tmp_path, row))) == H
    assert drawer.stderr.read() == waiting.stderr.read() == b""  # pyright: ignore[reportOptionalMemberAccess]


def test_ended_while_an_environment_is_built(
    tmp_path: Path, process: Callable[[Path], subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
):
    """Which does not take the end of the process for a failure of its own."""
    at_work = tmp_path / "at-work"
    monkeypatch.setenv("AT_WORK", str(at_work))
    config = configuration(Laborious)
    asked(tmp_path, config, lived(configuration(Counting), (0,), HORIZON), [((0, 0), (0, 5))])
    (tmp_path / "config.json").write_text(json.dumps({"config": to_json(config)}))
    drawer = process(tmp_path)
    until(at_work.exists)
    drawer.send_signal(signal.SIGTERM)
    assert drawer.wait(10) == 0
    assert clips(tmp_path) == []


def test_no_run(tmp_path: Path, process: Callable[[Path], subprocess.Popen[bytes]]):
    drawer = process(tmp_path)
    assert drawer.wait(20) == 2
    assert b"is not a run directory" in drawer.stderr.read()  # pyright: ignore[reportOptionalMemberAccess]


def making(env: type[Counting]) -> Callable[[], Any]:
    return lambda: envs.make(**made_by(configuration(env)))


def test_environments_that_do_not_repeat_themselves_are_found_out():
    assert repeats_itself(making(Counting))
    assert repeats_itself(lambda: envs.make("point", horizon=20))
    assert repeats_itself(lambda: envs.make("handle-press"))
    assert not repeats_itself(making(Forgetful))
    assert not repeats_itself(making(Ageing))
    with pytest.raises(BadInput, match="nowhere"):
        repeats_itself(lambda: envs.make(None, "nowhere:Robot"))


def test_clips_are_cut_from_what_was_filmed(tmp_path: Path):
    config, live = configuration(Forgetful), tmp_path / "label" / "live"

    def record(first: int, steps: int) -> tuple[dict[int, list[Step]], dict[int, list[np.ndarray]]]:
        place = Local(lambda: envs.make(**made_by(config), render=True), config.seed, TRAINING)
        recording = Recording(place, live, segment=H)
        assert recording.begin(first, afresh=True) is None
        episodes: dict[int, list[Step]] = {}
        scenes: dict[int, list[np.ndarray]] = {}
        for step in range(steps):
            episode = place.episode
            scenes.setdefault(episode, []).append(place.env.render())  # pyright: ignore[reportArgumentType]
            episodes.setdefault(episode, []).append(acted(recording, episode, step))
        recording.keep((1, 2))
        assert recording.notes == []
        place.env.close()  # and the rest as if it was killed
        return episodes, scenes

    episodes, scenes = record(0, 3 * HORIZON + 5)
    names = {f"episode-{number}.{kind}" for number in (1, 2) for kind in ("mp4", "npy")}
    assert {path.name for path in live.iterdir()} - {"episode-3.mp4.part"} == names
    (live / "episode-9.mp4.part").write_bytes(b"a film that a killed run was making")
    film = decoded(film_of(live, 2))
    assert numbers_in(film) == list(range(HORIZON))
    held = np.load(observations_of(film_of(live, 2)))
    np.testing.assert_array_equal(held, [step.observation for step in episodes[2]])

    cuts: list[Cut] = [((1, 3), (2, HORIZON - H - 1)), ((2, 8), (0, 9))]
    asked(tmp_path, config, {number: episodes[number] for number in range(3)}, cuts)
    here(tmp_path, config)
    rows = clips(tmp_path)
    assert [(row["pair"], row["side"], row["failure"] is None) for row in rows] == [
        (1, 0, True),
        (1, 1, True),
        (2, 0, True),
        (2, 1, False),
    ]
    assert "does not repeat episode 0 from its seed and actions, and it was not filmed" in rows[3]["failure"]
    for row, (episode, start) in zip(rows, (cuts[0][0], cuts[0][1], cuts[1][0]), strict=False):
        assert (row["frames"], row["fps"], row["speed"]) == (H, 8, 8 / 12)
        frames = decoded(file_of(tmp_path, row))
        assert numbers_in(frames) == list(range(start, start + H))
        assert_shows(frames, scenes[episode], start)

    # a run that goes on from before episode 2 films another one in its place, of which nothing was asked
    record(2, HORIZON + 1)
    assert {path.name for path in live.iterdir()} - {"episode-3.mp4.part"} == names
    execute(tmp_path, "DELETE FROM clips WHERE pair = 1")
    here(tmp_path, config)
    assert [row["failure"] for row in clips(tmp_path, "pair = 1")] == [
        None,
        "The film of episode 2 does not show what was asked about.",
    ]


def test_films_are_of_episodes_that_pairs_are_cut_from_and_go_when_they_are_told_to(tmp_path: Path):
    """Short ones are none of them."""
    place = Local(lambda: envs.make(**made_by(configuration(Forgetful)), render=True), 0, TRAINING)
    recording = Recording(place, tmp_path, segment=HORIZON)
    recording.begin(0, afresh=True)
    acted(recording, 0, 0)
    recording.segment = H
    recording.begin(4)
    for step in range(3 * HORIZON):
        acted(recording, place.episode, step)
    recording.segment = HORIZON
    for step in range(3 * HORIZON):
        acted(recording, place.episode, step)
    assert {path.name for path in tmp_path.glob("*.mp4")} == {f"episode-{number}.mp4" for number in (4, 5, 6)}
    recording.forget(6)  # goes on from a checkpoint before that one
    recording.keep({4, 6})
    assert {path.name for path in tmp_path.glob("*.mp4")} == {"episode-4.mp4"}
    assert {path.name for path in tmp_path.glob("*.npy")} == {"episode-4.npy"}
    recording.close()


def test_a_run_goes_on_where_nothing_can_be_filmed(tmp_path: Path):
    place = Local(lambda: envs.make(**made_by(configuration(Blind)), render=True), 0, TRAINING)
    recording = Recording(place, tmp_path, segment=H)
    assert recording.begin(0) is None
    for step in range(2 * HORIZON):
        acted(recording, 0, step)
    recording.close()
    assert recording.notes == ["Episode 0 is not filmed because the environment draws no rgb_array frames."]
    assert list(tmp_path.iterdir()) == []
