"""Intervals. Proportions by Clopper and Pearson, mean times by Poisson, medians by ranks (scipy); differences by a seeded bootstrap."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tailgate.core import Array


class Interval(NamedTuple):
    """A point estimate and its interval."""

    value: float
    low: float
    high: float


def proportion(successes: int, n: int, level: float = 0.95) -> Interval:
    """Share of successes with the exact (Clopper-Pearson) interval."""
    from scipy import stats  # its import takes half a second

    ci = stats.binomtest(successes, n).proportion_ci(confidence_level=level, method="exact")
    return Interval(successes / n, float(ci.low), float(ci.high))


def limits(successes: Array, n: Array, alpha: float) -> tuple[Array, Array]:
    """One-sided Clopper-Pearson limits of shares, lower and upper, each missed with a chance of at most alpha."""
    from scipy import stats

    low = np.where(successes > 0, stats.beta.ppf(alpha, np.maximum(successes, 1), n - successes + 1), 0.0)
    high = np.where(successes < n, stats.beta.isf(alpha, successes + 1, np.maximum(n - successes, 1)), 1.0)
    return low, high


def mean_time(events: int, time: float, dispersion: float = 1.0, level: float = 0.95) -> tuple[float, float | None]:
    """Limits of the mean time between events that came in so much of it: a Poisson interval, exact where they are independent.

    Events that come in clusters tell less than their number says: it and the time are divided by the dispersion (variance over mean of
    their number in a run) where that is above 1. The upper end is None without any event.
    """
    from scipy import stats

    clusters = max(dispersion, 1.0)
    if events:  # and one at least
        clusters = min(clusters, float(events))
    n, time, tail = events / clusters, time / clusters, (1.0 - level) / 2.0
    low = time / float(0.5 * stats.chi2.ppf(1.0 - tail, 2.0 * n + 2.0))
    return low, time / float(0.5 * stats.chi2.ppf(tail, 2.0 * n)) if n else None


def median_limits(values: Array, level: float = 0.95) -> tuple[float, float] | None:
    """The exact interval of the median of what values (n,) are drawn from: two of them, by the binomial distribution of their ranks.

    It covers with a chance of at least `level` whatever the distribution is. None where so few values cannot. Source: scipy's
    `quantile_test`; Conover, Practical Nonparametric Statistics, 1999, section 3.2.
    """
    from scipy import stats

    ends = stats.quantile_test(values, q=0.0, p=0.5).confidence_interval(confidence_level=level)
    return None if np.isnan(ends.low) or np.isnan(ends.high) else (float(ends.low), float(ends.high))


def paired_difference(a: Array, b: Array, level: float = 0.95, resamples: int = 4000, seed: int = 0, share: bool = False) -> Interval:
    """Mean of a - b on the same episodes, with an interval.

    a and b are (episodes,), or (training seeds, episodes). The part of the episodes comes from a bootstrap over them (a seed gives
    the same interval twice); that of the training seeds from Student's t over their means, as a bootstrap of three or five runs is too
    narrow. Both are added in squares. With one training seed the interval speaks of that policy alone.

    share: a and b are 0 or 1. An interval is then never narrower than what differences of -1 and of 1 could make of it that happened not to
    be among so many episodes: where all differences are equal the bootstrap has no width.
    """
    from scipy import stats

    delta = np.atleast_2d(np.asarray(a, np.float64) - np.asarray(b, np.float64))
    runs, episodes = delta.shape
    value, of_episode = float(delta.mean()), delta.mean(axis=0)
    rng = np.random.default_rng(seed)
    means = np.array([of_episode[rng.integers(episodes, size=episodes)].mean() for _ in range(resamples)])
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    spread = 0.0
    if runs > 1:
        spread = float(stats.t.ppf((1 + level) / 2, runs - 1) * delta.mean(axis=1).std(ddof=1) / np.sqrt(runs))
    unseen = 1.0 - ((1.0 - level) / 2.0) ** (1.0 / episodes) if share else 0.0  # the most likely that what was never seen may be
    below, above = max(value - low, unseen * (value + 1.0)), max(high - value, unseen * (1.0 - value))
    return Interval(value, value - float(np.hypot(below, spread)), value + float(np.hypot(above, spread)))


def paired_ratio(a: Array, b: Array, level: float = 0.95, resamples: int = 4000, seed: int = 0) -> Interval:
    """Mean of a over mean of b (episodes,), on the same episodes, with a bootstrap interval over them; b has a mean above 0."""
    rng, episodes = np.random.default_rng(seed), len(a)
    drawn = rng.integers(episodes, size=(resamples, episodes))
    low, high = np.quantile(a[drawn].mean(axis=1) / b[drawn].mean(axis=1), [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(a.mean() / b.mean()), float(low), float(high))


def holm(p: Sequence[float]) -> list[float]:
    """p-values adjusted for all of them together (Holm 1979): reject those below the level that one of them would be held to."""
    order = sorted(range(len(p)), key=lambda i: p[i])
    out, so_far = [0.0] * len(p), 0.0
    for rank, i in enumerate(order):
        so_far = max(so_far, min(1.0, (len(p) - rank) * p[i]))
        out[i] = so_far
    return out
