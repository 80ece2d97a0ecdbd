"""What of a configuration traced functions are made from, and what reaches them as numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from senior.agent import sac
from senior.config import Config
from senior.reward import bilevel, model


class Numbers(NamedTuple):
    """Numeric hyper-parameters of one run, traced."""

    sac: sac.Numbers
    fit: model.FitNumbers
    outer: bilevel.OuterNumbers
    until: Int[Array, ""]
    steps: Int[Array, ""]
    rate_end: Float[Array, ""]


def numbers_of(config: Config) -> Numbers:
    """The traced numbers of a configuration."""
    values = Numbers(
        sac.Numbers(
            config.sac.actor_rate,
            config.sac.critic_rate,
            config.sac.alpha_rate,
            config.sac.discount,
            config.sac.tau,
            config.sac.target_entropy,
        ),
        model.FitNumbers(config.reward.rate, config.reward.epochs, config.reward.stop_accuracy),
        bilevel.OuterNumbers(config.sac.critic_rate, config.reward.rate, config.bilevel.weight, config.sac.discount),
        until=jnp.int32(config.pretraining.until),
        steps=jnp.int32(config.steps),
        rate_end=jnp.float32(config.sac.rate_end),
    )
    return jax.tree.map(jnp.asarray, values)


def shape(config: Config) -> Config:
    """What of a configuration the traced functions are made from: runs that agree in it can share one program.

    The rest, here at its defaults, is in `Numbers`, or the host's matter: seed, task, schedule, questions, teacher.
    """
    plain, method, reward = Config(), config.method, Config().reward
    kept = replace(method, name="", select="uniform" if method.learns_reward else "none", outer="none")
    return Config(
        method=kept,
        steps=config.capacity,
        queries=replace(plain.queries, segment=config.queries.segment),
        pretraining=config.pretraining,
        networks=config.networks,
        sac=replace(
            plain.sac,
            batch=config.sac.batch,
            target_every=config.sac.target_every,
            updates=config.sac.updates,
            reset_updates=config.sac.reset_updates,
        ),
        reward=replace(config.reward, rate=reward.rate, epochs=reward.epochs, stop_accuracy=reward.stop_accuracy),
        pge=replace(config.pge, every=plain.pge.every, equal=plain.pge.equal, refresh_with_outer=True),
        bilevel=replace(plain.bilevel, optimizer=config.bilevel.optimizer, batch=config.bilevel.batch),
        rune=config.rune,
        qpa=replace(plain.qpa, share=config.qpa.share),
        device=config.device,
        precision=config.precision,
    )
