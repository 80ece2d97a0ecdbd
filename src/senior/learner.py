"""The traced half of a run: its state, and the pure functions of one run that the loop calls.

Every function takes the state of one run first and returns ``(state, result)``; there is no run axis in sight
(`senior.runs` lifts them). Host things (the environment, the schedule, teachers, files) are in `senior.loop`.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from senior import replay as replay_
from senior.agent import sac
from senior.agent.networks import MLP, Arithmetic, bfloat16_product, normalised_relu
from senior.config import Config
from senior.explore import Bonus, Now, preference_guided, state_entropy
from senior.replay import Fact, Replay
from senior.reward import bilevel, model
from senior.shape import Numbers, numbers_of, shape
from senior.types import Batch, EnvSpec, Source


class Purpose(IntEnum):
    """What a random number is for: keys are ``fold_in(seed, purpose, step)``."""

    INIT = 0
    ACT = 1
    UPDATE = 2
    RENEW = 3
    FIT = 4
    SESSION = 5
    REFRESH = 6
    OUTER = 7
    CANDIDATES = 8  # these and the next are drawn on the host
    SELECT = 9
    SIDES = 10
    SNAPSHOT = 11
    TEACHER = 12  # senior.teachers.scripted.RANDOM


class Run(NamedTuple):
    """Everything of one run that changes while it learns and lives on the device."""

    seed: Int[Array, ""]
    numbers: Numbers
    agent: sac.Agent
    model: model.RewardModel | None  # None for plain SAC
    replay: Replay
    entropy: state_entropy.StateEntropy | None  # this and the next: None without pre-training
    deviation: state_entropy.Deviation | None
    bonus: Any
    length_scale: Float[Array, ""]
    learned_return: Float[Array, ""]  # learned reward summed over the running episode


class Learner:
    """The functions of one run, for all configurations of one `shape`. Holds no state."""

    def __init__(self, config: Config, spec: EnvSpec, bonus: Bonus) -> None:
        self.config = shape(config)
        self.spec = spec
        self.bonus = bonus
        self.arithmetic = Arithmetic(
            normalised_relu if config.networks.layer_norm else jax.nn.relu,
            bfloat16_product if config.precision == "bfloat16" else jnp.matmul,
        )
        self._compiled_init = jax.jit(self._init)

    def init(self, config: Config) -> Run:
        """The state of a run of that configuration, which must have this shape, before its first step."""
        assert shape(config) == self.config, "this configuration needs a learner of its own"
        return self._compiled_init(np.uint32(config.seed), numbers_of(config), config.sac.initial_alpha)

    def _init(self, seed: Int[Array, ""], numbers: Numbers, initial_alpha: Float[Array, ""]) -> Run:
        config, spec, nets = self.config, self.spec, self.config.networks
        key_agent, key_model = jax.random.split(jax.random.fold_in(jax.random.key(seed), Purpose.INIT))
        until, neighbours = config.pretraining.until, config.pretraining.neighbours
        entropy, deviation = state_entropy.init(until, spec.observation_size, neighbours) if until else (None, None)
        return Run(
            seed=seed,
            numbers=numbers,
            agent=sac.init(
                key_agent,
                spec.observation_size,
                spec.action_size,
                nets.layers,
                nets.width,
                initial_alpha,
            ),
            model=self._new_model(key_model) if config.method.learns_reward else None,
            replay=replay_.init(config.capacity, spec.observation_size, spec.action_size),
            entropy=entropy,
            deviation=deviation,
            bonus=self.bonus.init(),
            length_scale=jnp.float32(spec.length_scale or 1.0),
            learned_return=jnp.zeros(()),
        )

    def _new_model(self, key: PRNGKeyArray) -> model.RewardModel:
        """Where it standardises, observations enter as they come (but for the cut) until the first fit."""
        reward, nets, size = self.config.reward, self.config.networks, self.spec.observation_size
        new = model.init(key, reward.members, size + self.spec.action_size, nets.reward_layers, nets.reward_width)
        return new._replace(scaling=model.Scaling(jnp.zeros(size), jnp.ones(size))) if reward.standardise else new

    # Every step.

    def store(self, run: Run, fact: Fact) -> tuple[Run, Float[Array, ""]]:
        """Store what happened, with its learned reward; returns the episode's learned return so far."""
        mean, spread = self._score(run, fact.observation[None], fact.action[None])
        learned_return = run.learned_return + mean[0]
        over = fact.terminated | fact.truncated
        run = run._replace(
            replay=replay_.store(run.replay, fact, mean[0], spread[0]),
            learned_return=jnp.where(over, 0.0, learned_return),
        )
        return run, learned_return

    def store_pretraining(self, run: Run, fact: Fact) -> tuple[Run, Float[Array, ""]]:
        """`store`, and the state enters the nearest-neighbour table."""
        run = run._replace(entropy=state_entropy.insert(_some(run.entropy), fact.observation))
        return self.store(run, fact)

    def pretrain(self, run: Run, step: Int[Array, ""]) -> tuple[Run, dict[str, Array]]:
        """The updates of a step whose reward is the state entropy."""
        key, times = _key(run, Purpose.UPDATE, step), self.config.pretraining.updates

        def one(
            state: tuple[sac.Agent, state_entropy.Deviation], nth: Array
        ) -> tuple[tuple[sac.Agent, state_entropy.Deviation], dict[str, Array]]:
            key_batch, key_update = self._nth(key, nth)
            batch = replay_.sample(run.replay, key_batch, self.config.sac.batch)
            deviation, reward = state_entropy.reward(_some(run.entropy), state[1], batch.row)
            move = nth % self.config.sac.target_every == 0
            agent, info = sac.update(state[0], batch, reward, key_update, run.numbers.sac, move, self.arithmetic)
            return (agent, deviation), info

        (agent, deviation), info = _in_turn(one, (run.agent, _some(run.deviation)), step * times + jnp.arange(times))
        return run._replace(agent=agent, deviation=deviation), info

    def learn(self, run: Run, step: Int[Array, ""], recent: Int[Array, ""]) -> tuple[Run, dict[str, Array]]:
        """The ordinary updates of a step; a share of their batches may come from the ``recent`` latest rows."""
        times = self.config.sac.updates
        return self._updates(run, step, _key(run, Purpose.UPDATE, step), step * times + jnp.arange(times), recent)

    # Now and then.

    def begin(self, run: Run, step: Int[Array, ""]) -> tuple[Run, dict[str, Array]]:
        """The end of pre-training: new critics, then the first updates on the learned reward."""
        key_critics, key_updates = jax.random.split(_key(run, Purpose.RENEW, step))
        run = run._replace(agent=sac.renew_critics(run.agent, key_critics))
        return self._updates(run, step, key_updates, jnp.arange(self.config.sac.reset_updates), jnp.int32(0))

    def cut(self, run: Run, starts: Int[Array, "p 2"]) -> tuple[Run, tuple[Array, Array, Array]]:
        """Observations, actions and true rewards of segments that begin at those rows of the run."""
        return run, replay_.segments(run.replay, starts, self.config.queries.segment)

    def summed_rewards(
        self, run: Run, observation: Float[Array, "p 2 H o"], action: Float[Array, "p 2 H a"]
    ) -> tuple[Run, Float[Array, "members p 2"]]:
        """Every member's sum of rewards of each segment: the logits of Eq. 1."""
        learned = _some(run.model)
        return run, model.rewards(learned.members, observation, action, learned.scaling).sum(axis=-1)

    def fit(self, run: Run, labelled: model.Labelled, step: Int[Array, ""]) -> tuple[Run, dict[str, Array]]:
        """Fit the reward model to all labels and relabel the replay."""
        key = _key(run, Purpose.FIT, step)
        reward, learned = self.config.reward, _some(run.model)
        if reward.standardise:
            learned = learned._replace(scaling=model.Scaling.of(*replay_.moments(run.replay)))
        snippets = model.Snippets(reward.snippets, reward.snippet_min, reward.snippet_max) if reward.snippets else None
        fitted, info = model.fit(learned, labelled, key, reward.batch, run.numbers.fit, snippets)
        return self.relabel(run._replace(model=fitted))[0], info

    def on_session(
        self, run: Run, preferred: Float[Array, "n d"], count: Int[Array, ""], step: Int[Array, ""]
    ) -> tuple[Run, None]:
        """Tell the bonus which positions are preferred."""
        key = _key(run, Purpose.SESSION, step)
        return run._replace(bonus=self.bonus.on_session(run.bonus, key, preferred, count)), None

    def refresh(self, run: Run, step: Int[Array, ""]) -> tuple[Run, None]:
        """Bring the bonus up to date."""
        key = _key(run, Purpose.REFRESH, step)
        return run._replace(bonus=self.bonus.on_refresh(run.bonus, key, run.replay, self._now(run, step))), None

    def outer(self, run: Run, pairs: bilevel.FirstSteps, step: Int[Array, ""]) -> tuple[Run, dict[str, Array]]:
        """Meta-Reward-Net's outer step on a uniform batch, or on that of the step's update; relabels the replay."""
        if self.config.bilevel.batch == "update":
            key_batch, key_update = self._nth(_key(run, Purpose.UPDATE, step), step * self.config.sac.updates)
            batch, key_value = self._draw(run, key_batch, jnp.int32(0)), jax.random.split(key_update)[0]
        else:
            key_batch, key_value = jax.random.split(_key(run, Purpose.OUTER, step))
            batch = replay_.sample(run.replay, key_batch, self.config.sac.batch)
        separate = self.config.bilevel.optimizer == "separate"
        numbers = run.numbers.outer._replace(inner_rate=self._decayed(run, step).critic_rate)
        exact = self.arithmetic._replace(product=jnp.matmul)
        fitted, info = bilevel.outer_step(
            _some(run.model), run.agent, batch, pairs, key_value, numbers, separate, exact
        )
        return self.relabel(run._replace(model=fitted))[0], info

    def measure(self, run: Run) -> tuple[Run, Float[Array, ""]]:
        """Take the length scale from the data: ten times the spread of the positions stored so far.

        In Meta-World the unit is a metre, ten times the spread of the hand's places; so a bandwidth means the
        same share of the visited space everywhere.
        """
        _, variance = replay_.moments(run.replay)
        scale = jnp.maximum(10 * jnp.sqrt(variance[self.spec.position].mean()), 1e-6)
        return run._replace(length_scale=scale), scale

    # Shared by the above.

    def _now(self, run: Run, step: Array) -> Now:
        return Now(step, step - run.numbers.until, run.length_scale)

    def _nth(self, key: PRNGKeyArray, nth: Array) -> tuple[PRNGKeyArray, PRNGKeyArray]:
        """Keys of the batch and of the rest of the ``nth`` update."""
        key_batch, key_update = jax.random.split(jax.random.fold_in(key, nth))
        return key_batch, key_update

    def _draw(self, run: Run, key: PRNGKeyArray, recent: Int[Array, ""]) -> Batch:
        """A batch of the method's mix. ``recent``: how many rows are the latest; 0: none is drawn from them alone."""
        size, replay = self.config.sac.batch, run.replay
        key_replay, key_other = jax.random.split(key)
        match self.config.method.mix:
            case "curiosity":
                bonus: preference_guided.State = run.bonus
                rows = preference_guided.draw(bonus, key_other, int(self.config.pge.share * size))
                curious = jax.tree.map(lambda column: column[rows], bonus.curiosity)
                if self.config.pge.rest == "older":
                    size = len(rows) + int((1 - self.config.pge.share) * size)
                    return replay_.mix(preference_guided.older(bonus, replay, key_replay, size), curious, bonus.ready)
                return replay_.mix(replay_.sample(replay, key_replay, size), curious, bonus.ready)
            case "recent":
                batch = replay_.sample(replay, key_replay, size)
                latest = replay_.latest(replay, key_other, int(self.config.qpa.share * size), recent)
                return replay_.mix(batch, latest, recent > 0)
        return replay_.sample(replay, key_replay, size)

    def _decayed(self, run: Run, step: Array) -> sac.Numbers:
        """SAC's numbers at a step: actor's and critics' rates on their straight line."""
        numbers = run.numbers
        along = jnp.clip((step - numbers.until) / (numbers.steps - numbers.until), 0, 1)
        factor = 1 + (numbers.rate_end - 1) * along
        return numbers.sac._replace(
            actor_rate=numbers.sac.actor_rate * factor, critic_rate=numbers.sac.critic_rate * factor
        )

    def _updates(
        self, run: Run, step: Array, key: PRNGKeyArray, count: Int[Array, " n"], recent: Int[Array, ""]
    ) -> tuple[Run, dict[str, Array]]:
        """Updates one after the other; ``count`` numbers them, which decides whether the targets move."""
        now, numbers = self._now(run, step), self._decayed(run, step)

        def one(agent: sac.Agent, nth: Array) -> tuple[sac.Agent, dict[str, Array]]:
            key_batch, key_update = self._nth(key, nth)
            batch = self._draw(run, key_batch, recent)
            paid = self.bonus.value(run.bonus, batch, now)
            reward = batch.learned_reward + paid if self.config.method.learns_reward else batch.reward
            move = nth % self.config.sac.target_every == 0
            agent, info = sac.update(agent, batch, reward, key_update, numbers, move, self.arithmetic)
            told = self.bonus.report(run.bonus, batch, now)
            shares = {
                f"{source.name.lower()}_share": jnp.mean(batch.source == source)
                for source in (Source.CURIOSITY, Source.RECENT)
            }
            return agent, {**info, **told, **shares, "bonus_mean": paid.mean(), "batch_reward": reward.mean()}

        agent, info = _in_turn(one, run.agent, count)
        return run._replace(agent=agent), info

    def _score(self, run: Run, observation: Array, action: Array) -> tuple[Array, Array]:
        if run.model is None:
            nothing = jnp.zeros(observation.shape[:-1])
            return nothing, nothing
        all_members = model.rewards(run.model.members, observation, action, run.model.scaling)
        return all_members.mean(axis=0), all_members.std(axis=0)

    def relabel(self, run: Run) -> tuple[Run, None]:
        """Score every stored transition anew with the reward model, the bonus's copies included."""
        run = run._replace(replay=replay_.relabel(run.replay, lambda o, a: self._score(run, o, a)))
        if self.config.method.mix != "curiosity" or not self.config.pge.relabel:
            return run, None
        held = run.bonus.curiosity
        mean, spread = self._score(run, held.observation, held.action)
        curiosity = held._replace(learned_reward=mean, spread=spread)
        return run._replace(bonus=run.bonus._replace(curiosity=curiosity)), None


class Acting(NamedTuple):
    """What choosing an action takes of a run."""

    seed: Int[Array, ""]
    actor: MLP


def acting(run: Run) -> Acting:
    """The part of a run that `act` needs."""
    return Acting(run.seed, run.agent.actor)


def act(
    part: Acting, observation: Float[Array, " o"], step: Int[Array, ""], random: Bool[Array, ""]
) -> Float[Array, " a"]:
    """An action in [-1, 1]: of the policy, or a uniform one."""
    key_policy, key_uniform = jax.random.split(_key(part, Purpose.ACT, step))
    action, _ = sac.sample(part.actor, observation, key_policy)
    uniform = jax.random.uniform(key_uniform, action.shape, minval=-1, maxval=1)
    return jnp.where(random, uniform, action)


def actor_of(run: Run) -> MLP:
    """The part of a run that `mean_action` needs."""
    return run.agent.actor


def mean_action(actor: MLP, observation: Float[Array, "*b o"]) -> Float[Array, "*b a"]:
    """The action that evaluation takes."""
    return sac.mean_action(actor, observation)


def _key(run: Run | Acting, purpose: Purpose, step: Array | int) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(run.seed), purpose), step)


def _in_turn(one: Callable[[Any, Array], tuple[Any, dict[str, Array]]], state: Any, count: Array) -> Any:
    """What updates make of a state one after the other, and the last one's numbers."""
    if len(count) == 1:
        return one(state, count[0])
    state, infos = jax.lax.scan(one, state, count)
    return state, jax.tree.map(lambda values: values[-1], infos)


def _some(part: Any) -> Any:
    assert part is not None, "this run has no such part"
    return part
