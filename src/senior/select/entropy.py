"""Ask where the members are unsure (PEBBLE): highest mean binary entropy of P(second preferred)."""

from __future__ import annotations

import numpy as np

from senior.select import Context, Selection, highest, probability_second


def entropy(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """Top ``n`` by the mean over members of the binary entropy, in nats."""
    p = probability_second(context.predict(context.pool.observation, context.pool.action))
    inside = np.clip(p, 1e-12, 1 - 1e-12)
    return highest(-(inside * np.log(inside) + (1 - inside) * np.log1p(-inside)).mean(axis=0), n, "entropy")
