"""The host's half of one run: its environments, teacher, preferences and files, and where it stands."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from senior import checkpoint, envs, labels, parts
from senior.config import Config, made_by
from senior.envs.episodes import EVALUATION, TRAINING, Episodes, Failure, Local, Step, episode_seed, restore
from senior.envs.recording import Recording, repeats_itself
from senior.envs.workers import Remote, Worker
from senior.learner import Learner, Purpose, Run
from senior.preferences import Preferences
from senior.reward.bilevel import FirstSteps
from senior.reward.model import Labelled
from senior.rundir import RunDirectory, told
from senior.types import BadInput, EnvSpec, Pairs

JUDGED_AT_ONCE = 10
"""Most episodes of one evaluation that a GPU, which waits for each of their steps, judges side by side."""


@dataclass
class Progress:
    """Where a run stands; goes into every checkpoint as JSON."""

    step: int = 0
    evaluated: int = 0  # the step of the last evaluation
    snapped: int = 0  # and of the last snapshot
    written: int = 0  # facts that are in chunks on the disk
    queried: int = 0
    labels: int = 0
    success: float | None = None  # of the last evaluation
    sessions: int = 0  # that were asked
    collected: int = 0  # of those, that were answered and learned from
    outer_steps: int = 0
    refreshes: int = 0
    pretraining_updates: int = 0
    updates: int = 0
    episode: int = 0
    elapsed: int = 0
    episode_return: float = 0.0
    episode_success: float | None = None
    recent: list[list[int]] = field(default_factory=list)  # [episode, first row, length] of those pairs are cut from
    returns: list[list[float]] = field(default_factory=list)  # [true return, length] of the latest ten episodes
    measured: bool = False  # the length scale was taken from the data
    right: list[int] = field(default_factory=list)  # per session, new pairs predicted rightly before the fit
    decided: list[int] = field(default_factory=list)  # of so many
    learned_returns: list[float] = field(default_factory=list)  # of the episodes since the last evaluation
    evaluations: list[list[float]] = field(default_factory=list)  # [success, mean learned return]
    latest: dict[str, float] = field(default_factory=dict)  # numbers of rare events, as last told
    lengths: dict[str, int] = field(default_factory=dict)  # bytes of the append-only files
    warned: list[str] = field(default_factory=list)


def make_environment(config: Config) -> tuple[Any, EnvSpec]:
    """The environment of a configuration."""
    return envs.make(**made_by(config))


def judged_at_once(device: str) -> int:
    """How many episodes of an evaluation are lived side by side at most, each in an environment of its own.

    On a CPU one: more would take memory, win little, and give other last bits.
    """
    return JUDGED_AT_ONCE if device == "gpu" else 1


class Trainee:
    """One run, as its host sees it. `begin` or `resume` gives it its state."""

    def __init__(
        self, config: Config, path: Path, learner: Learner, spec: EnvSpec, worker: Worker | None = None
    ) -> None:
        """``spec``: of its environment. ``worker``: the process that its environments live in; None: this one."""
        self.config = config
        self.spec = spec
        self.learner = learner
        self.directory = RunDirectory(path)
        self.progress = Progress()
        self.failure: str | None = None
        self.done = False
        self.filmed = self._must_be_filmed()
        self.environment = self._film() if self.filmed else self._place(TRAINING, worker)
        self.at_once = judged_at_once(config.device)
        places = min(config.evaluation.episodes, self.at_once)
        self.judged_in = [self._place(EVALUATION, worker) for _ in range(places)]
        self.rule = parts.selection(config) if config.method.learns_reward else None
        self.teacher = parts.teacher(config)
        self.rules = config.asking.rules
        self._told: tuple[str, float, int] = ("", 0.0, 0)  # phase, time and step of what was told last
        self.put: set[int] = set()  # pairs of the session under way that were put to the teacher
        self._preferences: Preferences | None = None

    def _place(self, purpose: int, worker: Worker | None) -> Episodes:
        if worker is None:
            return Local(lambda: make_environment(self.config), self.config.seed, purpose)
        return Remote(worker, made_by(self.config), self.spec, self.config.seed, purpose)

    def _must_be_filmed(self) -> bool:
        """Whether people can only see what happened if it is filmed when it does: see `senior.envs.recording`."""
        if self.config.teacher != "human" or self.config.env is None:
            return False
        return self.directory.films.exists() or not repeats_itself(lambda: make_environment(self.config))

    def _film(self) -> Episodes:
        """The training environment, in this process, filmed."""
        local = Local(lambda: envs.make(**made_by(self.config), render=True), self.config.seed, TRAINING)
        return Recording(local, self.directory.films, self.config.queries.segment)

    @property
    def name(self) -> str:
        return f"seed {self.config.seed}"

    @property
    def goes_on(self) -> bool:
        """Whether it has neither failed nor taken all its steps."""
        return self.failure is None and not self.done

    @property
    def preferences(self) -> Preferences:
        """The run's preference file, opened at first use."""
        if self._preferences is None:
            queries, spec = self.config.queries, self.spec
            self._preferences = Preferences(
                self.directory.preferences,
                queries.budget,
                queries.segment,
                spec.observation_size,
                spec.action_size,
            )
        return self._preferences

    def rng(self, purpose: Purpose, step: int) -> np.random.Generator:
        """Random numbers of the host, by purpose and step like the device's."""
        return np.random.default_rng([self.config.seed, purpose, step])

    # Beginning, saving, resuming.

    def begin(self) -> Run:
        """A new run in a directory made for it, whose environment stands at its first step (`reset`)."""
        self.directory.forget_everything()
        self._open_preferences()
        if self.rule and parts.is_recorded(self.config) and not self.preferences.session(0):
            labels.import_labels(Path(self.config.teacher), self.preferences, self.config.queries.per_session)
        return self.learner.init(self.config)

    def stand(self, progress: dict[str, Any] | None) -> None:
        """Take over where a checkpoint says the run stands, without its state; None: at the beginning."""
        self.progress = Progress(**progress) if progress else Progress()

    def reset(self, episode: int) -> None:
        """Bring the environment to the beginning of an episode; `BadInput` if it cannot."""
        failed = self.environment.begin(episode)
        if failed:
            raise BadInput(failed.message)

    def resume(self, tell: Callable[[str], None]) -> Run:
        """The newest checkpoint that can be read, or the beginning if there is none yet.

        Raises `BadInput` if its directory cannot be used. Whoever calls this holds the directory's lock.
        """
        with told(self.directory.path):
            return self._resume(tell)

    def _resume(self, tell: Callable[[str], None]) -> Run:
        found = checkpoint.newest(self.directory.checkpoints, lambda: self.learner.init(self.config), tell)
        if found is None:
            if any(self.directory.checkpoints.glob("step-*.npz")):
                raise BadInput(f"No checkpoint in {self.directory.path} can be read; the run cannot be resumed.")
            self.directory.check_beginning(self.config.checkpoint_every)
            if isinstance(self.environment, Recording):
                self.environment.forget(0)
            self.reset(0)
            return self.begin()
        step, run, progress = found
        self.stand(progress)
        self.progress.written = int(run.replay.count)  # the checkpoint was made before its own chunk was counted
        self.directory.truncate(self.progress.lengths, step)
        self._open_preferences()
        return self._relive(run)

    def _open_preferences(self) -> None:
        """Open the preference file with the labels that were learned from. Plain SAC asks nothing and has none.

        Sessions that it holds beyond are kept: the run will come to them, and to the answers that were given.
        """
        if self.config.method.learns_reward:
            self.preferences.read(self.progress.collected)

    def _relive(self, run: Run) -> Run:
        """Bring the environment to where the run stands, by the running episode's seed and actions; the run.

        One that is filmed goes on with another episode instead. Any other that does not repeat itself is found out on
        the way. Where no episode is running, the latest one is lived through again for that.
        """
        progress, count = self.progress, int(run.replay.count)
        if isinstance(self.environment, Recording):  # it cannot be lived through again: the episode is broken off
            self.environment.forget(progress.episode)
            progress.episode += bool(progress.elapsed)
            progress.elapsed, progress.episode_return, progress.episode_success = 0, 0.0, None
            self.reset(progress.episode)
            return run._replace(learned_return=run.learned_return * 0)
        episode, rows = progress.episode, np.arange(count - progress.elapsed, count)
        latest = progress.recent[-1:]
        if not progress.elapsed and latest and latest[0][1] >= count - run.replay.capacity:
            episode, first, length = latest[0]
            rows = np.arange(first, first + length)
        rows = rows % run.replay.capacity
        steps = restore(self.environment, episode, np.asarray(run.replay.facts.action)[rows])
        if isinstance(steps, Failure):
            raise BadInput(f"The run cannot go on: {steps.message}")
        stored = np.asarray(run.replay.facts.next_observation)[rows]
        if steps and not np.array_equal(np.stack([step.next_observation for step in steps]), stored):
            raise BadInput(
                f"The environment {self.spec.name} does not repeat an episode from its seed and actions, so the run in "
                f"{self.directory.path} cannot be resumed exactly; its reset must honour the seed it is given."
            )
        if not progress.elapsed:
            self.reset(progress.episode)
        return run

    def save(self, run: Run, step: int) -> str | None:
        """Write the policy and a checkpoint at the beginning of ``step``. Returns None, or in a sentence that the
        networks have diverged: they are not saved.

        The policy first: a run that is killed between the two then writes it again, where the other way round one
        killed after its last checkpoint would keep an older policy for ever.
        """
        progress = self.progress
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((run.agent, run.model))):
            return (
                f"Its networks have diverged: by step {step} they hold numbers that are not finite. What was saved at "
                f"step {progress.step} is kept; lower the rates of --sac or --reward."
            )
        self.directory.save_policy({**policy_arrays(run), "step": np.asarray(step)})
        progress.step = step
        progress.lengths = self.directory.lengths()
        progress.written = checkpoint.save(self.directory.checkpoints, step, run, asdict(progress), progress.written)
        return None

    def tell(self, phase: str, step: int) -> None:
        """Tell whoever looks on from outside what the run is doing; twice a second at most.

        phase: starting, pretraining, training, waiting (for answers), evaluating, finished or stopped.
        """
        now, (before, last, at) = time.time(), self._told
        if phase == before and now - last < 0.5:
            return
        rate = (step - at) / (now - last) if step > at and last else None
        self._told = phase, now, step
        self.directory.tell(
            {
                "phase": phase,
                "step": step,
                "steps": self.config.steps,
                "steps_per_second": rate,
                "labels": self.progress.labels,
                "success": self.progress.success,
                "failure": self.failure,
                "process": os.getpid(),
            }
        )

    def close(self) -> None:
        """Close environments and files."""
        self.environment.close()
        for place in self.judged_in:
            place.close()
        self.directory.close()
        if self._preferences is not None:
            self._preferences.close()
            self._preferences = None

    # What happened.

    def record(self, step: int, happened: Step, learned_return: Any, info: dict[str, Any]) -> None:
        """Count a step that was taken at ``step``; at the end of an episode write its row."""
        progress = self.progress
        progress.elapsed += 1
        progress.episode_return += happened.reward
        if happened.success is not None:
            progress.episode_success = max(progress.episode_success or 0.0, happened.success)
        if not happened.ended:
            return
        learned = float(learned_return) if self.config.method.learns_reward else None
        numbers = {name: float(value) for name, value in info.items()}
        self.directory.append(
            "train.csv",
            {
                "step": step + 1,
                "episode": progress.episode,
                "episode_length": progress.elapsed,
                "episode_return": progress.episode_return,
                "episode_success": progress.episode_success,
                "learned_return": learned,
                "queried": progress.queried,
                "labels": progress.labels,
                "outer_steps": progress.outer_steps,
                "refreshes": progress.refreshes,
                **progress.latest,
                **numbers,
            },
        )
        if learned is not None:
            progress.learned_returns.append(learned)
        if progress.elapsed > self.config.queries.segment:
            progress.recent.append([progress.episode, step + 1 - progress.elapsed, progress.elapsed])
            del progress.recent[: -self.config.window]
            if isinstance(self.environment, Recording):  # clips may still be cut from what is asked about
                self.environment.keep({row[0] for row in progress.recent} | self.preferences.open_episodes())
        progress.returns.append([progress.episode_return, progress.elapsed])
        del progress.returns[:-10]
        progress.episode += 1
        progress.elapsed, progress.episode_return, progress.episode_success = 0, 0.0, None

    # What can be asked and what was said, as arrays.

    def candidate_starts(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Rows, episodes and first steps, each ``[P, 2]``, of independently drawn candidate pairs.

        Episodes are uniform over the latest complete ones that are longer than a segment and still in the replay at
        ``step``; starts are uniform, the episode's last step excluded. None if there are fewer than two such episodes.
        """
        queries = self.config.queries
        usable = [row for row in self.progress.recent if row[1] >= step - self.config.capacity]
        if len(usable) < 2:
            return None
        episode, first, length = np.array(usable).T
        rng = self.rng(Purpose.CANDIDATES, step)
        shape = (queries.pool * queries.per_session, 2)
        drawn = rng.integers(len(usable), size=shape)
        start = rng.integers(length[drawn] - queries.segment)
        return (first[drawn] + start).astype(np.int32), episode[drawn], start

    def episodes_of(self, pairs: Pairs, actions: np.ndarray) -> dict[int, tuple[int, np.ndarray]]:
        """Seed and actions [n, a] of every episode that pairs were cut from; ``actions``: the replay's."""
        found = {}
        rows = {episode: (first, length) for episode, first, length in self.progress.recent}
        for episode in np.unique(pairs.episode).tolist():
            first, length = rows[episode]
            seed = episode_seed(self.config.seed, TRAINING, episode)
            found[episode] = seed, actions[np.arange(first, first + length) % self.config.capacity]
        return found

    @property
    def session_open(self) -> bool:
        """Whether a session was asked that is not yet learned from."""
        return self.progress.collected < self.progress.sessions

    def answered(self, step: int, waited_for: bool = False) -> bool:
        """Whether the session under way can be learned from at ``step``; ``waited_for``: the run stands still."""
        settle = self.config.asking.settle if self.config.teacher == "human" else 0.0
        return self.preferences.ready(self.progress.collected, step, self.rules, settle, waited_for)

    def evaluation_episodes(self, step: int) -> range:
        """Numbers of the episodes of the evaluation at ``step``; no two evaluations share one."""
        every, count = self.config.evaluation.every, self.config.evaluation.episodes
        first = -(-step // every) * count
        return range(first, first + count)

    def recent_rows(self) -> int:
        """How many of the latest rows QPA draws a share of each batch from; 0: none, or not any more.

        As many as its episodes have at their longest, the running one included; only while there is budget.
        """
        progress, config = self.progress, self.config
        if config.method.mix != "recent" or progress.queried >= config.queries.budget:
            return 0
        return min(config.qpa.episodes, progress.episode) * self.spec.horizon

    def reward_per_step(self) -> float:
        """Mean true reward of the latest ten episodes; scripted teachers measure by it."""
        total, steps = np.sum(self.progress.returns or [[0.0, 1.0]], axis=0)
        return float(total / steps)

    def labelled(self) -> Labelled:
        """All labels so far, in arrays of the budget's size."""
        observation, action, second, count = self.preferences.arrays
        return Labelled(observation, action, second, np.int32(count))  # pyright: ignore[reportArgumentType]

    def latest_pairs(self) -> FirstSteps:
        """First steps of the M most recent labelled pairs, for the outer step."""
        observation, action, second, count = self.preferences.arrays
        m = self.config.queries.per_session
        rows = np.arange(count - m, count)
        weight = (rows >= 0).astype(np.float32)
        rows = np.maximum(rows, 0)
        return FirstSteps(observation[rows, :, 0], action[rows, :, 0], second[rows], weight)  # pyright: ignore[reportArgumentType]


def policy_arrays(run: Run) -> dict[str, np.ndarray]:
    """The delivered policy: per layer ``weight_i [in, out]`` and ``bias_i [out]``."""
    actor = run.agent.actor
    return {
        f"{kind}_{i}": np.asarray(layer)
        for kind, layers in (("weight", actor.weights), ("bias", actor.biases))
        for i, layer in enumerate(layers)
    }
