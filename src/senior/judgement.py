"""Judge and film the policy of a run as it was last saved."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from senior import evaluate, rundir
from senior.agent.networks import MLP
from senior.config import load
from senior.device import prepare_device
from senior.envs import render
from senior.envs.episodes import AFTERWARDS, Failure, Local, episode_seed
from senior.learner import mean_action
from senior.policy import load_policy
from senior.trainee import made_by, make_environment
from senior.types import BadInput


@dataclass(frozen=True)
class Judgement:
    """`evaluate_run`'s finding."""

    episodes: int
    success_rate: float | None
    """In [0, 1]: episodes with success at any step. None if the environment tells no success."""
    return_mean: float
    """True return, a sum over an episode."""
    return_std: float
    """Its population standard deviation."""
    step: int
    """When the policy was saved."""
    video: Path | None
    no_video: str | None
    """Why there is no video, in a sentence."""


def evaluate_run(path: Path | str, episodes: int = 10, video: Path | str | None = None) -> Judgement:
    """Judge a run's policy, as last saved, on fresh episodes that training never saw; film the first one if asked.

    Raises `BadInput` if there is no such run or no policy yet, ``video`` cannot be written, or the environment fails.
    """
    check_asked(episodes, video)
    path = Path(path)
    config = load(path / "config.json")
    prepare_device("auto")
    policy = load_policy(path)
    actor = MLP(tuple(map(jnp.asarray, policy.weights)), tuple(map(jnp.asarray, policy.biases)))
    act = jax.jit(mean_action)
    place = Local(lambda: make_environment(config), config.seed, AFTERWARDS)
    try:
        rundir.RunDirectory(path).check_fits(place.spec)
        episodes_of = {0: range(episodes)}
        judged = evaluate.judge(lambda seen: {0: np.asarray(act(actor, seen[0]))}, {0: [place]}, episodes_of)[0]
    finally:
        place.close()
    if isinstance(judged, Failure):
        raise BadInput(judged.message)
    summary = evaluate.summary(judged)
    reason = None
    if video is not None:
        seed = episode_seed(config.seed, AFTERWARDS, 0)
        lived = judged[0].actions, judged[0].observations
        reason = render.record(render.Request(seed, *lived, **made_by(config)), Path(video))
    return Judgement(
        episodes,
        summary["success_rate"],
        float(summary["return_mean"] or 0),
        float(summary["return_std"] or 0),
        policy.step,
        None if video is None or reason else Path(video),
        reason,
    )


def check_asked(episodes: int, video: Path | str | None) -> None:
    """`BadInput` for no episodes, or for a video that cannot be written or would take the place of something else."""
    if episodes < 1:
        raise BadInput(f"--episodes must be at least 1, not {episodes}.")
    if video is None:
        return
    file = Path(video)
    if file.suffix != ".mp4":
        raise BadInput(f"--video {file} must be named NAME.mp4.")
    rundir.make_room(file)
    with rundir.told(file):
        if file.exists():
            with file.open("rb") as there:
                if there.read(8)[4:] != b"ftyp":
                    raise BadInput(f"{file} is no video, and would be overwritten; name another file.")
        unfinished = file.with_name(f"{file.name}.part")  # as it is named until it is whole
        unfinished.touch()
        unfinished.unlink()


def film_policy(path: Path, out: Path) -> str | None:
    """Film one fresh episode of a run's policy; None, or the sentence why there is no video."""
    try:
        return evaluate_run(path, episodes=1, video=out).no_video
    except BadInput as error:
        return str(error)
