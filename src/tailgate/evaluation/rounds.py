"""Rounds: all defences of a board play the same episodes, with seeds that nobody could know at submission.

Participants submit the digests of their defences; then a beacon becomes public; the seeds of all episodes follow from it.
Later submissions wait for the next beacon, with which the whole board is played again.
Seeds without a beacon are 0, 1, 2, ...: public, and meant for development.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from tailgate.base.errors import InputError
from tailgate.core.draws import PURPOSES

SEED_BITS = 53  # whole numbers that every JSON reader keeps
SHORTEST = 16  # characters of a beacon


def seeds_of(beacon: str, suite: str, purpose: str, count: int) -> list[int]:
    """Return the seeds of the first `count` episodes of a suite in the round of a beacon, by keyed BLAKE2b.

    Seeds are distinct and below 2^53. The key is the hash of the beacon; the message is suite, purpose and number.
    Anyone who knows the beacon can compute them.
    """
    if purpose not in PURPOSES:
        raise InputError("purpose", purpose, f"one of {', '.join(PURPOSES)}")
    if len(beacon) < SHORTEST:
        raise InputError("beacon", beacon, f"at least {SHORTEST} characters that nobody could know when the submissions were made")
    key = hashlib.blake2b(beacon.encode(), digest_size=32).digest()
    seeds: dict[int, None] = {}
    number = 0
    while len(seeds) < count:
        digest = hashlib.blake2b(f"{suite}/{purpose}/{number}".encode(), key=key, digest_size=8).digest()
        seeds[int.from_bytes(digest, "little") >> (64 - SEED_BITS)] = None
        number += 1
    return list(seeds)


def numbered(beacon: str, suite: str, purpose: str, first: int, count: int) -> Sequence[int]:
    """Return the seeds of episodes first, first + 1, ...: those of a round, or the numbers themselves without a beacon."""
    return seeds_of(beacon, suite, purpose, first + count)[first:] if beacon else range(first, first + count)
