"""Whole programs: train, resume, evaluate. What the command line calls, and what ``import senior`` offers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from senior import evaluate, parts, rundir
from senior.agent.networks import MLP
from senior.checkpoint import Damaged, unpack
from senior.checks import check
from senior.config import Config, load
from senior.envs import render
from senior.envs.vector import AFTERWARDS, Environments, episode_seed
from senior.learner import Learner, Run, mean_action
from senior.loop import Training, Watcher
from senior.report.curves import learning_curve
from senior.runs import Lift, Runs, lift_for, prepare_device
from senior.trainee import Trainee, make_environment
from senior.types import BadInput, EnvSpec


class Quiet:
    """A watcher that prints what is said and nothing else, and never says stop."""

    stop = False

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        pass

    def say(self, sentence: str) -> None:
        print(sentence)


@dataclass(frozen=True)
class Result:
    """What came of one run."""

    path: Path
    seed: int | None
    """None if the run could not be opened."""
    step: int
    """Environment steps taken."""
    finished: bool
    failure: str | None
    """Why the run was stopped, in a sentence."""
    labels: int
    success_rate: float | None
    """Of the last evaluation, in [0, 1]; None if the environment tells no success or nothing was evaluated."""


def train(
    config: Config,
    out: Path | str,
    seeds: int = 1,
    watcher: Watcher | None = None,
    lift: Lift | None = None,
) -> list[Result]:
    """Train ``seeds`` runs (seeds ``config.seed``, +1, ...) in one program, each in ``out/seed-N``.

    watcher: who is told of every step and of warnings, and can stop the runs, all saved; None prints warnings.
    lift: how the runs share the program, ``loop`` or ``vmap``; None takes what suits the device.

    Returns one `Result` per run. Raises `BadInput` before anything is written if the configuration makes no
    sense, the environment does not fit, or a directory is not empty.
    """
    if seeds < 1:
        raise BadInput(f"--seeds must be at least 1, not {seeds}.")
    check(config)
    check(replace(config, seed=config.seed + seeds - 1))
    watcher = watcher or Quiet()
    device = prepare_device(config.device)
    config = replace(config, device=device, answering=parts.answering(config))
    learner = make_learner(config)
    if config.method.learns_reward and learner.spec.horizon <= config.queries.segment:
        raise BadInput(
            f"A segment of {config.queries.segment} steps does not fit into an episode of {learner.spec.horizon}; "
            "lower --segment."
        )
    if config.capacity < min(learner.spec.horizon, config.steps):
        raise BadInput(
            f"A replay of {config.capacity} rows cannot hold an episode of {learner.spec.horizon} steps; raise "
            "--replay-capacity."
        )
    trainees = []
    for number in range(seeds):
        own = replace(config, seed=config.seed + number)
        trainees.append(Trainee(own, Path(out) / f"seed-{own.seed}", learner))
    for trainee in trainees:
        trainee.directory.check_free()
        trainee.reset(0)
    protocol = rundir.protocol(learner.spec, device)
    for trainee in trainees:
        trainee.directory.create(trainee.config, protocol)
    _announce(device, watcher)
    runs = Runs([trainee.begin() for trainee in trainees], lift or lift_for(device))
    return _run(trainees, runs, watcher)


def resume(path: Path | str, watcher: Watcher | None = None) -> list[Result]:
    """Continue an interrupted run, or every run under a directory that is not finished.

    Runs that stand at the same step go on in one program. One that cannot go on is told, and the others do. Raises
    `BadInput` if there is no run, or the only one cannot go on.
    """
    watcher = watcher or Quiet()
    waiting: list[tuple[Trainee, Run]] = []
    results: list[Result] = []
    found = find_runs(path)
    for directory in found:
        try:
            waiting.append(_reopen(directory, watcher))
        except BadInput as error:
            if len(found) == 1:
                raise
            watcher.say(f"{directory}: {error}")
            results.append(Result(directory, None, 0, False, str(error), 0, None))
    if waiting:
        _announce(waiting[0][0].config.device, watcher)
    while waiting:
        first = waiting[0][0]
        together = [
            pair
            for pair in waiting
            if pair[0].progress.step == first.progress.step
            and replace(pair[0].config, seed=0) == replace(first.config, seed=0)
        ]
        waiting = [pair for pair in waiting if not any(pair is other for other in together)]
        trainees = [trainee for trainee, _ in together]
        for trainee in trainees:
            trainee.learner = first.learner
        runs = Runs([run for _, run in together], lift_for(first.config.device))
        results += _run(trainees, runs, watcher)
        if watcher.stop:
            for trainee, _ in waiting:
                trainee.close()
            return results + [_finish(trainee) for trainee, _ in waiting]
    return results


def _announce(device: str, watcher: Watcher) -> None:
    watcher.say(f"Training on the {device.upper()}, {rundir.threads()} threads.")


def _reopen(directory: Path, watcher: Watcher) -> tuple[Trainee, Run]:
    config = load(directory / "config.json")
    device = prepare_device(config.device)
    trainee = Trainee(config, directory, make_learner(config))
    _compare_protocol(trainee, device, watcher)
    try:
        return trainee, trainee.resume(watcher.say)
    except BadInput:
        trainee.close()
        raise


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
    if episodes < 1:
        raise BadInput(f"--episodes must be at least 1, not {episodes}.")
    path = Path(path)
    config = load(path / "config.json")
    if video is not None:
        rundir.make_room(Path(video))
    prepare_device("auto")
    step, actor = load_policy(path)
    policy = jax.jit(mean_action)
    environment = Environments(lambda: make_environment(config), [config.seed], AFTERWARDS)
    try:
        judged = evaluate.judge(
            lambda observation: np.asarray(policy(actor, observation)), environment, range(episodes)
        )
    except evaluate.EpisodeFailed as error:
        raise BadInput(str(error)) from error
    finally:
        environment.close()
    summary = evaluate.summary(judged)
    reason = None
    if video is not None:
        reason = film(config, AFTERWARDS, 0, judged[0].actions, Path(video))
    return Judgement(
        episodes,
        summary["success_rate"],
        float(summary["return_mean"] or 0),
        float(summary["return_std"] or 0),
        step,
        None if video is None or reason else Path(video),
        reason,
    )


def film_policy(path: Path, out: Path) -> str | None:
    """Film one fresh episode of a run's policy; None, or the sentence why there is no video."""
    try:
        return evaluate_run(path, episodes=1, video=out).no_video
    except BadInput as error:
        return str(error)


def load_policy(path: Path) -> tuple[int, MLP]:
    """The step and the actor of a run's saved policy."""
    file = path / "policy" / "actor.npz"
    if not file.exists():
        raise BadInput(f"{path} holds no policy yet: the run has not reached its first checkpoint.")
    try:
        saved = unpack(file)
        layers = sum(name.startswith("weight_") for name in saved)
        actor = MLP(
            tuple(jnp.asarray(saved[f"weight_{i}"]) for i in range(layers)),
            tuple(jnp.asarray(saved[f"bias_{i}"]) for i in range(layers)),
        )
        return int(saved["step"]), actor
    except (Damaged, KeyError) as error:
        raise BadInput(f"The policy of {path} cannot be read: {error}.") from error


def film(config: Config, purpose: int, episode: int, actions: np.ndarray, out: Path) -> str | None:
    """Write an episode as MP4 by living through it again; None, or the sentence why there is no video."""
    request = render.Request(
        task=None if config.env else config.task,
        seed=episode_seed(config.seed, purpose, episode),
        actions=actions,
        env=config.env,
        position=config.position,
        length_scale=config.length_scale,
        horizon=config.horizon,
    )
    return render.record(request, out)


def find_runs(path: Path | str) -> list[Path]:
    """The run directories at or under a path, in order; `BadInput` if there is none."""
    path = Path(path)
    with rundir.told(path):
        if (path / "config.json").is_file():
            return [path]
        found = sorted(file.parent for file in path.glob("**/config.json") if rundir.is_run(file.parent))
    if not found:
        raise BadInput(f"There is no run in {path}: no config.json of a run at or below it.")
    return found


def make_learner(config: Config) -> Learner:
    """The functions of a run of that configuration; looks at its environment once."""
    environment, spec = make_environment(config)
    environment.close()
    return _learner(replace(config, seed=0), spec)


@lru_cache(maxsize=16)
def _learner(config: Config, spec: EnvSpec) -> Learner:
    """One learner for equal configurations, so that what one run compiled serves the next."""
    return Learner(config, spec, parts.bonus(config, spec))


def _run(trainees: Sequence[Trainee], runs: Runs, watcher: Watcher) -> list[Result]:
    try:
        Training(trainees, runs, watcher).train()
        return [_finish(trainee) for trainee in trainees]
    finally:
        for trainee in trainees:
            trainee.close()


def _finish(trainee: Trainee) -> Result:
    """The learning curve, and what there is to say of a run."""
    progress, directory = trainee.progress, trainee.directory.path
    finished = trainee.failure is None and progress.step == trainee.config.steps
    if finished:
        learning_curve(directory)
    return Result(
        directory,
        trainee.config.seed,
        progress.step,
        finished,
        trainee.failure,
        progress.labels,
        progress.success,
    )


def _compare_protocol(trainee: Trainee, device: str, watcher: Watcher) -> None:
    """Say so if the bits may differ from those of the uninterrupted run."""
    then = rundir.read_protocol(trainee.directory.path)
    now = rundir.protocol(trainee.spec, device)
    changed = [name for name in ("device", "threads", "packages") if then.get(name) != now[name]]
    if changed:
        watcher.say(
            f"{trainee.name}: {' and '.join(changed)} differ from when the run began, so it goes on but may not equal "
            "the uninterrupted run bit for bit."
        )
