"""Programs: attacks that a YAML file describes, phase by phase. Nothing in such a file can name code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.radio import on_receivers
from tailgate.agents.scripts.triggers import TRIGGERS, Timing, Trigger, TriggerState, idle, part, rearm
from tailgate.agents.scripts.values import TAGS, Law, PerWire, check_wires, law_of
from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.base.pytree import map_leaves, widened
from tailgate.core import AIRED, Array, Command, Count, Kind, PositiveCount, Probability, View, no_command, param
from tailgate.core.draws import Draws
from tailgate.core.kinds import EFFECTS, KindName
from tailgate.core.quantities import Unchecked
from tailgate.core.registry import register
from tailgate.core.scenario import config_path
from tailgate.core.schema import build, read_yaml
from tailgate.core.threat import Brief, fit

HIT, FIRST = 0, TAGS  # tags of the draws: which wires are hit, and the values


@dataclass(frozen=True)
class Phase:
    """One phase of a program: what is done to which wires, when, and until when. It ends at whichever end comes first."""

    kind: KindName = param("fdi", "what is done; the threat model has to grant it")
    targets: tuple[str, ...] = param((), "wires to attack; empty: those that `value` names, or all that are granted")
    agents: tuple[Count, ...] = param((), "agents to attack, by number from 0; empty: all that are granted")
    value: Annotated[Law | None, Unchecked] = param(None, "law of the values, for the kinds that have one: of one wire or of each")
    trigger: Annotated[Trigger, Unchecked] = param("time", "when it is on: a trigger's name, or a mapping with name and parameters")
    probability: Probability | dict[str, Probability] = param(
        1.0, "probability of a hit per step and wire: one number, or one by name for each wire [-]"
    )
    length: PositiveCount | None = param(None, "number of attacked steps after which it ends")
    duration: PositiveCount | None = param(None, "number of steps from its arming to its end, whatever it did")

    @property
    def ends(self) -> bool:
        return self.length is not None or self.duration is not None or bool(self.trigger.ends)


@dataclass(frozen=True)
class Sheet:
    """The YAML file of a program."""

    phases: tuple[Any, ...] = param((), "phases, one after the other: each is armed when the one before has ended")
    about: str = param("", "what it does, in a sentence")
    repeat: PositiveCount | Literal["forever"] = param(1, "how often the phases are played, or `forever`")


def read_program(path: Path) -> Sheet:
    """Return a program from its YAML file, every part checked; raise InputError that names the file, the phase and the field."""
    where = f"program {path.name}"
    data = read_yaml(path, where)
    sheet = build(Sheet, data, where)
    if not sheet.phases:
        raise InputError(f"{where}.phases", data.get("phases"), "at least one phase")
    phases = tuple(_phase(held, f"{where}, phase {i}") for i, held in enumerate(sheet.phases, start=1))
    for i, phase in enumerate(phases, start=1):
        if not phase.ends and (i < len(phases) or sheet.repeat != 1):
            expected = "an end (a length, a duration, or a trigger with a window), as something follows"
            raise InputError(f"{where}, phase {i}", "a phase without end", expected)
    return Sheet(phases, sheet.about, sheet.repeat)


def _phase(data: object, where: str) -> Phase:
    if not isinstance(data, dict):
        raise InputError(where, data, "a mapping of fields")
    phase = build(Phase, data, where)
    kind = Kind[phase.kind.upper()]
    if EFFECTS[kind].valued and phase.value is None:
        raise InputError(f"{where}.value", None, f"a law: kind {phase.kind} needs values")
    if not EFFECTS[kind].valued and phase.value is not None:
        raise InputError(f"{where}.value", phase.value, f"no value: kind {phase.kind} has none")
    law = None if phase.value is None else law_of(phase.value, f"{where}.value")
    trigger = part(TRIGGERS, phase.trigger, f"{where}.trigger")
    return dataclasses.replace(phase, value=law, trigger=trigger)


class Ready(NamedTuple):
    """A phase under a threat model."""

    phase: Phase
    trigger: Trigger
    timing: Timing
    kind: Kind
    target: Array  # (N, w) bool
    probability: Array  # (w,)


class ProgramPlan(NamedTuple):
    brief: Brief
    phases: tuple[Ready, ...]
    repeat: float  # inf: without end


class ProgramState(NamedTuple):
    """Every leaf has B first."""

    phase: Array  # (B,) int64: index of the phase that is armed; the number of phases when all is over
    rounds: Array  # (B,) int64: times that all phases have been played
    attacked: Array  # (B,) int64: attacked steps of this phase
    trigger: TriggerState


@register("attack", "program")
@dataclass(frozen=True)
class Program:
    """Phases of a YAML file in sequence, each with its kind, wires, law of values, trigger and end."""

    path: Path = param(Path("burst_jamming"), "YAML file, or the name of a built-in program")

    def __post_init__(self) -> None:
        _ = self.sheet  # a damaged file shall fail here

    @cached_property
    def file(self) -> Path:
        return config_path("attacks", str(self.path), "program")

    @cached_property
    def sheet(self) -> Sheet:
        return read_program(self.file)

    @property
    def sees_measurement(self) -> bool:
        """True if a phase has to see the readings."""
        return any(phase.trigger.sees_measurement for phase in self.sheet.phases)

    def prepare(self, brief: Brief) -> ProgramPlan:
        where = f"program {self.file.name}"
        phases = tuple(_ready(phase, brief, f"{where}, phase {i}") for i, phase in enumerate(self.sheet.phases, start=1))
        return ProgramPlan(brief, phases, np.inf if self.sheet.repeat == "forever" else float(self.sheet.repeat))

    def start(self, plan: ProgramPlan, batch: int, draws: Draws) -> ProgramState:
        count = np.zeros(batch, np.int64)
        return ProgramState(count, count.copy(), count.copy(), idle(batch, plan.brief.model.agents))

    def decide(self, plan: ProgramPlan, state: ProgramState, view: View, draws: Draws) -> tuple[ProgramState, Command]:
        brief, batch = plan.brief, len(view.k)
        command = no_command(batch, brief.model.agents, len(brief.model.wires))
        trigger = state.trigger._replace(lead_speed=np.array(view.scene.lead_speed))
        attacked, over = state.attacked, np.zeros(batch, bool)
        for i, ready in enumerate(plan.phases):
            here = state.phase == i
            if not num.some(here):
                continue
            now, on, count = ready.trigger.step(ready.timing, state.trigger, view, draws)
            hit = draws.uniform(ready.target.shape, HIT) < ready.probability
            law = ready.phase.value
            target = ready.target & hit if law is None else ready.target & hit & law.sends(brief, count)
            on = on & here & view.allowed & target.any(axis=(1, 2))
            value = 0.0 if law is None else fit(brief, ready.kind, law.sample(brief, count, draws, FIRST))
            part = brief.command(on, ready.kind, target, value)
            command = Command(*(np.where(widened(here, new), new, old) for new, old in zip(part, command, strict=True)))
            trigger = map_leaves(lambda new, old, here=here: np.where(widened(here, new), new, old), now, trigger)
            attacked = attacked + on
            ended = ready.trigger.over(now, view.k)
            if ready.phase.length is not None:
                ended = ended | (attacked >= ready.phase.length)
            if ready.phase.duration is not None:
                ended = ended | (now.armed >= ready.phase.duration)
            over = over | (here & ended)
        return self._move_on(plan, ProgramState(state.phase, state.rounds, attacked, trigger), over), command

    def _move_on(self, plan: ProgramPlan, state: ProgramState, over: Array) -> ProgramState:
        """Return the state in which the rows `over` (B,) have armed their next phase."""
        phase = state.phase + over
        rounds = state.rounds + (over & (phase == len(plan.phases)))
        again = over & (phase == len(plan.phases)) & (rounds < plan.repeat)
        return ProgramState(np.where(again, 0, phase), rounds, np.where(over, 0, state.attacked), rearm(state.trigger, over))


def _ready(phase: Phase, brief: Brief, where: str) -> Ready:
    """Return a phase under a threat model; raise NotApplicable where it needs something that is not granted."""
    law: Law | None = phase.value
    names = phase.targets or (law.wires if isinstance(law, PerWire) else ())
    wires = brief.model.wires
    target = chosen(brief, names, brief.granted, phase.agents, f"{where}.")
    if law is not None:
        check_wires(law, target, brief, f"{where}.value")
    chance = phase.probability
    if isinstance(chance, dict):
        for name in chance:
            if name not in wires:
                raise unknown(f"{where}.probability", name, wires)
        chances = np.array([chance.get(name, 1.0) for name in wires])
    else:
        chances = np.full(len(wires), float(chance))
    require(brief, where, [phase.kind], target)
    kind = Kind[phase.kind.upper()]
    if kind in AIRED:
        target = on_receivers(brief, where, target, bool(names))
        target = target & (np.cumsum(target, axis=1) == 1)  # one draw of `probability` for all that a receiver reads
    if kind == Kind.INSIDER:
        target = target & brief.geared
        if not target.any():
            raise NotApplicable(f"{where}.kind", phase.kind, "a car whose law weighs one of the targets")
    try:
        timing = phase.trigger.prepare(brief)
    except InputError as error:  # the file is sound, but not for steps of this length
        raise NotApplicable(f"{where}: {error.field}", error.value, error.expected) from None
    return Ready(phase, phase.trigger, timing, kind, target, chances)
