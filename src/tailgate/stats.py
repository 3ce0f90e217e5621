"""Intervals. Proportions by Clopper and Pearson (scipy); paired differences by a bootstrap with its own seed."""

from typing import NamedTuple

import numpy as np
from scipy import stats

from tailgate.core import Array


class Interval(NamedTuple):
    """A point estimate and its interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def proportion(successes: int, n: int, level: float = 0.95) -> Interval:
    """Share of successes with the exact (Clopper-Pearson) interval."""
    ci = stats.binomtest(successes, n).proportion_ci(confidence_level=level, method="exact")
    return Interval(successes / n, float(ci.low), float(ci.high))


def paired_difference(a: Array, b: Array, level: float = 0.95, resamples: int = 10_000, seed: int = 0) -> Interval:
    """Mean of a - b with a percentile bootstrap interval.

    a and b are (episodes,), or (training seeds, episodes) on the same episodes: then training seeds are resampled first and
    episodes within (hierarchical bootstrap). A seed gives the same interval twice.
    """
    delta = np.atleast_2d(np.asarray(a, np.float64) - np.asarray(b, np.float64))
    runs, episodes = delta.shape
    rng = np.random.default_rng(seed)
    means = np.empty(resamples)
    for i in range(resamples):
        chosen = rng.integers(runs, size=runs)
        columns = rng.integers(episodes, size=episodes)
        means[i] = delta[np.ix_(chosen, columns)].mean()
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(delta.mean()), float(low), float(high))
