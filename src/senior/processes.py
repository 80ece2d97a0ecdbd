"""Where modules are found: a user's, and those of the processes that this program starts. Imports no JAX."""

from __future__ import annotations

import os
import sys

PYTHON = [sys.executable, "-P"]
"""How a command begins that runs code of ours. ``-P``: Python would look into the working directory first, where a
user's ``queue.py`` hides its own."""


def importing_alike() -> dict[str, str]:
    """Environment variables for such a process: what is importable here is importable there, from the same places."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(place or os.curdir for place in sys.path)}


def look_here() -> None:
    """Have modules found in the working directory too, after all that is installed: a user's may lie there."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.append(os.getcwd())
