"""The whole configuration of one run: frozen dataclasses, the same in Python, in JSON and on the command line.

Every number that a paper leaves open is a named field here, with the reading we recommend as its default
(docs/methods.md gives the reasons). ``presets.py`` fills in what depends on task and method.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import cattrs
import tyro

from senior.methods import Method
from senior.preference_file import Rules
from senior.teachers import TEACHERS
from senior.types import BadInput

_FLAT = tyro.conf.arg(name="")
"""A group whose fields are options without the group's name in front."""

_TEACHER = tyro.conf.arg(
    help=f"Who answers: {', '.join(TEACHERS)}, a file of exported labels (.jsonl), or module:Name. The oracle compares "
    "true returns; human: people, in a browser."
)

Switch = Annotated[bool, tyro.conf.FlagConversionOff]
"""A setting that is given with its value: ``--pge.relabel False``. Plain ones are flags: ``--wait``, ``--no-wait``."""


def _flag(name: str) -> Any:
    """A field of a nested group whose command-line name stands alone: ``--bandwidth-mds``."""
    return tyro.conf.arg(name=name, prefix_name=False)


@dataclass(frozen=True)
class Networks:
    """Sizes of actor, critics and reward model."""

    layers: int = 3
    """Hidden layers of the actor and of each critic."""
    width: int = 256
    """Units of each hidden layer of the actor and of each critic."""
    layer_norm: Switch = False
    """Normalise the hidden layers of the critics before their activation. The papers do not."""
    reward_layers: int = 3
    """Hidden layers of each member of the reward ensemble."""
    reward_width: int = 256
    """Units of each hidden layer of the reward ensemble."""


@dataclass(frozen=True)
class SAC:
    """Soft actor-critic, as PEBBLE runs it on Meta-World (docs/methods.md)."""

    batch: int = 512
    """Transitions of one update."""
    actor_rate: float = 3e-4
    """Adam's learning rate for the actor."""
    critic_rate: float = 3e-4
    """Adam's learning rate for the critics."""
    alpha_rate: float = 1e-4
    """Adam's learning rate for the temperature."""
    rate_end: float = 1.0
    """Factor on actor's and critics' learning rates at the last step, reached linearly from the end of pre-training.
    1: constant, as in the papers."""
    discount: float = 0.99
    """Discount gamma."""
    tau: float = 0.005
    """Polyak step of the target critics."""
    target_every: int = 2
    """Updates between moves of the target critics."""
    initial_alpha: float = 0.1
    """Temperature at the start."""
    updates: int = 1
    """Updates per environment step in the main phase."""
    reset_updates: int = 100
    """Updates right after the critics are renewed at the end of pre-training."""
    target_entropy: float = -1.0
    """Entropy per action dimension that the temperature draws the policy towards."""


@dataclass(frozen=True)
class Pretraining:
    """Random steps, then exploration by state entropy (PEBBLE)."""

    random_steps: int = 1000
    """Uniformly random actions before the first update."""
    until: int = 10_000
    """Step at which pre-training ends and the first session takes place. 0: no pre-training (plain SAC)."""
    neighbours: int = 5
    """The k of the k-nearest-neighbour state entropy."""
    updates: int = 1
    """Updates per environment step."""


@dataclass(frozen=True)
class Reward:
    """Reward ensemble and its Bradley-Terry fit (Eq. 1 and 2)."""

    members: int = 3
    """Members of the ensemble."""
    rate: float = 3e-4
    """Adam's learning rate, shared with the outer step unless told otherwise."""
    epochs: int = 10
    """Most passes over the labels per session."""
    batch: int = 128
    """Pairs of one gradient step."""
    stop_accuracy: float = 0.97
    """A session's fit ends after an epoch with more training accuracy than this."""
    standardise: Switch = False
    """Bring each entry of the observation to mean 0 and deviation 1, of the replay at each fit, for the reward model.
    Kept within 10, and what hardly varies stays small. The papers do not."""
    snippets: int = 0
    """Random windows that stand for each pair in a fit (QPA's data augmentation, tau). 0: the whole segments."""
    snippet_min: int = 35
    """Fewest steps of such a window."""
    snippet_max: int = 45
    """Most steps of such a window."""


@dataclass(frozen=True)
class Queries:
    """Which segments can be asked about, and when."""

    budget: int = 250
    """Pairs asked in the whole run; a skipped pair counts too. --per-session grows with it unless it is given."""
    per_session: int = 5
    """Pairs asked per session (M)."""
    every: Annotated[int, _flag("session-every")] = 5000
    """Steps between sessions (K)."""
    segment: int = 50
    """Steps of a segment (H)."""
    episodes: Annotated[int, _flag("candidate-episodes")] = 100
    """How many of the latest complete episodes that are longer than a segment pairs are cut from.
    With --select policy_aligned it is --qpa.episodes instead."""
    pool: int = 10
    """Candidate pairs per asked pair: the pool p has this times M pairs."""


@dataclass(frozen=True)
class MotionDistinction:
    """MDS, Eq. 3 to 5, and the points that the paper leaves open."""

    keep: float = 0.3
    """Share of the pool that the motion score keeps (q / p)."""
    bandwidth: Annotated[float, _flag("bandwidth-mds")] = 0.05
    """Bandwidth h of the densities of MDS, in length scales (metres in Meta-World)."""
    density_sum: Annotated[Literal["density", "log"], _flag("density-sum")] = "density"
    """What the motion score sums: the density (paper) or its logarithm (public code)."""
    axis: Annotated[Literal["oriented", "raw", "absolute"], _flag("axis")] = "oriented"
    """Sign of a segment's principal axis: along its displacement, as the solver returns it, or ignored."""
    scores: Literal["own", "mirrored"] = "own"
    """Whose scores a pair is chosen by: its own, or those of the pair at the other end of the list (public code)."""


@dataclass(frozen=True)
class PreferenceGuided:
    """PGE, Eq. 6 to 8, and the points that the paper leaves open."""

    capacity: int = 1000
    """Rows of the curiosity buffer and of the preference sample."""
    share: float = 0.3
    """Share of a batch that is drawn from the curiosity buffer."""
    every: Annotated[int, _flag("refresh-every")] = 1000
    """Steps between refreshes of the curiosity buffer (Q)."""
    bandwidth: Annotated[float, _flag("bandwidth-pge")] = 0.1
    """Bandwidth h of the densities of PGE, in length scales (metres in Meta-World)."""
    beta: float = 0.1
    """Weight of the bonus at its first use (beta_0)."""
    decay: float = 0.01
    """Decay rate of the weight (rho)."""
    clock: Annotated[Literal["refresh", "env_step", "since_pretrain"], _flag("beta-clock")] = "refresh"
    """What t counts in beta_t: refreshes, environment steps, or steps since pre-training."""
    equal: Literal["left_out", "second"] = "left_out"
    """What a pair called equal adds to the preferred positions.
    left_out: nothing, while there are others. second: its second segment (public code)."""
    relabel: Switch = True
    """Score the curiosity buffer's rows anew whenever the replay is. The public code keeps them as they were drawn."""
    rest: Literal["all", "older"] = "all"
    """Rows that fill the batch up.
    all: of the whole replay.
    older: rounded down, of what is older than the last refresh and not in the curiosity buffer (public code)."""
    refresh_with_outer: Switch = True
    """Refresh at steps with an outer step too. The public code leaves those refreshes out."""


@dataclass(frozen=True)
class Bilevel:
    """Meta-Reward-Net's outer step."""

    every: Annotated[int, _flag("outer-every")] = 10_000
    """Steps between outer steps (N)."""
    weight: float = 0.1
    """Factor on the outer loss."""
    optimizer: Annotated[Literal["shared", "separate"], _flag("outer-optimizer")] = "shared"
    """Adam of the outer step: the reward fit's own (public code) or another."""
    after_budget: Switch = False
    """Go on with outer steps when the budget is spent (the paper's Algorithm 1 read literally)."""
    batch: Literal["uniform", "update"] = "uniform"
    """Batch of the inner step.
    uniform: one of its own from the whole replay (Algorithm 1). update: that of the step's update (public code)."""


@dataclass(frozen=True)
class Disagreement:
    """RUNE's bonus."""

    beta: float = 0.05
    """Weight of the bonus at step 0 (beta_0)."""
    decay: float = 1e-5
    """Decay rate of the weight per environment step (rho)."""


@dataclass(frozen=True)
class PolicyAligned:
    """QPA's policy-aligned buffer."""

    episodes: int = 30
    """How many of the latest episodes are the policy's own (N_pa): queries come from them."""
    share: float = 0.5
    """Share of a batch drawn from their steps, while there is budget (omega)."""


@dataclass(frozen=True)
class Answering:
    """The five numbers of a scripted teacher (B-Pref). Left out: those of the named teacher, else a perfect one's."""

    rationality: float | None = None
    """Inverse temperature of random answers; -1: always the better one (beta). Left out: the teacher's."""
    foresight: float | None = None
    """Discount that weighs a segment's earlier steps less; 1: all alike (gamma). Left out: the teacher's."""
    mistake: float | None = None
    """Probability of the opposite answer (epsilon_mistake). Left out: the teacher's."""
    skip: float | None = None
    """Pairs whose better segment earns less than this share of the recent average are skipped (epsilon_skip).
    Left out: the teacher's."""
    equal: float | None = None
    """Pairs that differ by less than this share of the recent average are called equal (epsilon_equal).
    Left out: the teacher's."""


@dataclass(frozen=True)
class Asking:
    """How answers are waited for, and what those of people amount to."""

    wait: bool = True
    """Wait for all answers to a session, as the paper does; else train on meanwhile, and ask again when all have come.
    Until there is a label every session is waited for: there is nothing to learn from."""
    overlap: int = 1
    """How many people are asked about each pair. It costs one of the budget, and is trained on by their mean answer."""
    replace_skipped: bool = False
    """Ask another pair in place of one that nobody could tell, at most as many as a session has; it costs nothing then.
    Else a skipped pair counts as asked (B-Pref)."""
    soft_labels: bool = False
    """Train "slightly better" towards 0.75 instead of 1."""
    settle: float = 3.0
    """Seconds in which the last answer of a session can still be undone."""

    @property
    def rules(self) -> Rules:
        """What answers amount to."""
        return Rules(self.overlap, self.replace_skipped, self.soft_labels)


@dataclass(frozen=True)
class Evaluation:
    """How often the policy is judged, on episodes of its own."""

    every: int = 10_000
    """Steps between evaluations."""
    episodes: int = 10
    """Episodes of one evaluation, with the mean action."""


@dataclass(frozen=True)
class Config:
    """One run. `senior.presets.preset` makes one; `check` refuses what makes no sense."""

    task: str = "door-lock"
    """A task of `senior tasks`. With --env it only says whose numbers the preset takes."""
    method: Annotated[Method, _FLAT] = field(default_factory=Method)
    preset: Literal["paper", "quick", "qpa_original"] = "paper"
    """paper: the numbers of the paper. quick: see below. qpa_original: QPA's own networks, batch and rates."""
    seed: int = 0
    """Seed of everything random in the run."""
    steps: int = 1_000_000
    """Environment steps."""
    compat: Literal["none", "release"] = "none"
    """release: m-senior as its authors' public code behaves, where that differs from the paper."""
    teacher: Annotated[str, _TEACHER] = "oracle"
    answering: Annotated[Answering, _FLAT] = field(default_factory=Answering)
    asking: Annotated[Asking, _FLAT] = field(default_factory=Asking)
    env: str | None = None
    """Any Gymnasium environment with Box spaces instead of a task: module:Name or a registered id."""
    position: str | None = None
    """Where the end-effector position lies in the observation of --env, for instance 0:3."""
    length_scale: float | None = None
    """The unit of both bandwidths in --env. Left out: ten times the spread of the positions seen in pre-training."""
    horizon: int | None = None
    """Most steps of an episode; the environment's own limit, where it has one, holds too."""
    queries: Annotated[Queries, _FLAT] = field(default_factory=Queries)
    pretraining: Pretraining = field(default_factory=Pretraining)
    networks: Networks = field(default_factory=Networks)
    sac: SAC = field(default_factory=SAC)
    reward: Reward = field(default_factory=Reward)
    mds: MotionDistinction = field(default_factory=MotionDistinction)
    pge: PreferenceGuided = field(default_factory=PreferenceGuided)
    bilevel: Bilevel = field(default_factory=Bilevel)
    rune: Disagreement = field(default_factory=Disagreement)
    qpa: PolicyAligned = field(default_factory=PolicyAligned)
    evaluation: Evaluation = field(default_factory=Evaluation)
    replay_capacity: int | None = None
    """Transitions kept; left out: all steps of the run."""
    checkpoint_every: int = 10_000
    """Steps between checkpoints."""
    snapshot_every: int = 50_000
    """Steps between snapshots of visited positions and of the bonus's densities."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to compute. gpu: an error if there is none."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Number format of the products in actor and critics. bfloat16 is not offered (results/precision)."""

    @property
    def environment(self) -> str:
        """The task, or what was given as ``--env``."""
        return self.env or self.task

    @property
    def window(self) -> int:
        """How many of the latest complete episodes candidate pairs are cut from."""
        return self.qpa.episodes if self.method.select == "policy_aligned" else self.queries.episodes

    @property
    def capacity(self) -> int:
        """Rows of the replay buffer."""
        return self.steps if self.replay_capacity is None else self.replay_capacity


def made_by(config: Config) -> dict[str, Any]:
    """What `senior.envs.make` makes the environment of a configuration from."""
    return {
        "task": None if config.env else config.task,
        "env": config.env,
        "position": config.position,
        "length_scale": config.length_scale,
        "horizon": config.horizon,
    }


def to_json(config: Config) -> dict[str, Any]:
    """The configuration as plain JSON data; `from_json` is its inverse."""
    return asdict(config)


def from_json(data: dict[str, Any]) -> Config:
    """Read a configuration. `BadInput` for an unknown key or a value of the wrong type."""
    try:
        return _converter().structure(data, Config)
    except (cattrs.BaseValidationError, TypeError, ValueError) as error:
        reasons = "; ".join(cattrs.transform_error(error))
        raise BadInput(f"The configuration cannot be read: {reasons}.") from error


@cache
def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True)
    for kind in (bool, int, float, str):
        converter.register_structure_hook(kind, _exactly)
    return converter


def _exactly(value: Any, kind: type[Any]) -> Any:
    """A value of that very type, where cattrs would make 3 of 3.7 and True of "no"; an int is a float too."""
    if type(value) is not kind and (kind, type(value)) != (float, int):
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return kind(value)


def load(path: Path) -> Config:
    """The configuration in a run directory's ``config.json``."""
    try:
        return from_json(json.loads(path.read_text())["config"])
    except FileNotFoundError:
        raise BadInput(f"{path.parent} is not a run directory: it holds no config.json.") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{path} is damaged: {error}.") from error


def differences(one: Any, other: Any, prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Fields in which two configurations differ, as (dotted name, value in one, value in other)."""
    found: list[tuple[str, Any, Any]] = []
    for entry in fields(one):
        left, right = getattr(one, entry.name), getattr(other, entry.name)
        if is_dataclass(left):
            found += differences(left, right, f"{prefix}{entry.name}.")
        elif left != right:
            found.append((prefix + entry.name, left, right))
    return found
