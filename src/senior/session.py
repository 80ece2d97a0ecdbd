"""A session of Algorithm 1: choose pairs of segments, ask about them, fit the reward model to the answers.

Host code. `hold` is a session that is waited for, in three parts: `ask` puts the pairs, `listen` takes down what the
teacher has said since, `learn` fits once all is answered. A session that is in the preference file already, because
a run that went on after it was killed comes to it again, is not chosen anew: what was said of it still holds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from senior import health, parts
from senior.learner import Purpose
from senior.runs import Runs
from senior.select import Context, probability_second
from senior.trainee import Progress, Trainee
from senior.types import Answers, Pairs, Preferred, Query

Warn = Callable[[str, str | None], None]
"""Tells a warning of a kind, if there is one."""
Drawn = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Rows, episodes and first steps of candidate pairs (`Trainee.candidate_starts`)."""


def hold(
    trainee: Trainee, runs: Runs, i: int, step: int, n: int, warn: Warn, pause: Callable[[bool], bool]
) -> str | None:
    """Ask ``n`` pairs in run ``i`` of ``runs``, and learn from the answers if they come at once or are waited for.

    pause: waits a moment, told whether it is the first; False: the run is to be left as it was saved before it asked.
    Returns None, or in a sentence why the run cannot go on.
    """
    if parts.takes_time(trainee.config) and step > trainee.progress.step:
        diverged = trainee.save(runs[i], step)  # whatever befalls it while it waits
        if diverged:
            return diverged
    if not ask(trainee, runs, i, step, n, warn):
        return None
    refused, first = listen(trainee), True
    must_wait = trainee.config.asking.wait or not trainee.progress.labels
    while not refused and not (trainee.answered(step, must_wait) and learn(trainee, runs, i, step, warn)):
        if not must_wait:
            return None
        if not pause(first):
            trainee.done = True
            return None
        refused, first = listen(trainee), False
    return refused


def ask(trainee: Trainee, runs: Runs, i: int, step: int, n: int, warn: Warn) -> bool:
    """Put ``n`` pairs of run ``i`` of ``runs`` into its preference file; False: put off, there are no episodes yet."""
    progress, preferences = trainee.progress, trainee.preferences
    drawn = trainee.candidate_starts(step)
    if drawn is None:
        warn(
            f"session at {step}",
            f"The session at step {step} is put off: fewer than two complete episodes are longer than a segment of "
            f"{trainee.config.queries.segment} steps.",
        )
        return False
    held = preferences.session(progress.sessions)
    if held and not preferences.foretold(progress.sessions):  # taken over from another run
        put = preferences.query(held, trainee.reward_per_step()).pairs
        summed = runs.one(i, trainee.learner.summed_rewards, put.observation, put.action)
        preferences.foretell(held, probability_second(np.asarray(summed).mean(axis=0)))
    if not held:
        query, reserves = _choose(trainee, runs, i, step, n, drawn, warn)
        sides = trainee.rng(Purpose.SIDES, step).integers(2, size=len(query.pairs))
        actions = np.asarray(runs.view(i, lambda run: run.replay.facts.action))
        episodes = trainee.episodes_of(query.pairs, actions)
        preferences.add(query, progress.sessions, step, trainee.config.seed, sides, reserves, episodes)
    trainee.put.clear()
    progress.sessions += 1
    progress.queried += n
    return True


def _choose(trainee: Trainee, runs: Runs, i: int, step: int, n: int, drawn: Drawn, warn: Warn) -> tuple[Query, int]:
    """Pairs to ask, best first, of those ``drawn``, and how many of them are only in reserve."""
    learner, progress = trainee.learner, trainee.progress
    starts, episodes, first_steps = drawn
    observation, action, reward = (np.asarray(column) for column in runs.one(i, learner.cut, starts))
    pool = Pairs(observation, action, reward, episodes, first_steps)
    length_scale = float(runs.view(i, lambda run: run.length_scale))
    variance = pool.observation[..., trainee.spec.position].var(axis=-2).max()
    warn("motion", health.nothing_moves(float(variance), length_scale))

    def predict(observation: np.ndarray, action: np.ndarray) -> np.ndarray:
        return np.asarray(runs.one(i, learner.summed_rewards, observation, action))

    rule = trainee.rule if progress.labels and trainee.rule else parts.first_selection()
    labelled = trainee.preferences.arrays.observation[: progress.labels]
    context = Context(pool, predict, trainee.spec, length_scale, labelled)
    reserves = n if trainee.config.asking.replace_skipped else 0
    chosen = rule(trainee.rng(Purpose.SELECT, step), context, n + reserves)
    before = predict(pool.observation, pool.action).mean(axis=0)[chosen.index]
    return Query(pool.take(chosen.index), chosen.scores, probability_second(before)), reserves


def listen(trainee: Trainee) -> str | None:
    """Ask what was not yet asked of the session under way, and write down what the teacher has said.

    Returns None, or in a sentence why the run cannot go on.
    """
    session, preferences = trainee.progress.collected, trainee.preferences
    while True:
        waiting = preferences.unanswered(session, trainee.rules)
        if new := [number for number in waiting if number not in trainee.put]:
            trainee.put.update(new)
            trainee.teacher.ask(new, preferences.query(new, trainee.reward_per_step()))
        answers = trainee.teacher.collect()
        if not answers.ids:
            return None
        once = len(set(answers.ids)) == len(answers.ids) == len(answers.labels)
        if not (once and set(answers.ids) <= set(waiting) and set(answers.labels) <= {None, *map(int, Preferred)}):
            return (
                f"The teacher {trainee.config.teacher} must answer pairs that it was asked, each once, by first (0), "
                "second (1), equal (-1) or a skip (None)."
            )
        labels = [None if label is None else int(label) for label in answers.labels]  # they may be NumPy's
        preferences.answer(Answers([int(number) for number in answers.ids], labels), trainee.config.teacher)


def learn(trainee: Trainee, runs: Runs, i: int, step: int, warn: Warn) -> bool:
    """Collect the session under way, all of which is answered, and fit the reward model to all labels so far.

    False, and nothing is done, where an answer was undone in the last moment.
    """
    learner, progress, preferences = trainee.learner, trainee.progress, trainee.preferences
    informed = progress.labels > 0
    if not preferences.collect(progress.collected, step, trainee.rules):
        return False
    _judge_predictions(progress, preferences.judged(progress.collected), informed, warn)
    progress.collected += 1
    progress.labels = preferences.arrays.count
    if progress.labels:
        at = np.int32(step)
        info = runs.one(i, learner.fit, trainee.labelled(), at)
        progress.latest.update({name: float(value) for name, value in info.items()})
        positions, count = preferences.preferred_positions(trainee.spec.position, trainee.config.pge.equal)
        runs.one(i, learner.on_session, positions, np.int32(count), at)
    return True


def _judge_predictions(
    progress: Progress, judged: list[tuple[float | None, float | None]], informed: bool, warn: Warn
) -> None:
    """Prospective accuracy: the model's prediction of new pairs before it is fitted to them, against the labels.

    ``informed``: it had been fitted to some before.
    """
    decided = [
        (prediction > 0.5) == (second > 0.5)
        for prediction, second in judged
        if prediction is not None and second not in (None, 0.5)
    ]
    if not decided:
        return
    progress.latest["reward_accuracy"] = sum(decided) / len(decided)
    if informed:
        progress.right.append(int(sum(decided)))
        progress.decided.append(len(decided))
        warn("accuracy", health.accuracy_at_chance(progress.right, progress.decided))
