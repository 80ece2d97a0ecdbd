"""Algorithm 1 of the paper as one ordinary loop. Host code only: what is computed is in `senior.learner`.

A step of every run: choose an action; if a session is due, select, ask, fit and relabel; if due, the outer step; if
due, refresh the bonus; update; take the action; store. The update waits for nothing that taking the action gives, so
the environments are stepped while the device computes it, and it counts only once they have been: an environment that
breaks leaves a whole step undone, to be resumed. Where something rare is due that cannot be taken back (answers that
were given), the action is taken first.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

import jax
import numpy as np

from senior import health, session
from senior.envs.episodes import Episodes, Failure, Step
from senior.evaluate import judge, summary
from senior.learner import Purpose, act, acting, actor_of, mean_action
from senior.replay import Fact
from senior.runs import Given, PerRun, Proposal, Runs
from senior.schedule import Due, due
from senior.trainee import Trainee

LISTEN_EVERY = 10
"""Steps between looks at whether a session that is not waited for is answered."""
LISTEN_SECONDS = 0.1
"""Seconds between such looks at one that is."""


class Watcher(Protocol):
    """Who looks on while training runs."""

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        """A step was done."""
        ...

    def say(self, sentence: str) -> None:
        """Something a person should read."""
        ...

    @property
    def stop(self) -> bool:
        """Whether to save everything and leave, as after an interrupt."""
        ...


class Clock:
    """Seconds per part of the loop, of all its runs together."""

    def __init__(self, start: int) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self.started = time.perf_counter()
        self.start = start
        self._told: dict[int, tuple[int, float, dict[str, float]]] = {}  # per run: step, time and parts of its last row

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.spent[name] += time.perf_counter() - began

    def row(self, run: int, step: int) -> dict[str, float]:
        """A row of timing.csv: the parts since the run's last one, and the rate at which it advanced."""
        now = time.perf_counter()
        last_step, last, before = self._told.get(run, (self.start, self.started, {}))
        self._told[run] = step, now, dict(self.spent)
        rate = (step - last_step) / (now - last)
        parts = {name: seconds - before.get(name, 0.0) for name, seconds in self.spent.items()}
        return {"step": step, "seconds": now - self.started, "steps_per_second": rate, **parts}


class Training:
    """R runs of one `senior.shape` that advance together."""

    def __init__(self, trainees: Sequence[Trainee], runs: Runs, watcher: Watcher) -> None:
        self.trainees = list(trainees)
        self.runs = runs
        self.watcher = watcher
        self.clock = Clock(trainees[0].progress.step)
        self.last = max(trainee.config.steps for trainee in trainees)
        self.waits = False  # wait for the device after each part, so that its time is that part's (senior bench)

    def train(self) -> None:
        """Run from where the runs stand to their end, or until the watcher says stop."""
        last = self.last
        start = self.trainees[0].progress.step
        plans, given = self.look_ahead(start, [None] * len(self.trainees))
        for step in range(start, last + 1):
            stop = self.watcher.stop
            self.look_back(step, stop or step == last)
            if stop or step == last or not self.active():
                return

            with self.clock.part("act"):
                actions = self.runs.look(acting, act, self.mask(), given, "observation", "step", "random")
                if self.waits:
                    jax.block_until_ready([actions[i] for i in self.active()])
            heard = {i for i in self.active() if step % LISTEN_EVERY == 0 and self.heard(i, step)}
            rare = bool(heard) or any(plan.rare for plan in plans)
            # under vmap environments live in workers, and step while the update is handed over
            early = rare or (self.runs.lift == "vmap" and not self.waits)
            happened = None
            if early:
                self.send(actions)
            if rare:
                happened = self.receive(step)
                with self.clock.part("session"):
                    for i in self.active():
                        self.now_and_then(i, step, plans[i], i in heard)
            with self.clock.part("update"):
                update = self.update(plans, given)
                if self.waits:
                    self.wait(update)
            if not early:
                self.send(actions)
            if happened is None:
                happened = self.receive(step)
            with self.clock.part("store"):
                ahead, given = self.look_ahead(step + 1, happened)
                self.store(step, plans, happened, update, given)
                if self.waits:
                    self.wait()
            self.watcher.advance(step + 1, self.trainees)
            for i in self.active():
                self.trainees[i].tell("pretraining" if plans[i].pretrain or plans[i].random else "training", step + 1)
            plans = ahead

    def wait(self, update: Proposal | None = None) -> None:
        """Until the device has done everything asked of it, that update included."""
        self.runs.wait(update)

    def active(self) -> list[int]:
        """Runs that go on: that have neither failed nor taken all their steps."""
        return [i for i, trainee in enumerate(self.trainees) if trainee.goes_on]

    def mask(self) -> list[bool]:
        return [trainee.goes_on for trainee in self.trainees]

    # Every step.

    def send(self, actions: PerRun) -> None:
        """Have the environments take a step."""
        with self.clock.part("act"):
            chosen = {i: np.asarray(actions[i]) for i in self.active()}
        with self.clock.part("environment"):
            for i, action in chosen.items():
                self.trainees[i].environment.send(action)
            for i in chosen:
                self.trainees[i].environment.set_out()

    def receive(self, step: int) -> list[Step | None]:
        """What the step gave; a run whose environment breaks is saved as it was, and stopped."""
        happened: list[Step | None] = [None] * len(self.trainees)
        with self.clock.part("environment"):
            for i in self.active():
                result = self.trainees[i].environment.receive()
                self.note(i, self.trainees[i].environment)
                if isinstance(result, Failure):
                    self.fail(i, step, result.message)
                else:
                    happened[i] = result
        return happened

    def look_ahead(self, step: int, happened: Sequence[Step | None]) -> tuple[list[Due], Given]:
        """What is due at ``step``, and what the device must know to store what ``happened`` before and to take that
        step: it is being sent already."""
        trainees = self.trainees
        plans = [due(one.config, step, one.progress.queried, one.session_open) for one in trainees]
        given = self.runs.give(
            fact=[_fact(trainee, one) for trainee, one in zip(trainees, happened, strict=True)],
            observation=[trainee.environment.observation for trainee in trainees],
            step=[np.int32(step)] * len(trainees),
            random=[np.bool_(plan.random) for plan in plans],
            recent=self.recent(),
        )
        return plans, given

    def recent(self) -> list[np.int32]:
        """Per run, how many of the latest rows a share of its batch is drawn from."""
        return [np.int32(trainee.recent_rows()) for trainee in self.trainees]

    def update(self, plans: Sequence[Due], given: Given) -> Proposal | None:
        """What the update would make of every run, on state entropy in pre-training, on rewards afterwards.

        All runs have one shape, which says when updates begin and of what kind they are.
        """
        learner = self.trainees[0].learner
        if plans[0].pretrain:
            return self.runs.propose(learner.pretrain, ("agent", "deviation"), self.mask(), given, "step")
        if plans[0].update:
            recent = self.recent()
            if recent != given.columns["recent"]:  # an episode's end or a session came after
                given = self.runs.give(**{**given.columns, "recent": recent})
            return self.runs.propose(learner.learn, ("agent",), self.mask(), given, "step", "recent")
        return None

    def store(
        self,
        step: int,
        plans: Sequence[Due],
        happened: Sequence[Step | None],
        update: Proposal | None,
        given: Given,
    ) -> None:
        """Let the update count, store what happened in every run, which was ``given``, and count both."""
        learner, mask = self.trainees[0].learner, self.mask()
        info = self.runs.accept(update, mask) if update else None
        if step < self.trainees[0].config.pretraining.until:
            changed = "replay", "learned_return", "entropy"
            returns = self.runs.every(learner.store_pretraining, changed, mask, given, "fact")
        else:
            returns = self.runs.every(learner.store, ("replay", "learned_return"), mask, given, "fact")
        for i in self.active():
            one, plan, trainee = happened[i], plans[i], self.trainees[i]
            trainee.progress.pretraining_updates += plan.pretrain * trainee.config.pretraining.updates
            trainee.progress.updates += plan.update * trainee.config.sac.updates
            if one is None:
                continue
            told = info[i] if one.ended and info else {}
            trainee.record(step, one, returns[i] if one.ended else None, told)
            if {"beta", "intrinsic_mean"} <= told.keys() and trainee.progress.labels:
                self.warn(i, "bonus", health.bonus_zero(float(told["beta"]), float(told["intrinsic_mean"])))

    # Now and then, one run at a time.

    def now_and_then(self, i: int, step: int, plan: Due, heard: bool) -> None:
        """What is rare, in the order of Algorithm 1; ``heard``: the answers to a session that was not waited for."""
        trainee, learner, at = self.trainees[i], self.trainees[i].learner, np.int32(step)
        progress = trainee.progress
        if plan.begin and trainee.spec.length_scale is None and not progress.measured:
            self.runs.one(i, learner.measure)
            progress.measured = True
        warn = partial(self.warn, i)
        if heard:
            session.learn(trainee, self.runs, i, step, warn)
        elif plan.session:
            refused = session.hold(trainee, self.runs, i, step, plan.session, warn, partial(self.pause, i, step))
            if refused:
                self.fail(i, step, refused)
            if not trainee.goes_on:
                return
        if plan.outer and progress.labels:
            info = self.runs.one(i, learner.outer, trainee.latest_pairs(), at)
            progress.outer_steps += 1
            progress.latest["outer_loss"] = float(info["outer_loss"])
        if plan.refresh:
            self.runs.one(i, learner.refresh, at)
            progress.refreshes += 1
        if plan.begin:
            self.runs.one(i, learner.begin, at)
            progress.updates += trainee.config.sac.reset_updates

    def pause(self, i: int, step: int, first: bool) -> bool:
        """Wait a moment for answers, telling so at the ``first`` time; False: to be left off, as after an interrupt."""
        if self.watcher.stop:
            return False
        trainee = self.trainees[i]
        if first:
            self.watcher.say(f"{trainee.name} waits for answers at step {step:,}.")
        trainee.tell("waiting", step)
        time.sleep(LISTEN_SECONDS)
        return True

    def heard(self, i: int, step: int) -> bool:
        """Whether a session that is not waited for has been answered by ``step``."""
        trainee = self.trainees[i]
        if not trainee.session_open:
            return False
        refused = session.listen(trainee)
        if refused:
            self.fail(i, step, refused)
        return not refused and trainee.answered(step)

    # Looking back: evaluation, snapshots, checkpoints.

    def look_back(self, step: int, last: bool) -> None:
        """What is due before the action of ``step``; ``last``: all runs end or are interrupted here."""
        judged = [
            i
            for i in self.active()
            if step > self.trainees[i].progress.evaluated
            and (step % self.trainees[i].config.evaluation.every == 0 or step == self.trainees[i].config.steps)
        ]
        if judged:
            for i in judged:
                self.trainees[i].tell("evaluating", step)
            with self.clock.part("evaluate"):
                self.evaluate(judged, step)
        for i in self.active():
            trainee = self.trainees[i]
            config, progress = trainee.config, trainee.progress
            at_end = step == config.steps
            if i in judged:
                trainee.directory.append("timing.csv", self.clock.row(i, step))
            if step > progress.snapped and (step % config.snapshot_every == 0 or at_end):
                self.snapshot(i, step)
                progress.snapped = step
            if step > progress.step and (step % config.checkpoint_every == 0 or at_end or last):
                with self.clock.part("checkpoint"):
                    diverged = trainee.save(self.runs[i], step)
                if diverged:
                    self.fail(i, step, diverged)
            trainee.done = at_end

    def evaluate(self, judged: Sequence[int], step: int) -> None:
        """Judge the policies of some runs on fresh episodes; one whose environment breaks is stopped."""
        trainees = self.trainees
        shape = len(trainees), trainees[0].at_once, trainees[0].spec.observation_size  # whoever is beside a run

        def policies(observations: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
            seen = np.zeros(shape, np.float32)
            for i, rows in observations.items():
                seen[i, : len(rows)] = rows
            mask = [i in observations for i in range(len(trainees))]
            given = self.runs.give(observation=list(seen))
            actions = self.runs.look(actor_of, mean_action, mask, given, "observation")
            return {i: np.asarray(actions[i]) for i in observations}

        places = {i: trainees[i].judged_in for i in judged}
        found = judge(policies, places, {i: trainees[i].evaluation_episodes(step) for i in judged})
        for i, episodes in found.items():
            for place in places[i]:
                self.note(i, place)
            if isinstance(episodes, Failure):
                self.fail(i, step, episodes.message)
                continue
            trainee, progress, result = trainees[i], trainees[i].progress, summary(episodes)
            trainee.directory.append(
                "eval.csv", {"step": step, "labels": progress.labels, "queried": progress.queried, **result}
            )
            progress.evaluated, progress.success = step, result["success_rate"]
            if result["success_rate"] is not None and progress.learned_returns and progress.labels:
                progress.evaluations.append([result["success_rate"], float(np.mean(progress.learned_returns))])
                success, learned = zip(*progress.evaluations, strict=True)
                self.warn(i, "fall", health.success_falls(success, learned))
            progress.learned_returns.clear()

    def snapshot(self, i: int, step: int) -> None:
        """2,000 positions of the latest steps, and the samples behind f_P and f_E where there is PGE."""
        trainee = self.trainees[i]
        facts = self.runs.view(i, lambda run: run.replay.facts.observation)
        latest = min(step, trainee.config.snapshot_every, trainee.config.capacity)
        rows = trainee.rng(Purpose.SNAPSHOT, step).integers(step - latest, step, size=2000)
        positions = np.asarray(facts)[rows % trainee.config.capacity][:, trainee.spec.position]
        bonus = self.runs.view(i, lambda run: run.bonus)
        behind = {}
        if trainee.config.method.explore == "preference_guided" and bool(bonus.ready):
            behind = {
                "preferred": np.asarray(bonus.preferred),
                "explored": np.asarray(bonus.curiosity.observation)[:, trainee.spec.position],
                "intrinsic": np.asarray(bonus.intrinsic),
                "beta": np.asarray(bonus.beta),
                "length_scale": np.asarray(self.runs.view(i, lambda run: run.length_scale)),
            }
        trainee.directory.snapshot(step, positions, behind)

    def warn(self, i: int, kind: str, sentence: str | None) -> None:
        """Tell a health warning once per run and kind, and keep it in the run directory."""
        trainee = self.trainees[i]
        if sentence is None or kind in trainee.progress.warned:
            return
        trainee.progress.warned.append(kind)
        trainee.directory.warn(sentence)
        self.watcher.say(f"Warning ({trainee.name}): {sentence}")

    def note(self, i: int, place: Episodes) -> None:
        """Tell, and keep in the run directory, what went wrong with an environment and was put right."""
        while place.notes:
            sentence = place.notes.pop(0)
            self.trainees[i].directory.note(sentence)
            self.watcher.say(f"{self.trainees[i].name}: {sentence}")

    def fail(self, i: int, step: int, message: str) -> None:
        """Stop one run, with a checkpoint at the beginning of ``step``; the others go on."""
        trainee = self.trainees[i]
        if step > trainee.progress.step:
            message = trainee.save(self.runs[i], step) or message
        trainee.failure = message
        kept = ", with a checkpoint" if step and trainee.progress.step == step else ""
        self.watcher.say(f"{trainee.name} is stopped at step {step}{kept}: {message}")


def _fact(trainee: Trainee, happened: Step | None) -> Fact:
    """A transition for the device; where nothing happened, anything of the right shape."""
    if happened is None:
        o, a = trainee.spec.observation_size, trainee.spec.action_size
        nothing = np.zeros(o, np.float32)
        happened = Step(nothing, np.zeros(a, np.float32), 0.0, nothing, False, False, None)
    values: list[Any] = [
        happened.observation,
        happened.action,
        np.float32(happened.reward),
        happened.next_observation,
        np.bool_(happened.terminated),
        np.bool_(happened.truncated),
        np.int32(trainee.progress.episode),
    ]
    return Fact(*values)
