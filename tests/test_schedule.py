"""Sessions, outer steps and refreshes of the paper's runs, counted without physics."""

from dataclasses import replace

import pytest

from senior.checks import check
from senior.config import Bilevel, Config, differences
from senior.methods import METHODS
from senior.presets import PAPER, preset, release, with_budget
from senior.schedule import Counts, due, plan
from senior.types import BadInput
from tests.small import small


@pytest.mark.parametrize(
    ("task", "sessions", "last", "outer"),
    [
        ("door-lock", 50, 255_000, 24),
        ("window-close", 50, 255_000, 24),
        ("handle-press", 25, 130_000, 11),
        ("window-open", 25, 130_000, 11),
        ("door-open", 100, 505_000, 49),
        ("door-unlock", 50, 255_000, 24),
    ],
)
def test_the_papers_runs(task: str, sessions: int, last: int, outer: int):
    config = preset("paper", task, "m-senior")
    counts = plan(config)
    assert (counts.sessions, counts.last_session, counts.outer_steps) == (sessions, last, outer)
    assert counts.queried == config.queries.budget
    assert counts.pretraining_updates == 8999
    assert counts.refreshes == (1_000_000 - 10_000) // config.pge.every
    assert counts.updates == 1_000_000 - 10_000 - 1 + 100


def every_step(config: Config) -> Counts:
    """The same counts by asking at every single step what is due."""
    sessions = queried = last = outer = refreshes = pretraining = updates = 0
    for step in range(config.steps):
        now = due(config, step, queried)
        if now.session:
            sessions, queried, last = sessions + 1, queried + now.session, step
        outer, refreshes = outer + now.outer, refreshes + now.refresh
        pretraining += now.pretrain * config.pretraining.updates
        updates += now.update * config.sac.updates + now.begin * config.sac.reset_updates
    return Counts(sessions, queried, last, outer, refreshes, pretraining, updates)


@pytest.mark.parametrize("method", METHODS)
def test_a_plan_is_what_comes_of_asking_at_every_step(method: str):
    for config in (
        replace(preset("paper", "door-open", method), steps=60_123),
        preset("quick", "door-close", method),
        replace(preset("quick", "window-open", method), steps=21_001),
        small(method),
        replace(small(method), steps=401, bilevel=Bilevel(every=100, after_budget=True)),
    ):
        assert plan(config) == every_step(config)


TABLE = {
    # task: budget, pairs per session, sessions, last session, outer steps, refresh every, episodes of QPA
    "door-lock": (250, 5, 50, 255_000, 24, 1000, 30),
    "window-close": (250, 5, 50, 255_000, 24, 500, 30),
    "handle-press": (250, 10, 25, 130_000, 11, 1000, 30),
    "window-open": (250, 10, 25, 130_000, 11, 500, 30),
    "door-open": (1000, 10, 100, 505_000, 49, 1000, 60),
    "door-unlock": (1000, 20, 50, 255_000, 24, 500, 30),
    "door-close": (250, 5, 50, 255_000, 24, 1000, 30),  # this and the following are ours
    "box-close": (1000, 10, 100, 505_000, 49, 1000, 30),
    "point": (250, 5, 50, 255_000, 24, 1000, 30),
}


def test_the_rows_are_those_of_the_papers():
    cells = {name: (row.select, row.explore, row.mix, row.outer) for name, row in METHODS.items()}
    assert cells == {
        "sac": ("none", "none", "uniform", "none"),
        "pebble": ("entropy", "none", "uniform", "none"),
        "mrn": ("disagreement", "none", "uniform", "bilevel"),
        "rune": ("disagreement", "disagreement", "uniform", "none"),
        "m-rune": ("disagreement", "disagreement", "uniform", "bilevel"),
        "qpa": ("policy_aligned", "none", "recent", "none"),
        "p-senior": ("motion_distinction", "preference_guided", "curiosity", "none"),
        "m-senior": ("motion_distinction", "preference_guided", "curiosity", "bilevel"),
    }


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["paper", "qpa_original"])
@pytest.mark.parametrize("task", TABLE)
def test_sessions_queries_outer_steps_and_refreshes_of_a_million_steps(task: str, name: str, method: str):
    if name == "qpa_original" and method != "qpa":
        with pytest.raises(BadInput, match=f"no numbers for {method}"):
            preset(name, task, method)
        return
    row, config = METHODS[method], preset(name, task, method)
    counts = plan(config)
    if method == "sac":
        assert counts == Counts(0, 0, 0, 0, 0, 0, 1_000_000 - 5001)
        return
    budget, per_session, sessions, last, outer, refresh, recent = TABLE[task]
    bilevel, pge = row.outer == "bilevel", row.explore == "preference_guided"
    assert config.queries.per_session == per_session
    assert counts == Counts(sessions, budget, last, outer * bilevel, 990_000 // refresh * pge, 8999, 990_000 - 1 + 100)
    assert config.window == (recent if method == "qpa" else 100)
    original = name == "qpa_original"
    assert (config.reward.members, config.reward.epochs) == ((1, 200) if method == "qpa" else (3, 10))
    assert config.reward.snippets == (20 if method == "qpa" and not original else 0)
    weight = (config.rune.beta, config.rune.decay) if row.explore == "disagreement" else (0.05, 1e-5)
    assert weight == (0.05, 1e-5)
    pge, mds, outer_step = config.pge, config.mds, config.bilevel
    assert (pge.beta, pge.decay, pge.share, pge.bandwidth, pge.capacity) == (0.1, 0.01, 0.3, 0.1, 1000)
    assert (pge.clock, mds.axis, mds.density_sum) == ("refresh", "oriented", "density")
    assert (mds.keep, mds.bandwidth, config.queries.pool) == (0.3, 0.05, 10)
    assert (outer_step.weight, outer_step.optimizer, outer_step.batch) == (0.1, "shared", "uniform")
    networks, sac = config.networks, config.sac
    assert (networks.layers, networks.width, sac.batch) == ((2, 1024, 1024) if original else (3, 256, 512))
    rates = (sac.actor_rate, sac.critic_rate, sac.alpha_rate)
    assert rates == ((1e-4, 1e-4, 1e-4) if original else (3e-4, 3e-4, 1e-4))
    assert (config.evaluation.every, config.evaluation.episodes) == (10_000, 100 if original else 10)
    assert set(TABLE) == set(PAPER)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", TABLE)
def test_the_quick_presets_run_is_the_same_on_every_task(task: str, method: str):
    row, counts = METHODS[method], plan(preset("quick", task, method))
    if method == "sac":
        assert counts == Counts(0, 0, 0, 0, 0, 0, 2 * (80_000 - 1001))
        return
    bilevel, pge = row.outer == "bilevel", row.explore == "preference_guided"
    assert counts == Counts(10, 250, 32_500, 4 * bilevel, 140 * pge, 8999, 2 * (70_000 - 1) + 100)


@pytest.mark.parametrize(
    ("task", "budget", "per_session"),
    [("door-lock", *pair) for pair in ((150, 3), (250, 5), (500, 10), (1000, 20))]
    + [("window-open", *pair) for pair in ((150, 6), (250, 10), (500, 20), (1000, 40))],
)
def test_the_papers_other_budgets_take_as_many_sessions(task: str, budget: int, per_session: int):
    before = preset("paper", task, "m-senior")
    config = check(with_budget(before, budget))
    assert config.queries.per_session == per_session
    counts = plan(config)
    assert counts.queried == budget
    assert counts.sessions == plan(before).sessions


def test_what_the_public_code_does_otherwise():
    before = preset("paper", "door-lock", "m-senior")
    config = check(release(before))
    assert plan(config).refreshes == plan(before).refreshes - plan(before).outer_steps
    assert not due(config, 20_000, 20).refresh
    assert due(config, 21_000, 20).refresh
    assert due(config, 10_000, 0).refresh
    changed = {name for name, _, _ in differences(before, config)}
    assert changed == {
        "compat", "mds.density_sum", "mds.axis", "mds.scores", "pge.bandwidth", "pge.clock", "pge.equal",
        "pge.relabel", "pge.rest", "pge.refresh_with_outer", "bilevel.batch",
    }  # fmt: skip


def test_p_senior_has_no_outer_step_and_sac_asks_nothing():
    short = {"steps": 30_000}
    assert plan(replace(preset("paper", "door-lock", "p-senior"), **short)).outer_steps == 0
    sac = plan(replace(preset("paper", "door-lock", "sac"), **short))
    assert (sac.sessions, sac.queried, sac.refreshes, sac.pretraining_updates) == (0, 0, 0, 0)
    assert sac.updates == 30_000 - 5001


def test_the_last_session_is_cut_to_what_is_left():
    config = preset("paper", "door-lock", "m-senior")
    assert due(config, 15_000, 248).session == 2
    assert due(config, 15_000, 250).session == 0


def test_no_session_begins_while_an_earlier_one_is_open_and_its_pairs_are_left():
    config = preset("paper", "door-lock", "m-senior")
    last = due(config, 20_000, 245)
    assert (last.session, last.outer) == (5, False)
    later = due(config, 20_000, 245, session_open=True)
    assert (later.session, later.outer) == (0, True)


def test_outer_steps_stop_with_the_budget_unless_told_otherwise():
    config = preset("paper", "door-lock", "m-senior")
    on = replace(config, bilevel=replace(config.bilevel, after_budget=True))
    assert not due(config, 500_000, 250).outer
    assert due(on, 500_000, 250).outer
