"""The attacker's seat of a platoon as a lane: what differs from `tailgate.fused.seat`, which pays for the worst car."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tailgate.core import Array
from tailgate.elementwise import clip
from tailgate.envs.cacc import V2V

from . import constants as of
from . import platoon_channel as channel
from . import platoon_road as road
from . import seat
from .compiled import phase
from .platoon_filter import AIM, WORK
from .platoon_rows import (
    AHEAD,
    ATTACKED,
    COMMAND,
    GAP,
    SENT,
    SHOWN,
    SHOWN_A,
    SHOWN_U,
    SHOWN_V,
    SHOWN_Y,
    TARGET,
    VALUE,
    WANT_TARGET,
    WANT_VALUE,
    WIRES,
    A,
    V,
)
from .rows import KIND, LANES, LEAD_X, ON, WANT_KIND, ZERO
from .rows import WANT_TARGET as STRAY

if TYPE_CHECKING:
    from tailgate.loop import Loop

_1 = np.uint64(LANES)
pay = seat.paying(many=True)

# What an observation shows of a car, as `seat.QUANTITIES`: the difference of two rows of its record in `s`; none of the second: 0.
OF_CAR = {
    "gap": (GAP, None), "speed": (SHOWN_V, None), "closing": (SHOWN_V, AHEAD), "accel": (SHOWN_A, None), "control0": (SHOWN_U, None),
    "noise_distance": (SHOWN_Y, GAP), "noise_velocity": (SHOWN_Y + _1, SHOWN_V),
}  # fmt: skip
OF_VICTIM = {"attacked": ATTACKED} | {f"last_{name}": SHOWN + np.uint64(w * LANES) for w, name in enumerate((
    "distance", "velocity", "acceleration", *V2V, "command",
))}  # fmt: skip
SHARED = ("progress", "allowed", "budget_left", "burst", "cooldown", "attacking")


def quantities(columns: list[str], f: Array, loop: Loop) -> dict[str, tuple[int, int]]:
    """The two rows of each component of the observation that has a lane."""
    victims, zero = np.flatnonzero(loop.plan.channel.granted.any(axis=1)).tolist(), int(ZERO)
    out = {name: (int(row), int(other)) for name, (row, other) in seat.QUANTITIES.items() if name in SHARED}
    out["least_gap"] = int(LEAD_X), zero
    for name in columns:
        what, _, tag = name.partition("[")
        car = int(tag[:-1]) if tag else -1
        work = int(f[of.WORKS]) + car * WORK
        if tag and what in OF_CAR:
            row, other = OF_CAR[what]
            out[name] = work + int(row), zero if other is None else work + int(other)
        elif car in victims and what in OF_VICTIM:
            out[name] = int(f[of.AIMS]) + victims.index(car) * AIM + int(OF_VICTIM[what]), zero
    return out


def scales(loop: Loop) -> dict[str, float]:
    """What is about 1 of those that have no scale of a single car's."""
    R, names = loop.model.R, loop.model.sensors
    return {"least_gap": 50.0} | {f"noise_{name}[{i}]": math.sqrt(R[i, j, j]) for i in range(len(R)) for j, name in enumerate(names)}


@phase
def decode(s, window, c, f, table, action, first, n):
    """Actions (B, ACTIONS), of this block from `first` on, into the rows WANT_*. -> whether there is any command."""
    kind, some = f[of.ACTION], 0
    for i in range(n):
        s[WANT_KIND + i] = s[STRAY + i] = 0.0
        some += 1 if action[first + i, 0] > 0.0 else 0  # the trigger, or the number of the action: 0 is none
    if some == 0:
        return False
    for i in range(n):
        if kind == of.DISCRETE or kind == of.RAMPING:
            s[WANT_KIND + i] = table[f[of.IN_MODES] + np.int64(action[first + i, 0]) * (2 + 2 * WIRES * f[of.VICTIMS])]
        else:
            s[ON + i] = clip(action[first + i, 0], -1.0, 1.0) > 0.0
            s[WANT_KIND + i] = seat.FDI if s[ON + i] != 0.0 else 0.0
    for h in range(f[of.VICTIMS]):
        victim = window[f[of.HUNTED] + h * channel.VICTIM : f[of.HUNTED] + (h + 1) * channel.VICTIM]
        aim, granted = s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM], table[f[of.IN_WIRES] + h * channel.PER_VICTIM :]
        if kind == of.DISCRETE or kind == of.RAMPING:
            _choose(s, victim, aim, granted, c, f, table, action, h, first, n)
        else:
            _fill(s, victim, aim, granted, c, f, action, first, n)
    return True


@phase
def _choose(s, victim, aim, granted, c, f, table, action, h, first, n):
    """What a discrete action asks of a victim."""
    ramping, rate, wide = f[of.ACTION] == of.RAMPING, c[of.RATE], 2 + 2 * WIRES * f[of.VICTIMS]
    for i in range(n):
        row = f[of.IN_MODES] + np.int64(action[first + i, 0]) * wide
        ramps, sign = ramping & (table[row] == seat.FDI) & (s[KIND + i] == seat.FDI), table[row + 1]
        for w in range(WIRES):
            at, bound = np.uint64(w * LANES) + i, granted[channel.BOUND + w]
            aimed, value = table[row + 2 + 2 * WIRES * h + w], table[row + 2 + 2 * WIRES * h + WIRES + w]
            value = clip(victim[VALUE + at] + rate * sign, -bound, bound) if ramps else value
            aim[WANT_TARGET + at] = aimed
            aim[WANT_VALUE + at] = value if aimed != 0.0 else 0.0


@phase
def _fill(s, victim, aim, granted, c, f, action, first, n):
    """What a vector of values asks of a victim."""
    rate, grows = c[of.RATE], f[of.ACTION] == of.INCREMENT
    for w in range(WIRES):
        down, bound, mine = np.uint64(w * LANES), granted[channel.BOUND + w], granted[channel.GRANTED + w] != 0.0
        place = np.int64(granted[channel.PLACE + w]) if mine else 0
        for i in range(n):
            share = clip(action[first + i, place], -1.0, 1.0)
            before = victim[VALUE + down + i] if s[KIND + i] == seat.FDI else 0.0
            value = clip(before + rate * share, -bound, bound) if grows else bound * share
            on = mine & (s[ON + i] != 0.0)
            aim[WANT_TARGET + down + i] = on
            aim[WANT_VALUE + down + i] = value if on else 0.0


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
    for h in range(f[of.VICTIMS]):
        victim = window[f[of.HUNTED] + h * channel.VICTIM : f[of.HUNTED] + (h + 1) * channel.VICTIM]
        aim = s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM]
        for i in range(n):
            aim[ATTACKED + i] = 0.0
        for w in range(WIRES):
            row = np.uint64(w * LANES)
            for i in range(n):
                aim[SHOWN + row + i] = victim[VALUE + row + i]
                aim[ATTACKED + i] = max(aim[ATTACKED + i], victim[TARGET + row + i])
