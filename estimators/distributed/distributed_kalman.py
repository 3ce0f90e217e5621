"""The distributed Kalman filter of a network (thesis (5.5)-(5.7), (6.19)-(6.25)), the base of the distributed estimators.

    L_j  = (A P_j A' + Sw)^-1          Q_i = (1/d_i) sum_{j in N(i)} L_j          W_ij = Q_i^-1 L_j / d_i
    xb_i = sum_j W_ij (A xh_j + B u + c)                                                              sum_j W_ij = I
    xh_i = xb_i + Q_i^-1 C_i' (Sv_i + C_i Q_i^-1 C_i')^-1 (y_i - C_i xb_i)                                         (5.7)
    P_i  = [ Q_i + C_i' Sv_i^-1 C_i ]^-1                                                                           (5.5)

N(i) = {i} + in-neighbours, d_i = |N(i)|. What arrives from the neighbours, xb_i with the covariance Q_i^-1, takes the place of the
prediction of a Kalman filter: innovation, gain and update are that filter's (kalman.py). Erratum: the sum in (5.5) runs over j with P_j.

Steady filters hold P_i at the fixed point of (5.5). With all L_j but its own, a node's equation is that of a Kalman filter with sqrt(d_i) A
and d_i Sw. It is solved by doubling, node after node, until nothing moves. Then (5.5) itself is iterated on the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.base.memo import remembered
from tailgate.core import Array, Innovation, Model, Positive, Prior, Probability, Received, param
from tailgate.core.reach import require_detectable
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, GateOut, Score
from tailgate.estimators.detectors.chi_square import ChiSquare
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanState, LinearFilter, alone, broad, gain_of, precision, riccati, updated
from tailgate.estimators.parts import Detector, Filter, Memoryless, Mitigation, Verdict, blame_all, normalised

SWEEPS = 200
SETTLED = 1e-13  # relative


class Fusion(NamedTuple):
    """Constants of the steady filter: L (N, n, n), Qinv (N, n, n) and P (N, n, n)."""

    L: Array
    Qinv: Array
    P: Array


class FusionPlan(NamedTuple):
    """The constants of LinearFilter, and the network."""

    A: Array
    B: Array
    c: Array
    C: Array  # (N, q, n)
    Q: Array
    R: Array
    broad: Array
    hears: Array  # (N, N) bool: the graph, with each agent hearing itself
    heard: tuple[tuple[int, ...], ...]  # N(i)
    held: Array | None = None  # (N, n, n) Q_i^-1 of the steady filter
    K: Array | None = None  # (N, q, n) its gain for all sensors
    merge: Array | None = None  # (N, n, n) Q_i^-1 / d_i
    L: Array | None = None  # (N, n, n) L_j
    M: Array | None = None  # (N, n, n) its inverse
    cross: Array | None = None  # (N, q, n) C_i Q_i^-1
    S: Array | None = None  # (N, q, q)


def neighbours(graph: Array) -> tuple[tuple[int, ...], ...]:
    """Return N(i) of each agent, itself included, in ascending order."""
    return tuple(tuple(np.flatnonzero(row).tolist()) for row in np.array(graph, bool) | np.eye(len(graph), dtype=bool))


def information(model: Model) -> Array:
    """Return C_i' Sv_i^-1 C_i (N, n, n)."""
    return np.stack([num.product(num.product(C.T, precision(R)), C) for C, R in zip(model.C, model.R, strict=True)])


def _inverse(M: Array) -> Array:
    out = num.inverse(M)
    return np.asarray(0.5 * (out + out.T))


def _predicted(model: Model, P: Array) -> Array:
    M = num.product(num.product(model.A, P), model.A.T) + model.Q
    return np.asarray(0.5 * (M + M.T))


@remembered("A", "C", "Q", "R", "graph")  # every cell of an evaluation asks again, and a long string takes minutes
def fixed_point(model: Model) -> Fusion:
    """Return P_i (N, n, n) of (5.5), with L_j and Q_i^-1. Raise InputError, naming the agents, where there is none."""
    require_detectable(model, "model")
    heard, G = neighbours(model.graph), information(model)
    L = np.stack([_inverse(model.Q)] * model.agents)  # L for P = 0
    P = np.zeros_like(L)
    due = np.ones(model.agents, bool)  # their neighbours have moved since; one sweep is enough where everybody hears cars ahead only
    for _ in range(SWEEPS):
        moved = 0.0
        for i, near in enumerate(heard):
            if not due[i]:
                continue
            d = len(near)
            others = np.zeros_like(model.Q)
            for j in near:
                if j != i:
                    others = others + L[j]
            H = G[i] + others / d
            M = riccati(np.sqrt(d) * model.A, H, d * model.Q)
            if M is None:
                raise InputError("model", f"agent {i}", "a system for which (5.5) settles")
            sent, before = d * _inverse(M), L[i].copy()
            new = _inverse(H + sent / d)
            moved = max(moved, _change(new, P[i]))
            L[i], P[i] = sent, new
            if (sent != before).any():
                due |= np.array([i in other for other in heard])
            due[i] = False
        if moved <= SETTLED:
            break
    else:
        raise InputError("model", f"{model.agents} agents", f"a network for which (5.5) settles within {SWEEPS} sweeps")
    for _ in range(3):
        L = np.stack([_inverse(_predicted(model, P_i)) for P_i in P])
        Q = np.stack([_mean(L, near) for near in heard])
        P = np.stack([_inverse(Q_i + G_i) for Q_i, G_i in zip(Q, G, strict=True)])
    return Fusion(L, np.stack([_inverse(Q_i) for Q_i in Q]), P)


def _mean(L: Array, near: tuple[int, ...]) -> Array:
    out = np.zeros_like(L[0])
    for j in near:
        out = out + L[j]
    return np.asarray(out / len(near))


def _change(new: Array, old: Array) -> float:
    """Return the largest change of an element, relative to its row's and column's size."""
    size = np.sqrt(new.diagonal())
    return float(np.max(np.abs(new - old) / (size[:, None] * size)))


class DistributedFilter(LinearFilter[FusionPlan]):
    """The recursion. A subclass sets in `steady` if P is held, and may change what is fused, and the update."""

    steady: bool

    def prepare(self, model: Model) -> FusionPlan:
        plan = FusionPlan(
            model.A, model.B, model.c, model.C, model.Q, model.R, broad(model), model.graph | np.eye(model.agents, dtype=bool),
            neighbours(model.graph),
        )  # fmt: skip
        if not self.steady:
            require_detectable(model, "model")
            return plan
        L, Qinv, _ = fixed_point(model)
        degree = np.array([len(near) for near in plan.heard])
        cross = num.matmul(model.C, Qinv)
        S = num.matmul(model.C, num.transpose(cross)) + model.R
        return plan._replace(
            held=Qinv, K=np.ascontiguousarray(gain_of(S, cross)), merge=Qinv / degree[:, None, None],
            L=L, M=np.stack([_inverse(L_j) for L_j in L]), cross=cross, S=S,
        )  # fmt: skip

    def start(self, plan: FusionPlan, prior: Prior) -> KalmanState:
        return KalmanState(prior.mean, shared(prior.cov) if plan.held is None else None)

    def predict(self, plan: FusionPlan, state: KalmanState, known_u: Array) -> KalmanState:
        """Return xb_i, and Q_i^-1 as the predicted covariance."""
        if plan.held is not None:
            assert plan.L is not None and plan.merge is not None
            return KalmanState(num.predicted(plan.A, plan.B, plan.c, plan.L, plan.merge, plan.hears, state.x, known_u), None)
        x, P = self.forecast(plan, state, known_u), self._predicted(plan, state)
        if len(P) < len(x):
            return self.fuse(plan, x, self.spread(plan, state))
        return KalmanState(*num.fused(plan.hears, x, P, step=(plan.A, plan.Q)))

    def forecast(self, plan: FusionPlan, state: KalmanState, known_u: Array) -> Array:
        """Return what each agent sends, A xh_j + B u_j + c (B, N, n)."""
        return num.apply(plan.A[None], state.x) + num.matvec(plan.B, known_u) + plan.c

    def spread(self, plan: FusionPlan, state: KalmanState) -> Array:
        """Return L_j^-1 = A P_j A' + Sw (B or 1, N, n, n): the covariance that each agent gives what it sends."""
        if plan.held is not None:
            assert plan.M is not None
            return plan.M[None]
        return num.congruent(plan.A, self._predicted(plan, state), plan.Q)

    def fuse(self, plan: FusionPlan, x: Array, M: Array, weight: Array | None = None) -> KalmanState:
        """Return xb_i and Q_i^-1 of what is sent, x (B, N, n) with its `spread` M.

        With `weight` (B, N, N) the means are weighted: Q_i = sum_j w_ij L_j / sum_j w_ij over N(i), and xb_i with them. Where an agent's
        weights are all equal, every bit is that of the fusion without weights.
        """
        if plan.held is not None:
            assert plan.merge is not None and plan.L is not None
            z = num.apply(plan.L, x)
            out = KalmanState(num.apply(plan.merge, gather(plan.heard, z)), None)
            return out if weight is None else self._reweigh(plan, out, z, weight)
        alike = None if weight is None else even(plan.heard, weight)
        if weight is None or alike is None or (len(M) < len(x) and num.every(alike)):  # the last: one covariance for all rows
            return KalmanState(*num.fused(plan.hears, x, M))
        share, total = np.where(alike[..., None], 1.0, weight), num.zeros(alike.shape)
        for i, near in enumerate(plan.heard):
            for j in near:
                total[:, i] += share[:, i, j]
        return KalmanState(*num.fused(plan.hears, x, M, (share, total, np.where(alike, -0.0, 0.0))))

    def _reweigh(self, plan: FusionPlan, out: KalmanState, z: Array, weight: Array) -> KalmanState:
        """Repeat the steady fusion of z_j = L_j x_j (B, N, n) where an agent's weights differ from each other."""
        assert plan.L is not None
        x, P, alike = out.x, None, even(plan.heard, weight)
        for i, near in enumerate(plan.heard):
            rows = ~alike[:, i]
            if not num.some(rows):
                continue
            w = weight[:, i]
            total, Q, y = np.zeros(len(w)), np.zeros((len(w), *plan.Q.shape)), np.zeros((len(w), z.shape[2]))
            for j in near:
                total += w[:, j]
                Q += w[:, j, None, None] * plan.L[j]
                y += w[:, j, None] * z[:, j]
            total = np.where(rows, total, 1.0)
            Qinv = num.inverse(Q / total[:, None, None])
            if P is None:
                P = num.full((*x.shape, x.shape[2]), plan.held)
            P[:, i] = np.where(rows[:, None, None], Qinv, P[:, i])
            x[:, i] = np.where(rows[:, None], num.matvec(Qinv, y / total[:, None]), x[:, i])
        return out if P is None else KalmanState(x, P)

    def innovation(self, plan: FusionPlan, state: KalmanState, received: Received) -> Innovation:
        r = np.where(received.valid, received.y - num.apply(plan.C, state.x), 0.0)
        S = plan.S
        if S is None or state.P is not None:
            S = num.matmul(plan.C, num.transpose(self._cross(plan, state))) + plan.R
        return Innovation(r, alone(np.broadcast_to(S, (*r.shape, r.shape[-1])), received.valid))

    def update(self, plan: FusionPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        """Return the Kalman filter's update. Constant gains, and a covariance that all rows share, save work and change no bit."""
        r, S = innovation
        if plan.held is not None and state.P is None:
            assert plan.K is not None and plan.cross is not None
            x = num.apply(plan.K, r, state.x)
            return KalmanState(num.elsewhere(accept.all(axis=-1), x, _corrected, state.x, r, S, plan.cross[None], accept), None)
        assert state.P is not None
        known = one_row(state.P)
        if len(known) < len(r) and num.every(accept) and len(one_row(S)) == 1:
            x, P = updated(state.x, known, r, S[:1], num.matmul(plan.C, known))
            P = np.broadcast_to(P, state.P.shape)
        else:
            x, P = num.corrected(plan.C, num.inverse(alone(S, accept)), state.x, known, r, accept)
        return KalmanState(x, P if plan.held is None else None)

    def _predicted(self, plan: FusionPlan, state: KalmanState) -> Array:
        return one_row(super()._predicted(plan, state))


def one_row(P: Array) -> Array:
    """Return the first row of a covariance that all rows of a batch share in memory, else all rows."""
    return P[:1] if P.ndim == 4 and len(P) > 1 and P.strides[0] == 0 else P


def shared(P: Array) -> Array:
    """Return P (B, ...) with its rows shared in memory where they are all equal."""
    return np.broadcast_to(P[:1], P.shape) if len(P) > 1 and (P[:1] == P).all() else P


def _corrected(x: Array, r: Array, S: Array, cross: Array, accept: Array) -> Array:
    return np.asarray(x + num.matvec(gain_of(alone(S, accept), cross * accept[..., None]), r * accept))


def even(heard: tuple[tuple[int, ...], ...], weight: Array) -> Array:
    """Return (B, N) bool: agent i weighs all j in N(i) alike, by weight (B, N, N)."""
    return np.stack([(weight[:, i, near] == weight[:, i, near[:1]]).all(axis=1) for i, near in enumerate(heard)], axis=1)


def gather(heard: tuple[tuple[int, ...], ...], z: Array) -> Array:
    """Return in row i the sum of z_j (B, N, n) over N(i), in ascending order."""
    out = num.zeros(z.shape)
    for i, near in enumerate(heard):
        for j in near:
            out[:, i] += z[:, j]
    return out


@register("filter", "dkf", reference="Dutta 2018, (5.5)-(5.7), (6.19)-(6.25)")
@dataclass(frozen=True)
class DistributedKalmanFilter(DistributedFilter):
    """Distributed Kalman filter: neighbours' predictions are fused, and the own sensors correct them."""

    steady: bool = param(True, "hold gain and covariance where they settle when nothing is missed")


@register("defence", "dkf", reference="Dutta 2018, (5.5)-(5.7), (6.19)-(6.25)")
@dataclass(frozen=True)
class DistributedKalman(Composed):
    """Distributed Kalman filter that believes every measurement and every neighbour."""

    gain: Gain = param("steady", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return DistributedKalmanFilter(self.gain == "steady"), Score(), AcceptAll()


@register("detector", "chi2_tail", reference="Dutta 2018, section 4.2")
@dataclass(frozen=True)
class TailChiSquare(Memoryless):
    """Alarms when the normalised innovation squared exceeds the quantile of chi-square that belongs to a false-alarm probability.

    The same for any number of sensors: the thesis's threshold 20 for two sensors is 22.8 for three, and 44.7 for fourteen. The probability
    is met where S is the innovation's covariance and all readings arrive. Distributed filters have an S that is too large (`dkf`) or, where
    they cut corrections, too small.
    """

    tail: Probability = param(4.54e-5, "nominal probability of a false alarm per step and agent, above 0; exp(-10) is the thesis's [-]")

    def prepare(self, model: Model) -> float:
        """Return the threshold eta."""
        if not 0.0 < self.tail < 1.0:
            raise InputError("detector chi2_tail.tail", self.tail, "a probability between 0 and 1")
        from scipy import special  # not loaded where no threshold is made

        return float(special.chdtri(len(model.sensors), self.tail))

    def step(self, plan: float, state: None, innovation: Innovation) -> tuple[None, Verdict]:
        score = normalised(innovation)
        return None, blame_all(score, score > plan, innovation)

    def gate(self, plan: float, state: None) -> float:
        return plan


QUANTILE = "none: the quantile of chi-square with as many degrees of freedom as sensors that leaves exp(-10) [-]"
ETA, ALARM = (f"{what} above this r' S^-1 r; {QUANTILE}" for what in ("readings are ignored", "alarm"))


def gate_of(eta: float | None) -> Detector:
    """Return the gate of the distributed defences."""
    return TailChiSquare() if eta is None else ChiSquare(eta)


@register("defence", "chi2_dkf", reference="Dutta 2018, (6.19)-(6.25) with the gate of Algorithm 3")
@dataclass(frozen=True)
class GatedDistributedKalman(Composed):
    """Distributed Kalman filter in which an agent ignores its own readings where r' S^-1 r exceeds eta.

    With the varying gain an agent whose gate is shut knows that it knows less: its gate widens, and its neighbours weigh it less. With the
    steady gain neither holds, and a manoeuvre that nobody knew of can lock the gate for good.
    """

    threshold_field: ClassVar[str] = "eta"
    eta: Positive | None = param(None, ETA)
    gain: Gain = param("varying", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return DistributedKalmanFilter(self.gain == "steady"), gate_of(self.eta), GateOut()
