"""Values that follow the road: for each wire the weights of `feedback`, with every trigger, bursts and a later kind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tailgate.agents.scripts.feedback import FEATURES, STEEPEST, UNIT, fed_back, road, sent
from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Command, Kind, View
from tailgate.core.draws import Draws
from tailgate.core.kinds import EFFECTS
from tailgate.core.threat import Brief
from tailgate.ensemble.battery import opens
from tailgate.ensemble.points import Memory, Point, Points, at_rest, shares_of, vector_of
from tailgate.ensemble.space import LONG, NEVER

KINDS = Kind.FDI, Kind.DOS_JAM, Kind.DOS_HOLD, Kind.DROPOUT, Kind.NOISE_JAM, Kind.ECHO_DELAY  # a fresh hold is left to scripts
SPARING = 0.3  # how often single steps of constants leave out a wire
SIZES = np.array([2.0, 0.5, 0.5, 0.5, 0.5])  # of weights that are drawn: of a constant value more than of one that follows
TIMES = 4  # numbers of a point behind its weights: trigger, burst, pause, switch
CHANGES, REPEATS, PULSES = 0.4, 0.5, 0.5  # how often a later kind, bursts, and single steps of constants are drawn


class Numbers(NamedTuple):
    """The numbers of B attacks."""

    weights: Array  # (B, N, w, FEATURES)
    target: Array  # (B, N, w) bool
    kind: Array  # (B,) int64 of `Kind`
    later: Array  # (B,) int64: kind after `switch` steps of the window
    switch: Array  # (B,) int64
    trigger: Array  # (B,) int64: place in TRIGGERS
    threshold: Array  # (B,) of the trigger
    start: Array  # (B,) int64: first step
    burst: Array  # (B,) int64: steps of a burst
    pause: Array  # (B,) int64: steps between two bursts

    def take(self, places: Array) -> Numbers:
        """Return the attacks at these places."""
        return map_leaves(lambda leaf: leaf[places], self)

    @property
    def decider(self) -> Many:
        """The attack that plays them, another one in each row."""
        return Many()

    def remembered(self) -> Memory:
        """Return the memory of the attacks at the start of their episodes."""
        return at_rest(self, *self.target.shape[:2])


@dataclass(frozen=True)
class Many:
    """An attack that plays another `feedback` in each row."""

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands: what `feedback` sends under the same numbers."""
        one, count = memory.numbers, memory.elapsed
        opened = memory.opened | opens(plan, view, one, memory.lead_speed)
        on = opened & view.allowed & (count % (one.burst + one.pause) < one.burst)
        raw = fed_back(one.weights, road(view, count, plan.model.dt))
        kind, value = np.where(count < one.switch, one.kind, one.later), np.zeros(raw.shape)
        for valued in KINDS:
            if EFFECTS[valued].valued and valued.name.lower() in plan.threat.kinds:
                value = np.where((kind == valued)[:, None, None], sent(plan, valued, raw), value)
        target = on[:, None, None] & one.target
        hit = target.any(axis=(1, 2))
        command = Command(np.where(hit, kind, 0).astype(np.int8), target, np.where(target, value, 0.0))
        return Memory(one, opened, count + opened, np.array(view.scene.lead_speed)), command


class Choice(NamedTuple):
    """The choices of an attack that have no neighbours."""

    kind: Kind
    later: Kind
    wires: int  # place in `Space.wires`
    agent: int | None  # None: all that are granted
    trigger: int  # place in `Space.triggers`
    bursts: bool

    @property
    def kinds(self) -> frozenset[Kind]:
        """The kinds that it may send."""
        return frozenset((self.kind, self.later))

    @property
    def sort(self) -> tuple[object, ...]:
        """The choices that set attacks apart."""
        return self.kind, self.bursts


@dataclass(frozen=True)
class Feedbacks(Points):
    """Attacks of `feedback` that a threat model grants in a scenario. A point has the weights (w * FEATURES,) and TIMES."""

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of the attacks; empty: there are none."""
        return self.granted(KINDS)

    def drawn(self, rng: np.random.Generator) -> Point:
        """Return an attack at random."""
        space = self.space
        kind, later = (self.kinds[int(rng.integers(len(self.kinds)))] for _ in range(2))
        later = later if rng.random() < CHANGES else kind
        choice = Choice(kind, later, *self.aim(rng), bool(rng.random() < REPEATS and space.budget > 1))
        weights, shares = rng.standard_normal((len(self.wires), FEATURES)) * SIZES, rng.uniform(0.0, 1.0, TIMES)
        if rng.random() < PULSES and space.budget > 1:  # another constant on each wire, in single steps
            valued = [one for one in self.kinds if EFFECTS[one].valued]
            kind = valued[int(rng.integers(len(valued)))]
            choice = choice._replace(kind=kind, later=kind, wires=choice.wires if rng.random() < SPARING else 0, bursts=True)
            most = min(np.arcsinh(space.reach(kind)[1] / UNIT), STEEPEST)
            weights = rng.uniform(-most, most, len(weights))[:, None] * np.eye(FEATURES)[0]
            shares[1:3] = 0.0, np.log(rng.integers(1, LONG + 1)) / np.log(LONG)
        return Point(choice, np.concatenate([weights.ravel(), vector_of(shares)]))

    def numbers(self, points: list[Point]) -> Numbers:
        """Return the numbers of attacks."""
        rows = [self._row(point) for point in points]
        return Numbers(*(np.array(part) for part in zip(*rows, strict=True)))

    def _row(self, point: Point) -> Numbers:
        """Return the numbers of one attack, without their first axis."""
        choice, budget = point.choice, max(self.space.budget, 1)
        when, burst, pause, switch = shares_of(point.vector[-TIMES:])
        weights, target = np.round(point.vector[:-TIMES].reshape(len(self.wires), FEATURES), 3), self.target(choice)
        trigger, threshold, start = self.opening(choice, when)
        steps = (
            choice.kind, choice.later, max(1, int(budget * switch)) if choice.later != choice.kind else NEVER, start,
            max(1, round((budget / 2.0) ** burst)) if choice.bursts else NEVER, max(1, round(LONG**pause)) if choice.bursts else 0,
        )  # fmt: skip
        kind, later, change, first, length, rest = (np.array(number, np.int64) for number in steps)
        everywhere = np.broadcast_to(weights, (*target.shape, FEATURES))
        return Numbers(everywhere, target, kind, later, change, trigger, threshold, first, length, rest)

    def text(self, point: Point) -> str:
        """Return the text of one attack, as on the command line."""
        one, choice = self._row(point), point.choice  # without a first axis
        parts = [f"kind={choice.kind.name.lower()}"]
        if choice.later != choice.kind:
            parts += [f"later={choice.later.name.lower()}", f"switch={one.switch}"]
        parts += self.words(choice, shares_of(point.vector[-TIMES:])[0])
        if choice.bursts:
            parts.append(f"burst={one.burst},pause={one.pause}")
        if any(EFFECTS[kind].valued for kind in choice.kinds):
            for name, held, on in zip(self.wires, one.weights[0].tolist(), np.asarray(one.target.any(axis=0)), strict=True):
                if on:
                    parts.append(f"weights.{name}=[{','.join(map(str, held))}]")
        return f"feedback:{','.join(parts)}"
