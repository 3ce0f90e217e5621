"""Centralised references: one estimator reads the sensors of all agents, and everybody gets its estimate.

The sensors of all N agents are stacked to the N q sensors of one agent. For it (5.7) is the Kalman filter and (6.26) the robust one, in
steady state. It begins at the mean of the agents' priors, and knows the input of agent 0: in a platoon the leader's own command. It hears
more than any agent of the network does: it is a reference, not a competitor.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, ComposedPlan, ComposedState, Score, compose
from tailgate.estimators.distributed.distributed_kalman import DistributedKalmanFilter
from tailgate.estimators.distributed.lasso import Lasso, LassoFilter
from tailgate.estimators.parts import Filter

USES = ("measurements", "redundant", "leader_input")


class CentralPlan(NamedTuple):
    one: Composed
    plan: ComposedPlan  # plan of the one
    agents: int


def stacked(model: Model) -> Model:
    """Return the same system with a single agent, which has the sensors of all in the order of the agents."""
    N, q, n = model.C.shape
    R = np.zeros((1, N * q, N * q))
    for i in range(N):
        R[0, i * q : (i + 1) * q, i * q : (i + 1) * q] = model.R[i]
    names = tuple(f"{name} of {i}" for i in range(N) for name in model.sensors)
    return Model(model.A, model.B, model.c, model.C.reshape(1, N * q, n), model.Q, R, np.ones((1, 1), bool), model.dt, names)


def together(x: Array) -> Array:
    """Reshape (B, N, q) to (B, 1, N q)."""
    return num.stack([x[:, i, j] for i in range(x.shape[1]) for j in range(x.shape[2])])[:, None]


class Central:
    """Base of the centralised defences: a subclass gives the one agent's filter. It shows no innovation (look), being nobody's own."""

    def filter(self) -> Filter:
        """Return the filter of the stacked system."""
        raise TypeError(f"{type(self).__name__} must define filter()")

    def prepare(self, model: Model) -> CentralPlan:
        one = compose(self.filter(), Score(), AcceptAll())
        return CentralPlan(one, one.prepare(stacked(model)), model.agents)

    def start(self, plan: CentralPlan, prior: Prior) -> ComposedState:
        mean = prior.mean[:, :1]
        for i in range(1, plan.agents):
            mean = mean + prior.mean[:, i : i + 1]
        return plan.one.start(plan.plan, Prior(mean / plan.agents, prior.cov[:, :1]))

    def step(
        self, plan: CentralPlan, state: ComposedState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[ComposedState, Estimate]:
        heard = Received(together(received.y), together(received.valid), received.energy[:, :1])
        state, told = plan.one.step(plan.plan, state, heard, known_u[:, :1], draws)
        return state, Estimate(*(None if x is None else np.repeat(x, plan.agents, axis=1) for x in told))  # type: ignore[arg-type]


@register("defence", "centralised_kf", uses=USES, reference="Dutta 2018, (5.7), with the sensors of all agents")
@dataclass(frozen=True)
class CentralisedKalman(Central):
    """Kalman filter that sees the sensors of all agents and believes every one: what the distributed filter approximates."""

    def filter(self) -> Filter:
        return DistributedKalmanFilter()


@register("defence", "centralised_lasso", uses=USES, reference="Dutta 2018, (6.26), with the sensors of all agents")
@dataclass(frozen=True)
class CentralisedLasso(Lasso, Central):
    """Estimator that sees the sensors of all agents and takes sparse attacks out of them: what the distributed one approximates."""

    def filter(self) -> Filter:
        return LassoFilter(self.lam, self.unit, self.solver)
