"""Ask where the members disagree (MRN, RUNE): highest deviation over members of P(second preferred)."""

from __future__ import annotations

import numpy as np

from senior.select import Context, Selection, deviation, highest, probability_second


def disagreement(rng: np.random.Generator, context: Context, n: int) -> Selection:
    """Top ``n`` by the population standard deviation over members."""
    p = probability_second(context.predict(context.pool.observation, context.pool.action))
    return highest(deviation(p), n, "disagreement")
