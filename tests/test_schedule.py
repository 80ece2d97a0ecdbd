"""Sessions, outer steps and refreshes of the paper's runs, counted without physics."""

from dataclasses import replace

import pytest

from senior.config import check, from_json, to_json
from senior.methods import METHODS
from senior.presets import PAPER, PRESETS, preset
from senior.schedule import due, plan
from senior.types import BadInput


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


def test_outer_steps_stop_with_the_budget_unless_told_otherwise():
    config = preset("paper", "door-lock", "m-senior")
    on = replace(config, bilevel=replace(config.bilevel, after_budget=True))
    assert not due(config, 500_000, 250).outer
    assert due(on, 500_000, 250).outer


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_sound_and_survives_json(method: str, name: str):
    for task in PAPER:
        config = check(preset(name, task, method))
        assert from_json(to_json(config)) == config


def test_an_unknown_key_is_named():
    data = to_json(preset("paper", "door-lock", "m-senior"))
    data["queries"]["bugdet"] = 3
    with pytest.raises(BadInput, match="bugdet"):
        from_json(data)
