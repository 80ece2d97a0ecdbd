"""Environments that do not repeat themselves: found out by `repeats_itself`, filmed while they are lived through.

Everywhere else an episode is drawn afterwards, by living through it again (`senior.envs.drawing`). Where the same
seed and actions give another episode, what happened can only be seen when it happens.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from senior.envs.drawing import CLIP_SIDE, KEYFRAMES, Camera, Film, NoVideo, camera, own_fps
from senior.envs.episodes import AFTERWARDS, Failure, Local, Step
from senior.files import put
from senior.types import BadInput, EnvSpec

STEPS = 60


def repeats_itself(make: Callable[[], tuple[gymnasium.Env[Any, Any], EnvSpec]]) -> bool:
    """Whether an episode's seed and actions decide it, bit for bit, in a fresh environment and in one that was used.

    ``make``: as for `Local`; two environments take `STEPS` random steps each, one of them after a few of another
    episode. Raises `BadInput` where one cannot be made or breaks.
    """
    with contextlib.ExitStack() as stack:
        fresh, used = (stack.enter_context(contextlib.closing(Local(make, 0, AFTERWARDS))) for _ in range(2))
        actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, fresh.spec.action_size)).astype(np.float32)
        _lived(used, 1, actions[: STEPS // 10])
        return _lived(fresh, 0, actions) == _lived(used, 0, actions)


def _lived(place: Local, episode: int, actions: np.ndarray) -> list[object]:
    """All that came of actions [n, a], from the beginning of an episode on; more follow where it ends."""
    failed = place.begin(episode)
    if failed is not None:
        raise BadInput(failed.message)
    came: list[object] = [place.observation.tobytes()]
    for action in actions:
        place.send(action)
        step = place.receive()
        if isinstance(step, Failure):
            raise BadInput(step.message)
        came += [step.next_observation.tobytes(), step.reward, step.terminated, step.truncated]
        came.append(place.observation.tobytes())
    return came


def film_of(folder: Path, episode: int) -> Path:
    """Where the film of an episode is kept: every scene that an action was taken in, frame k before action k."""
    return folder / f"episode-{episode}.mp4"


def observations_of(film: Path) -> Path:
    """Where the observations are kept that were made in a film's scenes: NPY, [n, o] float32."""
    return film.with_suffix(".npy")


class Recording:
    """`senior.envs.episodes.Episodes` that films what it lives through.

    A film appears (`film_of`), with its observations beside it, when its episode has ended, so a killed run leaves no
    half of one; an episode that is lived through once more is filmed once more, and takes the place of the first.
    The run that goes on after a kill must not live through complete episodes again, as it would elsewhere.

    MuJoCo draws only if `senior.envs.drawing.prepare_opengl` was called before it was imported (`senior.program`).
    """

    def __init__(self, local: Local, folder: Path, segment: int) -> None:
        """``local``: made by ``make(..., render=True)``. ``segment``: of episodes not longer than so many steps, from
        which no pair is cut, there is no film."""
        self.local = local
        self.folder = folder
        self.segment = segment
        self.observation = local.observation
        self.notes = local.notes
        self._camera: Camera | None = None
        self._film: Film | None = None
        self._observations: list[np.ndarray] = []  # of the running film
        self._blind = False  # a film failed, and it was told

    def begin(self, episode: int, afresh: bool = False) -> Failure | None:
        """See `senior.envs.episodes.Episodes.begin`."""
        self._discard()
        self.folder.mkdir(parents=True, exist_ok=True)
        for unfinished in self.folder.glob("*.part"):
            unfinished.unlink()
        if afresh:
            self._put_away()
        return self._begun(self.local.begin(episode, afresh))

    def keep(self, episodes: Container[int]) -> None:
        """Throw away the films of all episodes but these."""
        self._drop([number for number in self._kept() if number not in episodes])

    def forget(self, first: int) -> None:
        """Throw away the films from that episode on: the run goes on from before they were lived through."""
        self._drop([number for number in self._kept() if number >= first])

    def send(self, action: np.ndarray) -> None:
        """See `senior.envs.episodes.Episodes.send`."""
        self.local.send(action)

    def set_out(self) -> None:
        """See `senior.envs.episodes.Episodes.set_out`; there is nobody else to do it."""

    def receive(self) -> Step | Failure:
        """See `senior.envs.episodes.Episodes.receive`. The scene that ends an episode is no frame."""
        came = self.local.receive()
        if isinstance(came, Failure):
            self._discard()
        elif came.ended:
            self._finish()
            self._begun(None)
        else:
            self.observation = self.local.observation
            self._shoot()
        return came

    def close(self) -> None:
        """See `senior.envs.episodes.Episodes.close`. The running episode's film is lost."""
        self._discard()
        self._put_away()
        self.local.close()

    def _begun(self, failed: Failure | None) -> Failure | None:
        """Start the film of the episode that the environment is at the beginning of, unless it failed."""
        self.observation = self.local.observation
        if failed is None:
            try:
                if self._camera is None:
                    self._camera = camera(self.local.env, CLIP_SIDE)
                out = film_of(self.folder, self.local.episode)
                self._film = Film(out, own_fps(self.local.env), KEYFRAMES)
            except Exception as error:
                self._tell(error)
            self._shoot()
        return failed

    def _shoot(self) -> None:
        """Add the scene that the environment is in to the running film, if there is one."""
        if self._film is None or self._camera is None:
            return
        try:
            self._film.add(self._camera.frame())
            self._observations.append(self.observation)
        except Exception as error:
            self._tell(error)

    def _finish(self) -> None:
        """Put the running film in its place."""
        if self._film is None or len(self._observations) <= self.segment:
            self._discard()
            return
        observations = observations_of(self._film.out)
        try:
            unfinished = observations.with_name(observations.name + ".part")
            with unfinished.open("wb") as file:
                np.save(file, np.stack(self._observations))
            put(unfinished, observations)
            self._film.finish()
        except Exception as error:
            self._tell(error)
        self._discard()

    def _kept(self) -> list[int]:
        """Numbers of the episodes of which there are films, in order."""
        return sorted(int(film.stem.removeprefix("episode-")) for film in self.folder.glob("episode-*.mp4"))

    def _drop(self, episodes: list[int]) -> None:
        for film in (film_of(self.folder, episode) for episode in episodes):
            film.unlink()
            observations_of(film).unlink(missing_ok=True)

    def _discard(self) -> None:
        """Forget the running film, if there is one that was not finished."""
        if self._film is not None:
            self._film.discard()
        self._film = None
        self._observations = []

    def _put_away(self) -> None:
        """Close the camera, because the environment will be."""
        if self._camera is not None:
            with contextlib.suppress(Exception):
                self._camera.close()
        self._camera = None

    def _tell(self, error: Exception) -> None:
        """Note, once, that there will be films missing; training goes on."""
        self._discard()
        if not self._blind:
            told = str(error) if isinstance(error, NoVideo) else f"of {type(error).__name__}: {error}"
            self.notes.append(f"Episode {self.local.episode} is not filmed because {' '.join(told.split())}")
        self._blind = True
