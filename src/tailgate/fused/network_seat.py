"""The attacker's seat of a network as a lane: what differs from `tailgate.fused.seat`, which pays for the agent that errs most."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tailgate.core import Array
from tailgate.kernels import _log

from . import constants as of
from . import network, seat, several, wires
from .compiled import phase
from .rows import LANES, ZERO

if TYPE_CHECKING:
    from tailgate.loop import Loop

_pay = seat.paying(many=True)


def quantities(loop: Loop, f: Array) -> dict[str, tuple[int, int]]:
    """The two rows of each component of the observation that has a lane."""
    sized = range(f[of.CARS] if f[of.SIZES] else 0)
    return several.shown(loop, f) | {f"reading[{i}]": (int(f[of.SIZES]) + i * LANES, int(ZERO)) for i in sized}


@phase
def pay(s, c, f, n):
    """After a step of a decision: its reward, what happened, and how large the largest error is."""
    _pay(s, c, f, n)
    network.damage(s, n)


@phase
def look(s, window, c, f, table, paid, flags, count, mask, first, n):
    """What the information of a step shows of the state that it led to, and what the observation needs of it."""
    network.still(s, n)
    seat.look(s, window, c, f, table, paid, flags, count, mask, first, n)
    wires.look(s, window, f, table, n)
    for j in range(f[of.CARS] if f[of.SIZES] != 0 else 0):
        at = f[of.SIZES] + j * LANES
        _size(window, f[of.SENTS] + j * f[of.SENSED] * LANES, f[of.SENSED], c[of.SPREAD], s[at : at + LANES], n)


@phase
def _size(window, sent, q, spread, size, n):
    """Of the readings of an agent, log(1 + |y| / spread)."""
    for i in range(n):
        size[i] = 0.0
    for at in range(sent, sent + q * LANES, LANES):
        y = window[at : at + LANES]
        for i in range(n):
            size[i] += y[i] * y[i]
    for i in range(n):
        size[i] = 1.0 + np.sqrt(size[i]) / spread
    for i in range(n):
        size[i] = _log(size[i])
