"""Processes that this program starts. Imports no JAX."""

from __future__ import annotations

import os
import sys

OURS = [sys.executable, "-P"]
"""How a command begins that runs code of ours. ``-P``: Python would look into the working directory first, where a
user's ``queue.py`` hides its own."""


def importing_alike() -> dict[str, str]:
    """Environment variables for such a process: what is importable here is importable there, from the same places."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(place or os.curdir for place in sys.path)}
