"""The space of scripts: families of attacks, on every set of wires, with every trigger, bursts and pauses.

A point is a vector of numbers in [0, 1], a genome. It says the numbers of a script, which lie within the threat model. Thresholds of
triggers lie within what the road shows in episodes without an attack. The text of a script is as on the command line.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Kind
from tailgate.core.threat import Brief, receivers
from tailgate.play.trace import Trace

TRIGGERS = ("time", "near", "speed", "slow", "closing", "leader_braking")
MOST_SETS = 12  # sets of wires, at most; of many wires only single ones and all
SMALL = 1e-3  # of a bound: the smallest magnitude that is tried
LONG = 30  # longest pause between two bursts [steps]
SIGNED = Kind.FDI, Kind.DOS_JAM  # kinds whose values have a sign
NEVER = 1 << 30  # a length that no episode has [steps]
GENES = (
    "family", "targets", "agent", "trigger", "when", "bursts", "burst", "pause", "sign", "size", "rate_sign", "rate", "switch", "hop",
)  # fmt: skip


class Rows(NamedTuple):
    """The numbers of B scripts, one in each row."""

    kind: Array  # (B,) int64 of `Kind`
    then: Array  # (B,) int64: kind after `switch` steps
    switch: Array  # (B,) int64
    target: Array  # (B, N, w) bool
    base: Array  # (B,) value of the first step
    rate: Array  # (B,) its growth a step
    trigger: Array  # (B,) int64: place in TRIGGERS
    threshold: Array  # (B,) of the trigger
    start: Array  # (B,) int64: first step
    burst: Array  # (B,) int64: steps of a burst
    pause: Array  # (B,) int64: steps between two bursts
    hop: Array  # (B,) bool: radiate only after a step in which the probe was heard


class Sequence(NamedTuple):
    """The scripts of B episodes: one phase or two, of which the second is armed when the first has attacked for `length` steps."""

    phases: tuple[Rows, ...]
    length: Array  # (B,) int64

    def take(self, places: Array) -> Sequence:
        """Return the scripts at these places."""
        return map_leaves(lambda leaf: leaf[places], self)


@dataclass(frozen=True)
class Family:
    """A script without random values: its name, its kind, and the fields that say its value."""

    name: str
    kind: Kind
    value: str = ""  # field of the value; the ramps have base and rate instead
    ramp: bool = False
    then: Kind | None = None
    fixed: str = ""  # fields that do not vary
    whole: bool = False  # the value is a whole number

    @property
    def air(self) -> bool:
        """If it radiates."""
        return self.kind in (Kind.NOISE_JAM, Kind.ECHO_DELAY)


FAMILIES = (
    Family("dos_hold", Kind.DOS_HOLD),
    Family("dos_hold", Kind.DOS_HOLD_FRESH, fixed="fresh=true"),
    Family("dropout", Kind.DROPOUT),
    Family("dos_jam", Kind.DOS_JAM, value="low"),
    Family("fdi", Kind.FDI, value="value"),
    Family("fdi_ramp", Kind.FDI, ramp=True),
    Family("fdi_then_jam", Kind.FDI, value="value", then=Kind.DOS_JAM),
    Family("delay", Kind.DELAY, value="age", whole=True),
    Family("replay", Kind.REPLAY, value="window", whole=True),
    Family("noise_jam", Kind.NOISE_JAM, value="power"),
    Family("echo_delay", Kind.ECHO_DELAY, value="delay"),
    Family("echo_pull_off", Kind.ECHO_DELAY, ramp=True),
)


def road_of(trace: Trace) -> dict[str, tuple[float, float]]:
    """Return the range of each signal that a trigger waits for, from the 1st to the 99th percentile; nothing where nobody drives."""
    follows = trace.model.followers
    if not follows.any():
        return {}
    live, found = trace.live, {}
    gap, speed, ahead = (trace.signals[name][:, :, follows][live] for name in ("gap", "speed", "lead_speed"))
    fall = -np.diff(trace.signals["lead_speed"][:, :, follows], axis=0)[live[1:]] / trace.dt
    for name, values in {"near": gap, "speed": speed, "slow": speed, "closing": speed - ahead, "leader_braking": fall}.items():
        low, high = (float(x) for x in np.percentile(values[np.isfinite(values)], (1.0, 99.0)))
        if high > max(low, 0.0):
            found[name] = (max(low, 0.0), high)
    return found


def _short(values: Array) -> Array:
    """Return the values with four digits, as the text of a script has them."""
    return np.array([float(f"{value:.4g}") for value in values.tolist()])


def _pick(gene: Array, count: int) -> Array:
    """Return for each gene a place among `count`."""
    return np.minimum((gene * count).astype(np.int64), count - 1)


def _log(gene: Array, low: float, high: float) -> Array:
    """Return numbers between low and high, log-uniform for a uniform gene."""
    return np.asarray(low * (high / low) ** gene)


@dataclass(frozen=True)
class Space:
    """All scripts that a threat model grants in a scenario. A genome is a vector of `genes` numbers in [0, 1)."""

    brief: Brief
    road: dict[str, tuple[float, float]]
    phase: bool = False  # the scripts are phases of a program, which know no bursts of a fixed length

    genes: ClassVar[int] = len(GENES)
    leads: ClassVar[tuple[int, ...]] = (0,)  # genes that say a family

    @cached_property
    def families(self) -> tuple[Family, ...]:
        """The families whose kinds are granted, and have a receiver."""
        granted, heard = {Kind[name.upper()] for name in self.brief.threat.kinds}, bool(receivers(self.brief).any())
        return tuple(
            f for f in FAMILIES
            if {f.kind, f.then or f.kind} <= granted and (heard or not f.air) and not (self.phase and f.then)
        )  # fmt: skip

    @cached_property
    def wires(self) -> tuple[tuple[str, ...], ...]:
        """The sets of wires that are tried; the empty one names all that are granted."""
        granted = [name for name, hit in zip(self.brief.model.wires, np.any(self.brief.granted, axis=0).tolist(), strict=True) if hit]
        sets = [subset for size in range(1, len(granted)) for subset in itertools.combinations(granted, size)]
        return ((), *(sets if len(sets) < MOST_SETS else [(name,) for name in granted]))

    @cached_property
    def agents(self) -> tuple[int | None, ...]:
        """The agents that are tried alone; None names all that are granted."""
        granted = np.flatnonzero(self.brief.granted.any(axis=1)).tolist()
        return (None, *(granted if len(granted) > 1 else ()))

    @cached_property
    def triggers(self) -> tuple[str, ...]:
        """The triggers that may fire here."""
        return tuple(name for name in TRIGGERS if name == "time" or name in self.road)

    @property
    def budget(self) -> int:
        """The attack steps that an episode may have."""
        most = self.brief.threat.budget
        return self.brief.horizon if most is None else min(most, self.brief.horizon)

    def reach(self, kind: Kind) -> tuple[float, float]:
        """Return the smallest and the largest value of a kind, of one sign."""
        threat = self.brief.threat
        low, high = threat.jam_range
        most = {
            Kind.FDI: threat.fdi_bound, Kind.DOS_JAM: max(abs(low), abs(high)), Kind.NOISE_JAM: threat.jam_power,
            Kind.ECHO_DELAY: threat.delay_bound, Kind.DELAY: float(threat.memory), Kind.REPLAY: float(threat.memory),
        }.get(kind, 1.0)  # fmt: skip
        return (1.0, max(most, 1.0)) if kind in (Kind.DELAY, Kind.REPLAY) else (SMALL * most, most)

    def rows(self, genomes: Array) -> Rows:
        """Return the numbers of the scripts of genomes (B, genes)."""
        gene = dict(zip(GENES, np.moveaxis(genomes, 1, 0), strict=True))
        count, brief = len(genomes), self.brief
        family, wires, agent = (_pick(gene[name], len(of)) for name, of in
                                (("family", self.families), ("targets", self.wires), ("agent", self.agents)))  # fmt: skip
        base, rate = np.zeros(count), np.zeros(count)
        target = np.zeros((count, *brief.granted.shape), bool)
        for i, one in enumerate(self.families):
            here = family == i
            low, high = self.reach(one.kind)
            size = _log(gene["size"][here], low, high)
            signed = one.kind in SIGNED
            value = np.where(gene["sign"][here] < 0.5, -size, size) if signed else size
            base[here] = np.round(value) if one.whole else _short(value)
            if one.ramp:
                fastest = max(2.0 * high / max(self.budget, 1), low)
                growth = _log(gene["rate"][here], min(SMALL * high, 0.5 * fastest), fastest)
                rate[here] = _short(np.where(gene["rate_sign"][here] < 0.5, -growth, growth) if signed else growth)
            target[here] = self._aired if one.air else brief.granted
        free = ~np.array([f.air for f in self.families])[family] | (not self.phase)  # a phase over the air hits all that a receiver reads
        for i, names in enumerate(self.wires):
            if names:
                target[(wires == i) & free] &= np.array([name in names for name in brief.model.wires])
        for i, number in enumerate(self.agents):
            if number is not None:
                target[agent == i] &= (np.arange(brief.granted.shape[0]) == number)[:, None]
        trigger, threshold, start = self.opening(gene["trigger"], gene["when"])
        many = (gene["bursts"] < 0.4) & (self.budget > 1) & (not self.phase)
        kinds, thens = (np.array([int(held) for held in each]) for each in
                        ((f.kind for f in self.families), (f.then or f.kind for f in self.families)))  # fmt: skip
        return Rows(
            kinds[family], thens[family],
            np.where(kinds[family] == thens[family], NEVER, 1 + _pick(gene["switch"], max(self.budget, 1))), target, base, rate,
            trigger, threshold, start,
            np.where(many, np.round(_log(gene["burst"], 1.0, max(self.budget / 2, 1.0))).astype(np.int64), NEVER),
            np.where(many, np.round(_log(gene["pause"], 1.0, LONG)).astype(np.int64), 0),
            (gene["hop"] < 0.3) & np.array([f.air for f in self.families])[family] & (not self.phase),
        )  # fmt: skip

    def opening(self, trigger_gene: Array, when_gene: Array) -> tuple[Array, Array, Array]:
        """Return trigger, threshold and first step (B,) each, of two genes (B,)."""
        trigger = np.array([TRIGGERS.index(name) for name in self.triggers])[_pick(trigger_gene, len(self.triggers))]
        threshold, threat = np.zeros(len(trigger)), self.brief.threat
        for name, (low, high) in self.road.items():
            here = trigger == TRIGGERS.index(name)
            threshold[here] = _short(low + (high - low) * when_gene[here])
        last = self.brief.horizon if threat.end is None else min(threat.end, self.brief.horizon)
        first = threat.onset + _pick(when_gene, max(last - threat.onset + 1, 1))
        return trigger, threshold, np.where(trigger == 0, first, 1)

    @property
    def _aired(self) -> Array:
        """Return the wires (N, w) that are hit over the air: a phase of a program names the first that a receiver reads."""
        heard = receivers(self.brief)
        return np.asarray(heard & (np.cumsum(heard, axis=1) == 1)) if self.phase else heard

    @property
    def rhythms(self) -> Array:
        """Genomes (P, genes) of single steps of the largest value, from the first step on, with every pause.

        A defence may trust its sensors again some steps after an alarm. One pause alone defeats it, and a search hardly finds that one.
        """
        signs, pauses = (0.0, 0.75), np.log(np.arange(1.0, LONG + 1.0)) / np.log(LONG)
        out = np.zeros((len(self.families), len(signs), LONG, self.genes))
        gene = dict(zip(GENES, np.moveaxis(out, -1, 0), strict=True))
        gene["family"][:] = ((np.arange(len(self.families)) + 0.5) / max(len(self.families), 1))[:, None, None]
        gene["sign"][:] = np.array(signs)[:, None]
        gene["pause"][:] = pauses
        gene["rate_sign"][:] = np.array(signs)[:, None]
        for name in ("size", "rate", "hop"):
            gene[name][:] = np.nextafter(1.0, 0.0)
        distinct = np.array([[True, one.kind in SIGNED] for one in self.families], bool).reshape(-1, len(signs))
        return np.minimum(out[distinct & (self.budget > 1)].reshape(-1, self.genes), np.nextafter(1.0, 0.0))

    def scripts(self, genomes: Array) -> Sequence:
        """Return the scripts of genomes (B, genes)."""
        return Sequence((self.rows(genomes),), np.full(len(genomes), NEVER))

    def label(self, genome: Array) -> str:
        """Return a short text of one script."""
        return self.text(genome)

    def family(self, genome: Array) -> Family:
        """Return the family of one script."""
        return self.families[int(_pick(genome[:1], len(self.families))[0])]

    def sets(self, genome: Array) -> tuple[tuple[str, ...], int | None]:
        """Return the wires that one script names, and its agent; empty and None: all that are granted."""
        gene = dict(zip(GENES, genome[:, None], strict=True))
        return self.wires[int(_pick(gene["targets"], len(self.wires))[0])], self.agents[int(_pick(gene["agent"], len(self.agents))[0])]

    def text(self, genome: Array, folder: Path | None = None) -> str:
        """Return the text of one script, as on the command line."""
        row, family = self.rows(genome[None]), self.family(genome)
        words = [family.fixed] if family.fixed else []
        base, rate = (f"{held[0]:.4g}" for held in (row.base, row.rate))
        if family.ramp:
            words += [f"base={base}", f"rate={rate}"] + ([] if family.air else [f"limit={self.brief.threat.fdi_bound:g}"])
        elif family.value:
            words.append(f"{family.value}={base}")
        if family.name == "dos_jam":
            words.append(f"high={base}")
        if family.then:
            words.append(f"inject={row.switch[0]}")
        if row.hop[0]:
            words.append("hop=true")
        names, agent = self.sets(genome)
        if names:
            words.append(f"targets=[{','.join(names)}]")
        if agent is not None:
            words.append(f"agents=[{agent}]")
        name = TRIGGERS[int(row.trigger[0])]
        words += [f"start_step={row.start[0]}"] if name == "time" else [f"trigger={name}", f"threshold={row.threshold[0]:.4g}"]
        if row.burst[0] < NEVER:
            words += [f"burst={row.burst[0]}", f"pause={row.pause[0]}"]
        return f"{family.name}:{','.join(words)}"


