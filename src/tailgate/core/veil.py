"""The secret by which a defence in another process cannot tell episodes of a search from those that count."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar

_veil: ContextVar[bytes] = ContextVar("veil", default=b"")


def secret() -> bytes:
    """Return the secret of this search or training; empty outside of one."""
    return _veil.get()


@contextlib.contextmanager
def veiled() -> Iterator[None]:
    """Hide from isolated defences, within the block, which episode is played and that an attack is searched or trained.

    Training seeds are small numbers, and episodes are counted.
    A class that recognised them could be weak in training and strong where it is scored.
    The keys of its draws are therefore hashed with a secret, which is new each time. Rows of one episode keep one key, as where they count:
    their readings are alike as well.
    """
    token = _veil.set(os.urandom(32))
    try:
        yield
    finally:
        _veil.reset(token)
