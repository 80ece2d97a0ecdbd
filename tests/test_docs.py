"""What the documentation says about the tests that hold it."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
NAMED = re.compile(r"`(?:(test_\w+\.py))?(?: ?-k (\w+))?`")


def test_every_test_that_the_conformance_page_names_exists():
    """A file alone must be there; a name after -k must be part of a test's name in that file."""
    default, seen = "", 0
    for line in (ROOT / "docs" / "methods.md").read_text().splitlines():
        if found := re.search(r"test \(`(test_\w+\.py)` unless told\)", line):
            default = found[1]
        for file, name in NAMED.findall(line):
            if not (file or name):
                continue
            source = (ROOT / "tests" / (file or default)).read_text()
            assert not name or re.search(rf"def test_\w*{name}", source), f"{file or default} has no test of {name}"
            seen += 1
    assert seen > 60
