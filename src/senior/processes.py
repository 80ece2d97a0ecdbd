"""Processes that this program starts. Imports no JAX."""

from __future__ import annotations

import os
import sys


def importing_alike() -> dict[str, str]:
    """Environment variables for a process of ours: it imports what this one does, from the same places.

    Left to itself, Python would look into the working directory first, where a user's ``queue.py`` hides its own.
    """
    places = [place or os.getcwd() for place in sys.path]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(places), "PYTHONSAFEPATH": "1"}
