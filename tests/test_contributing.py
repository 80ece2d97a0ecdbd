"""What CONTRIBUTING.md says of a new rule and a new teacher, done as it is written: one file and one line each."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
TRAIN = """
from dataclasses import replace
from senior import METHODS, preset, train
config = preset("quick", "point", "pebble")
train(
    replace(
        config,
        method=replace(METHODS["pebble"], select="uneven"),
        teacher="second",
        steps=900,
        pretraining=replace(config.pretraining, random_steps=200, until=500),
        queries=replace(config.queries, budget=20, per_session=10, every=200),
    ),
    out="runs",
)
"""


def test_a_rule_and_a_teacher_are_one_file_and_one_line_each(tmp_path: Path):
    text = (ROOT / "CONTRIBUTING.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    files = re.findall(r" is\s`(src/senior/\w+/\w+\.py)`:\n", text)
    folders = re.findall(r"a line in `(\w+)` of `(src/senior/\w+/__init__\.py)`:\n", text)
    assert len(blocks) == 4 and len(files) == len(folders) == 2
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    for file, (name, package), code, line in zip(files, folders, blocks[::2], blocks[1::2], strict=True):
        assert line.count("\n") == 1
        (tmp_path / file).write_text(code)
        before = (tmp_path / package).read_text()
        head = f"\n{name} = {{\n"
        assert before.count(head) == 1
        (tmp_path / package).write_text(before.replace(head, head + line))
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", TRAIN],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "src")},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    with sqlite3.connect(tmp_path / "runs" / "seed-0" / "preferences.sqlite") as file:
        asked = file.execute(
            "SELECT session, scores, second, annotator FROM pairs JOIN answers ON pair = pairs.id ORDER BY pairs.id"
        ).fetchall()
    file.close()
    assert [row[2:] for row in asked] == [(1, "second")] * 20
    assert all("uneven" in json.loads(scores) for session, scores, _, _ in asked if session)
