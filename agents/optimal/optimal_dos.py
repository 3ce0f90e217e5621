"""The schedule of losses that does a Kalman filter the most harm: a ceiling for attackers that jam within a budget."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tailgate import num
from tailgate.agents.optimal.schedules import Filtering, Objective, Rules, best_losses
from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Command, Kind, Model, Positive, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief
from tailgate.estimators.filters.kalman import steady_state


@register(
    "attack", "optimal_dos", optimal=True,
    reference="H. Zhang, P. Cheng, L. Shi, J. Chen, Optimal Denial-of-Service Attack Scheduling with Energy Constraint, 2015",
)  # fmt: skip
@dataclass(frozen=True)
class OptimalDos(Script):
    """Loses the readings whose loss makes the trace of a Kalman filter's error covariance largest, by dynamic programming.

    The public model is enough: the covariance does not depend on what is read. Onset, end, budget, longest burst and pause of the threat
    model are kept. The system has no input, and one agent watches it.
    """

    objective: Objective = param("final", "final: the trace at the horizon; sum: its sum over the horizon")
    prior_var: Positive | None = param(None, "variance of every state before the first step; none: that of the filter at rest")
    share: Positive = param(1e-6, "share of the optimum that the search may miss [-]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        model, where = brief.model, "attack optimal_dos"
        if model.agents != 1 or model.inputs:
            raise NotApplicable(f"{where}: model", f"{model.agents} agents, {model.inputs} inputs", "one agent, and a system without input")
        target = chosen(brief, self.targets, brief.granted, self.agents)
        require(brief, where, ["dropout"], target)
        lost = target[0, : len(model.sensors)]
        if not lost.any():
            raise NotApplicable(f"{where}: targets", list(self.targets), "a sensor")
        system = Filtering(model.A, model.C[0], model.Q, model.R[0], lost)
        schedule = best_losses(
            system, self._before(model, system), Rules.of(brief.threat, brief.horizon), brief.horizon, self.objective,
            self.share / brief.horizon,
        )  # fmt: skip
        return ScriptPlan(brief, target, schedule)

    def _before(self, model: Model, system: Filtering) -> Array:
        """Return the covariance (n, n) before the first step."""
        if self.prior_var is not None:
            return np.diag(np.full(model.states, self.prior_var))
        return np.asarray(system.updated(steady_state(model), np.ones_like(system.lost))[0])

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return plan.brief.command(on & num.take(plan.extra, view.k - 1), Kind.DROPOUT, plan.target, 0.0)
