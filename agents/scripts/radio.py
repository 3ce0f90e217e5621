"""Scripted attacks over the air: a jammer's noise, a late echo, and the thesis's readings of a jammed radar."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.agents.scripts.values import Constant, Law, PerWire, Ramp, Uniform
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Finite, Kind, Positive, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief, fit, receivers

WIRES = ("distance", "relative_speed")  # wires of a radar
Span = Annotated[tuple[Finite, Finite], Field(min_length=2, max_length=2)]


def on_receivers(brief: Brief, attack: str, target: Array, named: bool) -> Array:
    """Return (N, w) bool: the receivers of `target`. Raise NotApplicable without one, InputError where another wire is `named`."""
    if not brief.model.air:
        raise NotApplicable(attack, "sensors without an echo", "a plant whose sensors listen to the echo of their own probe")
    reached = receivers(brief)
    for name, other in zip(brief.model.wires, np.any(target & ~reached, axis=0).tolist(), strict=True):
        if other and named:
            raise InputError(f"{attack}.targets", name, f"sensors ({', '.join(brief.model.sensors)})")
    if not (target & reached).any():
        raise NotApplicable(f"{attack}: threat_model.targets", brief.threat.targets, "a threat model that grants a sensor")
    return np.asarray(target & reached)


@dataclass(frozen=True)
class OverTheAir(Script):
    """Base of scripts that radiate."""

    hop: bool = param(False, "radiate only after a step in which the probe was heard: silent where a muted probe is likely to stay so")

    def radiate(self, plan: ScriptPlan, on: Array, kind: Kind, law: Law, count: Array, view: View, draws: Draws) -> Command:
        """Return the command to radiate a law's values, in the rows `on` (B,)."""
        if self.hop:
            assert view.probed is not None
            on = on & view.probed.any(axis=1)
        return plan.brief.command(on, kind, plan.target, fit(plan.brief, kind, law.sample(plan.brief, count, draws)))


def _aimed(script: Script, brief: Brief, kind: str) -> ScriptPlan:
    """Return the plan of a script over the air, where the threat model grants it."""
    attack = f"attack {kind}"
    target = on_receivers(brief, attack, chosen(brief, script.targets, brief.granted, script.agents), bool(script.targets))
    require(brief, attack, [kind], target)
    return script.plan(brief, target)


@register("attack", "noise_jam", reference="Dutta 2018, (3.10)")
@dataclass(frozen=True)
class NoiseJam(OverTheAir):
    """A jammer's noise reaches the receiver, which measures worse, or nothing, as their powers decide."""

    power: Positive = param(0.1, "power of the jammer, cut at jam_power [W]", cut="jam_power")

    def prepare(self, brief: Brief) -> ScriptPlan:
        return _aimed(self, brief, "noise_jam")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return self.radiate(plan, on, Kind.NOISE_JAM, Constant(self.power), count, view, draws)


@register("attack", "echo_delay", reference="Dutta 2018, section 3.5: 6 m more")
@dataclass(frozen=True)
class EchoDelay(OverTheAir):
    """The probe is answered late: the car ahead seems to be farther away than it is."""

    delay: Positive = param(6.0, "extra range, cut at delay_bound [m]", cut="delay_bound")

    def prepare(self, brief: Brief) -> ScriptPlan:
        return _aimed(self, brief, "echo_delay")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return self.radiate(plan, on, Kind.ECHO_DELAY, Constant(self.delay), count, view, draws)


@register("attack", "echo_pull_off", reference="D. C. Schleher, Electronic Warfare in the Information Age, 1999: range-gate pull-off")
@dataclass(frozen=True)
class EchoPullOff(OverTheAir):
    """The probe is answered a little later in every step, slowly enough to look like a car that draws away."""

    base: Finite = param(0.0, "extra range before the first growth [m]")
    rate: Positive = param(0.25, "growth a step, up to delay_bound [m]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        return _aimed(self, brief, "echo_delay")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return self.radiate(plan, on, Kind.ECHO_DELAY, Ramp(self.base, self.rate, plan.brief.threat.delay_bound), count, view, draws)


@register("attack", "radar_jam", reference="Dutta 2018, section 3.5: 'a very high value'; its numbers are not given there")
@dataclass(frozen=True)
class RadarJam(OverTheAir):
    """Denial of service as the thesis has it: a jammed radar reads random far distances and fast opening speeds."""

    distance: Span = param((180.0, 250.0), "the distance is uniform on this span [m]")
    relative_speed: Span = param((0.0, 60.0), "the relative speed is uniform on this span [m/s]")

    def __post_init__(self) -> None:
        for name in WIRES:
            low, high = getattr(self, name)
            if low > high:
                raise InputError(f"attack radar_jam.{name}", (low, high), "two numbers, the smaller first")

    def prepare(self, brief: Brief) -> ScriptPlan:
        for name in WIRES:
            if name not in brief.model.sensors or not brief.model.air:
                raise NotApplicable("attack radar_jam", f"no sensor {name}", "a radar, which reads distance and relative speed")
        mine = np.isin(brief.model.wires, WIRES)
        target = chosen(brief, self.targets, brief.granted & mine, self.agents)
        for name, other in zip(brief.model.wires, np.any(target & ~mine, axis=0).tolist(), strict=True):
            if other:
                raise InputError("attack radar_jam.targets", name, f"sensors ({', '.join(WIRES)})")
        if not target.any():
            raise NotApplicable("attack radar_jam: threat_model.targets", brief.threat.targets, "a threat model that grants a sensor")
        require(brief, "attack radar_jam", ["dos_jam"], target)
        return self.plan(brief, target, PerWire(tuple((name, Uniform(*getattr(self, name))) for name in WIRES)))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return self.radiate(plan, on, Kind.DOS_JAM, plan.extra, count, view, draws)
