"""The command line: bad input gets one sentence and code 2 and leaves all files alone; good input reaches the parts."""

from __future__ import annotations

import ast
import errno
import json
import shutil
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import senior
from senior import envs, judgement, program
from senior.cli import COMMANDS, main
from senior.cli.shared import DONE, FAILED
from senior.config import Answering, Config, to_json
from senior.label.address import Address
from senior.methods import METHODS
from senior.presets import preset, quick_changes, release
from senior.types import BAD_INPUT, BadInput

HERE = "tests.test_cli"


@pytest.fixture(autouse=True)
def _workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A directory of its own to stand in; what a command changes in the process is put back."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def contents(directory: Path) -> dict[str, bytes | None]:
    """Every file's bytes, and every directory."""
    return {
        str(path.relative_to(directory)): path.read_bytes() if path.is_file() else None for path in directory.rglob("*")
    }


def refused(arguments: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one sentence with which the program refuses these arguments; nothing is printed or written beside it."""
    before = contents(Path.cwd())
    assert main(arguments.split()) == BAD_INPUT
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("senior: ")
    assert told.err.endswith("\n")
    assert told.err.count("\n") == 1, told.err
    assert not {"│", "╭", "Traceback", "---"} & set(told.err.split())
    assert contents(Path.cwd()) == before
    return told.err


NO_RULE = 3

NAMES = {
    "trian": "'trian'; did you mean train",
    "--frobnicate": "'--frobnicate'; known are train, resume",
    "train --task door-lok": "'door-lok'; did you mean door-lock",
    "train --method m-senor": "'m-senor'; did you mean m-senior",
    "train --preset quik": "'quik'; did you mean quick",
    "train --buget 10": "--buget; did you mean --budget",
    "train --refresh_evry 10": "--refresh_evry; did you mean --refresh-every",
    "train --sac.discont 0.9": "did you mean --sac.discount",
    "train --task point further": "no use for 'further'",
    "train --task": "--task needs a value",
    "train --device tpu": "Unknown --device 'tpu'",
    "train --axis rwa": "did you mean raw",
    "train --select entrpy": "'entrpy'; did you mean entropy",
    "train --explore prefrence_guided": "did you mean preference_guided",
    "train --outer bilvel": "'bilvel'; did you mean bilevel",
    "train --mix curious": "'curious'; did you mean curiosity",
    "train --task point --teacher orakel": "'orakel'; did you mean oracle",
    "resume": "senior resume needs a PATH",
    "eval": "senior eval needs a PATH",
    "labels export run": "senior labels export needs a --out",
    "eval run --vido film.mp4": "--vido; did you mean --video",
    "eval one two": "no use for 'two'",
    "tasks door": "no use for 'door'",
    "methods --all": "Unknown option --all",
    "bench --task doorlock": "did you mean door-lock",
    "bench --method m-senor": "m-senior",
}


@pytest.mark.parametrize("arguments", NAMES)
def test_unknown_names_are_told_with_the_nearest(arguments: str, capsys: pytest.CaptureFixture[str]):
    assert NAMES[arguments] in refused(arguments, capsys)


NUMBERS = {
    "--steps many": "--steps needs a whole number, not 'many'",
    "--steps 1e6": "--steps needs a whole number, not '1e6'",
    "--steps": "--steps needs a value",
    "--steps 0": "--steps must be at least 1, not 0",
    "--steps -5": "--steps must be at least 1, not -5",
    "--steps 10000": "10000 steps end before the first session at step 10000",
    "--seed -1": "--seed must be 0 or more",
    "--seed 4294967296": "--seed must be below 4294967296",
    "--seed 4294967295 --seeds 2": "--seed must be below 4294967296",
    "--seeds 0": "--seeds must be at least 1, not 0",
    "--seeds two": "--seeds needs a whole number, not 'two'",
    "--budget 4 --per-session 5": "budget of 4 labels is below one session of 5",
    "--budget many": "--budget needs a whole number",
    "--budget -3": "budget of -3 labels is below one session",
    "--budget 20 --per-session 21": "below one session of 21",
    "--refresh-every 300": "Q, --refresh-every 300, must divide K, --session-every 5000",
    "--outer-every 1500": "Q, --refresh-every 1000, must divide N, --outer-every 1500",
    "--pool 0": "--pool must be at least 1",
    "--candidate-episodes 1": "--candidate-episodes must be at least 2",
    "--segment 50": "segment of 50 steps does not fit into an episode of 50",
    "--horizon 0": "--horizon 0 must be at least 1",
    "--bandwidth-mds nan": "--bandwidth-mds must be a positive number, not nan",
    "--bandwidth-pge inf": "--bandwidth-pge must be a positive number, not inf",
    "--bandwidth-pge 0": "--bandwidth-pge must be a positive number, not 0.0",
    "--sac.actor-rate -1": "--sac.actor-rate must be a positive number",
    "--sac.discount 1.5": "--sac.discount must lie between 0 and 1",
    "--sac.tau x": "--sac.tau needs a number, not 'x'",
    "--sac.reset-updates -5": "--sac.reset-updates must be at least 1",
    "--sac.target-entropy nan": "--sac.target-entropy must be a number",
    "--pretraining.random-steps -5": "--pretraining.random-steps must be 0 or more",
    "--pretraining.random-steps 4": "looks at 5 neighbours, more than there are after 4 random steps",
    "--pretraining.until 10500": "Q, --refresh-every 1000, must divide the end of pre-training",
    "--pretraining.until 1000": "Pre-training must last beyond its 1000 random steps",
    "--pge.beta nan": "--pge.beta must be 0 or more, not nan",
    "--pge.beta -0.1": "--pge.beta must be 0 or more",
    "--pge.decay nan": "--pge.decay must be at least 0 and below 1, not nan",
    "--bilevel.weight inf": "--bilevel.weight must be 0 or more, not inf",
    "--reward.stop-accuracy nan": "--reward.stop-accuracy must lie between 0 and 1",
    "--rune.decay 1": "--rune.decay must be at least 0 and below 1, not 1.0",
    "--rune.beta -1": "--rune.beta must be 0 or more",
    "--qpa.episodes 1": "--qpa.episodes must be at least 2",
    "--qpa.share 1.5": "--qpa.share must lie between 0 and 1",
    "--method p-senior --pge.share 0.001": "--pge.share 0.001 of a batch of 512 is not one row",
    "--method qpa --qpa.share 0": "--qpa.share 0 of a batch of 512 is not one row",
    "--rationality 0": "--rationality must be a positive number, or -1",
    "--mistake 1.5": "--mistake must lie between 0 and 1",
    "--foresight nan": "--foresight must lie between 0 and 1",
    "--skip -0.1": "--skip must be 0 or more",
    "--reward.snippets -1": "--reward.snippets must be 0 or more",
    "--reward.snippets 5": "Windows of 35 to 45 steps do not fit into segments of 10",
    "--replay-capacity 0": "--replay-capacity must be at least 1",
    "--replay-capacity 10000": "cannot hold pre-training's 10000 steps",
    "--precision bfloat16": "--precision bfloat16 is not offered: its learning curves do not agree",
    "--device gpu": "--device gpu: JAX finds no GPU here",
}


@pytest.mark.parametrize("options", NUMBERS)
def test_numbers_that_make_no_sense(options: str, capsys: pytest.CaptureFixture[str]):
    assert NUMBERS[options] in refused(f"train --task point {options}", capsys)


COMBINATIONS = {
    "--teacher human --seeds 2 --port 9000": "--port 9000 is for one page, and each of 2 runs has its own",
    "--select none": "no reward model, so an outer step (bilevel) makes no sense",
    "--method sac --explore preference_guided": "no reward model, so a bonus",
    "--method sac --mix curiosity": "no reward model, so a mix of sources",
    "--method sac --pretraining.until 100": "--pretraining.until must be 0",
    "--method sac --select disagreement": "With --select disagreement method sac would be another one; name one",
    "--method pebble --select none --pretraining.until 0": "would be another one; name one that learns from the true",
    "--pool 1 --replace-skipped": "--replace-skipped keeps as many pairs in reserve as a session asks, so --pool must",
    "--mix uniform": "--explore preference_guided needs --mix curiosity",
    "--explore none": "--mix curiosity needs --explore preference_guided",
    "--method qpa --select disagreement": "One member cannot disagree with itself, so --select disagreement needs",
    "--method qpa --select kcenter_disagreement": "so --select kcenter_disagreement needs --reward.members 2",
    "--method rune --reward.members 1": "One member cannot disagree with itself",
    "--method qpa --explore disagreement": "so --explore disagreement needs --reward.members 2 or more",
    "--method sac --compat release": "--compat release is about m-senior",
    "--method p-senior --compat release": "--compat release is about m-senior",
    "--compat release --beta-clock refresh": "With pge.clock refresh this is not what the public code does",
    "--compat release --bandwidth-mds 0.3": "With mds.bandwidth 0.3 this is not what the public code does",
    "--compat release --mds.keep 1": "With mds.keep 1.0 this is not",
    "--compat release --pool 3": "With queries.pool 3 this is not",
    "--compat release --pge.share 0.5": "With pge.share 0.5 this is not",
    "--compat release --reward.members 1": "With reward.members 1 this is not",
    "--compat release --bilevel.weight 0": "With bilevel.weight 0.0 this is not",
    "--compat release --bilevel.after-budget True": "With bilevel.after_budget True this is not",
    "--compat release --replay-capacity 50000": "--pge.rest older needs a replay that holds the whole run",
    "--bilevel.batch update": "takes the batch of the step's update, which cannot be known",
    "--preset qpa_original --method pebble": "it has no numbers for pebble",
    "--teacher mistkae --mistake 0.2": "'mistkae'; did you mean mistake",
    f"--teacher {HERE}:contents --mistake 0.2": "--mistake is a number of scripted teachers, and",
    "--position 0:2": "belong to --env; the task point has its own",
    "--length-scale 2": "belong to --env; the task point has its own",
    "--select no_such_module:Rule": "'no_such_module:Rule' cannot be imported",
    "--select :Rule": "':Rule' cannot be imported",
    f"--select {HERE}:Missing": "holds no Missing",
    f"--select {HERE}:NO_RULE": "is a int, not a class or a function",
    f"--teacher {HERE}:NO_RULE": "is a int, not a class or a function",
    f"--explore {HERE}:NO_RULE --mix uniform": "is a int, not a class or a function",
}


@pytest.mark.parametrize("options", COMBINATIONS)
def test_cells_and_options_that_do_not_go_together(options: str, capsys: pytest.CaptureFixture[str]):
    assert COMBINATIONS[options] in refused(f"train --task point {options}", capsys)


ENVIRONMENTS = {
    "Pendulum-v1": "needs --position",
    "Pendulum-v1 --position 3:1": "'3:1' is not a range of observation indices",
    "Pendulum-v1 --position hand": "'hand' is not a range",
    "Pendulum-v1 --position 0:9": "0:9 lies outside the 3 numbers",
    "Pendulum-v1 --position 0:2 --length-scale nan": "--length-scale must be a positive number, not nan",
    "Pendulum-v1 --position 0:2 --segment 200": "does not fit into an episode of 200",
    "Pendulum-v1 --position 0:2 --method sac --replay-capacity 150": "150 rows cannot hold an episode of 200 steps",
    "Pendulum-v11 --position 0:2": "did you mean Pendulum-v1",
    "CartPole-v1 --position 0:2": "only a bounded Box",
    "no_such_module:Env --position 0:2": "cannot be imported",
}


@pytest.mark.parametrize("options", ENVIRONMENTS)
def test_environments_that_do_not_fit(options: str, capsys: pytest.CaptureFixture[str]):
    assert ENVIRONMENTS[options] in refused(f"train --env {options}", capsys)


def test_a_selection_rule_that_raises_when_imported(capsys: pytest.CaptureFixture[str], monkeypatch):
    Path("broken_rule.py").write_text("raise RuntimeError('first line\\nsecond line')\n")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    told = refused("train --task point --select broken_rule:rule", capsys)
    assert "cannot be imported: first line second line" in told


def test_a_place_that_is_taken_or_cannot_be_written(capsys: pytest.CaptureFixture[str]):
    Path("taken/seed-1").mkdir(parents=True)
    Path("taken/seed-1/thesis.tex").write_text("years of work")
    Path("file").write_text("no directory")
    train = "train --task point --out"
    assert "taken/seed-1 exists and is not empty" in refused(f"{train} taken --seeds 2", capsys)
    assert "file/seed-0 is, or lies in, a file where a directory should be." in refused(f"{train} file", capsys)
    assert "file/below/seed-0 is, or lies in, a file" in refused(f"{train} file/below", capsys)


def test_a_place_that_may_not_be_looked_into(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """As root, who runs these tests in CI, may look anywhere, the refusal is made here."""
    Path("hidden/seed-0").mkdir(parents=True)

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    sentence = "hidden/seed-0 cannot be opened: Permission denied"
    assert sentence in refused("train --task point --out hidden", capsys)


def test_a_video_or_figures_in_a_place_that_cannot_be(capsys: pytest.CaptureFixture[str]):
    """Told before anything is judged or measured."""
    Path("run").mkdir()
    Path("file").write_text("no directory")
    about = {"config": to_json(preset("quick", "point", "m-senior")), "protocol": {}}
    Path("run/config.json").write_text(json.dumps(about))
    assert "file is, or lies in, a file where a directory should be." in refused("eval run --video file/a.mp4", capsys)
    assert "file is, or lies in, a file where a directory should be." in refused("bench --json file/a.json", capsys)
    assert "--video film.avi must be named NAME.mp4" in refused("eval run --video film.avi", capsys)
    Path("notes.mp4").write_text("precious")
    assert "notes.mp4 is no video, and would be overwritten" in refused("eval run --video notes.mp4", capsys)
    assert Path("notes.mp4").read_text() == "precious"
    if Path("/proc").is_dir():
        assert "/proc/film.mp4 cannot be opened: " in refused("eval run --video /proc/film.mp4", capsys)


DAMAGED = {
    "{": "is damaged",
    "[]": "is damaged",
    "{}": "is damaged",
    '{"config": 3}': "cannot be read",
    '{"config": {"tsak": "point"}}': "tsak",
    '{"config": {"steps": "many"}}': "steps",
    "\xff\xfe": "is damaged",
}


@pytest.mark.parametrize("command", ["resume", "eval"])
@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_configuration(command: str, text: str, capsys: pytest.CaptureFixture[str]):
    Path("run").mkdir()
    Path("run/config.json").write_bytes(text.encode("latin-1"))
    assert DAMAGED[text] in refused(f"{command} run", capsys)


def test_what_is_no_run(capsys: pytest.CaptureFixture[str]):
    Path("empty").mkdir()
    Path("file").write_text("no directory")
    for command in ("resume", "eval", "labels stats"):
        for path in ("empty", "file", "nowhere"):
            assert f"There is no run in {path}" in refused(f"{command} {path}", capsys)
    for seed in (0, 1):
        Path(f"early/seed-{seed}").mkdir(parents=True)
        about = {"config": to_json(preset("quick", "point", "m-senior")), "protocol": {}}
        Path(f"early/seed-{seed}/config.json").write_text(json.dumps(about))
    assert "has not reached its first checkpoint" in refused("eval early/seed-0", capsys)
    assert "There are 2 runs under early; name one of them." in refused("labels stats early", capsys)
    assert "--episodes must be at least 1, not 0" in refused("eval early/seed-0 --episodes 0", capsys)
    assert "--episodes needs a whole number, not 'x'" in refused("eval early/seed-0 --episodes x", capsys)
    assert "--video films one run" in refused("eval early --video film.mp4", capsys)
    assert main(["eval", "early"]) == FAILED  # each is told, and the others are judged
    told = capsys.readouterr().err.splitlines()
    assert [line.partition(":")[0] for line in told] == ["early/seed-0", "early/seed-1"]
    Path("early/seed-0/policy").mkdir()
    Path("early/seed-0/policy/actor.npz").write_bytes(b"PK no archive")
    assert "early/seed-0 cannot be read" in refused("eval early/seed-0", capsys)
    shutil.rmtree("early/seed-1")
    assert "early/seed-0 has no labels" in refused("labels stats early", capsys)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), sqlite3.OperationalError("database or disk is full")]
)
def test_a_full_disk_is_told_in_a_sentence(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(program, "train", full)
    assert main(["train", "--task", "point", "--preset", "quick"]) == FAILED
    assert capsys.readouterr().err == f"senior: {error}. What was saved is kept.\n"


def test_the_reward_of_meta_world_is_the_dense_one():
    with pytest.raises(BadInput, match="'v1' is not supported; did you mean v2"):
        envs.metaworld.MetaWorld("door-lock", "v1")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("train --task door-lok", "senior: Unknown task 'door-lok'; did you mean door-lock?\n"),
        ("eval --episodes", "senior: --episodes needs a value.\n"),
        ("resume nowhere", "senior: There is no run in nowhere: no config.json of a run at or below it.\n"),
    ],
)
def test_the_installed_program_says_it_too(arguments: str, sentence: str):
    program = [str(Path(sys.executable).with_name("senior")), *arguments.split()]
    # A narrow terminal that knows no box drawing.
    environment = {"PATH": "/usr/bin:/bin", "COLUMNS": "40", "PYTHONIOENCODING": "ascii", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(program, capture_output=True, text=True, timeout=120, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (BAD_INPUT, "", sentence)


def test_lists_and_help_need_no_jax_and_no_physics():
    script = (
        "import json, sys\n"
        "from senior.cli import COMMANDS, main\n"
        "assert main([]) == main(['--version']) == main(['tasks']) == main(['methods']) == 0\n"
        "for name in COMMANDS:\n"
        "    try: main([name, '--help'])\n"
        "    except SystemExit as end: assert not end.code\n"
        "    else: raise AssertionError(name)\n"
        "print(sorted({'jax', 'mujoco', 'metaworld', 'matplotlib', 'senior.program'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("\n[]\n")


def test_tasks_and_methods_are_listed(capsys: pytest.CaptureFixture[str]):
    assert main([]) == DONE
    overview = capsys.readouterr().out
    assert all(f"\n  {name} " in overview for name in COMMANDS)
    assert main(["tasks"]) == DONE
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[2:]] == envs.names()
    assert main(["methods"]) == DONE
    listed = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()[2:]}
    assert list(listed) == list(METHODS)
    assert "motion_distinction  preference_guided  30% curiosity  bilevel every 10,000 steps" in listed["m-senior"]
    assert listed["qpa"].endswith("50% recent     -                           1 member, snippets")
    assert listed["sac"].endswith("true reward")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert not end.value.code
    assert f"usage: senior {command}" in capsys.readouterr().out


def test_what_is_said_of_an_option_breaks_its_lines_where_a_clause_ends():
    """``--help`` keeps the line breaks of what stands under a field."""
    seen, root = 0, Path(senior.__file__).parent
    for path in (root / "config.py", root / "methods.py", *(root / "cli").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            for field, said in pairwise(node.body if isinstance(node, ast.ClassDef) else ()):
                match field, said:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                        lines = text.strip().splitlines()
                        assert all(line.endswith((".", ":", ";")) for line in lines if line), f"{path.name}: {name}"
                        seen += 1
    assert seen > 100


def test_help_of_train_tells_what_quick_changes_and_the_defaults_of_the_preset(capsys: pytest.CaptureFixture[str]):
    def told(*arguments: str) -> str:
        with pytest.raises(SystemExit):
            main(["train", *arguments, "--help"])
        return "".join(capsys.readouterr().out.replace("│", "").split())

    paper, quick = told(), told("--preset", "quick", "--task", "door-close")
    for line in quick_changes().splitlines():
        assert "".join(line.split()) in paper
    assert "Environmentsteps.(default:1000000)" in paper
    config = preset("quick", "door-close", "m-senior")
    assert f"Environmentsteps.(default:{config.steps})" in quick
    assert f"Pairsaskedpersession(M).(default:{config.queries.per_session})" in quick
    assert quick != paper


def test_options_of_the_machine_reach_the_program(monkeypatch: pytest.MonkeyPatch):
    asked: list[dict[str, Any]] = []
    for name in ("train", "resume"):
        monkeypatch.setattr(program, name, lambda *_, **machine: asked.append(machine) or [])
    assert main(["train", "--workers", "2", "--runs-per-device", "3"]) == DONE
    assert main(["resume", "somewhere", "--workers", "0", "--runs-per-device", "auto"]) == DONE
    page = {"page": Address()}
    assert asked == [{"workers": 2, "runs_per_device": 3, **page}, {"workers": 0, "runs_per_device": None, **page}]
    asked.clear()
    where = "--host 0.0.0.0 --port 9000 --allowed-host robot --allowed-host arm --token secret"
    assert main(["resume", "somewhere", *where.split()]) == DONE
    assert asked[0]["page"] == Address("0.0.0.0", 9000, ("robot", "arm"), "secret")
    assert main(["resume", "somewhere", "--port", "70000"]) == BAD_INPUT


def trained_with(arguments: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Config, Path, int]:
    """What `program.train` is asked for."""
    asked: list[Any] = []

    def instead(config: Config, out: Path, seeds: int, watcher: Any, **machine: Any) -> list[Any]:
        asked.extend((config, out, seeds))
        assert machine == {"workers": None, "runs_per_device": None, "page": Address()}
        return []

    monkeypatch.setattr(program, "train", instead)
    assert main(["train", *arguments.split()]) == DONE
    config, out, seeds = asked
    return config, out, seeds


def test_options_reach_the_configuration(monkeypatch: pytest.MonkeyPatch):
    assert trained_with("", monkeypatch) == (
        preset("paper", "door-lock", "m-senior"),
        Path("runs/door-lock-m-senior-paper"),
        1,
    )
    options = "--task window-open --method mrn --preset quick"
    start = preset("quick", "window-open", "mrn")
    assert trained_with(options, monkeypatch) == (start, Path("runs/window-open-mrn-quick"), 1)

    config, out, seeds = trained_with(
        f"{options} --seed 3 --seeds 5 --out elsewhere --steps 70000 --budget 50 --per-session 10 --session-every 600 "
        "--segment 20 --select uniform --outer none --bandwidth-mds 0.5 --axis raw --refresh-every 300 --pge.beta 0.2 "
        "--outer-every 900 --bilevel.after-budget True --sac.batch 32 --reward.members 5 --networks.width 7 "
        "--evaluation.every 123 --env Pendulum-v1 --position 0:2 --length-scale 3 --horizon 100",
        monkeypatch,
    )
    assert (out, seeds, config.seed, config.steps) == (Path("elsewhere"), 5, 3, 70_000)
    queries = config.queries
    assert (queries.budget, queries.per_session, queries.every, queries.segment) == (50, 10, 600, 20)
    assert (config.method.name, config.method.select, config.method.outer) == ("mrn", "uniform", "none")
    assert (config.mds.bandwidth, config.mds.axis, config.pge.every, config.pge.beta) == (0.5, "raw", 300, 0.2)
    assert (config.bilevel.every, config.bilevel.after_budget) == (900, True)
    assert (config.sac.batch, config.reward.members, config.networks.width) == (32, 5, 7)
    assert (config.env, config.position, config.length_scale, config.horizon) == ("Pendulum-v1", "0:2", 3.0, 100)
    assert (config.evaluation.every, config.evaluation.episodes) == (123, start.evaluation.episodes)
    assert config.reward.epochs == start.reward.epochs

    config, *_ = trained_with("--teacher mistake --mistake 0.2 --equal 0.1 --budget 500", monkeypatch)
    assert (config.teacher, config.answering) == ("mistake", Answering(mistake=0.2, equal=0.1))
    assert (config.queries.budget, config.queries.per_session) == (500, 10)
    config, *_ = trained_with("--budget 500 --per-session 5", monkeypatch)
    assert (config.queries.budget, config.queries.per_session) == (500, 5)
    start = preset("paper", "door-lock", "m-senior")
    assert trained_with("--compat release", monkeypatch)[0] == release(start)
    config, *_ = trained_with("--select disagreement", monkeypatch)
    assert config.method == replace(start.method, select="disagreement")
    config, *_ = trained_with("--explore none --mix uniform --mds.scores mirrored --pge.relabel False", monkeypatch)
    assert config.method == replace(start.method, explore="none", mix="uniform")
    assert (config.mds.scores, config.pge.relabel) == ("mirrored", False)


def test_a_run_that_broke_is_told_and_ends_with_code_1(capsys: pytest.CaptureFixture[str], monkeypatch):
    results = [
        program.Result(Path("runs/arm/seed-0"), 0, 1000, True, None, 20, None),
        program.Result(Path("runs/arm/seed-1"), 1, 649, False, "The environment arm failed: motor burnt", 20, None),
    ]
    monkeypatch.setattr(program, "train", lambda *_, **_options: results)
    monkeypatch.setattr(judgement, "film_policy", lambda *_: "There is no video: arm draws nothing.")
    assert main(["train", "--seeds", "2"]) == FAILED
    told = capsys.readouterr().out
    assert "seed 0: runs/arm/seed-0\n  success rate   not told by the environment" in told
    assert "There is no video: arm draws nothing." in told
    assert "seed 1: runs/arm/seed-1\n  stopped at step 649: The environment arm failed: motor burnt\n" in told


def test_train_then_eval(capsys: pytest.CaptureFixture[str]):
    options = "--steps 120 --pretraining.random-steps 60 --networks.layers 1 --networks.width 32 --sac.batch 64"
    command = f"train --task point --method sac --out runs/toy --seed 4 --evaluation.episodes 2 {options} --device cpu"
    assert main(command.split()) == DONE
    told = capsys.readouterr().out
    run = Path("runs/toy/seed-4")
    assert f"seed 4: {run}" in told
    assert f"{run}/plots/learning-curve.png" in told
    assert (run / "videos" / "final.mp4").stat().st_size > 0

    before = contents(run)
    assert main(["eval", "runs/toy", "--episodes", "2", "--video", "film.mp4"]) == DONE
    told = capsys.readouterr().out
    assert f"{run}: policy of step 120, 2 fresh episodes: success rate " in told
    assert Path("film.mp4").stat().st_size > 0
    assert contents(run) == before
    assert "exists and is not empty" in refused(command, capsys)
