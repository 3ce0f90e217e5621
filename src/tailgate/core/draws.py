"""Random numbers by counter: every draw is a pure function of (key, episode, step, stream, element).

key = 64 bits of BLAKE2b(purpose, party, seed); counter = (episode, block, step, stream). A stream belongs to a ROLE, so
swapping the defence or the attack leaves every other draw identical, and comparisons are paired. The three
parties have unrelated keys: the draws of a defence or an attack say nothing about the sensor noise.

The upper bits of an episode counter hold the purpose, for manoeuvres that keep recordings apart by it. No draw depends on these bits.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.engine import elementary
from tailgate.engine.array import Traced
from tailgate.engine.compiled import Code

Array = NDArray[Any]

Pair = Callable[..., tuple[Array, Array]]  # a function of key, episode, step, stream and block that gives two numbers
PURPOSES = ("train", "tune", "calibrate", "select", "report")
_PARTIES = ("world", "attack", "defence")
_SHIFT = 29  # of the purpose in an episode counter: an environment plays fewer episodes in a row
_COUNT = (1 << _SHIFT) - 1  # the other bits


class Role(IntEnum):
    """The streams, in one table. A number is never reused for another role."""

    PRIOR = 0
    PROCESS = 1
    SENSOR = 2
    MANOEUVRE = 3
    TRAFFIC = 4
    V2V = 5
    LINK = 6
    ATTACK = 16
    POLICY = 17
    DEFENCE = 32


def _party(role: Role) -> int:
    return 0 if role < 16 else 1 if role < 32 else 2


class Keys(NamedTuple):
    """The keys of the draws: party keys (B, 3) uint64 and the episode counter (B,) uint32 of each row."""

    key: Array
    episode: Array

    def at(self, role: Role, step: Array) -> "Draws":
        """Return the draws of one role at each row's own step (B,). Only those of the world know the purpose."""
        episode = counted(self.episode) if _party(role) else self.episode
        return Draws(self.key[:, _party(role)], episode, step.astype(np.uint32), int(role))


def counted(episode: Array) -> Array:
    """Return the numbers of episodes (B,) from their counters, without the purpose."""
    out: Array = episode & np.uint32(_COUNT)
    return out


def purpose_of(draws: "Draws") -> Array:
    """Return the index in PURPOSES (B,) int64 of draws of the world."""
    out: Array = draws.episode.astype(np.int64) >> np.int64(_SHIFT)
    return out


def keys(purpose: str, seeds: Sequence[int]) -> Keys:
    """Return keys of B rows, one seed each, at episode 0. `purpose` keeps training and report seeds apart."""
    if purpose not in PURPOSES:
        raise InputError("purpose", purpose, f"one of {', '.join(PURPOSES)}")
    out = np.empty((3, len(seeds)), np.uint64)
    for p, party in enumerate(_PARTIES):
        for i, seed in enumerate(seeds):
            digest = hashlib.blake2b(f"{purpose}/{party}/{int(seed)}".encode(), digest_size=8).digest()
            out[p, i] = int.from_bytes(digest, "little")
    return Keys(out.T, first_episodes(purpose, len(seeds)))


def first_episodes(purpose: str, batch: int) -> Array:
    """Return the counters (B,) uint32 of first episodes of a purpose."""
    return np.full(batch, PURPOSES.index(purpose) << _SHIFT, np.uint32)


@cache
def _code(pair: Pair) -> Code:
    return Code(pair, np.uint64, 5)


class Draws(NamedTuple):
    """One role's random numbers at one step. A second independent draw in the same step needs another `tag`."""

    key: Array
    episode: Array
    step: Array
    stream: int

    def _numbers(self, pair: Pair, shape: tuple[int, ...], tag: int) -> Array:
        """Return numbers (B, *shape) of a function that gives two for each block."""
        size, batch = math.prod(shape), len(self.key)
        blocks, stream = (size + 1) // 2, np.uint64(self.stream << 16 | tag)
        if isinstance(self.key, Traced):
            counters = self.key, counted(self.episode).astype(np.uint64), self.step.astype(np.uint64), stream
            out = [number for block in range(blocks) for number in pair(*counters, np.uint64(block))][:size]
            held = np.stack(out, axis=-1) if out else np.zeros((batch, 0))
            return cast(Array, held.reshape(batch, *shape))
        given = np.empty((5, blocks, batch), np.uint64)
        given[0], given[1], given[2], given[3], given[4] = self.key, counted(self.episode), self.step, stream, np.arange(blocks)[:, None]
        held = _code(pair)(given.reshape(5, -1)) if given.size else np.empty((2, 0))
        both = held.reshape(2, blocks, batch).swapaxes(0, 1).reshape(2 * blocks, batch)
        return num.last_to_first(both[:size].reshape(*shape, batch))

    def normal(self, shape: tuple[int, ...] = (), tag: int = 0) -> Array:
        """Return standard normals (B, *shape)."""
        return self._numbers(elementary.normal_pair, shape, tag)

    def uniform(self, shape: tuple[int, ...] = (), tag: int = 0) -> Array:
        """Return uniforms on (0, 1), ends excluded, (B, *shape)."""
        return self._numbers(elementary.uniform_pair, shape, tag)


def constants(name: str, seed: int) -> Draws:
    """Return draws for the random constants of a component, such as a random matrix: one row, the same for every episode."""
    digest = hashlib.blake2b(f"constants/{name}/{int(seed)}".encode(), digest_size=8).digest()
    return Draws(np.array([int.from_bytes(digest, "little")], np.uint64), np.zeros(1, np.uint32), np.zeros(1, np.uint32), 0)
