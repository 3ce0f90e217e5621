"""Trust between neighbours.

I. Matei, J. S. Baras, V. Srinivasan, Trust-Based Multi-Agent Filtering for Increased Smart Grid Security, MED 2012.

The paper's idea: an agent mixes its neighbours' estimates with its own, weighed by its trust in them. A neighbour that departs much from
the expected value loses trust; one with little trust is disregarded. Here the weights enter the fusion of the distributed Kalman filter
(thesis (6.19)-(6.25)). The expected value is the own prediction; the law by which trust moves is ours:

    z_ij  = max_k |xb_j,k - xb_i,k| / sqrt(M_i,kk + M_j,kk)          M_j = A P_j A' + Sw, the covariance that j gives what it sends
    T_ij  = min( (threshold / z_ij)^2,  T_ij + rate (1 - T_ij) )      T_ii = 1, and T_ij = 1 at the start: lost at once, regained slowly
    w_ij  = T_ij, or 0 where T_ij < cutoff
    Q_i   = sum_j w_ij L_j / sum_j w_ij          xb_i = Q_i^-1 sum_j w_ij L_j (A xh_j + B u + c) / sum_j w_ij

With equal trust it is the distributed Kalman filter. An agent believes its own sensors: the trust protects it from the others only, and one
whose own sensors are attacked distrusts the honest. With a gate it is `composed:filter=trust_dkf`.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Positive, Prior, Probability, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed
from tailgate.estimators.distributed.disagreement import THRESHOLD, disagreement
from tailgate.estimators.distributed.distributed_kalman import ALARM, DistributedFilter, FusionPlan, gate_of
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanState
from tailgate.estimators.parts import Detector, Filter, Mitigation

REFERENCE = "I. Matei, J. S. Baras, V. Srinivasan, Trust-Based Multi-Agent Filtering for Increased Smart Grid Security, MED 2012"
RATE = "share of the lost trust that is regained in a step without disagreement [-]"
CUTOFF = "trust below which a neighbour is disregarded [-]"


@register("filter", "trust_dkf", reference=REFERENCE)
@dataclass(frozen=True)
class TrustFilter(DistributedFilter):
    """Distributed Kalman filter that weighs each neighbour by the trust that it has earned."""

    threshold: Positive = param(3.0, THRESHOLD)
    rate: Probability = param(0.05, RATE)
    cutoff: Probability = param(0.1, CUTOFF)
    steady: bool = param(False, "hold gain and covariance where they settle when nothing is missed")

    def start(self, plan: FusionPlan, prior: Prior) -> KalmanState:
        agents = prior.mean.shape[1]
        return super().start(plan, prior)._replace(trust=num.full((len(prior.mean), agents, agents), 1.0))

    def predict(self, plan: FusionPlan, state: KalmanState, known_u: Array) -> KalmanState:
        assert state.trust is not None
        x, M = self.forecast(plan, state, known_u), self.spread(plan, state)
        z = np.maximum(disagreement(plan.heard, x, M) / self.threshold, 1.0)
        trust = np.minimum(1.0 / (z * z), state.trust + self.rate * (1.0 - state.trust))
        weight = np.where(trust < self.cutoff, 0.0, trust)
        return self.fuse(plan, x, M, weight)._replace(trust=trust)

    def update(self, plan: FusionPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        return super().update(plan, state, innovation, accept)._replace(trust=state.trust)

    def forget(self, plan: FusionPlan, state: KalmanState, where: Array) -> KalmanState:
        return super().forget(plan, state, where)._replace(trust=state.trust)


@register("defence", "trust_dkf", reference=REFERENCE)
@dataclass(frozen=True)
class TrustingDistributedKalman(Composed):
    """Distributed Kalman filter that weighs each neighbour by the trust that it has earned, and believes its own sensors."""

    threshold_field: ClassVar[str] = "eta"
    threshold: Positive = param(TrustFilter.threshold, THRESHOLD)
    rate: Probability = param(TrustFilter.rate, RATE)
    cutoff: Probability = param(TrustFilter.cutoff, CUTOFF)
    eta: Positive | None = param(None, ALARM)
    gain: Gain = param("varying", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return TrustFilter(self.threshold, self.rate, self.cutoff, self.gain == "steady"), gate_of(self.eta), AcceptAll()
