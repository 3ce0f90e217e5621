"""The space of values that follow the road: for each wire the weights of `feedback`, with every trigger, bursts and a later kind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from tailgate.agents.scripts.feedback import FEATURES, fed_back, road, sent
from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Command, Kind, View
from tailgate.core.draws import Draws
from tailgate.core.kinds import AIRED, EFFECTS
from tailgate.core.threat import Brief, receivers
from tailgate.ensemble.battery import opens
from tailgate.ensemble.space import LONG, NEVER, TRIGGERS, Space, log_between, pick

KINDS = Kind.FDI, Kind.DOS_JAM, Kind.DOS_HOLD, Kind.DROPOUT, Kind.NOISE_JAM, Kind.ECHO_DELAY
GENES = "kind", "later", "targets", "agent", "trigger", "when", "bursts", "burst", "pause", "switch"
SPREAD = 0.6  # of the weights (logistic): half of them are within two thirds of it


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

    def remembered(self) -> Memory:
        """Return the memory of the attacks at the start of their episodes."""
        count = np.zeros(len(self.kind), np.int64)
        return Memory(self, count > 0, count, np.full(self.target.shape[:2], -np.inf))


class Memory(NamedTuple):
    """The attacks of B episodes and what they remember; every leaf has B first."""

    numbers: Numbers
    opened: Array  # (B,) bool: the trigger has fired
    elapsed: Array  # (B,) int64: steps since it first fired
    lead_speed: Array  # (B, N) at the last look; -inf before the first


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
        for one_kind in KINDS:
            if EFFECTS[one_kind].valued and one_kind.name.lower() in plan.threat.kinds:
                value = np.where((kind == one_kind)[:, None, None], sent(plan, one_kind, raw), value)
        target = on[:, None, None] & one.target
        hit = target.any(axis=(1, 2))
        command = Command(np.where(hit, kind, 0).astype(np.int8), target, np.where(target, value, 0.0))
        return Memory(one, opened, count + opened, np.array(view.scene.lead_speed)), command


@dataclass(frozen=True)
class Feedbacks:
    """All attacks of `feedback` that a threat model grants in a scenario. A genome has the numbers of GENES, then the weights."""

    space: Space  # of scripts in the same place

    leads: ClassVar[tuple[int, ...]] = (0,)  # genes that say a family

    @property
    def brief(self) -> Brief:
        """What the attacker is granted."""
        return self.space.brief

    @cached_property
    def families(self) -> tuple[Kind, ...]:
        """The kinds that are granted, and have a receiver; of those without a value, only where another kind may follow."""
        heard = bool(receivers(self.brief).any())
        kinds = [kind for kind in KINDS if kind.name.lower() in self.brief.threat.kinds and (heard or kind not in AIRED)]
        return tuple(kinds) if any(EFFECTS[kind].valued for kind in kinds) and self.space.road else ()

    @property
    def genes(self) -> int:
        """The numbers of a genome."""
        return len(GENES) + FEATURES * len(self.brief.model.wires)

    def scripts(self, genomes: Array) -> Numbers:
        """Return the attacks of genomes (B, genes)."""
        gene, brief, space = dict(zip(GENES, np.moveaxis(genomes, 1, 0), strict=False)), self.brief, self.space
        count, (agents, wires) = len(genomes), brief.granted.shape
        centred = np.clip(genomes[:, len(GENES) :], 1e-4, 1.0 - 1e-4)
        weights = np.round(SPREAD * np.log(centred / (1.0 - centred)), 3).reshape(count, 1, wires, FEATURES)
        weights = weights * np.array([2.5, 1.0, 1.0, 1.0, 1.0])  # of a constant value more than of one that follows
        kinds = np.array([int(kind) for kind in self.families])
        kind, later = kinds[pick(gene["kind"], len(kinds))], kinds[pick(gene["later"] / 0.4, len(kinds))]
        changes = (gene["later"] < 0.4) & (later != kind)
        later = np.where(changes, later, kind)
        target = np.broadcast_to(brief.granted, (count, agents, wires)).copy()
        chosen, alone = pick(gene["targets"], len(space.wires)), pick(gene["agent"], len(space.agents))
        for i, names in enumerate(space.wires):
            if names:
                target[chosen == i] &= np.array([name in names for name in brief.model.wires])
        for i, number in enumerate(space.agents):
            if number is not None:
                target[alone == i] &= (np.arange(agents) == number)[:, None]
        air = np.isin(kind, AIRED) | np.isin(later, AIRED)
        reached = target & receivers(brief)
        reached = np.where(reached.any(axis=(1, 2), keepdims=True), reached, receivers(brief))
        target = np.where(air[:, None, None], reached, target)
        trigger, threshold, start = space.opening(gene["trigger"], gene["when"])
        many = (gene["bursts"] < 0.3) & (space.budget > 1)
        return Numbers(
            np.broadcast_to(weights, (count, agents, wires, FEATURES)).copy(), target, kind, later,
            np.where(changes, 1 + pick(gene["switch"], max(space.budget, 1)), NEVER), trigger, threshold, start,
            np.where(many, np.round(log_between(gene["burst"], 1.0, max(space.budget / 2, 1.0))).astype(np.int64), NEVER),
            np.where(many, np.round(log_between(gene["pause"], 1.0, LONG)).astype(np.int64), 0),
        )  # fmt: skip

    def label(self, genome: Array) -> str:
        """Return a short text of one attack."""
        return self.text(genome)

    def text(self, genome: Array, folder: Path | None = None) -> str:
        """Return the text of one attack, as on the command line."""
        one, wires = map_leaves(lambda leaf: leaf[0], self.scripts(genome[None])), self.brief.model.wires
        kind, later = Kind(int(one.kind)), Kind(int(one.later))
        parts = [f"kind={kind.name.lower()}"]
        if later != kind:
            parts += [f"later={later.name.lower()}", f"switch={one.switch}"]
        hit = np.asarray(one.target.any(axis=0))
        granted = receivers(self.brief).any(axis=0) if {kind, later} & set(AIRED) else self.brief.granted.any(axis=0)
        if (hit != granted).any():
            parts.append(f"targets=[{','.join(name for name, on in zip(wires, hit, strict=True) if on)}]")
        if len(self.space.agents) > 1 and len(agents := np.flatnonzero(one.target.any(axis=1)).tolist()) == 1:
            parts.append(f"agents=[{agents[0]}]")
        name = TRIGGERS[int(one.trigger)]
        parts.append(f"start_step={one.start}" if name == "time" else f"trigger={name},threshold={float(one.threshold)!r}")
        if one.burst < NEVER:
            parts.append(f"burst={one.burst},pause={one.pause}")
        for wire, held, on in zip(wires, one.weights[0].tolist(), hit, strict=True):
            if on:
                parts.append(f"weights.{wire}=[{','.join(f'{number:.4g}' for number in held)}]")
        return f"feedback:{','.join(parts)}"
