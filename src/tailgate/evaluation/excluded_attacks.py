"""What a suite keeps out of its logs: families of attacks, also where one stands under another name.

A family is a registered name with any parameters. A program's phase, the law of `fdi_sparse` and the actions of a policy can be the same
attack: the same kind with the same law of values.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.agents.policy.zoo import ZooAttack
from tailgate.agents.scripts.program import Phase, Program
from tailgate.agents.scripts.scripted import Inject, InjectSparse
from tailgate.agents.scripts.triggers import Chance
from tailgate.agents.scripts.values import Constant, Gaussian, PerWire, Ramp, Uniform
from tailgate.core.registry import Spec

GROWING = ("ramp", "increment")  # actions of a policy that change the value sent last


class Shape(NamedTuple):
    """What an attack does with readings, whenever it does it."""

    kind: str
    law: type[Any] | None = None  # of the values; None: whatever they are
    chance: bool = False  # steps and wires are hit by chance


SHAPES = {  # of those families that something else can be, too
    "fdi": Shape("fdi", Constant), "fdi_bernoulli": Shape("fdi", Constant, True), "fdi_gaussian": Shape("fdi", Gaussian),
    "fdi_uniform": Shape("fdi", Uniform), "fdi_ramp": Shape("fdi", Ramp), "dos_jam": Shape("dos_jam", Uniform),
    "radar_jam": Shape("dos_jam", Uniform), "dos_hold": Shape("dos_hold"), "dropout": Shape("dropout"), "delay": Shape("delay"),
    "replay": Shape("replay"), "noise_jam": Shape("noise_jam"), "echo_delay": Shape("echo_delay", Constant),
    "echo_pull_off": Shape("echo_delay", Ramp),
}  # fmt: skip


def families(text: str) -> set[str]:
    """The families of an attack: the name that it is registered under, and all whose shape it has somewhere."""
    spec = Spec("attack", text)
    shown = _shapes(spec.make())
    same = {name for name, (kind, law, chance) in SHAPES.items() for one in shown
            if one.kind == kind and law in (None, one.law) and one.chance >= chance}  # fmt: skip
    return {spec.entry.name} | same


def _shapes(attack: Any) -> list[Shape]:
    if isinstance(attack, Program):
        phases = attack.sheet.phases
        return [Shape(phase.kind.removesuffix("_fresh"), law, _by_chance(phase)) for phase in phases for law in _laws(phase.value)]
    if isinstance(attack, InjectSparse):
        return [Shape("fdi", law, True) for law in _laws(attack.law)]
    if isinstance(attack, Inject) and attack.chance < 1.0:
        return [Shape("fdi", Constant, True)]
    policy = attack.policy if isinstance(attack, ZooAttack) else attack
    if isinstance(policy, PolicyAttack) and policy.action.action in GROWING:
        return [Shape("fdi", Ramp), Shape("echo_delay", Ramp)]
    return []


def _laws(law: Any) -> list[type[Any]]:
    """The laws of a value: of each wire, where they differ."""
    return [type(held) for _, held in law.laws] if isinstance(law, PerWire) else [type(law)]


def _by_chance(phase: Phase) -> bool:
    each = phase.probability.values() if isinstance(phase.probability, dict) else (phase.probability,)
    return min(each, default=1.0) < 1.0 or (isinstance(phase.trigger, Chance) and not phase.trigger.latch)
