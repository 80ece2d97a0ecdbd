"""What the documentation says about the tests that hold it."""

from __future__ import annotations

import re
from pathlib import Path

from senior.rundir import TABLES

ROOT = Path(__file__).parent.parent
CELL = re.compile(r"`([^`]*)`")
NAMED = re.compile(r"(?:(test_\w+\.py))?(?: ?-k (\w+))?")


def test_every_row_of_the_conformance_page_names_tests_that_exist():
    """In every table before the quick preset's: a file, and after -k a part of a test's name in it."""
    default, inside, rows = "", False, 0
    page, _ = (ROOT / "docs" / "methods.md").read_text().split("## What the quick preset changes")
    for line in page.splitlines():
        last = line.strip("|").split("|")[-1].strip()
        if not line.startswith("|"):
            inside, default = False, ""
        elif not inside:
            assert last.startswith("test"), f"names no tests: {line}"
            inside, default = True, "".join(re.findall(r"test_\w+\.py", last))
        elif inside and set(last) != {"-"}:
            named = [NAMED.fullmatch(name) for name in CELL.findall(last)]
            assert named and all(named), f"names no test: {line}"
            for file, name in (match.groups() for match in named if match):
                source = (ROOT / "tests" / (file or default)).read_text()
                assert name and re.search(rf"def test_\w*{name}", source), f"{file or default} has no {name}"
            rows += 1
    assert rows > 80


def test_every_column_of_a_run_is_told():
    parts = (ROOT / "docs" / "run-directory.md").read_text().split("\n## ")
    told = {part.split(":")[0]: part for part in parts if ".csv:" in part}
    assert told.keys() == TABLES.keys()
    for table, columns in TABLES.items():
        rows = [line.split("|")[1] for line in told[table].splitlines() if line.startswith("| `")]
        assert sorted(CELL.findall("".join(rows))) == sorted(columns)
