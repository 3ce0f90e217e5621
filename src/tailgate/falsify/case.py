"""A case: a defence in a scenario, a property, and what a search may choose to break it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Command, View, draws
from tailgate.core.draws import Draws
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.core.threat import Brief
from tailgate.ensemble.battery import Memory, Scripts, remembered
from tailgate.ensemble.search import Arena
from tailgate.ensemble.space import GENES, Sequence
from tailgate.falsify.claim import Claim, claim_of
from tailgate.falsify.road import Slot, Steered, numbers_of, slots_of
from tailgate.play.trace import Trace, episodes_at_once, rollout

PURPOSE = "tune"  # of the episodes' seeds
AT_ONCE = 1024  # episodes side by side; changes no result


class Many:
    """An attack whose row i plays script i of a list."""

    def __init__(self, scripts: Sequence) -> None:
        self.scripts, self._attack = scripts, Scripts()

    def prepare(self, brief: Brief) -> Brief:
        """Return the brief."""
        return brief

    def start(self, plan: Brief, batch: int, draws: Draws) -> Memory:
        """Return the memory of B scripts; a smaller or larger batch takes them in turn."""
        return remembered(self.scripts.take(np.arange(batch) % len(self.scripts.length)), plan.model.agents)

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands of each script."""
        return self._attack.decide(plan, memory, view, draws)


class Choice(NamedTuple):
    """One trial: the attack as text, and the genes of the start."""

    attack: str
    start: Array  # (D,)


@dataclass(frozen=True)
class Case:
    """A property and all that may break it.

    With an empty `attack` scripts are searched. Else this attack is played, and the road alone is searched.
    """

    suite: str
    scenario: str
    dose: int | None
    defence: str
    threat: tuple[tuple[str, Any], ...]
    formula: str
    attack: str = ""

    def __post_init__(self) -> None:
        if self.dose is not None and (isinstance(self.dose, bool) or not isinstance(self.dose, int) or self.dose < 0):
            raise InputError("--dose", self.dose, "a whole number of attack steps, not below 0, or none")

    @cached_property
    def arena(self) -> Arena:
        """The place of the search."""
        granted = dict(load_suite(self.suite).granted) if self.suite else {}
        return Arena(self.suite or "custom", self.scenario, self.dose, self.defence, granted | dict(self.threat), None)

    @cached_property
    def claim(self) -> Claim:
        """The property."""
        return claim_of(load_scenario(self.scenario), self.formula)

    def loop(self, attack: str) -> Loop:
        """Return the loop under an attack, which knows what it needs to know."""
        spec, defence = Spec("attack", attack), Spec("defence", self.defence)
        return self.arena.cell(attack).place(spec.make(), spec.entry.knowledge).loop(defence.make(), defence.entry.uses)

    @cached_property
    def own(self) -> Loop:
        """The loop of the search."""
        return self.loop(self.attack or "none")

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """The draws of a start."""
        return slots_of(self.own)

    @property
    def genes(self) -> tuple[str, ...]:
        """The names of what is searched."""
        road = (f"start{i}" for i in range(sum(slot.size for slot in self.slots)))
        return (*(() if self.attack else GENES), *road)

    def check(self) -> None:
        """Check all that could fail later.

        Raises
        ------
        InputError
            For anything that does not exist or has no meaning here.
        """
        _ = self.claim, self.own.brief.granted, self.own.plan, self.slots
        if not self.attack and not self.arena.space.families:
            raise InputError("--attack", "searched", f"none or an attack by name: {self.scenario} grants no script at this dose")

    def choice(self, genome: Array) -> Choice:
        """Return what a genome (genes,) means."""
        if self.attack:
            return Choice(self.attack, genome)
        return Choice(self.arena.space.text(genome[: len(GENES)]), genome[len(GENES) :])

    def robustness(self, genomes: Array, seeds: Array) -> Array:
        """Return the robustness (B, E) of each genome (B, genes) in its episodes, which have the seeds (B, E)."""
        rows, flat = np.repeat(genomes, seeds.shape[1], axis=0), seeds.ravel()
        size, out = episodes_at_once(self.own.model, self.own.horizon, AT_ONCE), []
        for first in range(0, len(rows), size):
            part = slice(first, first + size)
            out.append(self.claim.robustness(self._played(rows[part], flat[part])))
        return np.concatenate(out).reshape(seeds.shape)

    def _played(self, genomes: Array, seeds: Array) -> Trace:
        """Play genome i in the episode of seed i."""
        keys = draws.keys(PURPOSE, seeds.tolist())
        if self.attack:
            return rollout(self.own, Spec("attack", self.attack).make(), Steered.of(keys, numbers_of(self.slots, genomes)))
        space, start = self.arena.space, genomes[:, len(GENES) :]
        return rollout(self.own, Many(space.scripts(genomes[:, : len(GENES)])), Steered.of(keys, numbers_of(self.slots, start)))
