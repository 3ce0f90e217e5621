"""A ghost: the readings of a second state are added to the true ones. Where every sensor lies, no reading can separate the two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.scripts.aim import require
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Command, Count, Kind, NonNegative, Positive, View, param
from tailgate.core.draws import Draws, constants
from tailgate.core.quantities import Settling
from tailgate.core.registry import register
from tailgate.core.threat import Brief


def grown(count: Array | int, dt: float, grow: Array | float) -> Any:
    """Return the share of its size that a ghost has `count` steps after it began. grow: [s]; 0: at once."""
    return np.minimum((count + 1) * dt / np.where(grow > 0.0, grow, dt), 1.0)


def within(brief: Brief, values: Array) -> int:
    """Return the steps of readings (K, N, w) before one leaves the bounds."""
    beyond = (np.abs(values) > brief.bounds).any(axis=(1, 2))
    return int(np.argmax(beyond)) if beyond.any() else len(values)


class Ghost(NamedTuple):
    """The values added to the readings, by the step of the window; the last one that the bounds admit is the end."""

    value: Array  # (K, N, w)


@register("attack", "ghost", reference="Y. Mo and B. Sinopoli, False Data Injection Attacks in Control Systems, 2010")
@dataclass(frozen=True)
class GhostState(Script):
    """Adds C_i g to the readings of every attacked agent, where g+ = A g lives in the modes that last longest, and grows in over some time.

    A linear filter follows g. One that limits the change of a step follows as fast as its limit lets it, without an end. The attack has the
    same direction in every step. Grown in slowly it passes a gate. It ends before the threat model's bound is met.
    """

    size: Positive = param(100.0, "2-norm of g when it is fully grown [unit of the state]")
    grow: NonNegative = param(0.0, "time over which it grows in, linearly [s]; 0: at once")
    mode: Count = param(0, "seed of the direction within the modes that last longest")
    settle: Settling = param(400, "steps of A that leave only these modes of a random direction")

    def prepare(self, brief: Brief) -> ScriptPlan:
        target, values = self.readings(brief)
        last = within(brief, values)
        if last == 0:
            raise NotApplicable("attack ghost.size", self.size, "a ghost whose readings stay within the bounds of the threat model")
        return ScriptPlan(brief, target, Ghost(values[:last]))

    def readings(self, brief: Brief) -> tuple[Array, Array]:
        """Return the sensors (N, w) bool that are attacked, and their readings (K, N, w) in a horizon."""
        model, where = brief.model, "attack ghost"
        target = super().prepare(brief).target & (np.arange(len(model.wires)) < len(model.sensors))
        if not target.any():
            raise NotApplicable(f"{where}: targets", list(brief.threat.targets), "a threat model that grants sensors")
        require(brief, where, ["fdi"], target)
        g, values = self._direction(model.A), np.zeros((brief.horizon, *target.shape))
        for k in range(brief.horizon):
            share = grown(k, model.dt, self.grow)
            for i in range(model.agents):
                values[k, i, : len(model.sensors)] = share * num.matvec(model.C[i], g)
            g = num.matvec(model.A, g)
        return target, np.where(target, values, 0.0)

    def _direction(self, A: Array) -> Array:
        """Return a direction (n,) of norm `size`, after many steps of A from a random direction."""
        g = constants("ghost", self.mode).normal((len(A),))[0]
        for _ in range(self.settle):
            g = num.matvec(A, g)
            length = float(np.sqrt(num.dot(g, g)))
            if length == 0.0:
                raise NotApplicable("attack ghost: model", "a system that forgets everything", "modes that last")
            g = g / length
        return np.asarray(self.size * g)

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        ghost: Ghost = plan.extra
        on = on & (count < len(ghost.value))
        value = num.take(ghost.value, np.minimum(count, len(ghost.value) - 1))
        return plan.brief.command(on, Kind.FDI, plan.target, value)
