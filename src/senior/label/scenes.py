"""The scenes of a segment that is to be seen: lived through again, or from the film that was made of its episode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import gymnasium
import numpy as np

from senior.envs.drawing import CLIP_SIDE, Camera, NoVideo, camera, drawable, own_fps
from senior.envs.recording import observations_of
from senior.types import BadInput


class Segment(NamedTuple):
    """What was done in a few steps of an episode; frame k of it is the scene that observation k was made in."""

    episode: int
    start: int
    observation: np.ndarray  # [H, o] float32
    seed: int | None  # of the episode; None: its actions were not kept
    actions: np.ndarray  # [n, a] float32, all of the episode's


class Unlike(Exception):
    """What was lived through again, or filmed, is not what the segment says; the text is a sentence."""


class Stage:
    """One environment, at a step of an episode, and the camera before it; made when first needed."""

    def __init__(self, made_by: dict[str, Any]) -> None:
        """``made_by``: arguments of `senior.envs.make`."""
        self.made_by = made_by
        self.name = made_by["env"] or made_by["task"]
        self.episode: int | None = None
        self.step = 0
        self._actions = np.zeros((0, 0), np.float32)  # of that episode
        self._seed: int | None = None
        self._observation = np.zeros(0, np.float32)
        self._open: tuple[gymnasium.Env[Any, Any], Camera] | None = None
        self._never: Exception | None = None  # why it cannot be opened

    def open(self) -> tuple[gymnasium.Env[Any, Any], Camera]:
        """Environment and camera. Raises `NoVideo` or `BadInput`, each time what was raised the first time."""
        if self._never is not None:
            raise self._never
        if self._open is None:
            try:
                env = drawable(**self.made_by)
                self._open = env, camera(env, CLIP_SIDE)
            except (NoVideo, BadInput) as error:
                self._never = error
                raise
        return self._open

    @property
    def fps(self) -> Fraction:
        """Steps per second of the environment's own time."""
        return own_fps(self.open()[0])

    def scenes(self, segment: Segment) -> Iterator[np.ndarray]:
        """The frames [h, w, 3] uint8 of a segment. Raises `Unlike`, `NoVideo`, and whatever an environment raises."""
        if segment.seed is None:
            raise Unlike(
                f"The actions of episode {segment.episode} were not kept, so it cannot be lived through again."
            )
        env, eye = self.open()
        lived = segment.seed == self._seed and np.array_equal(segment.actions, self._actions)
        if self.episode is None or not lived or self.step > segment.start:
            self.episode = None  # as long as nobody knows where it stands
            self._saw(env.reset(seed=segment.seed)[0])
            self._seed, self._actions = segment.seed, segment.actions
            self.episode, self.step = segment.episode, 0
        for number, expected in enumerate(segment.observation, start=segment.start):
            while self.step < number:
                self._saw(env.step(self._actions[self.step].copy())[0])  # it may scale what it is given in place
                self.step += 1
            if not np.array_equal(self._observation, expected):
                raise Unlike(
                    f"The environment {self.name} does not repeat episode {segment.episode} from its seed and actions, "
                    "and it was not filmed; its reset must honour the seed it is given."
                )
            yield eye.frame()

    def _saw(self, observation: Any) -> None:
        self._observation = np.array(observation, np.float32)

    def clear(self) -> None:
        """Close everything; what is needed again is opened again."""
        for one in reversed(self._open or ()):
            with suppress(Exception):
                one.close()
        self._open = self.episode = None


def filmed(film: Path, segment: Segment) -> Iterator[np.ndarray]:
    """The frames [h, w, 3] uint8 of a segment, from the film of its episode. Raises `Unlike` if it shows another."""
    held = np.load(observations_of(film))[segment.start :][: len(segment.observation)]
    if not np.array_equal(held, segment.observation):
        raise Unlike(f"The film of episode {segment.episode} does not show what was asked about.")
    with av.open(str(film)) as container:
        stream = container.streams.video[0]
        ticks = 1 / (_told(stream.average_rate) * _told(stream.time_base))  # of a frame
        container.seek(int(segment.start * ticks), stream=stream)
        numbers = iter(range(segment.start, segment.start + len(segment.observation)))
        number = next(numbers)
        for frame in container.decode(stream):  # from the last keyframe before
            if round((frame.pts or 0) / ticks) == number:
                yield frame.to_ndarray(format="rgb24")
                if (number := next(numbers, -1)) < 0:
                    return
    raise Unlike(f"The film of episode {segment.episode} ends before the segment does.")


def film_fps(film: Path) -> Fraction:
    """Frames per second of a film: the steps per second of its environment's own time."""
    with av.open(str(film)) as container:
        return _told(container.streams.video[0].average_rate)


def _told(number: Fraction | None) -> Fraction:
    if number is None:
        raise Unlike("The film of the episode is damaged.")
    return number
