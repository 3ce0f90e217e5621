"""The attacker's seat of a platoon as a lane: what differs from `tailgate.fused.seat`, which pays for the worst car."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tailgate.core import Array

from . import constants as of
from . import platoon_road as road
from . import seat, several, wires
from .compiled import phase
from .platoon_filter import WORK
from .platoon_rows import AHEAD, COMMAND, GAP, SENT, SHOWN_A, SHOWN_U, SHOWN_V, SHOWN_Y, A, V
from .rows import LANES, LEAD_X, ZERO

if TYPE_CHECKING:
    from tailgate.loop import Loop

_1 = np.uint64(LANES)
pay = seat.paying(many=True)

# What an observation shows of a car, as `seat.QUANTITIES`: the difference of two rows of its record in `s`; none of the second: 0.
OF_CAR = {
    "gap": (GAP, None), "speed": (SHOWN_V, None), "closing": (SHOWN_V, AHEAD), "accel": (SHOWN_A, None), "control0": (SHOWN_U, None),
    "noise_distance": (SHOWN_Y, GAP), "noise_velocity": (SHOWN_Y + _1, SHOWN_V),
}  # fmt: skip


def quantities(columns: list[str], f: Array, loop: Loop) -> dict[str, tuple[int, int]]:
    """The two rows of each component of the observation that has a lane."""
    zero = int(ZERO)
    out = several.shown(loop, f) | {"least_gap": (int(LEAD_X), zero)}
    for name in columns:
        what, _, tag = name.partition("[")
        car = int(tag[:-1]) if tag else -1
        work = int(f[of.WORKS]) + car * WORK
        if tag and what in OF_CAR:
            row, other = OF_CAR[what]
            out[name] = work + int(row), zero if other is None else work + int(other)
    return out


def scales(loop: Loop) -> dict[str, float]:
    """What is about 1 of those that have no scale of a single car's."""
    R, names = loop.model.R, loop.model.sensors
    return {"least_gap": 50.0} | {f"noise_{name}[{i}]": math.sqrt(R[i, j, j]) for i in range(len(R)) for j, name in enumerate(names)}


@phase
def look(s, window, c, f, table, paid, flags, count, mask, first, n):
    """What the information of a step shows of the state that it led to, and what the observation needs of it."""
    road.look_ahead(s, window, f, n)
    seat.look(s, window, c, f, table, paid, flags, count, mask, first, n)
    for j in range(f[of.CARS]):
        car, work = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            work[SHOWN_V + i], work[SHOWN_A + i], work[SHOWN_U + i] = car[V + i], car[A + i], car[COMMAND + i]
            work[SHOWN_Y + i], work[SHOWN_Y + _1 + i] = car[SENT + i], car[SENT + _1 + i]
        if f[of.THERE] != 0:  # a reading that is lost is off by nothing
            there = window[j * f[of.CAR] + f[of.THERE] :]
            for i in range(n):
                work[SHOWN_Y + i] = work[SHOWN_Y + i] if there[i] != 0.0 else work[GAP + i]
                work[SHOWN_Y + _1 + i] = work[SHOWN_Y + _1 + i] if there[_1 + i] != 0.0 else car[V + i]
    wires.look(s, window, f, table, n)
