"""Adaptive multilevel splitting: the probability that a process reaches what it rarely does.

Particles are paths of random keys, one key a step. Those that came least far are replaced by copies of others. A copy goes on
with fresh keys from the step on at which it was farther. The estimate is unbiased for any number of particles and any measure of how far a
path has come (Brehier, Gazeau, Goudenege, Lelievre and Rousset 2016). Several independent runs give an interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import ndtri, stdtrit

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.trust.statistics import interval

SHARE = 0.25  # of the particles that are replaced at a level, at least
FLOOR = 1e-15  # a run that falls below this has not arrived
Tell = Callable[[int, float, float], None]  # level, probability so far, distance that is left


class Play(Protocol):
    """A process with all its chance in its keys: an episode of K steps in each row."""

    def __call__(self, keys: Array) -> Array:
        """Return margins (K, B) of keys (K, B, 3) uint64: a path arrives at the first one below 0. Step k depends on keys[: k + 1]."""


class Run(NamedTuple):
    """One run of splitting."""

    probability: float
    levels: int
    episodes: int  # that were played, of K steps each
    keys: Array  # (K, M, 3) of the paths that arrived
    margins: Array  # (M,) their least margins
    first: int = 0  # how many of the first particles arrived


class Chance(NamedTuple):
    """A probability with its interval, from several runs."""

    probability: float
    low: float
    high: float
    runs: tuple[float, ...]
    episodes: int


def split(play: Play, steps: int, particles: int, rng: np.random.Generator, tell: Tell | None = None) -> Run:
    """Estimate the probability that a margin falls below 0 within these steps.

    Parameters
    ----------
    play
        The process.
    steps
        K.
    particles
        Paths at a time; the relative variance is about -log(p) / particles.
    rng
        Chance of the keys, and of the copies.
    tell
        Called after each level.

    Returns
    -------
    Run
        Its probability is 0 where no path arrived.
    """
    keys = _fresh(rng, steps, particles)
    margins = play(keys)
    reached, probability, levels, episodes = -margins.min(axis=0), 1.0, 0, particles
    first = int(np.count_nonzero(reached > 0.0))
    while True:
        level = float(np.sort(reached)[max(int(SHARE * particles), 1) - 1])
        if level >= 0.0:
            break
        lost = reached <= level
        left = np.flatnonzero(~lost)
        probability *= len(left) / particles
        levels += 1
        if tell is not None:
            tell(levels, probability, -level)
        if probability < FLOOR:
            return Run(0.0, levels, episodes, keys[:, :0], reached[:0], first)
        rows, parents = np.flatnonzero(lost), left[rng.integers(0, len(left), int(lost.sum()))]
        since = np.argmax(-margins[:, parents] > level, axis=0)  # the first step that was farther
        young = _fresh(rng, steps, len(rows))
        keys[:, rows] = np.where((np.arange(steps)[:, None] <= since)[:, :, None], keys[:, parents], young)
        margins[:, rows] = play(keys[:, rows])
        reached[rows] = -margins[:, rows].min(axis=0)
        episodes += len(rows)
    there = reached > 0.0
    return Run(probability * float(there.mean()), levels, episodes, keys[:, there], -reached[there], first)


def _fresh(rng: np.random.Generator, steps: int, count: int) -> Array:
    """Return keys (K, count, 3): each path keeps one key to its end."""
    held = rng.integers(0, 2**64, (count, 3), np.uint64)
    return np.repeat(held[None], steps, axis=0)


def check(particles: int, runs: int, confidence: float, seed: int) -> None:
    """Check the numbers of an estimate.

    Raises
    ------
    InputError
        For fewer than 8 particles or 3 runs, a confidence outside (0, 1), a seed below 0.
    """
    for name, value, least in (("--particles", particles, 8), ("--runs", runs, 3)):
        if sizes.check(name[2:], value, name) < least:
            raise InputError(name, value, f"at least {least}")
    if not 0.0 < confidence < 1.0:
        raise InputError("--confidence", confidence, "a number above 0 and below 1")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError("--seed", seed, "a whole number, not below 0")


def chance_of(runs: list[Run], particles: int, confidence: float = 0.95) -> Chance:
    """Return the mean of independent runs, with a two-sided interval.

    The estimates of runs are nearly log-normal, so the interval is Cox's for the mean of a log-normal, with Student's quantile (Olsson
    2005). If a run did not arrive, they are too few and too skewed for that. If one needed no level, they are shares of plain episodes, and
    near 1 far from log-normal. Then the interval is the exact one of plain episodes, which the first particles of all runs are.
    """
    values = np.array([run.probability for run in runs])
    mean, count = float(values.mean()), len(values)
    quantile = float(stdtrit(count - 1, 0.5 + 0.5 * confidence))
    if not values.all() or any(run.levels == 0 for run in runs):
        _, low, high = interval(sum(run.first for run in runs), particles * count, confidence)
    else:
        logs = np.log(values)
        variance = float(logs.var(ddof=1))
        middle = float(logs.mean()) + 0.5 * variance
        half = quantile * math.sqrt(variance / count + variance**2 / (2.0 * (count - 1)))
        low, high = math.exp(middle - half), min(math.exp(middle + half), 1.0)
    return Chance(mean, min(low, mean), max(high, mean), tuple(values.tolist()), sum(run.episodes for run in runs))


def plain_episodes(chance: Chance, confidence: float = 0.95) -> float:
    """Return how many plain episodes would give an interval as narrow as this one; infinite where there is none."""
    half = 0.5 * (chance.high - chance.low)
    if not 0.0 < chance.probability < 1.0 or half <= 0.0:
        return math.inf
    quantile = float(ndtri(0.5 + 0.5 * confidence))
    return chance.probability * (1.0 - chance.probability) * (quantile / half) ** 2
