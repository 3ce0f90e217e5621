"""The attacker's seat of a network as a lane: what differs from `tailgate.fused.seat`, which pays for the agent that errs most."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tailgate.core import Array

from . import constants as of
from . import network, seat, wires
from .compiled import phase
from .rows import LANES, ZERO

if TYPE_CHECKING:
    from tailgate.loop import Loop

SHARED = ("progress", "allowed", "budget_left", "burst", "cooldown", "attacking")
_pay = seat.paying(many=True)


def quantities(f: Array, loop: Loop) -> dict[str, tuple[int, int]]:
    """The two rows of each component of the observation that has a lane."""
    granted, zero = loop.plan.channel.granted, int(ZERO)
    out = {name: (int(row), int(other)) for name, (row, other) in seat.QUANTITIES.items() if name in SHARED}
    for at, (i, w) in enumerate(np.argwhere(granted).tolist()):
        out[f"last_{loop.model.wires[w]}[{i}]"] = int(f[of.AIMS]) + at * wires.AIM + int(wires.SHOWN), zero
    behind = int(f[of.AIMS]) + int(f[of.WIRED]) * wires.AIM
    for h, i in enumerate(np.flatnonzero(granted.any(axis=1)).tolist()):
        out[f"attacked[{i}]"] = behind + h * LANES, zero
    return out


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
