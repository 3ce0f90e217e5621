"""An insider: a car of the platoon that drives by a law with other gains than it promised."""

from dataclasses import dataclass

import numpy as np

from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Finite, Kind, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief, fit


@register(
    "attack", "insider",
    reference="I. Sajjad, D. D. Dunn, R. Sharma, R. Gerdes, Attack Mitigation in Adversarial Platooning, 2015",
)  # fmt: skip
@dataclass(frozen=True)
class Insider(Script):
    """A car scales the two gains of its law, on the spacing error and its rate, and ignores its defence."""

    kp_scale: Finite = param(0.0, "factor on the gain of the spacing error, cut at gain_bound [-]", cut="gain_bound")
    kd_scale: Finite = param(-1.0, "factor on the gain of the error's rate, cut at gain_bound [-]", cut="gain_bound")

    def prepare(self, brief: Brief) -> ScriptPlan:
        attack, geared = "attack insider", brief.geared
        wires = brief.model.gains
        if not wires:
            raise NotApplicable(attack, "no gains that could be scaled", "the plant platoon, whose cars drive by a law with gains")
        require(brief, attack, ["insider"])
        target = chosen(brief, self.targets, brief.granted & geared, self.agents)
        for name, other in zip(brief.model.wires, np.any(target, axis=0).tolist(), strict=True):
            if other and name not in wires:
                raise InputError(f"{attack}.targets", name, f"wires whose signal the law weighs by a gain ({', '.join(wires)})")
        followers = brief.model.followers
        for i in self.agents:
            if not followers[i]:
                raise NotApplicable(f"{attack}.agents", i, "cars that follow another: the manoeuvre drives the leader")
        target = target & geared
        require(brief, attack, target=target)
        if not target.any():
            raise NotApplicable(f"{attack}: threat_model.targets", brief.threat.targets, f"a threat model that grants {' or '.join(wires)}")
        scale = dict(zip(wires, (self.kp_scale, self.kd_scale), strict=True))
        value = np.array([scale.get(name, 0.0) for name in brief.model.wires])
        return self.plan(brief, target, fit(brief, Kind.INSIDER, value))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return plan.brief.command(on, Kind.INSIDER, plan.target, plan.extra)
