"""Ghosts of every size: readings of a second state, which grow in over some time. They are searched where nobody drives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.white_box.ghost import GhostState, grown, within
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Command, Kind, View
from tailgate.core.draws import Draws
from tailgate.core.kinds import EFFECTS
from tailgate.core.threat import Brief
from tailgate.ensemble.battery import opens
from tailgate.ensemble.points import Memory, Point, Points, at_rest, shares_of, vector_of

MODES = 4  # directions that are tried
SMALLEST, SLOWEST = 0.01, 0.5  # of the bound: the smallest size; of the horizon: the longest growth
AT_ONCE = 0.2  # how often a ghost does not grow


class Numbers(NamedTuple):
    """The numbers of B attacks."""

    table: Array  # (MODES, K, N, w) values of size 1, the same for all
    size: Array  # (B,)
    grow: Array  # (B,) [s]; 0: at once
    mode: Array  # (B,) int64
    last: Array  # (B,) int64: steps before the bounds end it
    trigger: Array  # (B,) int64: place in TRIGGERS
    threshold: Array  # (B,) of the trigger
    start: Array  # (B,) int64: first step

    def take(self, places: Array) -> Numbers:
        """Return the attacks at these places."""
        return Numbers(self.table, *(leaf[places] for leaf in self[1:]))

    @property
    def decider(self) -> Many:
        """The attack that plays them, another one in each row."""
        return Many(self.table)

    def remembered(self) -> Memory:
        """Return the memory of the attacks at the start of their episodes."""
        return at_rest(Rows(*self[1:]), len(self.size), self.table.shape[2])


class Rows(NamedTuple):
    """The numbers of B attacks without the table."""

    size: Array
    grow: Array
    mode: Array
    last: Array
    trigger: Array
    threshold: Array
    start: Array


@dataclass(frozen=True, eq=False)
class Many:
    """An attack that plays another `ghost` in each row, to the last digits."""

    table: Array  # (MODES, K, N, w)

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands."""
        one, count, steps = memory.numbers, memory.elapsed, self.table.shape[1]
        opened = memory.opened | opens(plan, view, one, memory.lead_speed)
        on = opened & view.allowed & (count < one.last)
        share = grown(count, plan.model.dt, one.grow)
        flat = self.table.reshape(-1, *self.table.shape[2:])
        raw = num.take(flat, one.mode * steps + np.minimum(count, steps - 1)) * (one.size * share)[:, None, None]
        target = on[:, None, None] & (np.arange(plan.granted.shape[1]) < len(plan.model.sensors)) & plan.granted
        kind = np.where(on, int(Kind.FDI), 0).astype(np.int8)
        command = Command(kind, target, np.where(target, EFFECTS[Kind.FDI].clip(plan.limits, raw), 0.0))
        return Memory(one, opened, count + opened, np.array(view.scene.lead_speed)), command


class Choice(NamedTuple):
    """The choices of an attack that have no neighbours."""

    mode: int
    grows: bool
    agent: int | None = None  # all that are granted
    wires: int = 0  # all that are granted
    trigger: int = 0  # place in `Space.triggers`

    @property
    def kinds(self) -> frozenset[Kind]:
        """The kinds that it may send."""
        return frozenset((Kind.FDI,))

    @property
    def sort(self) -> tuple[object, ...]:
        """The choices that set attacks apart."""
        return self.mode, self.grows


@dataclass(frozen=True)
class Ghosts(Points):
    """Ghosts that a threat model grants. A point has `when`, size and growth."""

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """False data where it is granted on sensors and nobody drives; empty: there are none."""
        return (Kind.FDI,) if not self.space.road and self.table.size else ()

    @cached_property
    def table(self) -> Array:
        """The readings (MODES, K, N, w) of ghosts of size 1; empty where the threat model grants none."""
        try:
            return np.array([GhostState(size=1.0, mode=mode).readings(self.brief)[1] for mode in range(MODES)])
        except NotApplicable:
            return np.zeros(0)

    def drawn(self, rng: np.random.Generator) -> Point:
        """Return an attack at random."""
        choice = Choice(int(rng.integers(MODES)), bool(rng.random() >= AT_ONCE), trigger=int(rng.integers(len(self.space.triggers))))
        return Point(choice, vector_of(rng.random(3)))

    def numbers(self, points: list[Point]) -> Numbers:
        """Return the numbers of attacks."""
        return Numbers(self.table, *(np.array(part) for part in zip(*map(self._row, points), strict=True)))

    def _row(self, point: Point) -> Rows:
        """Return the numbers of one attack, without their first axis."""
        choice, brief = point.choice, self.brief
        when, size, grow = shares_of(point.vector)
        most = self.space.reach(Kind.FDI)[1]
        size = float(f"{most * SMALLEST ** (1.0 - size):.4g}")
        grow = float(f"{SLOWEST * brief.horizon * brief.model.dt * grow:.4g}") if choice.grows else 0.0
        share, unit = grown(np.arange(brief.horizon), brief.model.dt, grow), self.table[choice.mode]
        size = min(size, float(f"{0.999 / np.max(np.abs(share[0] * unit[0]) / brief.bounds):.3g}"))  # else it ends before it begins
        last = within(brief, size * share[:, None, None] * unit)
        mode, length = (np.array(number, np.int64) for number in (choice.mode, last))
        return Rows(np.array(size), np.array(grow), mode, length, *self.opening(choice, when))

    def text(self, point: Point) -> str:
        """Return the text of one attack, as on the command line."""
        row = self._row(point)
        parts = [f"size={row.size}", f"grow={row.grow}", f"mode={row.mode}", *self.words(point.choice, shares_of(point.vector)[0])]
        return f"ghost:{','.join(parts)}"
