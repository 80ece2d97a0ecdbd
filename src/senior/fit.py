"""Whether a configuration fits its environment and this program, found out before anything is trained. No JAX."""

from __future__ import annotations

from pathlib import Path

from senior import envs, labels, parts
from senior.checks import check
from senior.config import Config, from_json, made_by, to_json
from senior.types import BadInput, EnvSpec


def check_offered(config: Config) -> None:
    """`BadInput` for what makes no sense, or is not offered for training."""
    check(config)
    from_json(to_json(config))  # numbers of another type could not be read again
    if config.precision != "float32":  # `senior bench` may measure it
        raise BadInput(
            f"--precision {config.precision} is not offered: its learning curves do not agree well enough with "
            "float32's (results/precision)."
        )


def spec_of(config: Config) -> EnvSpec:
    """What there is to know of a configuration's environment; looks at it once."""
    environment, spec = envs.make(**made_by(config))
    environment.close()
    return spec


def check_fit(config: Config, spec: EnvSpec) -> None:
    """Refuse what does not fit into an environment's episodes."""
    if config.method.learns_reward and spec.horizon <= config.queries.segment:
        raise BadInput(
            f"A segment of {config.queries.segment} steps does not fit into an episode of {spec.horizon}; "
            "lower --segment."
        )
    if config.method.learns_reward and parts.is_recorded(config):
        sizes = config.queries.segment, spec.observation_size, spec.action_size
        held = labels.pairs_in(Path(config.teacher), config.environment, sizes)
        if held < config.queries.budget:
            raise BadInput(
                f"{config.teacher} holds {held} answered pairs, fewer than the budget of {config.queries.budget}; give "
                f"--budget {held} or less."
            )
    if config.capacity < min(spec.horizon, config.steps):
        raise BadInput(
            f"A replay of {config.capacity} rows cannot hold an episode of {spec.horizon} steps; raise "
            "--replay-capacity."
        )
