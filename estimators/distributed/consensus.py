"""The Kalman-consensus filter (R. Olfati-Saber, Kalman-Consensus Filter: Optimality, Stability, and Performance, CDC 2009).

    xh_i = xb_i + K_i (y_i - C_i xb_i) + Cons_i sum_{j ~ i} (xb_j - xb_i)          xb_i = A xh_i + B u + c
    K_i  = M_i C_i' (Sv_i + C_i M_i C_i')^-1          M_i = A P_i A' + Sw          P_i = M_i - K_i C_i M_i
    Cons_i = eps / (1 + ||M_i||_F) M_i

Each agent is a Kalman filter on its own sensors. It pulls its estimate towards the predictions of its neighbours, the harder the less it
knows; the covariance ignores that. With `share` the neighbours send their readings too (the paper's second algorithm), and K_i
uses them like the agent's own. An agent sends the readings that passed its gate.

Two things differ from the paper. The sum over the neighbours is their mean. So one gain suits every graph: for a gain up to 1 the pull
alone is a contraction. The gain is called `consensus`, not eps.

An agent that cannot see a mode by itself has a covariance that grows with it, linearly where the mode lasts. The pull then works on just
this mode. Where such a mode grows the covariance overflows in time: NotApplicable.
"""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Innovation, Model, Positive, Probability, param
from tailgate.core.reach import MARGIN, blind
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed
from tailgate.estimators.distributed.distributed_kalman import ALARM, DistributedFilter, FusionPlan, gate_of, neighbours, one_row
from tailgate.estimators.filters.kalman import KalmanState, alone, updated
from tailgate.estimators.parts import Detector, Filter, Mitigation

REFERENCE = "R. Olfati-Saber, Kalman-Consensus Filter: Optimality, Stability, and Performance, CDC 2009"
CONSENSUS = "consensus gain: pull towards the mean of the neighbours' predictions, times M / (1 + |M|); 0: none [-]"
SHARE = "neighbours send their readings as well as their predictions"


@register("filter", "consensus_kf", reference=REFERENCE)
@dataclass(frozen=True)
class ConsensusFilter(DistributedFilter):
    """Kalman-consensus filter: a local filter that is pulled towards what its neighbours predict."""

    consensus: Probability = param(1.0, CONSENSUS)
    share: bool = param(False, SHARE)

    steady = False

    def prepare(self, model: Model) -> FusionPlan:
        plan = super().prepare(model)
        if num.spectral_radius(model.A) > 1.0 + MARGIN:
            alone_at = [i for i, near in enumerate(neighbours(model.graph)) if blind(_seen(model, near if self.share else (i,)))]
            if alone_at:
                wanted = "for each agent a model whose growing modes it sees by itself" + (", or by its neighbours" if self.share else "")
                raise NotApplicable("defence consensus_kf: agents", alone_at, wanted)
        return plan

    def predict(self, plan: FusionPlan, state: KalmanState, known_u: Array) -> KalmanState:
        x, M = self.forecast(plan, state, known_u), self.spread(plan, state)
        return KalmanState(x, np.broadcast_to(M, (len(x), *M.shape[1:])))

    def update(self, plan: FusionPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        assert state.P is not None
        corrected = self._shared(plan, state, innovation, accept) if self.share else super().update(plan, state, innovation, accept)
        if not self.consensus:
            return corrected
        M, pull = one_row(state.P), num.zeros(state.x.shape)
        for i, near in enumerate(plan.heard):
            others = [j for j in near if j != i]
            for j in others:
                pull[:, i] += state.x[:, j] - state.x[:, i]
            pull[:, i] /= max(len(others), 1)
        rows = num.dot(M, M)
        gain = self.consensus / (1.0 + np.sqrt(num.dot(rows, np.ones(rows.shape[-1]))))
        return KalmanState(corrected.x + gain[..., None] * num.matvec(M, pull), corrected.P)

    def _shared(self, plan: FusionPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        """Return the Kalman update with the accepted sensors of N(i), one neighbour after the other: their noises are independent."""
        assert state.P is not None
        known = one_row(state.P) if num.every(accept) else state.P
        x, P = state.x.copy(order="K"), num.zeros(known.shape)
        for i, near in enumerate(plan.heard):
            P_i = known[:, i]
            for j in near:
                keep = accept[:, j] if len(known) > 1 else accept[:1, j]
                cross = num.matmul(plan.C[j], P_i) * keep[..., None]
                S = alone(num.matmul(cross, plan.C[j].T) + plan.R[j], keep)
                r = innovation.r[:, j] + num.matvec(plan.C[j][None], state.x[:, j] - x[:, i])
                x[:, i], P_i = updated(x[:, i], P_i, r * accept[:, j], S, cross)
            P[:, i] = P_i
        return KalmanState(x, np.broadcast_to(P, state.P.shape))


def _seen(model: Model, agents: tuple[int, ...]) -> Model:
    """Return the model of one agent that has the sensors of these."""
    q, some = model.C.shape[1] * len(agents), list(agents)
    return dataclasses.replace(
        model, C=model.C[some].reshape(1, q, -1), R=np.eye(q)[None], graph=np.eye(1, dtype=bool), gap=None, speed=None,
        sensors=tuple(map(str, range(q))),
    )  # fmt: skip


@register("defence", "consensus_kf", reference=REFERENCE)
@dataclass(frozen=True)
class ConsensusKalman(Composed):
    """Kalman-consensus filter that believes every reading and every neighbour."""

    threshold_field: ClassVar[str] = "eta"
    consensus: Probability = param(ConsensusFilter.consensus, CONSENSUS)
    share: bool = param(ConsensusFilter.share, SHARE)
    eta: Positive | None = param(None, ALARM)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return ConsensusFilter(self.consensus, self.share), gate_of(self.eta), AcceptAll()
