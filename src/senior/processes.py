"""Processes that this program starts. Imports no JAX."""

from __future__ import annotations

import os
import sys


def importing_alike() -> dict[str, str]:
    """Environment variables for a process of ours: what is importable here is importable there."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
