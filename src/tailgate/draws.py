"""Random numbers by counter: every draw is a pure function of (key, episode, step, stream, element).

key = 64 bits of BLAKE2b(purpose, party, seed); counter = (episode, block, step, stream). A stream belongs to a ROLE, so
swapping the defence or the attack leaves every other draw identical, and comparisons are paired. The three
parties have unrelated keys: what a defence or an attack holds tells nothing of the sensor noise.
"""

import hashlib
import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tailgate import kernels, num
from tailgate.engine import elementary
from tailgate.engine.array import Traced
from tailgate.errors import InputError

Array = NDArray[Any]

PURPOSES = ("train", "tune", "calibrate", "select", "report")
_PARTIES = ("world", "attack", "defence")


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
    """Who draws: party keys (B, 3) uint64 and the episode counter (B,) uint32 of each row."""

    key: Array
    episode: Array

    def at(self, role: Role, step: Array) -> "Draws":
        """The draws of one role at each row's own step (B,)."""
        return Draws(self.key[:, _party(role)], self.episode, step.astype(np.uint32), int(role))


def keys(purpose: str, seeds: Sequence[int]) -> Keys:
    """Keys of B rows, one seed each, at episode 0. `purpose` keeps training and report seeds apart."""
    if purpose not in PURPOSES:
        raise InputError("purpose", purpose, f"one of {', '.join(PURPOSES)}")
    out = np.empty((3, len(seeds)), np.uint64)
    for p, party in enumerate(_PARTIES):
        for i, seed in enumerate(seeds):
            digest = hashlib.blake2b(f"{purpose}/{party}/{int(seed)}".encode(), digest_size=8).digest()
            out[p, i] = int.from_bytes(digest, "little")
    return Keys(out.T, np.zeros(len(seeds), np.uint32))


class Draws(NamedTuple):
    """One role's random numbers at one step. A second independent draw in the same step needs another `tag`."""

    key: Array
    episode: Array
    step: Array
    stream: int

    def _fill(self, fill: Any, shape: tuple[int, ...], tag: int) -> Array:
        size = math.prod(shape)
        if isinstance(self.key, Traced):
            return self._traced(fill is kernels.fill_normal, size, tag).reshape(len(self.key), *shape)
        out = np.empty((size, len(self.key)))
        fill(np.ascontiguousarray(self.key), self.episode, self.step, self.stream << 16 | tag, out)
        return num.last_to_first(out.reshape(*shape, len(self.key)))

    def _traced(self, normal: bool, size: int, tag: int) -> Any:
        pair = elementary.normal_pair if normal else elementary.uniform_pair
        counters = (self.key, self.episode.astype(np.uint64), self.step.astype(np.uint64), np.uint64(self.stream << 16 | tag))
        out = [number for block in range((size + 1) // 2) for number in pair(*counters, np.uint64(block))][:size]
        return np.stack(out, axis=-1) if out else np.zeros((len(self.key), 0))

    def normal(self, shape: tuple[int, ...] = (), tag: int = 0) -> Array:
        """Standard normals (B, *shape)."""
        return self._fill(kernels.fill_normal, shape, tag)

    def uniform(self, shape: tuple[int, ...] = (), tag: int = 0) -> Array:
        """Uniforms on (0, 1), ends excluded, (B, *shape)."""
        return self._fill(kernels.fill_uniform, shape, tag)


def constants(name: str, seed: int) -> Draws:
    """Draws for the random constants of a component, such as the matrices of a random system: one row, the same for every episode."""
    digest = hashlib.blake2b(f"constants/{name}/{int(seed)}".encode(), digest_size=8).digest()
    return Draws(np.array([int.from_bytes(digest, "little")], np.uint64), np.zeros(1, np.uint32), np.zeros(1, np.uint32), 0)
