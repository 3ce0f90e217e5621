"""Segments: lies one after the other, with honest steps between them; each wire has its own value in each segment."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.feedback import sent
from tailgate.agents.scripts.radio import on_receivers
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Count, Finite, Kind, PositiveCount, View, param
from tailgate.core.draws import Draws
from tailgate.core.kinds import AIRED
from tailgate.core.registry import register
from tailgate.core.threat import Brief


class Lies(NamedTuple):
    """The numbers of J segments, each (..., J); values and rates (..., J, w). Leading axes are those of the rows, or none."""

    rests: Array  # int64: honest steps before the segment
    steps: Array  # int64: false steps
    pauses: Array  # int64: honest steps between two false ones
    values: Array  # of its first step [unit of the wire]
    rates: Array  # growth a step, pauses included [unit of the wire]


def lie(count: Array, lies: Lies) -> tuple[Array, Array]:
    """Return if a step (B,) is false, and its values (B, w), `count` (B,) steps after the window opened."""
    on, value, begin = count < 0, np.zeros((len(count), lies.values.shape[-1])), np.zeros(len(count), np.int64)
    for j in range(lies.steps.shape[-1]):
        begin, every = begin + lies.rests[..., j], 1 + lies.pauses[..., j]
        past, length = count - begin, (lies.steps[..., j] - 1) * every + 1
        here = (past >= 0) & (past < length) & (past % every == 0)
        value = np.where(here[:, None], lies.values[..., j, :] + lies.rates[..., j, :] * past[:, None], value)
        on, begin = on | here, begin + np.maximum(length, 0)
    return on, value


@register("attack", "segments")
@dataclass(frozen=True)
class Segments(Script):
    """Lies in segments one after the other: each rests first, then sends values that may grow, in a row or in single steps with pauses.

    Each field has a number for each segment. Over the air the size of a value counts, without its sign. The window's own bursts and
    length hold as well.
    """

    kind: Literal["fdi", "dos_jam", "noise_jam", "echo_delay"] = param("fdi", "kind of the attack")
    rests: tuple[Count, ...] = param((), "honest steps before each segment; empty: none")
    steps: tuple[PositiveCount, ...] = param((10, 10), "false steps of each segment")
    pauses: tuple[Count, ...] = param((), "honest steps between two false ones of each segment; empty: none")
    values: dict[str, tuple[Finite, ...]] | None = param(
        None, "first value of each segment, for each wire by name; the other wires get 0. It is needed [unit of the wire]", if_any=True
    )
    rates: dict[str, tuple[Finite, ...]] | None = param(
        None, "growth a step in each segment, pauses included, for wires by name; none: 0 [unit of the wire]", if_any=True
    )

    def __post_init__(self) -> None:
        if not self.steps:
            raise InputError("attack segments.steps", [], "at least one segment")
        fields: dict[str, tuple[float, ...]] = {"rests": self.rests or self.steps, "pauses": self.pauses or self.steps}
        for name, held in (("values", self.values), ("rates", self.rates)):
            fields |= {f"{name}.{wire}": numbers for wire, numbers in (held or {}).items()}
        for name, numbers in fields.items():
            if len(numbers) != len(self.steps):
                raise InputError(f"attack segments.{name}", list(numbers), f"as many numbers as steps has ({len(self.steps)})")

    def prepare(self, brief: Brief) -> ScriptPlan:
        where, wires = "attack segments", brief.model.wires
        if not self.values:
            raise NotApplicable(f"{where}.values", None, f"numbers for a wire, such as values.{wires[0]}=[-3,-3]")
        target = chosen(brief, self.targets, brief.granted, self.agents)
        if Kind[self.kind.upper()] in AIRED:
            target = on_receivers(brief, where, target, bool(self.targets))
        require(brief, where, [self.kind], target)
        for field, held in (("values", self.values), ("rates", self.rates or {})):
            for name in held:
                if name not in wires:
                    raise InputError(f"{where}.{field}", name, f"wires ({', '.join(wires)})")
                if not target[:, wires.index(name)].any():
                    raise InputError(f"{where}.{field}", name, "a wire that is attacked: see targets")
        still = (0.0,) * len(self.steps)
        values, rates = (np.array([held.get(name, still) for name in wires]).T for held in (self.values, self.rates or {}))
        none = (0,) * len(self.steps)
        rests, steps, pauses = (np.array(part or none, np.int64) for part in (self.rests, self.steps, self.pauses))
        return self.plan(brief, target, Lies(rests, steps, pauses, values, rates))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        false, raw = lie(count, plan.extra)
        kind = Kind[self.kind.upper()]
        return plan.brief.command(on & false, kind, plan.target, sent(plan.brief, kind, raw[:, None, :] + np.zeros(plan.target.shape)))
