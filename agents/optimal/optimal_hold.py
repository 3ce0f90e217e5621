"""When to hold the reading of a scalar loop, by dynamic programming over the state, the held value and the budget: a ceiling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from tailgate.agents.optimal.schedules import Grid, Holding, HoldTable, Objective, Rules, best_holds
from tailgate.agents.scripts.aim import chosen, require
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Finite, Kind, Positive, PositiveCount, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief
from tailgate.envs.plants.scalar import WIRE, StateFeedback


class HoldPlan(NamedTuple):
    brief: Brief
    target: Array  # (1, w) bool
    table: HoldTable


class HoldState(NamedTuple):
    """Every leaf has B first."""

    good: Array  # (B,) the last reading that arrived
    latest: Array  # (B,) what was sent in the step before


@register("attack", "optimal_hold", optimal=True)
@dataclass(frozen=True)
class OptimalHold:
    """Holds the last good reading of a scalar loop when that makes the expected squared error of the defence largest.

    For a defence that believes the reading (`none`), whose error is then what the state has moved since. It needs to see the reading, and
    to know the public model and the feedback gain. Exact up to the grid.
    """

    sees_measurement: ClassVar[bool] = True
    objective: Objective = param("final", "final: the squared error at the horizon; sum: its sum over the horizon")
    gain: Finite = param(StateFeedback.gain, "feedback gain of the loop, which the public model does not tell [-]")
    reach: Positive = param(14.0, "half the width of the grid [standard deviations of the noise]")
    spacing: PositiveCount = param(5, "grid points to a standard deviation of the noise")

    def prepare(self, brief: Brief) -> HoldPlan:
        model, threat, where = brief.model, brief.threat, "attack optimal_hold"
        if (model.agents, model.states, model.inputs) != (1, 1, 1) or model.sensors != (WIRE,):
            raise NotApplicable(f"{where}: model", f"{model.states} states, {list(model.sensors)}", "the plant scalar_loop")
        target = chosen(brief, (), brief.granted & ~brief.is_actuator)
        require(brief, where, ["dos_hold_fresh"], target)
        if not target.any():
            raise NotApplicable(f"{where}: threat_model.targets", list(threat.targets), f"a threat model that grants {WIRE}")
        rules = Rules.of(threat, brief.horizon)
        if rules.duration < rules.budget or rules.cooldown > 1:
            raise NotApplicable(f"{where}: threat_model", "bursts that are limited", "no duration and no cooldown")
        loop = Holding(float(model.A[0, 0]), float(model.B[0, 0]) * self.gain, float(np.sqrt(model.Q[0, 0])))
        table = best_holds(loop, rules, brief.horizon, self.objective, Grid.of(loop.sd, self.reach, self.spacing))
        return HoldPlan(brief, target, table)

    def start(self, plan: HoldPlan, batch: int, draws: Draws) -> HoldState:
        return HoldState(np.zeros(batch), np.zeros(batch))

    def decide(self, plan: HoldPlan, state: HoldState, view: View, draws: Draws) -> tuple[HoldState, Command]:
        if view.received is None:
            raise InputError("threat_model.sees_measurement", False, "true: attack optimal_hold needs it")
        x = view.received.y[:, 0, 0]
        good = np.where(view.last.kind == Kind.NONE, state.latest, state.good)
        on = plan.table.decide(view.k, view.budget_left, x, good) & view.allowed
        return HoldState(good, np.array(x)), plan.brief.command(on, Kind.DOS_HOLD_FRESH, plan.target, 0.0)
