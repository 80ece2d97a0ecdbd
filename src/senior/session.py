"""A session of Algorithm 1: choose pairs of segments, ask about them, fit the reward model to the answers.

Host code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from senior import health, parts
from senior.learner import Purpose
from senior.runs import Runs
from senior.select import Context, probability_second
from senior.trainee import Progress, Trainee
from senior.types import Pairs, Preferred, Query

Warn = Callable[[str, str | None], None]
"""Tells a warning of a kind, if there is one."""


def hold(trainee: Trainee, runs: Runs, i: int, step: int, n: int, warn: Warn) -> str | None:
    """Ask ``n`` pairs in run ``i`` of ``runs``, and learn from the answers; put off where there are no episodes yet.

    Returns None, or in a sentence why the run cannot go on; then nothing was asked.
    """
    learner, progress, preferences = trainee.learner, trainee.progress, trainee.preferences
    drawn = trainee.candidate_starts(step)
    if drawn is None:
        warn(
            f"session at {step}",
            f"The session at step {step} is put off: fewer than two complete episodes are longer than a segment of "
            f"{trainee.config.queries.segment} steps.",
        )
        return None
    starts, episodes, first_steps = drawn
    observation, action, reward = (np.asarray(column) for column in runs.one(i, learner.cut, starts))
    pool = Pairs(observation, action, reward, episodes, first_steps)
    length_scale = float(runs.view(i, lambda run: run.length_scale))
    variance = pool.observation[..., trainee.spec.position].var(axis=-2).max()
    warn("motion", health.nothing_moves(float(variance), length_scale))

    def predict(observation: np.ndarray, action: np.ndarray) -> np.ndarray:
        return np.asarray(runs.one(i, learner.summed_rewards, observation, action))

    informed = progress.labels > 0
    rule = trainee.rule if informed and trainee.rule else parts.first_selection()
    labelled = preferences.arrays.observation[: progress.labels]
    context = Context(pool, predict, trainee.spec, length_scale, labelled)
    chosen = rule(trainee.rng(Purpose.SELECT, step), context, n)
    before = predict(pool.observation, pool.action).mean(axis=0)[chosen.index]
    query = Query(pool.take(chosen.index), chosen.scores, probability_second(before), trainee.reward_per_step())

    sides = trainee.rng(Purpose.SIDES, step).integers(2, size=n)
    ids = preferences.add(query, progress.sessions, step, trainee.config.seed, sides)
    trainee.teacher.ask(ids, query)
    answers = trainee.teacher.collect()
    if sorted(answers.ids) != ids or not set(answers.labels) <= {None, *map(int, Preferred)}:
        preferences.truncate(ids[0] - 1)
        return (
            f"The teacher {trainee.config.teacher} must answer every pair at once, by first (0), second (1), "
            "equal (-1) or a skip (None)."
        )
    preferences.answer(answers, trainee.config.teacher, step)
    progress.sessions += 1
    progress.queried += n
    progress.labels = preferences.arrays.count

    said = dict(zip(answers.ids, answers.labels, strict=True))
    _judge_predictions(progress, query, [said[number] for number in ids], informed, warn)
    if progress.labels:
        at = np.int32(step)
        info = runs.one(i, learner.fit, trainee.labelled(), at)
        progress.latest.update({name: float(value) for name, value in info.items()})
        positions, count = preferences.preferred_positions(trainee.spec.position, trainee.config.pge.equal)
        runs.one(i, learner.on_session, positions, np.int32(count), at)
    return None


def _judge_predictions(
    progress: Progress, query: Query, labels: Sequence[int | None], informed: bool, warn: Warn
) -> None:
    """Prospective accuracy: the model's prediction of new pairs before it is fitted to them.

    ``informed``: it had been fitted to some before.
    """
    assert query.prediction is not None
    decided = [
        (probability > 0.5) == (label == Preferred.SECOND)
        for probability, label in zip(query.prediction, labels, strict=True)
        if label in (Preferred.FIRST, Preferred.SECOND)
    ]
    if not decided:
        return
    progress.latest["reward_accuracy"] = sum(decided) / len(decided)
    if informed:
        progress.right.append(int(sum(decided)))
        progress.decided.append(len(decided))
        warn("accuracy", health.accuracy_at_chance(progress.right, progress.decided))
