"""Python's collector of cyclic garbage, switched off where many objects are made that stay."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterator

_off: list[bool] = []  # for each open block, if the collector was on before


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Switch the collector off within the block: it walks all objects again and again, and took a third of the time of a trace."""
    was = gc.isenabled()
    gc.disable()
    _off.append(was)
    try:
        yield
    finally:
        _off.pop()
        if was:
            gc.enable()


def _in_a_child() -> None:
    """Switch it on again in a process that was forked while another thread was in the block."""
    if any(_off):
        gc.enable()
    _off.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_a_child)
