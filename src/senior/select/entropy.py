"""Ask where the members are unsure (PEBBLE): highest mean binary entropy of P(second preferred)."""

from __future__ import annotations

import numpy as np

from senior.select import Context, Selection, binary_entropy, highest, probability_second


def entropy(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """Top ``n`` by the mean over members of the binary entropy."""
    p = probability_second(context.predict(context.pool.observation, context.pool.action))
    return highest(binary_entropy(p), n, "entropy")
