"""The configuration: the same in Python, in JSON and in a run directory, and no preset that `check` refuses."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from senior import bench, envs, protocol
from senior.checks import check
from senior.config import SAC, Config, Queries, differences, from_json, load, to_json
from senior.methods import METHODS, Method
from senior.presets import PRESETS, preset, quick_changes
from senior.types import BadInput, EnvSpec

EVERYTHING = [
    (name, task, row)
    for name in PRESETS
    for task in [*envs.names(), "some-other-robot"]
    for row in METHODS
    if name != "qpa_original" or row == "qpa"
]


@pytest.mark.parametrize(("name", "task", "row"), EVERYTHING)
def test_every_preset_makes_sense_and_survives_json(name: str, task: str, row: str):
    config = preset(name, task, row)
    assert check(config) is config
    assert (config.preset, config.task, config.method) == (name, task, METHODS[row])
    assert from_json(json.loads(json.dumps(to_json(config)))) == config


@pytest.mark.parametrize(("name", "task", "row"), EVERYTHING)
def test_what_the_bench_makes_of_every_preset_makes_sense_too(name: str, task: str, row: str):
    config = preset(name, task, row)
    hastened = bench.hastened(config)
    assert hastened.pretraining.until == (2000 if config.method.learns_reward else 0)
    assert (hastened.networks, hastened.sac) == (config.networks, config.sac)


def test_the_readme_tells_what_quick_changes():
    assert f"```\n{quick_changes()}\n```" in (Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.parametrize("name", PRESETS)
def test_every_task_has_room_for_a_segment(name: str):
    for task in envs.names():
        env, spec = envs.make(task)
        env.close()
        method = "qpa" if name == "qpa_original" else "m-senior"
        assert preset(name, task, method).queries.segment < spec.horizon, task


def changed(*path: str, value: Any = 1) -> dict[str, Any]:
    """A configuration as JSON data with one entry added or changed."""
    data = to_json(Config())
    inner = data
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (changed("stepps"), "stepps"),
        (changed("sac", "discont"), "discont"),
        (changed("steps", value="many"), "steps"),
        (changed("steps", value=None), "steps"),
        (changed("sac", value=3), "sac"),
        (changed("sac", "tau", value=[0.1]), "tau"),
        (changed("mds", "axis", value="sideways"), "axis"),
        (changed("preset", value="quik"), "preset"),
        (changed("seed", value=3.7), "seed"),
        (changed("sac", "batch", value=True), "batch"),
        (changed("sac", "discount", value="0.9"), "discount"),
        (changed("asking", "wait", value="no"), "wait"),
    ],
)
def test_json_that_does_not_fit_is_refused_by_name(data: dict[str, Any], named: str):
    with pytest.raises(BadInput, match=rf"The configuration cannot be read: .*\b{named}\b") as caught:
        from_json(data)
    assert "\n" not in str(caught.value)


def test_what_json_leaves_out_has_its_default():
    data = to_json(Config(seed=3, sac=SAC(batch=7)))
    del data["mds"], data["sac"]["tau"]
    assert from_json(data) == Config(seed=3, sac=SAC(batch=7))


def test_a_whole_number_in_json_will_do_for_any_number():
    assert from_json({"sac": {"discount": 1}}) == Config(sac=SAC(discount=1.0))


def test_a_run_directory_gives_its_configuration_back(tmp_path: Path):
    config = Config(task="point", seed=7, replay_capacity=20_000, length_scale=0.1, sac=SAC(tau=1 / 3))
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"config": to_json(config), "protocol": {}}))
    assert load(path) == config
    with pytest.raises(BadInput, match="is not a run directory"):
        load(tmp_path / "nowhere" / "config.json")


def test_differences_are_named_with_their_groups():
    other = Config(seed=1, sac=SAC(batch=7), method=METHODS["sac"])
    found = differences(Config(), other)
    assert ("seed", 0, 1) in found
    assert ("sac.batch", 512, 7) in found
    assert ("method.select", "motion_distinction", "none") in found
    assert len(found) == 2 + 5
    assert differences(other, other) == []


def test_capacity_is_what_is_asked_for_or_all_steps():
    assert Config(steps=123).capacity == 123
    assert Config(steps=123, replay_capacity=50).capacity == 50


OWN_RULE = Method("m-senior", select="my_module:rule")


@pytest.mark.parametrize(
    "row",
    [
        OWN_RULE,
        replace(OWN_RULE, explore="my_module:Bonus", mix="uniform"),
        replace(OWN_RULE, explore="none", mix="uniform", outer="none"),
        replace(METHODS["pebble"], outer="bilevel"),
        replace(METHODS["pebble"], explore="preference_guided", mix="curiosity"),
    ],
)
def test_cells_that_go_together(row: Method):
    row.check()
    assert check(replace(Config(), method=row)).method == row


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ({"select": "entrpy"}, "did you mean entropy"),
        ({"outer": "bi-level"}, "did you mean bilevel"),
        ({"select": "none"}, "no reward model"),
        ({"select": "none", "outer": "none", "explore": "my_module:Bonus", "mix": "uniform"}, "no reward model"),
        ({"mix": "uniform"}, "needs --mix curiosity"),
        ({"explore": "my_module:Bonus"}, "needs --explore preference_guided"),
    ],
)
def test_cells_that_do_not_go_together(cells: dict[str, str], message: str):
    with pytest.raises(BadInput, match=message):
        check(replace(Config(), method=replace(METHODS["m-senior"], **cells)))


def test_q_divides_k_and_n_only_where_they_exist():
    odd = replace(Config(), queries=Queries(every=1500))
    with pytest.raises(BadInput, match="Q, --refresh-every 1000, must divide K, --session-every 1500"):
        check(odd)
    check(replace(odd, method=METHODS["mrn"]))  # no PGE, so there is no Q
    odd = replace(Config(), bilevel=replace(Config().bilevel, every=1500))
    with pytest.raises(BadInput, match="must divide N, --outer-every 1500"):
        check(odd)
    check(replace(odd, method=METHODS["p-senior"]))  # no outer step, so there is no N


def test_a_run_tells_the_commit_of_its_source_and_whether_it_was_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def git(*arguments: str) -> str:
        names = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
        return subprocess.run(
            ["git", *names, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout.strip()

    def told() -> str | None:
        return protocol.of(EnvSpec("own", 4, 2, slice(0, 2), 10, None, False), "cpu")["git_commit"]

    source = tmp_path / "src" / "senior" / "protocol.py"
    monkeypatch.setattr(protocol, "__file__", str(source))
    source.parent.mkdir(parents=True)
    source.write_text("first")
    assert told() is None
    git("init")
    git("add", ".")
    git("commit", "--message", "first")
    (tmp_path / "notes.txt").write_text("beside the source")
    assert told() == git("rev-parse", "HEAD")
    source.write_text("second")
    assert told() == git("rev-parse", "HEAD") + "-changed"
