"""Runs that share a program or a device: each is what it would be alone, whoever else is there."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from senior import fit, learner, parts, together, trainee
from senior.config import Config
from senior.learner import Learner
from senior.loop import Training
from senior.methods import METHODS
from senior.presets import preset, release
from senior.program import Quiet, make_learner, resume, train_all
from senior.replay import Fact
from senior.reward.bilevel import FirstSteps
from senior.reward.model import Labelled
from senior.rundir import saved_steps
from senior.shape import shape
from senior.types import BadInput
from tests.equal import assert_same_run, short
from tests.small import rows, small


class Said(Quiet):
    """Keeps what is said."""

    def __init__(self, stop: bool = False) -> None:
        self.sentences: list[str] = []
        self.stop = stop

    def say(self, sentence: str) -> None:
        self.sentences.append(sentence)


def other() -> Config:
    """A run of the shape of `short`, and nothing else like it: other numbers, sessions, questions, row of the table."""
    run = short(seed=7, method=METHODS["p-senior"], teacher="mistake", checkpoint_every=400)
    return replace(
        run,
        sac=replace(run.sac, critic_rate=1e-3, discount=0.8, tau=0.1, initial_alpha=0.3),
        queries=replace(run.queries, budget=12, per_session=4, every=100, pool=5),
        mds=replace(run.mds, keep=0.6),
        pge=replace(run.pge, every=50),
        evaluation=replace(run.evaluation, every=250, episodes=2),
    )


def test_a_shape_is_shared_by_tasks_seeds_schedules_and_methods_that_differ_outside_of_it():
    door, window = (preset("paper", task, "m-senior") for task in ("door-lock", "window-close"))
    assert make_learner(door) is make_learner(replace(window, seed=3))
    assert make_learner(door) is make_learner(preset("paper", "box-close", "p-senior"))
    assert make_learner(preset("paper", "door-lock", "pebble")) is make_learner(preset("paper", "door-open", "mrn"))
    different = ("sac", "pebble", "rune", "qpa")
    learners = {make_learner(preset("paper", "door-lock", method)) for method in ("m-senior", *different)}
    assert len(learners) == 5
    assert make_learner(short()) is make_learner(other())
    assert make_learner(short()) is not make_learner(short(horizon=50, replay_capacity=701))


def changed(value: Any) -> Any:
    """Another value in every field."""
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{entry.name: changed(getattr(value, entry.name)) for entry in fields(value)})
    match value:
        case bool():
            return not value
        case int() | float():
            return value + 1
        case str():
            return value + "x"
    return 1


def leaves(value: Any, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for entry in fields(value):
        own = getattr(value, entry.name)
        found |= leaves(own, f"{prefix}{entry.name}.") if is_dataclass(own) else {prefix + entry.name: own}
    return found


class Spied:
    """A configuration that notes which of its fields are read."""

    def __init__(self, config: Any, read: set[str], prefix: str = "") -> None:
        self._config, self._read, self._prefix = config, read, prefix

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._config, name)
        if is_dataclass(value):
            return Spied(value, self._read, f"{self._prefix}{name}.")
        self._read.add(self._prefix + name)
        return value

    def __eq__(self, other: object) -> bool:
        return self._config == other

    __hash__ = None  # pyright: ignore[reportAssignmentType]


def everything() -> Config:
    """RUNE's bonus with normalised layers and standardised observations."""
    run = small("m-rune", steps=700)
    networks, reward = replace(run.networks, layer_norm=True), replace(run.reward, standardise=True)
    return replace(run, networks=networks, reward=reward)


@pytest.mark.parametrize(
    "config",
    [short(steps=700), small("qpa", steps=700), release(short(steps=700, replay_capacity=None)), everything()],
    ids=["senior", "qpa", "release", "rune"],
)
def trace(tutor: Learner, config: Config) -> None:
    """Trace every function of a learner, without compiling any."""

    def array(*size: int, kind: type = np.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(size, kind)

    step, whole = array(kind=np.int32), (config.queries.budget, 2, config.queries.segment)
    flag, second = array(kind=np.bool_), array(whole[0])
    fact = Fact(array(4), array(2), array(), array(4), flag, flag, step)
    labelled = Labelled(array(*whole, 4), array(*whole, 2), second, step)
    first_steps = FirstSteps(array(whole[0], 2, 4), array(whole[0], 2, 2), second, array(whole[0]))
    run = jax.eval_shape(lambda: tutor.init(config))
    calls: list[tuple[Any, ...]] = [
        (tutor.store, fact),
        (tutor.store_pretraining, fact),
        (tutor.pretrain, step),
        (tutor.learn, step, step),
        (tutor.begin, step),
        (tutor.cut, array(6, 2, kind=np.int32)),
        (tutor.summed_rewards, array(*whole, 4), array(*whole, 2)),
        (tutor.fit, labelled, step),
        (tutor.on_session, array(20, 2), step, step),
        (tutor.refresh, step),
        (tutor.outer, first_steps, step),
        (tutor.measure,),
        (tutor.relabel,),
    ]
    for function, *arguments in calls:
        jax.eval_shape(function, run, *arguments)
    public = {name for name in vars(Learner) if not name.startswith("_")} - {"init"}
    assert {function.__name__ for function, *_ in calls} == public


@pytest.mark.parametrize(
    "config",
    [short(), small("qpa"), release(short(replay_capacity=None)), everything()],
    ids=["senior", "qpa", "release", "rune"],
)
def test_traced_functions_read_nothing_that_a_shape_leaves_out(config: Config, monkeypatch: pytest.MonkeyPatch):
    one, two = leaves(shape(config)), leaves(shape(changed(config)))
    left_out = {name for name in one if one[name] == two[name]} - {"method.select", "replay_capacity"}
    assert {"seed", "task", "sac.critic_rate", "queries.budget", "mds.keep", "evaluation.every"} <= left_out
    assert not {"sac.batch", "queries.segment", "pge.share", "qpa.share", "networks.width"} & left_out

    read: set[str] = set()
    seen: Any = Spied(config, read)
    spec = fit.spec_of(config)
    monkeypatch.setattr(learner, "shape", lambda config: config if isinstance(config, Spied) else Spied(config, read))
    trace(Learner(seen, spec, parts.bonus(seen, spec)), config)
    expected = {"sac.batch", "networks.width", "queries.segment", "networks.layer_norm", "method.explore", "precision"}
    assert expected <= read
    read -= {"seed", "sac.initial_alpha"}  # which `init` hands on as numbers
    assert not read & left_out


def test_runs_of_one_shape_equal_themselves_alone(tmp_path: Path):
    both = [(short(), tmp_path / "a"), (other(), tmp_path / "b")]
    for result, (config, _) in zip(train_all(both, Said()), both, strict=True):
        assert result.finished
        (alone,) = train_all([(config, tmp_path / f"alone-{config.seed}")], Said())
        assert_same_run(alone.path, result.path, interrupted=False)
    assert [row["step"] for row in rows(tmp_path / "b" / "eval.csv")] == ["250", "500", "750", "1000"]
    assert rows(tmp_path / "b" / "train.csv")[-1]["queried"] == "12"


def test_under_vmap_a_run_depends_neither_on_its_neighbour_nor_on_the_program_beside_it(tmp_path: Path):
    """The two programs train in threads of their own."""
    sac = small("sac", steps=700)
    first = [(short(), tmp_path / "one" / "a"), (other(), tmp_path / "one" / "b"), (sac, tmp_path / "one" / "c")]
    assert all(result.finished for result in train_all(first, Said(), lift="vmap"))
    train_all([(short(), tmp_path / "two" / "a"), (short(seed=3), tmp_path / "two" / "b")], Said(), lift="vmap")
    assert_same_run(tmp_path / "one" / "a", tmp_path / "two" / "a", interrupted=False)


def test_episodes_judged_side_by_side_are_those_judged_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As on a GPU, in three places: five episodes of one run beside two of the other."""
    runs = {"a": short(steps=500), "b": replace(other(), steps=500)}

    def evaluations(folder: str) -> dict[str, list[dict[str, float]]]:
        train_all([(run, tmp_path / folder / name) for name, run in runs.items()], Said(), lift="vmap", workers=1)
        read = {name: rows(tmp_path / folder / name / "eval.csv") for name in runs}
        return {name: [{k: float(v) for k, v in row.items() if v} for row in read[name]] for name in runs}

    expected = evaluations("one after the other")
    monkeypatch.setattr(trainee, "judged_at_once", lambda device: 3)
    shapes = set[Any]()
    plain = together.Runs.give

    def noted(self: Any, **columns: Any) -> Any:
        if list(columns) == ["observation"]:
            shapes.add(np.shape(columns["observation"]))
        return plain(self, **columns)

    monkeypatch.setattr(together.Runs, "give", noted)
    found = evaluations("side by side")
    assert shapes == {(2, 3, 4)}
    for name in runs:
        assert [row["episodes"] for row in found[name]] == [row["episodes"] for row in expected[name]]
        for row, one in zip(found[name], expected[name], strict=True):
            assert row == pytest.approx(one, rel=1e-3)


def test_programs_side_by_side_have_workers_of_their_own_which_step_during_the_update(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    done: dict[int, list[str]] = defaultdict(list)
    for name in ("send", "update", "receive"):
        plain = getattr(Training, name)

        def noted(training: Training, *arguments: Any, name: str = name, plain: Any = plain) -> Any:
            done[id(training)].append(name)
            return plain(training, *arguments)

        monkeypatch.setattr(Training, name, noted)
    runs = [(short(steps=500), tmp_path / "a"), (small("sac", steps=500), tmp_path / "b")]
    assert all(result.finished for result in train_all(runs, Said(), lift="vmap", workers=1))
    assert len(done) == 2
    for names in done.values():
        steps = Counter(zip(*[iter(names)] * 3, strict=True))
        assert steps.total() == 500
        assert steps["send", "update", "receive"] >= 490, steps  # but where something rare is due


class Breaks(Said):
    """Raises at a step of plain SAC, as a full disk does."""

    def advance(self, step: int, trainees: Any) -> None:
        if step == 50 and trainees[0].config.method.name == "sac":
            raise OSError("No space left on device")
        time.sleep(0.001)


def test_an_error_in_one_program_ends_those_beside_it_with_all_saved(tmp_path: Path):
    runs = [(small("sac", steps=5000), tmp_path / "a"), (small("pebble", steps=100_000), tmp_path / "b")]
    with pytest.raises(OSError, match="No space"):
        train_all(runs, Breaks(), lift="vmap")
    assert 0 < saved_steps(tmp_path / "b" / "checkpoints")[0] < 50_000


def test_programs_one_after_the_other_do_not_disturb_each_other(tmp_path: Path):
    configs = [small("sac", steps=700), short()]
    together = train_all([(config, tmp_path / "all" / config.method.name) for config in configs], Said())
    for config, result in zip(configs, together, strict=True):
        assert result.finished
        train_all([(config, tmp_path / "alone" / config.method.name)], Said())
        assert_same_run(tmp_path / "alone" / config.method.name, result.path, interrupted=False)


def test_a_run_that_is_shorter_ends_while_others_go_on(tmp_path: Path):
    configs = [short(steps=steps, replay_capacity=700, evaluation=short().evaluation) for steps in (700, 1000)]
    assert make_learner(configs[0]) is make_learner(configs[1])
    brief, long = train_all([(config, tmp_path / str(config.steps)) for config in configs], Said())
    assert (brief.step, long.step) == (700, 1000)
    assert brief.finished and long.finished
    assert [row["step"] for row in rows(brief.path / "eval.csv")] == ["500", "700"]
    assert int(rows(brief.path / "train.csv")[-1]["step"]) == 700


def test_as_many_at_a_time_as_asked_for_and_the_rest_afterwards(tmp_path: Path):
    said = Said()
    runs = [(short(seed=seed), tmp_path / "three" / f"seed-{seed}") for seed in range(3)]
    results = train_all(runs, said, runs_per_device=2)
    assert [(result.seed, result.finished) for result in results] == [(0, True), (1, True), (2, True)]
    told = [sentence for sentence in said.sentences if "at a time" in sentence]
    assert len(told) == 1 and "; 2 of 3 runs at a time, " in told[0]
    (alone,) = train_all([(short(seed=2), tmp_path / "alone")], Said())
    assert_same_run(alone.path, results[2].path, interrupted=False)


def test_as_many_at_a_time_as_the_memory_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    size = together.state_bytes(make_learner(short()), short())
    monkeypatch.setattr(together, "device_memory", lambda device: 2.5 * size)  # nine tenths of it hold two
    said = Said(stop=True)
    train_all([(short(seed=seed), tmp_path / f"seed-{seed}") for seed in range(3)], said)
    assert f"A run keeps {size / 1e6:,.1f} MB; 2 of 3 runs at a time, {2 * size / 1e6:,.1f} MB." in said.sentences[0]


def test_what_is_told_of_runs_that_are_not_reached_is_where_they_stand(tmp_path: Path):
    train_all([(short(), tmp_path / "a"), (short(seed=1), tmp_path / "b")], Said())
    first, second = resume(tmp_path, Said(stop=True), runs_per_device=1)
    assert (first.step, first.labels) == (second.step, second.labels) == (1000, 25)
    assert second.finished and second.success_rate is not None


def test_runs_that_were_not_begun_can_be_resumed(tmp_path: Path):
    runs = [(short(seed=seed), tmp_path / f"seed-{seed}") for seed in range(2)]
    results = train_all(runs, Said(stop=True), runs_per_device=1)
    assert [(result.step, result.finished) for result in results] == [(0, False), (0, False)]
    assert all(result.finished for result in resume(tmp_path, Said(), runs_per_device=1))


def test_what_cannot_be_trained_together_is_refused_before_anything_is_written(tmp_path: Path):
    place = tmp_path / "a"
    for runs, options, message in (
        ([], {}, "no run to train"),
        ([(short(), place), (short(seed=1), place)], {}, "directory of its own"),
        ([(short(device="cpu"), place), (short(seed=1), tmp_path / "b")], {}, "--device must be the same"),
        ([(short(), place)], {"runs_per_device": 0}, "--runs-per-device 0 must be at least 1"),
    ):
        with pytest.raises(BadInput, match=message):
            train_all(runs, Said(), **options)
    assert not list(tmp_path.iterdir())
