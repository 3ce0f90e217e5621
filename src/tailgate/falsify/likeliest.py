"""The likeliest failure: the most probable noise that breaks a property (the aim of adaptive stress testing, Lee et al. 2015).

The normal draws of every step get a mean. The cross-entropy method moves it until a share of the samples fails; each sample counts by its
likelihood ratio (Rubinstein and Kroese 2004). Then the mean is noise by itself, with no other noise. It is brought to the least size that
fails, along the gradient of the margin (Hasofer and Lind 1974, Rackwitz and Fiessler 1978). Each step searches a line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import ndtr

from tailgate.core import Array

ELITE = 0.1  # share of the samples that the next mean is made of
STARTS = 3  # of the whole search: failures at other times are other minima
ROUNDS = 12  # of cross-entropy, at most
COARSE = 10  # parts of the time over which its mean is constant: more would be noise
POLISHED = 12  # steps along the gradient, at most
NUDGE = 0.05  # of a difference, in standard deviations
NUDGED = 256  # differences side by side; changes no result
SCALES = np.arange(4, 13) / 8  # of a mean, for the least one that fails
FINER = np.arange(1, 17) / 16  # between the least scale that fails and the one below
LINE = np.arange(9) / 8  # between a mean and the next
LITTLE = 1e-3  # relative gain that ends the polishing
Tell = Callable[[int, int, float], None]  # round, at most, distance that is left


class Noisy(Protocol):
    """A process with normal noise of d numbers in each of K steps."""

    def __call__(self, mean: Array, keys: Array, size: float) -> tuple[Array, Array]:
        """Return least margins (B,) and noise (B, K, d) = mean (B, K, d) + size x standard normals of keys (B, 3) uint64.

        A path fails if its least margin is below 0. With size 0 the noise is the mean, and any other chance is at its median.
        """


class Likeliest(NamedTuple):
    """The likeliest failure that was found."""

    failed: bool  # the mean alone fails
    mean: Array  # (K, d) of the noise, in its standard deviations
    distance: float  # its Euclidean norm
    log_likelihood: float  # of this noise over that of no noise: -distance^2 / 2
    first_order: float  # Phi(-distance): the probability if the failures filled a half-space
    episodes: int


def likeliest(
    play: Noisy, steps: int, width: int, samples: int, blocks: int, rng: np.random.Generator, tell: Tell | None = None
) -> Likeliest:
    """Search the likeliest failure.

    Parameters
    ----------
    play
        The process.
    steps, width
        K and d.
    samples
        Paths in a round.
    blocks
        The noise is constant over this many parts of the time.
    rng
        Chance of the keys.
    """
    update, found, failed, episodes = tell or (lambda *_: None), list[Array](), list[bool](), 0
    for number in range(STARTS):
        mean, count = _moved(play, steps, width, samples, rng, lambda done, of, left, at=number: update(at * of + done, STARTS * of, left))  # type: ignore[misc]
        best, more = _polished(play, mean, min(blocks, steps))
        found.append(mean if best is None else best)
        failed.append(best is not None)
        episodes += count + more
    at = min(range(STARTS), key=lambda i: (not failed[i], float(np.linalg.norm(found[i]))))
    distance = float(np.linalg.norm(found[at]))
    return Likeliest(failed[at], found[at], distance, -0.5 * distance**2, float(ndtr(-distance)), episodes)


def _polished(play: Noisy, mean: Array, blocks: int) -> tuple[Array | None, int]:
    """Return the smallest noise (K, d) that fails, from a mean on, if any does, and the episodes that it took."""
    best, episodes = _least(play, mean[None], 2.0 * SCALES)
    here = mean if best is None else best
    for _ in range(POLISHED):
        onward, count = _next(play, here, blocks)
        tried, more = _least(play, here + LINE[:, None, None] * (onward - here), SCALES)
        episodes += count + more
        if best is not None and (tried is None or np.linalg.norm(tried) > (1.0 - LITTLE) * np.linalg.norm(best)):
            break
        best, here = tried, onward if tried is None else tried
    return best, episodes


def _parts(steps: int, blocks: int) -> Array:
    """Return the part (K,) of the time that each step belongs to."""
    return np.asarray(np.minimum(np.arange(steps) * blocks // steps, blocks - 1))


def _moved(play: Noisy, steps: int, width: int, samples: int, rng: np.random.Generator, tell: Tell) -> tuple[Array, int]:
    """Return the mean (K, d) to which cross-entropy leads, and the episodes that it took."""
    blocks = min(COARSE, steps)
    block = _parts(steps, blocks)
    length, mean = np.bincount(block, minlength=blocks)[:, None], np.zeros((blocks, width))
    for number in range(ROUNDS):
        keys = rng.integers(0, 2**64, (samples, 3), np.uint64)
        margin, noise = play(np.broadcast_to(mean[block], (samples, steps, width)), keys, 1.0)
        sums = np.stack([noise[:, block == i].sum(axis=1) for i in range(blocks)], axis=1)
        ratio = 0.5 * float(np.sum(length * mean**2)) - np.sum(sums * mean, axis=(1, 2))
        level = max(float(np.quantile(margin, ELITE, method="higher")), 0.0)
        tell(number + 1, ROUNDS, level)
        elite = margin <= level if level > 0.0 else margin < 0.0
        if not elite.any():  # no margin is finite
            return mean[block], (number + 1) * samples
        weight = elite * np.exp(ratio - ratio[elite].max())
        mean = np.einsum("b,bkd->kd", weight / weight.sum(), sums) / length
        if level == 0.0:
            break
    return mean[block], (number + 1) * samples


def _alone(play: Noisy, means: Array) -> Array:
    """Return the margins (B,) of means (B, K, d) without other noise."""
    return play(means, np.zeros((len(means), 3), np.uint64), 0.0)[0]


def _least(play: Noisy, means: Array, scales: Array) -> tuple[Array | None, int]:
    """Return the smallest noise (K, d) that fails among means (M, K, d) times scales, if any does, and the episodes that it took."""

    def tried(some: Array, by: Array) -> tuple[Array, float]:
        """Return the smallest that fails among `some` (M, K, d) times scales, and its scale; 0 if none does."""
        margin = _alone(play, (by[:, None, None, None] * some).reshape(-1, *some.shape[1:])).reshape(len(by), -1)
        size = np.where(margin.T < 0.0, np.linalg.norm(some, axis=(1, 2))[:, None] * by, np.inf)
        row, at = np.unravel_index(int(np.argmin(size)), size.shape)
        return some[row], float(by[at]) if np.isfinite(size[row, at]) else 0.0

    if not means.any():
        return None, 0
    coarse, scale = tried(means, scales)
    if not scale:
        return None, scales.size * len(means)
    gap = scales[1] - scales[0]
    fine, finer = tried(coarse[None], scale - gap + gap * FINER)
    return (finer or scale) * fine, scales.size * len(means) + FINER.size


def _next(play: Noisy, mean: Array, blocks: int) -> tuple[Array, int]:
    """Return the nearest noise (K, d) that fails if the margin is linear about this one, and the episodes that it took."""
    steps, width = mean.shape
    block = _parts(steps, blocks)
    here, count = float(_alone(play, mean[None])[0]), blocks * width
    margin = []
    for first in range(0, count, NUDGED):
        numbers = np.arange(first, min(first + NUDGED, count))
        part, channel = np.divmod(numbers, width)
        tried = np.repeat(mean[None], len(numbers), axis=0)
        tried[np.arange(len(numbers)), :, channel] += NUDGE * (block == part[:, None])
        margin.append(_alone(play, tried))
    if not np.isfinite(here):
        return mean, count + 1
    slope = np.nan_to_num((np.concatenate(margin) - here) / NUDGE, posinf=0.0, neginf=0.0).reshape(blocks, width)
    slope = slope[block] / np.bincount(block, minlength=blocks)[block][:, None]  # of one step's noise
    steep = float(np.sum(slope**2))
    return (mean if steep == 0.0 else (float(np.sum(slope * mean)) - here) / steep * slope), count + 1
