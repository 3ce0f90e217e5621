"""Lies in segments: for each wire a value and a growth in each of them, with every trigger."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tailgate.agents.scripts.feedback import STEEPEST, UNIT, sent
from tailgate.agents.scripts.segments import Lies, lie
from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Command, Kind, View
from tailgate.core.draws import Draws
from tailgate.core.threat import Brief
from tailgate.ensemble.battery import opens
from tailgate.ensemble.points import Memory, Point, Points, at_rest, shares_of, vector_of
from tailgate.ensemble.space import LONG

KINDS = Kind.FDI, Kind.DOS_JAM, Kind.NOISE_JAM, Kind.ECHO_DELAY
MOST = 3  # segments
GROWTH = 0.1 * UNIT  # of a rate near 0 [unit of the wire per step]
SMALL = 1.0  # the least bound of an attack's numbers: values of 0.12
GROWING, SINGLE, WAITS = 0.6, 0.35, 0.4  # how often growth, single steps with pauses, and a wait between lies are drawn


class Numbers(NamedTuple):
    """The numbers of B attacks."""

    lies: Lies  # (B, MOST), and (B, MOST, w)
    target: Array  # (B, N, w) bool
    kind: Array  # (B,) int64 of `Kind`
    trigger: Array  # (B,) int64: place in TRIGGERS
    threshold: Array  # (B,) of the trigger
    start: Array  # (B,) int64: first step

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
    """An attack that plays other `segments` in each row."""

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands: what `segments` sends under the same numbers."""
        one, count = memory.numbers, memory.elapsed
        opened = memory.opened | opens(plan, view, one, memory.lead_speed)
        false, raw = lie(count, one.lies)
        value, wide = np.zeros(one.target.shape), raw[:, None, :] + np.zeros(one.target.shape)
        for kind in KINDS:
            if kind.name.lower() in plan.threat.kinds:
                value = np.where((one.kind == kind)[:, None, None], sent(plan, kind, wide), value)
        target = (opened & view.allowed & false)[:, None, None] & one.target
        hit = target.any(axis=(1, 2))
        command = Command(np.where(hit, one.kind, 0).astype(np.int8), target, np.where(target, value, 0.0))
        return Memory(one, opened, count + opened, np.array(view.scene.lead_speed)), command


class Choice(NamedTuple):
    """The choices of an attack that have no neighbours."""

    kind: Kind
    wires: int  # place in `Space.wires`
    agent: int | None  # None: all that are granted
    trigger: int  # place in `Space.triggers`
    single: tuple[bool, ...]  # for each segment: single steps with pauses between them

    @property
    def kinds(self) -> frozenset[Kind]:
        """The kinds that it may send."""
        return frozenset((self.kind,))

    @property
    def sort(self) -> tuple[object, ...]:
        """The choices that set attacks apart."""
        return self.kind, self.single


@dataclass(frozen=True)
class Lines(Points):
    """Attacks of `segments` that a threat model grants. A point has `when`, then MOST rests, steps and pauses, then values and rates."""

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of the attacks; empty: there are none."""
        return self.granted(KINDS) if self.space.budget > 1 else ()

    def drawn(self, rng: np.random.Generator) -> Point:
        """Return an attack at random."""
        kind = self.kinds[int(rng.integers(len(self.kinds)))]
        single = tuple((rng.random(int(rng.integers(1, MOST + 1))) < SINGLE).tolist())
        choice = Choice(kind, *self.aim(rng), single)
        largest = min(np.arcsinh(self.space.reach(kind)[1] / UNIT), STEEPEST)
        most = rng.uniform(min(SMALL, largest), largest)  # small values and large ones seldom do harm together
        values = rng.uniform(-most, most, (MOST, len(self.wires)))
        rates = rng.standard_normal(values.shape) * (rng.random(values.shape) < GROWING)
        shares = rng.random(1 + 3 * MOST)
        shares[1 + MOST : 1 + 2 * MOST] **= 0.5  # long segments rather than short ones
        if len(single) > 1 and rng.random() < WAITS:  # a small lie, a wait of any length, and a large lie
            values[0] = rng.uniform(-SMALL, SMALL, len(self.wires)) * 2.0
            values[1] = np.sign(values[1]) * rng.uniform(most / 2.0, most, len(self.wires))
            shares[2] = np.log(rng.integers(1, LONG + 1)) / np.log(LONG)
        return Point(choice, np.concatenate([vector_of(shares), values.ravel(), rates.ravel()]))

    def numbers(self, points: list[Point]) -> Numbers:
        """Return the numbers of attacks."""
        rows = [self._row(point) for point in points]
        lies = Lies(*(np.array(part) for part in zip(*(row.lies for row in rows), strict=True)))
        return Numbers(lies, *(np.array(part) for part in zip(*(row[1:] for row in rows), strict=True)))

    def _row(self, point: Point) -> Numbers:
        """Return the numbers of one attack, without their first axis."""
        choice, timed = point.choice, 1 + 3 * MOST
        when, *shares = shares_of(point.vector[:timed])
        rests, steps, pauses = np.zeros((3, MOST), np.int64)
        for j, single in enumerate(choice.single):
            rest, length, pause = shares[j::MOST]
            rests[j] = round(LONG**rest) - 1 if j else 0
            steps[j] = max(1, round(self.space.budget**length))
            pauses[j] = round(LONG**pause) if single else 0
        numbers = point.vector[timed:].reshape(2, MOST, len(self.wires))
        values = _digits(UNIT * np.sinh(np.clip(numbers[0], -STEEPEST, STEEPEST)))
        rates = _digits(GROWTH * np.sinh(np.clip(numbers[1], -STEEPEST, STEEPEST)))
        kind, (trigger, threshold, start) = np.array(choice.kind, np.int64), self.opening(choice, when)
        return Numbers(Lies(rests, steps, pauses, values, rates), self.target(choice), kind, trigger, threshold, start)

    def text(self, point: Point) -> str:
        """Return the text of one attack, as on the command line."""
        choice, (lies, target, *_) = point.choice, self._row(point)
        used, hit = slice(len(choice.single)), np.asarray(target.any(axis=0))
        parts = [f"kind={choice.kind.name.lower()}", *self.words(choice, shares_of(point.vector[:1])[0])]
        parts += [f"{name}={_listed(getattr(lies, name)[used])}" for name in ("rests", "steps", "pauses")]
        for field in ("values", "rates"):
            held = getattr(lies, field)[used]
            parts += [f"{field}.{name}={_listed(held[:, i])}" for i, name in enumerate(self.wires) if hit[i]]
        return f"segments:{','.join(parts)}"


def _digits(values: Array) -> Array:
    """Return values with four digits, as a text has them."""
    return np.array([float(f"{value:.4g}") for value in values.ravel().tolist()]).reshape(values.shape)


def _listed(values: Array) -> str:
    return f"[{','.join(map(str, values.tolist()))}]"
