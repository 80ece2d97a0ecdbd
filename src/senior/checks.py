"""Refuse a configuration that makes no sense, before anything is made or written."""

from __future__ import annotations

import math

from senior.config import Config, differences
from senior.methods import METHODS
from senior.presets import release
from senior.types import BadInput


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise BadInput(sentence)


def check(config: Config) -> Config:
    """Refuse a configuration that makes no sense, with one sentence that says why."""
    queries, row = config.queries, config.method
    for name, value in (
        ("--steps", config.steps),
        ("--per-session", queries.per_session),
        ("--session-every", queries.every),
        ("--refresh-every", config.pge.every),
        ("--outer-every", config.bilevel.every),
        ("--segment", queries.segment),
        ("--pool", queries.pool),
        ("--sac.batch", config.sac.batch),
        ("--sac.updates", config.sac.updates),
        ("--sac.target-every", config.sac.target_every),
        ("--sac.reset-updates", config.sac.reset_updates),
        ("--reward.members", config.reward.members),
        ("--reward.batch", config.reward.batch),
        ("--reward.epochs", config.reward.epochs),
        ("--networks.layers", config.networks.layers),
        ("--networks.width", config.networks.width),
        ("--networks.reward-layers", config.networks.reward_layers),
        ("--networks.reward-width", config.networks.reward_width),
        ("--evaluation.every", config.evaluation.every),
        ("--evaluation.episodes", config.evaluation.episodes),
        ("--checkpoint-every", config.checkpoint_every),
        ("--snapshot-every", config.snapshot_every),
        ("--pretraining.neighbours", config.pretraining.neighbours),
        ("--pretraining.updates", config.pretraining.updates),
        ("--pge.capacity", config.pge.capacity),
        ("--reward.snippet-min", config.reward.snippet_min),
        ("--replay-capacity", 1 if config.replay_capacity is None else config.replay_capacity),
    ):
        _require(value >= 1, f"{name} must be at least 1, not {value}.")
    for name, value in (
        ("--seed", config.seed),
        ("--pretraining.random-steps", config.pretraining.random_steps),
        ("--pge.beta", config.pge.beta),
        ("--bilevel.weight", config.bilevel.weight),
        ("--reward.snippets", config.reward.snippets),
        ("--rune.beta", config.rune.beta),
        *((f"--{name}", getattr(config.answering, name) or 0.0) for name in ("skip", "equal")),
    ):
        _require(0 <= value < float("inf"), f"{name} must be 0 or more, not {value}.")
    _require(config.steps < 2**31, f"--steps must be below {2**31}, not {config.steps}.")
    _require(config.seed < 2**32, f"--seed must be below {2**32}, not {config.seed}.")
    for name, episodes in (("--candidate-episodes", queries.episodes), ("--qpa.episodes", config.qpa.episodes)):
        _require(episodes >= 2, f"{name} must be at least 2, as pairs need, not {episodes}.")
    for name, number in (
        ("--bandwidth-mds", config.mds.bandwidth),
        ("--bandwidth-pge", config.pge.bandwidth),
        ("--sac.actor-rate", config.sac.actor_rate),
        ("--sac.critic-rate", config.sac.critic_rate),
        ("--sac.alpha-rate", config.sac.alpha_rate),
        ("--sac.initial-alpha", config.sac.initial_alpha),
        ("--reward.rate", config.reward.rate),
        ("--length-scale", 1.0 if config.length_scale is None else config.length_scale),
    ):
        _require(0 < number < float("inf"), f"{name} must be a positive number, not {number}.")
    for name, share in (
        ("--pge.share", config.pge.share),
        ("--qpa.share", config.qpa.share),
        *((f"--{name}", getattr(config.answering, name) or 0.0) for name in ("mistake", "foresight")),
        ("--mds.keep", config.mds.keep),
        ("--sac.tau", config.sac.tau),
        ("--sac.discount", config.sac.discount),
        ("--sac.rate-end", config.sac.rate_end),
        ("--reward.stop-accuracy", config.reward.stop_accuracy),
    ):
        _require(0 <= share <= 1, f"{name} must lie between 0 and 1, not {share}.")
    _require(
        math.isfinite(config.sac.target_entropy),
        f"--sac.target-entropy must be a number, not {config.sac.target_entropy}.",
    )
    for name, decay in (("--pge.decay", config.pge.decay), ("--rune.decay", config.rune.decay)):
        _require(0 <= decay < 1, f"{name} must be at least 0 and below 1, not {decay}.")
    rationality = config.answering.rationality
    _require(
        rationality is None or rationality == -1 or 0 < rationality < float("inf"),
        f"--rationality must be a positive number, or -1 for always the better segment, not {rationality}.",
    )
    asking, people = config.asking, config.teacher == "human"
    _require(asking.overlap >= 1, f"--overlap must be at least 1, not {asking.overlap}.")
    _require(
        people or asking.overlap == 1,
        f"--overlap {asking.overlap} asks several people, and the teacher {config.teacher} is one; leave it out.",
    )
    _require(0 <= asking.settle < 3600, f"--settle must be 0 or more seconds, below an hour, not {asking.settle}.")
    row.check()
    if row.name in METHODS and METHODS[row.name].learns_reward != row.learns_reward:
        learns = "learns a reward, like pebble" if row.learns_reward else "learns from the true reward: sac"
        raise BadInput(f"With --select {row.select} method {row.name} would be another one; name one that {learns}.")
    _require(
        row.learns_reward or not people,
        f"Method {row.name} learns from the true reward and asks nothing, so --teacher human has no use.",
    )
    of_release = row.select == "motion_distinction" and row.explore == "preference_guided" and row.outer == "bilevel"
    _require(
        of_release or config.compat == "none",
        "--compat release is about m-senior: no other method is in its authors' public code.",
    )
    until, random_steps = config.pretraining.until, config.pretraining.random_steps
    if not row.learns_reward:
        _require(until == 0, f"Method {row.name} learns from the true reward, so --pretraining.until must be 0.")
        return config
    _require(
        queries.budget >= queries.per_session,
        f"The budget of {queries.budget} labels is below one session of {queries.per_session}; "
        "raise --budget or lower --per-session.",
    )
    _require(
        queries.pool > 1 or not asking.replace_skipped,
        "--replace-skipped keeps as many pairs in reserve as a session asks, so --pool must be at least 2.",
    )
    _require(
        config.steps > until,
        f"{config.steps} steps end before the first session at step {until}; raise --steps or lower "
        "--pretraining.until.",
    )
    _require(
        random_steps >= config.pretraining.neighbours,
        f"State entropy looks at {config.pretraining.neighbours} neighbours, more than there are after {random_steps} "
        "random steps; raise --pretraining.random-steps.",
    )
    _require(
        random_steps + 1 < until,
        f"Pre-training must last beyond its {random_steps} random steps; raise --pretraining.until ({until}).",
    )
    _require(
        config.capacity > until,
        f"A replay of {config.capacity} rows cannot hold pre-training's {until} steps; raise --replay-capacity.",
    )
    if config.reward.snippets:
        shortest, longest = config.reward.snippet_min, config.reward.snippet_max
        _require(
            shortest <= longest <= queries.segment,
            f"Windows of {shortest} to {longest} steps do not fit into segments of {queries.segment}; set "
            "--reward.snippet-min and --reward.snippet-max.",
        )
    for cell, value in (("--select", row.select), ("--explore", row.explore)):
        _require(
            config.reward.members > 1 or value not in ("disagreement", "kcenter_disagreement"),
            f"One member cannot disagree with itself, so {cell} {value} needs --reward.members 2 or more.",
        )
    for mix, name, share in (
        ("curiosity", "--pge.share", config.pge.share),
        ("recent", "--qpa.share", config.qpa.share),
    ):
        _require(
            row.mix != mix or int(share * config.sac.batch) > 0,
            f"{name} {share:g} of a batch of {config.sac.batch} is not one row; raise it or use --mix uniform.",
        )
    if row.outer == "bilevel" and config.bilevel.batch == "update":
        _require(
            row.mix != "recent" and (row.mix != "curiosity" or not config.pge.refresh_with_outer),
            "--bilevel.batch update takes the batch of the step's update, which cannot be known with --mix recent, nor "
            "with --mix curiosity unless --pge.refresh-with-outer False.",
        )
    if config.compat == "release":
        for name, _, value in differences(release(config), config):
            raise BadInput(
                f"With {name} {value} this is not what the public code does; leave --compat release out and give its "
                "other options by themselves."
            )
    if row.mix == "curiosity" and config.pge.rest == "older":
        _require(
            config.capacity >= config.steps,
            "--pge.rest older needs a replay that holds the whole run; leave --replay-capacity out.",
        )
    if row.explore == "preference_guided":
        every = config.pge.every
        others = [("K, --session-every", queries.every), ("the end of pre-training, --pretraining.until", until)]
        if row.outer == "bilevel":
            others.append(("N, --outer-every", config.bilevel.every))
        for name, other in others:
            _require(
                other % every == 0,
                f"Q, --refresh-every {every}, must divide {name} {other} (the paper's Algorithm 1).",
            )
    return config
