"""What an environment gives, checked, and what is said of one that breaks."""

from __future__ import annotations

import sysconfig
import traceback
from pathlib import Path
from typing import Any

import numpy as np

LARGEST = float(np.finfo(np.float32).max)
OURS, PYTHONS = Path(__file__).parents[1], Path(sysconfig.get_path("stdlib"))


class BadNumber(Exception):
    """The environment gave a number or a shape that no learner can use."""


def checked(observation: Any, size: int) -> np.ndarray:
    """A float32 copy of an observation, checked: [size] and finite. Raises `BadNumber`."""
    with np.errstate(over="ignore"):  # beyond float32 becomes infinite, and is told below
        copy = np.array(observation, np.float32)
    if copy.shape != (size,):
        raise BadNumber(f"the observation has shape {copy.shape} instead of ({size},).")
    if not np.isfinite(copy).all():
        where = int(np.flatnonzero(~np.isfinite(copy))[0])
        raise BadNumber(f"the observation is {copy[where]} at index {where}.")
    return copy


def finite(what: str, value: Any) -> float:
    """A number that float32 can hold, or the one in an array of one. Raises `BadNumber`."""
    array = np.asarray(value)
    if array.size != 1:
        raise BadNumber(f"the {what} is an array of shape {array.shape}.")
    try:
        number = float(array.item())
    except (TypeError, ValueError):
        raise BadNumber(f"the {what} is {value!r}.") from None
    if not abs(number) <= LARGEST:
        raise BadNumber(f"the {what} is {number}.")
    return number


def cause(error: Exception) -> str:
    """What an environment raised, in a line."""
    kind = "" if isinstance(error, BadNumber) else f"{type(error).__name__}: "
    return f"{kind}{' '.join(str(error).split())}".rstrip(": ")


def raised_at(error: BaseException) -> str:
    """Where an error came from: the last line that is neither of this package, nor of Python, nor of one installed."""
    for raised in filter(None, (error, error.__cause__)):
        for frame in reversed(traceback.extract_tb(raised.__traceback__)):
            file = Path(frame.filename)
            if not {OURS, PYTHONS} & {*file.parents} and "site-packages" not in file.parts:
                return f" ({file.name}, line {frame.lineno})"
    return ""
