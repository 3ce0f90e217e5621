"""Schedules: values that are injected step by step after a trigger has opened, as programs that `evaluate` plays."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from tailgate.agents.scripts.scripted import Inject, InjectRamp
from tailgate.agents.scripts.triggers import TRIGGERS, Trigger, TriggerState, idle, part
from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic
from tailgate.core import Array, Command, Kind, View
from tailgate.core.draws import Draws
from tailgate.core.registry import Spec
from tailgate.core.threat import Brief, fit


class Schedule(NamedTuple):
    """When a schedule begins, and what it adds."""

    trigger: dict[str, Any]  # name and parameters, as in a program
    values: Array  # (T, N, w), or (B, T, N, w) with one schedule for each episode [unit of the wire]
    chosen: Array  # (T,) or (B, T) bool: the steps that are attacked

    @property
    def sent(self) -> Array:
        """The values of the attacked steps; 0 elsewhere."""
        return np.where(self.chosen[..., None, None], self.values, 0.0)

    def when(self) -> Trigger:
        """Return the trigger."""
        return part(TRIGGERS, self.trigger, "schedule.trigger")

    def program(self, brief: Brief, about: str) -> str:
        """Return the text of a program that plays the one schedule of all episodes."""
        wires, granted = brief.model.wires, brief.granted
        last = int(np.flatnonzero(self.chosen)[-1]) + 1 if self.chosen.any() else 1
        laws = {}
        for w in np.flatnonzero(granted.any(axis=0)).tolist():
            entries = [[float(f"{x:.6g}") if on else None for x, on in zip(row, granted[:, w], strict=True)]
                       for row in self.values[:last, :, w].tolist()]  # fmt: skip
            held = [row if hit else None for row, hit in zip(entries, self.chosen[:last].tolist(), strict=True)]
            laws[wires[w]] = {"name": "table", "values": [row[0] if row is not None and len(row) == 1 else row for row in held]}
        phase = {"kind": "fdi", "value": laws, "trigger": self.trigger}
        return yaml.safe_dump({"about": about, "phases": [phase]}, sort_keys=False, default_flow_style=None, width=140)

    def write(self, path: Path, brief: Brief, about: str) -> None:
        """Write the program to a YAML file."""
        write_atomic(path, self.program(brief, about).encode())


def steps_of(brief: Brief) -> int:
    """Return the longest schedule: the steps from the onset to the last one that is granted."""
    threat = brief.threat
    return max((brief.horizon if threat.end is None else min(threat.end, brief.horizon)) - threat.onset + 1, 1)


def schedule_of(text: str, brief: Brief) -> Schedule:
    """Return what a script of false data sends, as a schedule; one that opens at a time begins at the onset instead, silent at first.

    Raises
    ------
    InputError
        For an attack that is not `fdi` or `fdi_ramp`.
    """
    script = Spec("attack", text).make()
    if not isinstance(script, (Inject, InjectRamp)):
        raise InputError("script", text, "false data: fdi or fdi_ramp, with parameters")
    plan, when, count = script.prepare(brief), script.when, np.arange(steps_of(brief))
    late = type(when) is Trigger and when.start > brief.threat.onset
    count = count - (when.start - brief.threat.onset if late else 0)
    if isinstance(script, Inject):
        value = np.full(len(count), script.value)
    else:
        value = np.clip(script.base + script.rate * (count + 1), -script.limit, script.limit)
    on = (count >= 0) & (count < (np.inf if script.length is None else script.length))
    if script.burst is not None:
        on &= count % (script.burst + script.pause) < script.burst
    on &= np.cumsum(on) <= (len(on) if brief.threat.budget is None else brief.threat.budget)
    fields = {held.name: getattr(when, held.name) for held in dataclasses.fields(when) if getattr(when, held.name) != held.default}
    for name in ("start", "window") if late else ("window",):
        fields.pop(name, None)
    name = next(name for name, kind in TRIGGERS.items() if kind is type(when))
    target = plan.target * (1.0 if plan.extra is None else plan.extra)
    return Schedule({"name": name} | fields, fit(brief, Kind.FDI, value[:, None, None] * target), on)


@dataclass(frozen=True, eq=False)
class Scheduled:
    """An attack that plays schedules, each episode of a batch its own. It exists for bounds with hindsight, which no attacker reaches."""

    schedule: Schedule

    def prepare(self, brief: Brief) -> Brief:
        """Return the brief."""
        return brief

    def start(self, plan: Brief, batch: int, draws: Draws) -> TriggerState:
        """Return the memory of the trigger."""
        return idle(batch, plan.model.agents)

    def decide(self, plan: Brief, state: TriggerState, view: View, draws: Draws) -> tuple[TriggerState, Command]:
        """Return the next memory and the command of this step, in each row that of its schedule."""
        trigger, rows = self.schedule.when(), np.arange(len(view.k))
        after, on, count = trigger.step(trigger.prepare(plan), state, view, draws)
        place = np.minimum(count, self.schedule.chosen.shape[1] - 1)
        on = on & view.allowed & (count < self.schedule.chosen.shape[1]) & self.schedule.chosen[rows, place]
        value = fit(plan, Kind.FDI, self.schedule.values[rows, place])
        return after, plan.command(on, Kind.FDI, plan.granted, value)
