"""Whole runs, small: equal seeds give equal runs, alone or together; nothing compiles late; vmap computes the same."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import checkpoint, program, runs
from senior.checkpoint import unpack
from senior.learner import Run
from senior.program import Quiet, make_learner, train
from senior.replay import Fact
from senior.reward.model import Labelled
from senior.runs import Runs
from senior.schedule import due, plan
from senior.trainee import Trainee
from tests.equal import assert_same_run, short
from tests.small import rows


def test_equal_seeds_give_equal_files_and_two_runs_in_one_program_equal_each_alone(tmp_path: Path):
    train(short(), tmp_path / "together", seeds=2)
    for seed in (0, 1):
        (alone,) = train(replace(short(), seed=seed), tmp_path / "alone")
        assert_same_run(alone.path, tmp_path / "together" / f"seed-{seed}", interrupted=False)
        assert sorted(unpack(alone.path / "positions.npz")) == [f"step-{at:010d}" for at in (300, 600, 900, 1000)]
        assert len(list((alone.path / "bonus").iterdir())) == 3  # none while nothing is preferred
    with pytest.raises(AssertionError):
        assert_same_run(tmp_path / "alone" / "seed-0", tmp_path / "alone" / "seed-1", interrupted=False)


class Compilations(Quiet):
    """Counts what JAX traces or compiles, by the step in which it does."""

    def __init__(self) -> None:
        self.step = 0
        self.at: list[int] = []

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        self.step = step

    def count(self, event: str, seconds: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            self.at.append(self.step)


def test_nothing_compiles_after_warm_up_the_cut_last_session_included(tmp_path: Path):
    config = short()
    warm = 601  # the first session, and the first by the method's own rule, lie behind
    assert due(config, 600, 10).session == 10
    assert due(config, 800, 20).session == 5
    program._learner.cache_clear()  # what other tests compiled would hide what this run compiles
    runs.compiled.cache_clear()
    seen = Compilations()
    jax.monitoring.register_event_duration_secs_listener(seen.count)
    try:
        train(config, tmp_path, watcher=seen)
    finally:
        jax.monitoring.unregister_event_duration_listener(seen.count)
    assert len(seen.at) > 20
    assert max(seen.at) < warm, sorted(set(seen.at))


def test_vmap_and_the_loop_compute_the_same(tmp_path: Path):
    config = short()
    learner = make_learner(config)
    trained = train(config, tmp_path, seeds=2)

    def states() -> list[Run]:
        """The two trained runs, each time anew because a `Runs` gives its arrays away; they fit for one epoch."""
        found = []
        for result in trained:
            run, _ = checkpoint.restore(result.path / "checkpoints", 1000, learner.init(config))
            fit = run.numbers.fit._replace(epochs=jnp.int32(1))  # rounding grows from epoch to epoch
            found.append(run._replace(numbers=run.numbers._replace(fit=fit)))
        return found

    rng = np.random.default_rng(0)
    facts = [
        Fact(
            rng.normal(size=4).astype(np.float32),
            rng.uniform(-1, 1, 2).astype(np.float32),
            np.float32(i),
            rng.normal(size=4).astype(np.float32),
            np.bool_(False),
            np.bool_(i == 1),
            np.int32(13),
        )
        for i in range(2)
    ]
    shape = (config.queries.budget, 2, config.queries.segment)
    labelled = Labelled(
        rng.normal(size=(*shape, 4)).astype(np.float32),
        rng.uniform(-1, 1, size=(*shape, 2)).astype(np.float32),
        rng.integers(2, size=shape[0]).astype(np.float32),
        np.int32(20),
    )
    at = np.int32(1000)
    both: dict[str, Runs] = {"loop": Runs(states(), "loop"), "vmap": Runs(states(), "vmap")}
    results: dict[str, list[Any]] = {lift: [] for lift in both}
    for lift, lifted in both.items():
        before = jax.tree.map(np.asarray, [lifted[i].agent.actor for i in range(2)])
        given = lifted.give(fact=facts, step=[at, at], recent=[np.int32(0)] * 2)
        results[lift].append(lifted.every(learner.learn, ("agent",), [True, True], given, "step", "recent"))
        results[lift].append(lifted.every(learner.store, ("replay", "learned_return"), [True, True], given, "fact"))
        results[lift].append(lifted.one(1, learner.fit, labelled, at))
        results[lift].append(lifted.one(0, learner.refresh, at))
        after = [lifted[i].agent.actor for i in range(2)]
        assert not np.allclose(after[0].weights[0], before[0].weights[0], atol=1e-4)

    def close(one: Any, other: Any) -> None:
        for (path, left), right in zip(
            jax.tree_util.tree_leaves_with_path(one), jax.tree_util.tree_leaves(other), strict=True
        ):
            np.testing.assert_allclose(left, right, rtol=1e-3, atol=1e-5, err_msg=jax.tree_util.keystr(path))

    for i in range(2):
        close(both["loop"][i], both["vmap"][i])
    for one, other in zip(results["loop"][:2], results["vmap"][:2], strict=True):
        close([one[0], one[1]], [other[0], other[1]])
    close(results["loop"][2:], results["vmap"][2:])


def test_m_senior_on_meta_world(tmp_path: Path):
    config = short("door-close", steps=700)
    (result,) = train(config, tmp_path)
    expected = plan(config)
    assert result.finished
    assert result.labels == expected.queried == 20
    assert [row["step"] for row in rows(result.path / "eval.csv")] == ["500", "700"]
    assert [int(row["labels"]) for row in rows(result.path / "train.csv")][-1] == 20
    assert rows(result.path / "train.csv")[-1]["refreshes"] == str(expected.refreshes)
