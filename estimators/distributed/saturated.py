"""The saturated innovation update, carried over to a moving state.

Y. Chen, S. Kar, J. M. F. Moura, Resilient Distributed Estimation: Sensor Attacks, arXiv 1709.06156.

In the paper agents estimate a constant parameter theta from y_n = theta + noise. Each adds to its estimate a consensus term
and its innovation, whose length is cut at a threshold; all three weights shrink in time:

    x_n+ = x_n - beta_t sum_{l ~ n} (x_n - x_l) + alpha_t k_n (y_n - x_n),          k_n = min(1, gamma_t / |y_n - x_n|)

If fewer than half of the agents are attacked, all estimates converge to theta.

The carry-over: a moving state is never known for good, so that the weights cannot shrink to nothing. The fused prediction xb_i of the
distributed Kalman filter replaces the consensus term; its gain K_i replaces alpha_t. The covariance S_i of the innovation measures the
length. With the varying gain it shrinks from the prior's to the steady one, as gamma_t does:

    x_i = xb_i + k_i K_i r_i,          k_i = min(1, gamma / sqrt(r_i' S_i^-1 r_i / q))

The paper's guarantee does not carry over. What holds, whatever is injected: one step moves the estimate of the agent by at most
gamma sqrt(q lambda_max(K_i S_i K_i')).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed
from tailgate.estimators.distributed.distributed_kalman import ALARM, DistributedFilter, FusionPlan, gate_of
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanState, alone
from tailgate.estimators.parts import Detector, Filter, Mitigation

REFERENCE = "Y. Chen, S. Kar, J. M. F. Moura, Resilient Distributed Estimation: Sensor Attacks, arXiv 1709.06156, 2017"
GAMMA = "length at which an innovation is cut, sqrt(r' S^-1 r / q): 1 is what noise alone has [-]"


@register("filter", "saturated_dkf", reference=REFERENCE)
@dataclass(frozen=True)
class SaturatedFilter(DistributedFilter):
    """Distributed Kalman filter that shortens an innovation which is too long, and keeps its direction."""

    gamma: Positive = param(1.0, GAMMA)
    steady: bool = param(True, "hold gain and covariance where they settle when nothing is missed")

    def update(self, plan: FusionPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        r, S = innovation
        if not num.every(accept):
            r, S = r * accept, alone(S, accept)
        length = np.sqrt(num.quadratic(r, num.inverse(S)) / np.maximum(np.count_nonzero(accept, axis=-1), 1))
        keep = self.gamma / np.maximum(length, self.gamma)
        return super().update(plan, state, innovation._replace(r=innovation.r * keep[..., None]), accept)


@register("defence", "saturated_dkf", reference=REFERENCE)
@dataclass(frozen=True)
class SaturatedDistributedKalman(Composed):
    """Distributed Kalman filter with saturated innovations: whatever is injected moves an estimate by a bounded amount a step."""

    threshold_field: ClassVar[str] = "eta"
    gamma: Positive = param(SaturatedFilter.gamma, GAMMA)
    eta: Positive | None = param(None, ALARM)
    gain: Gain = param("steady", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return SaturatedFilter(self.gamma, self.gain == "steady"), gate_of(self.eta), AcceptAll()
