"""Several agents in the fused engine: their wires that may be attacked (`tailgate.fused.wires`), as arrays and as the loop's nouns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tailgate.agents.codec import Mode
from tailgate.agents.scripted import NoAttack
from tailgate.core import Array, Command
from tailgate.loop import Loop

from . import constants as of
from . import rows as at
from . import script, seat, wires
from .constants import Table
from .lanes import Lanes
from .memory import OBEY
from .rows import LANES

WIRE_ROWS = 4  # of a wire, in the window and in s


def listed(loop: Loop, f: Array, table: Table, places: Callable[[Array, Array], Sequence[Array]]) -> None:
    """The constants of each wire into the table; `places` of agents and wires: SENT, ARRIVED, VALID, ACTS."""
    plan, (i, w) = loop.plan.channel, np.nonzero(loop.plan.channel.granted)
    victims, mine = np.flatnonzero(plan.granted.any(axis=1)), np.flatnonzero(plan.granted.any(axis=0))
    place = 1 + np.searchsorted(victims, i) * len(mine) + np.searchsorted(mine, w)
    element, first = i * plan.granted.shape[1] + w, np.diff(i, prepend=-1) != 0
    parts = [plan.bounds[w], plan.low[w], plan.high[w], place, element, i, *places(i, w), first]
    f[of.IN_WIRES] = table.add(np.stack(parts, axis=1).astype(np.float64))


def modes(loop: Loop, table: Array, f: Array, known: Sequence[Mode]) -> Array:
    """The table with the discrete actions behind it: kind, sign, and each wire's target and value."""
    i, w = np.nonzero(loop.plan.channel.granted)
    f[of.IN_MODES] = len(table)
    parts = [((mode.kind, mode.sign), mode.target[i, w], mode.value[w]) for mode in known]
    return np.concatenate([table, *(np.asarray(part, np.float64) for mode in parts for part in mode)])


def numbers(loop: Any, attack: Any, plan: Any) -> Array | None:
    """A script as (PLACES + 2 wires,) numbers, None where it has no lane: what aims at wires that are not granted has none."""
    granted = loop.plan.channel.granted
    if not script.known(attack):
        return None
    target = getattr(plan, "target", np.zeros(granted.shape, bool))
    if (target & ~granted).any() or (type(attack) is not NoAttack and not target.any()):
        return None
    sign = script.signs(attack, plan) if target.any() else np.ones(granted.shape)
    return np.concatenate([script.law(attack, plan), target[granted], sign[granted]])


def shown(loop: Loop, f: Array) -> dict[str, tuple[int, int]]:
    """The two rows of each component of an observation that says what may be done, what was sent last, and to whom."""
    granted, zero = loop.plan.channel.granted, int(at.ZERO)
    out = {name: (int(seat.QUANTITIES[name][0]), zero) for name in ("progress", "allowed", "budget_left", "burst", "cooldown", "attacking")}
    for place, (i, w) in enumerate(np.argwhere(granted).tolist()):
        out[f"last_{loop.model.wires[w]}[{i}]"] = int(f[of.AIMS]) + place * wires.AIM + int(wires.SHOWN), zero
    for place, i in enumerate(np.flatnonzero(granted.any(axis=1)).tolist()):
        out[f"attacked[{i}]"] = int(f[of.AIMS]) + int(f[of.WIRED]) * wires.AIM + place * LANES, zero
    return out


def recorded(f: Array) -> dict[str, Array]:
    """The rows of what a step leaves of every wire; below 0: -1 - row of one that stands in the window."""
    each = np.arange(f[of.WIRED]) * wires.WIRE
    hunted, aims = int(f[of.HUNTED]), int(f[of.AIMS])
    return {
        "clean": aims + int(wires.CLEAN) + each, "target": -1 - hunted - int(wires.TARGET) - each,
        "value": -1 - hunted - int(wires.VALUE) - each,
    }  # fmt: skip


def spread(loop: Any, held: dict[str, Array], arrived: Array) -> dict[str, Array]:
    """`recorded` (K, B, wires) as signals, beside what arrived (K, B, N, links): all other wires carry what is sent."""
    granted = loop.plan.channel.granted
    links, out = granted[:, : arrived.shape[-1]], {"clean": np.array(arrived)}
    out["clean"][:, :, links] = held["clean"][..., np.nonzero(granted)[1] < arrived.shape[-1]]
    for name, kind in (("target", bool), ("value", np.float64)):
        out[name] = np.zeros((*arrived.shape[:2], *granted.shape), kind)
        out[name][:, :, granted] = held[name]
    return out


class Several(Lanes):
    """B episodes of several agents."""

    numbers = staticmethod(numbers)

    @staticmethod
    def groups(f: Array) -> dict[str, Array]:
        """The rows of every signal that is recorded of a step; below 0: -1 - row of one that stands in the window."""
        raise NotImplementedError

    @classmethod
    def columns(cls, f: Array) -> Array:
        """The rows that are recorded of every step."""
        return np.concatenate(list(cls.groups(f).values())).astype(np.int64)

    def recorded(self, steps: int) -> dict[str, Array]:
        """Every group (K, B, rows), of so many steps."""
        held, first = {}, 0
        for name, part in self.groups(self.constants.f).items():
            held[name] = np.moveaxis(self.record[:steps, first : first + len(part)], 1, 2)
            first += len(part)
        return held

    def signals(self, steps: int) -> dict[str, Array]:
        """Those of a Trace, of so many steps."""
        raise NotImplementedError

    def window(self, first: int, count: int, apart: int = LANES) -> Array:
        """(B, count) rows of the window, so far apart."""
        held = [self.memory.window[:, first + j * apart : first + j * apart + LANES].reshape(-1) for j in range(count)]
        return np.stack(held, axis=1)[: self.batch]

    def advance(self, command: Command, t: int = 0) -> None:
        asked, granted = self.memory.asked, self.loop.plan.channel.granted
        count = int(self.constants.f[of.WIRED])
        asked[0], asked[1] = command.kind, np.count_nonzero(command.target & ~granted, axis=(1, 2))
        asked[2 : 2 + count], asked[2 + count :] = command.target[:, granted].T, command.value[:, granted].T
        self.run(OBEY, 1, first_step=t)

    def last(self) -> Command:
        granted, f = self.loop.plan.channel.granted, self.constants.f
        target, value = (np.zeros((self.batch, *granted.shape)) for _ in range(2))
        for out, row in ((target, wires.TARGET), (value, wires.VALUE)):
            if f[of.WIRED]:
                out[:, granted] = self.window(int(f[of.HUNTED]) + int(row), int(f[of.WIRED]), wires.WIRE)
        return Command(self.row(at.KIND).astype(np.int8), target != 0.0, value)
