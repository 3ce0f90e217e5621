"""How many runs, and what their outcomes say: exact intervals, tests that stop by themselves, and their true error rates.

Published figures use a number of runs that is fixed beforehand. The rules that stop early are for exploring. An interval that is looked at
after every run until it is narrow misses more often than it says (`Sequential.coverage`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.evaluation.stats import limits, proportion

MOST = 1_000_000  # runs of a rule that stops by itself
interval = proportion


def _share(field: str, value: float) -> float:
    if not 0.0 < value < 1.0:
        raise InputError(field, value, "a number above 0 and below 1")
    return value


def lower(k: int, n: int, alpha: float) -> float:
    """Return the one-sided Clopper-Pearson limit of k in n: the true probability lies below it with a chance of at most alpha."""
    return float(limits(np.array([k]), np.array([n]), alpha)[0][0])


def okamoto(half: float, delta: float) -> int:
    """Return runs after which a share is within `half` of the probability with a chance of 1 - delta, whatever it is (Okamoto 1958)."""
    return math.ceil(math.log(2.0 / _share("delta", delta)) / (2.0 * _share("half", half) ** 2))


def _reach(n: int, level: float) -> float:
    """Return the farthest that an end of the Clopper-Pearson interval lies from its share, of all that n runs may give."""
    k = np.arange(n + 1)
    low, high = limits(k, np.full(n + 1, n), (1.0 - level) / 2.0)
    return float(max(np.max(k / n - low), np.max(high - k / n)))


def runs_for(half: float, level: float) -> int:
    """Return the least number of runs with which every Clopper-Pearson interval lies within `half` of its share, whatever comes out."""
    _share("precision", half), _share("confidence", level)
    if okamoto(half, 1.0 - level) > MOST:
        raise InputError("precision", half, f"one that {MOST} runs can give")
    low, high = 0, 1
    while _reach(high, level) > half:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _reach(middle, level) > half else (low, middle)
    return high


class Verdict(NamedTuple):
    """The answer of a rule, and after how many runs."""

    runs: int
    holds: bool | None  # of a test: the hypothesis that it settled on


class Rule(Protocol):
    """When to stop."""

    def stop(self, outcomes: Array) -> Verdict | None:
        """Return the verdict on outcomes (n,) bool in their order; None: go on."""


@dataclass(frozen=True)
class Sequential:
    """Stops at the first run after which the two-sided Clopper-Pearson interval is no wider than `width`."""

    width: float = 0.1
    level: float = 0.95

    def __post_init__(self) -> None:
        _share("width", self.width), _share("level", self.level)
        if self.width < 0.05:
            raise InputError("width", self.width, "at least 0.05: for less, a fixed number of runs")

    def _narrow(self, k: Array, n: int) -> Array:
        low, high = limits(k, np.full(len(k), n), (1.0 - self.level) / 2.0)
        return np.asarray(high - low <= self.width)

    def stop(self, outcomes: Array) -> Verdict | None:
        k = np.cumsum(outcomes)[: len(self._stops) - 1]
        narrow = np.flatnonzero(self._stops[np.arange(1, len(k) + 1), k])
        return Verdict(int(narrow[0]) + 1, None) if len(narrow) else None

    @cached_property
    def _stops(self) -> Array:
        """[n, k]: whether it stops after k successes in n runs, for all that it can come to."""
        most = self.ends[-1][0]
        out = np.zeros((most + 1, most + 1), bool)
        for n, k, _ in self.ends:
            out[n, k] = True
        return out

    @cached_property
    def ends(self) -> list[tuple[int, int, int]]:
        """(n, k, ways) of every pair that the rule may stop at: `ways` sequences of outcomes lead there."""
        going, out = {0: 1}, []
        n = 0
        while going:
            n += 1
            ways: dict[int, int] = {}
            for k, count in going.items():
                for after in (k, k + 1):
                    ways[after] = ways.get(after, 0) + count
            at = np.array(sorted(ways))
            stops = self._narrow(at, n)
            out += [(n, int(k), ways[int(k)]) for k in at[stops]]
            going = {int(k): ways[int(k)] for k in at[~stops]}
        return out

    def coverage(self, p: Array) -> Array:
        """Return chance that the interval at which the rule stops holds p, for each of p: exact, by dynamic programming over (n, k)."""
        p = np.atleast_1d(np.asarray(p, np.float64))
        n, k, low, high, logs = self._table
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = logs + np.where(k > 0, k * np.log(p[:, None]), 0.0) + np.where(n > k, (n - k) * np.log1p(-p[:, None]), 0.0)
        inside = (p[:, None] >= low) & (p[:, None] <= high)
        return np.asarray(np.where(inside, np.exp(terms), 0.0).sum(axis=1))

    @cached_property
    def _table(self) -> tuple[Array, Array, Array, Array, Array]:
        """n, k, interval and the logarithm of the number of ways of each end."""
        n, k = (np.array([end[i] for end in self.ends]) for i in (0, 1))
        low, high = limits(k, n, (1.0 - self.level) / 2.0)
        return n, k, low, high, np.array([math.log(end[2]) for end in self.ends])

    def worst_coverage(self) -> tuple[float, float]:
        """Return (coverage, p) where it is least: just inside or outside of the ends of intervals, at which alone it jumps, and between."""
        _, _, low, high, _ = self._table
        edges = np.unique(np.concatenate([low, high]))
        edges = np.concatenate([edges - 1e-12, edges, edges + 1e-12, 0.5 * (edges[1:] + edges[:-1])])
        p = edges[(edges > 0.0) & (edges < 1.0)]
        found = self.coverage(p)
        return float(found.min()), float(p[np.argmin(found)])


class Rates(NamedTuple):
    """Error rates of a test at one true probability."""

    accepts: float  # chance that it says p >= high
    rejects: float  # chance that it says p <= low
    runs: float  # mean number of runs


@dataclass(frozen=True)
class Sprt:
    """Wald's sequential test of p >= high against p <= low, with limits 1 / alpha and beta for the likelihood ratio.

    The answer is p <= low though p >= high with a chance of at most alpha, and the other way round with at most beta. With these limits
    both hold exactly (Ville's inequality); Wald's own (1 - beta) / alpha and beta / (1 - alpha) hold only nearly. Between low and high
    either answer is right.
    """

    low: float = 0.85
    high: float = 0.9
    alpha: float = 0.05
    beta: float = 0.05

    def __post_init__(self) -> None:
        for name in ("low", "high", "alpha", "beta"):
            _share(name, getattr(self, name))
        if self.low >= self.high:
            raise InputError("low, high", [self.low, self.high], "two probabilities, low < high")

    @property
    def _steps(self) -> tuple[float, float]:
        """The terms that a success and a failure add to log L(low) / L(high)."""
        return math.log(self.low / self.high), math.log((1.0 - self.low) / (1.0 - self.high))

    def _ratio(self, k: Array, n: Array | int) -> Array:
        success, failure = self._steps
        return np.asarray(k * success + (n - k) * failure)

    def stop(self, outcomes: Array) -> Verdict | None:
        k = np.cumsum(outcomes)
        ratio = self._ratio(k, np.arange(1, len(k) + 1))
        out = np.flatnonzero((ratio >= -math.log(self.alpha)) | (ratio <= math.log(self.beta)))
        return Verdict(int(out[0]) + 1, bool(ratio[out[0]] < 0.0)) if len(out) else None

    def rates(self, p: float, left: float = 1e-12) -> Rates:
        """Return exact chances and mean length at a true probability, by dynamic programming until no more than `left` is undecided."""
        going, first = np.ones(1), 0  # chance of each number of successes from `first` on, undecided so far
        accepts = rejects = runs = 0.0
        n = 0
        while (mass := float(going.sum())) > left and n < MOST:
            runs += mass
            n += 1
            after = np.zeros(len(going) + 1)
            after[:-1] += going * (1.0 - p)
            after[1:] += going * p
            ratio = self._ratio(first + np.arange(len(after)), n)
            low, high = ratio >= -math.log(self.alpha), ratio <= math.log(self.beta)
            rejects, accepts = rejects + float(after[low].sum()), accepts + float(after[high].sum())
            kept = np.flatnonzero(~(low | high))
            if not len(kept):
                break
            going, first = after[kept[0] : kept[-1] + 1], first + int(kept[0])
        return Rates(accepts, rejects, runs)
