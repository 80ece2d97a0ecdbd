"""Any pair is as good as another: the selection of every first session."""

from __future__ import annotations

import numpy as np

from senior.select import Context, Selection


def uniform(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """The first ``n`` pairs: the pool is drawn independently, so these are a uniform draw."""
    return Selection(np.arange(n))
