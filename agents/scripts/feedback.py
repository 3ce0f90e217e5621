"""Values that follow the road: for each wire a feedback of time, gap and speeds."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.radio import on_receivers
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Finite, Kind, PositiveCount, View, param
from tailgate.core.draws import Draws
from tailgate.core.kinds import AIRED, EFFECTS
from tailgate.core.registry import register
from tailgate.core.threat import Brief, fit

FEATURES = 5  # of `road`
UNIT, STEEPEST = 0.1, 8.0  # of a value near 0 [unit of the wire], and the largest argument of sinh: a value of 149
Form = Literal["fdi", "dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "noise_jam", "echo_delay"]
Weights = Annotated[tuple[Finite, ...], Field(min_length=FEATURES, max_length=FEATURES)]


def road(view: View, count: Array, dt: float) -> tuple[Array, ...]:
    """Return what the feedback weighs, each (B, N): 1, the seconds since the window opened, gap / 20 m, closing / 5 m/s, speed / 20 m/s."""
    scene = view.scene
    ahead = np.where(scene.gap < np.inf, scene.gap, 0.0)
    since = np.zeros(ahead.shape) + (count * dt)[:, None]
    return np.ones(ahead.shape), since, ahead / 20.0, (scene.speed - scene.lead_speed) / 5.0, scene.speed / 20.0


def fed_back(weights: Array, seen: tuple[Array, ...]) -> Array:
    """Return 0.1 sinh(w . seen), (B, N, w), for weights that broadcast to (B, N, w, FEATURES); sinh has small values and large ones."""
    argument = weights[..., 0] * seen[0][..., None]
    for i in range(1, FEATURES):
        argument = argument + weights[..., i] * seen[i][..., None]
    argument = np.clip(argument, -STEEPEST, STEEPEST)
    return np.asarray(0.5 * UNIT * (num.exp(argument) - num.exp(-argument)))


@register("attack", "feedback")
@dataclass(frozen=True)
class Feedback(Script):
    """Each wire gets a value that follows the road, 0.1 sinh(w . (1, t, gap / 20 m, closing / 5 m/s, speed / 20 m/s)), cut at the bounds.

    t [s] is the time since the window opened. The argument of sinh is cut at 8, and a gap without a car ahead counts as 0. Over the air the
    largest |value| counts. A kind without a value needs no weights.
    """

    kind: Form = param("fdi", "kind of the attack")
    weights: dict[str, Weights] | None = param(
        None, "five weights w for each wire that gets a value, by name; the others get 0. A kind with a value needs them", if_any=True
    )
    later: Form | None = param(None, "kind after `switch` steps; none: the same")
    switch: PositiveCount | None = param(None, "steps of the window before the later kind", if_any=True)

    def __post_init__(self) -> None:
        if (self.later is None) != (self.switch is None):
            raise InputError("attack feedback: later, switch", [self.later, self.switch], "both, or neither")

    def prepare(self, brief: Brief) -> ScriptPlan:
        where, wires = "attack feedback", brief.model.wires
        held = self.weights or {}
        if not held and any(EFFECTS[Kind[kind.upper()]].valued for kind in (self.kind, self.later or self.kind)):
            raise NotApplicable(f"{where}.weights", None, f"five weights for a wire, such as weights.{wires[0]}=[-3,0,0,0,0]")
        for name in held:
            if name not in wires:
                raise InputError(f"{where}.weights", name, f"wires ({', '.join(wires)})")
        target = chosen(brief, self.targets, brief.granted, self.agents)
        if {self.kind, self.later or self.kind} & {kind.name.lower() for kind in AIRED}:
            target = on_receivers(brief, where, target, bool(self.targets))
        require(brief, where, [self.kind, self.later or self.kind], target)
        for name in held:
            if not target[:, wires.index(name)].any():
                raise InputError(f"{where}.weights", name, "a wire that is attacked: see targets")
        return self.plan(brief, target, np.array([held.get(name, (0.0,) * FEATURES) for name in wires]))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        brief, first = plan.brief, Kind[self.kind.upper()]
        raw = fed_back(plan.extra, road(view, count, brief.model.dt))
        if self.later is None or self.switch is None:
            return brief.command(on, first, plan.target, sent(brief, first, raw))
        then, second = count >= self.switch, Kind[self.later.upper()]
        value = np.where(then[:, None, None], sent(brief, second, raw), sent(brief, first, raw))
        return brief.command(on, np.where(then, second, first), plan.target, value)


def sent(brief: Brief, kind: Kind, raw: Array) -> Array:
    """Return the values (B, N, w) that a kind sends; none of a kind without a value."""
    if not EFFECTS[kind].valued:
        return np.zeros(raw.shape)
    return fit(brief, kind, raw if kind in (Kind.FDI, Kind.DOS_JAM) else np.abs(raw))
