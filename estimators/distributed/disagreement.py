"""Gate and neighbour disagreement (U. A. Khan, A. M. Stankovic, Secure Distributed Estimation in Cyber-Physical Systems, ICASSP 2013).

In the paper an agent tests every input before it uses it: its measurement against its prediction (local), and a neighbour's message
against its own estimate (nodal). An input that fails is left out. Here, on the distributed Kalman filter:

    own readings      left out where r' S^-1 r > eta
    neighbour j       left out of N(i) where  z_ij = max_k |xb_j,k - c_i,k| / sqrt(M_i,kk + M_j,kk)  > threshold

Agent j sends xb_j with its covariance M_j = A P_j A' + Sw. c_i is the own prediction of i, or the median, state by state, of it and all
that i hears. With the median an agent can also find that it is wrong itself. Two agents have no majority. An agent without neighbours left
keeps its own prediction. Errors of neighbours are correlated, so that z is smaller than for independent ones: the threshold, in sigma, is
conservative.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from tailgate import num
from tailgate.core import Array, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.compose import Composed, GateOut
from tailgate.estimators.distributed.distributed_kalman import ETA, DistributedFilter, FusionPlan, gate_of
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanState
from tailgate.estimators.parts import Detector, Filter, Mitigation

REFERENCE = "U. A. Khan, A. M. Stankovic, Secure Distributed Estimation in Cyber-Physical Systems, ICASSP 2013"
THRESHOLD = "largest disagreement of any state, in standard deviations of the difference [-]"
CENTRE = "own: neighbours are compared with the own prediction; median: all, oneself included, with the median of what is heard"

Centre = Literal["own", "median"]


def disagreement(heard: tuple[tuple[int, ...], ...], x: Array, M: Array, centre: Centre = "own") -> Array:
    """Return z (B, N, N): the distance in sigma of what j sends from what i compares it with, for j in N(i); 0 elsewhere.

    x (B, N, n) is what is sent, M (B or 1, N, n, n) its covariance.
    """
    variance = M.diagonal(axis1=-2, axis2=-1)
    out = num.zeros((len(x), x.shape[1], x.shape[1]))
    for i, near in enumerate(heard):
        middle = x[:, i] if centre == "own" else _median(x[:, near])
        for j in near:
            if centre == "median" or j != i:
                out[:, i, j] = np.max(np.abs(x[:, j] - middle) / np.sqrt(variance[:, i] + variance[:, j]), axis=-1)
    return out


def _median(x: Array) -> Array:
    """Return the median over the middle axis of (B, d, n)."""
    ranked, half = np.sort(x, axis=1), x.shape[1] // 2
    return np.asarray(ranked[:, half] if x.shape[1] % 2 else 0.5 * (ranked[:, half - 1] + ranked[:, half]))


@register("filter", "disagreement_dkf", reference=REFERENCE)
@dataclass(frozen=True)
class DisagreementFilter(DistributedFilter):
    """Distributed Kalman filter that leaves out what disagrees with the rest."""

    threshold: Positive = param(3.0, THRESHOLD)
    centre: Centre = param("own", CENTRE)
    steady: bool = param(False, "hold gain and covariance where they settle when nothing is missed")

    def predict(self, plan: FusionPlan, state: KalmanState, known_u: Array) -> KalmanState:
        x, M = self.forecast(plan, state, known_u), self.spread(plan, state)
        return self.fuse(plan, x, M, self.weights(plan, x, M))

    def weights(self, plan: FusionPlan, x: Array, M: Array) -> Array:
        """Return (B, N, N): 1 for the agents that an agent uses, 0 for the others."""
        use = disagreement(plan.heard, x, M, self.centre) <= self.threshold
        nobody = num.zeros(use.shape[:2], bool)
        for i, near in enumerate(plan.heard):
            nobody[:, i] = ~use[:, i, near].any(axis=-1)
        own = np.eye(use.shape[1], dtype=bool)
        return np.where(nobody[..., None], own, use).astype(np.float64)


@register("defence", "disagreement_dkf", reference=REFERENCE)
@dataclass(frozen=True)
class DisagreeingDistributedKalman(Composed):
    """Gated distributed Kalman filter that leaves out the neighbours who disagree with the rest."""

    threshold_field: ClassVar[str] = "eta"
    threshold: Positive = param(DisagreementFilter.threshold, THRESHOLD)
    centre: Centre = param(DisagreementFilter.centre, CENTRE)
    eta: Positive | None = param(None, ETA)
    gain: Gain = param("varying", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return DisagreementFilter(self.threshold, self.centre, self.gain == "steady"), gate_of(self.eta), GateOut()
