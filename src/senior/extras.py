"""What is installed only with an extra of this package."""

from __future__ import annotations

import importlib.util

from senior.types import BadInput


def require(what: str, extra: str, *packages: str) -> None:
    """`BadInput` that says how to install them if some of the packages are missing, which ``what`` needs."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise BadInput(
            f"{what} needs {' and '.join(missing)}, which is not installed: pip install 'senior-rl[{extra}]'"
        )
