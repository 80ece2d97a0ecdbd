"""How often `senior.report.statistics.mean_interval` holds the truth: ``python benchmarks/coverage.py``.

Seeds' true success rates are drawn from a beta distribution, ten episodes of each are counted, and the 90 % interval of
so many seeds is compared with the distribution's mean.
"""

from __future__ import annotations

import numpy as np

from senior.report.statistics import mean_interval

TRIALS, EPISODES = 4000, 10
rng = np.random.default_rng(0)
for a, b, seeds in ((2, 2, 5), (0.2, 0.05, 5), (50, 1, 8)):
    truth, held = a / (a + b), 0
    for _ in range(TRIALS):
        rates = rng.binomial(EPISODES, rng.beta(a, b, seeds)) / EPISODES
        interval = mean_interval(list(rates), EPISODES)
        held += interval.low <= truth <= interval.high
    print(f"beta({a}, {b}), mean {truth:.2f}, {seeds} seeds: {held / TRIALS:.2f}")
