"""Confidence intervals: proportions by Clopper-Pearson, mean times by Poisson, medians by ranks, differences by a seeded bootstrap."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tailgate.core import Array

AT_ONCE = 1 << 14  # numbers that a bootstrap draws at once


class Interval(NamedTuple):
    """A point estimate and its interval."""

    value: float
    low: float
    high: float


def proportion(successes: int, n: int, level: float = 0.95) -> Interval:
    """Return the share of successes with the exact (Clopper-Pearson) interval."""
    from scipy.optimize import brentq

    cdf, sf = _binomial()
    tail = (1.0 - level) / 2.0
    low = brentq(lambda p: sf(successes - 1, n, p) - tail, 0.0, 1.0) if successes > 0 else 0.0
    high = brentq(lambda p: cdf(successes, n, p) - tail, 0.0, 1.0) if successes < n else 1.0
    return Interval(successes / n, low, high)


def _binomial() -> tuple[Callable[..., Array], Callable[..., Array]]:
    """Return the distribution function of the binomial distribution and its complement, functions of k, n and p.

    Both are scipy's own, of which published limits have every bit. Its package of statistics takes longer to import than all of this one.
    """
    try:
        from scipy.special._ufuncs import _binom_cdf, _binom_sf
    except ImportError:  # the names are private
        from scipy.stats import binom

        return binom.cdf, binom.sf
    return _binom_cdf, _binom_sf


def limits(successes: Array, n: Array, alpha: float) -> tuple[Array, Array]:
    """One-sided Clopper-Pearson limits of shares, lower and upper, each missed with a chance of at most alpha."""
    from scipy import special

    low = np.where(successes > 0, special.betaincinv(np.maximum(successes, 1), n - successes + 1, alpha), 0.0)
    high = np.where(successes < n, special.betainccinv(successes + 1, np.maximum(n - successes, 1), alpha), 1.0)
    return low, high


def at_least(k: ArrayLike, n: ArrayLike, p: float = 0.5) -> Array:
    """Return the probability of k or more successes in n trials, each with probability p."""
    return np.where(np.less_equal(k, 0), 1.0, _binomial()[1](np.maximum(k, 1) - 1, n, p))


def mean_time(events: int, time: float, dispersion: float = 1.0, level: float = 0.95) -> tuple[float, float | None]:
    """Return limits of the mean time between `events` in a span of time: a Poisson interval, exact for independent events.

    Clustered events carry less information than their number suggests.
    A `dispersion` above 1 (variance over mean of their number per run) therefore divides their number and the time.
    The upper limit is None without any event.
    """
    from scipy import special

    clusters = max(dispersion, 1.0)
    if events:  # at least one cluster
        clusters = min(clusters, float(events))
    n, time, tail = events / clusters, time / clusters, (1.0 - level) / 2.0
    low = time / float(special.gammaincinv(n + 1.0, 1.0 - tail))
    return low, time / float(special.gammaincinv(n, tail)) if n else None


def median_limits(values: Array, level: float = 0.95) -> tuple[float, float] | None:
    """Return the exact interval of the median of the distribution of values (n,): two of them, by the binomial distribution of ranks.

    It covers the median with probability `level` or more for any distribution; None if there are too few values.
    References: scipy's `quantile_test`; Conover, Practical Nonparametric Statistics, 1999, section 3.2.
    """
    from scipy import stats

    ends = stats.quantile_test(values, q=0.0, p=0.5).confidence_interval(confidence_level=level)
    return None if np.isnan(ends.low) or np.isnan(ends.high) else (float(ends.low), float(ends.high))


def paired_difference(a: Array, b: Array, level: float = 0.95, resamples: int = 4000, seed: int = 0, share: bool = False) -> Interval:
    """Return the mean of a - b on the same episodes, with an interval.

    a and b are (episodes,), or (training seeds, episodes). A bootstrap over episodes gives their part; `seed` makes it repeatable.
    Student's t over the means gives the part of the training seeds, because a bootstrap of three to five runs is too narrow.
    The parts add in squares. With one training seed the interval describes that policy only.

    `share` says that a and b are 0 or 1. The interval then allows for differences of -1 and 1 that happened not to occur.
    Without this, equal differences would give a bootstrap without width.
    """
    from scipy import special

    delta = np.atleast_2d(np.asarray(a, np.float64) - np.asarray(b, np.float64))
    runs, episodes = delta.shape
    value, of_episode = float(delta.mean()), delta.mean(axis=0)
    rng = np.random.default_rng(seed)
    few = max(1, AT_ONCE // episodes)
    sizes = (min(few, resamples - at) for at in range(0, resamples, few))
    means = np.concatenate([of_episode[rng.integers(episodes, size=(size, episodes))].mean(axis=1) for size in sizes])
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    spread = 0.0
    if runs > 1:
        spread = float(special.stdtrit(runs - 1, (1 + level) / 2) * delta.mean(axis=1).std(ddof=1) / np.sqrt(runs))
    unseen = 1.0 - ((1.0 - level) / 2.0) ** (1.0 / episodes) if share else 0.0  # the largest probability of an event that never occurred
    below, above = max(value - low, unseen * (value + 1.0)), max(high - value, unseen * (1.0 - value))
    return around(value, np.hypot(below, spread), np.hypot(above, spread), share)


def around(value: float, below: float, above: float, share: bool) -> Interval:
    """Return a difference with what lies below and above it; that of two shares is between -1 and 1."""
    most = 1.0 if share else np.inf
    return Interval(value, max(value - float(below), -most), min(value + float(above), most))


def paired_ratio(a: Array, b: Array, level: float = 0.95, resamples: int = 4000, seed: int = 0) -> Interval:
    """Return the ratio of means of a and b (episodes,), with a bootstrap interval over the episodes; b has a mean above 0."""
    rng, episodes = np.random.default_rng(seed), len(a)
    drawn = rng.integers(episodes, size=(resamples, episodes))
    low, high = np.quantile(a[drawn].mean(axis=1) / b[drawn].mean(axis=1), [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(a.mean() / b.mean()), float(low), float(high))


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values adjusted for multiple tests (Holm 1979); compare each with the level of a single test."""
    order = sorted(range(len(p)), key=lambda i: p[i])
    out, so_far = [0.0] * len(p), 0.0
    for rank, i in enumerate(order):
        so_far = max(so_far, min(1.0, (len(p) - rank) * p[i]))
        out[i] = so_far
    return out
