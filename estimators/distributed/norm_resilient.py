"""The resilient distributed estimator of chapter 5 (thesis (5.8)): a 2-norm in place of the squares bounds what any attack can do.

    xh_i = argmin_x  lam || Sv_i^-1/2 (y_i - C_i x) ||_2 + (x - xb_i)' Q_i (x - xb_i)                              (5.8)

xb_i and Q_i^-1 are what the neighbours' predictions fuse to (distributed.py). With M = Sv^-1/2 C and the whitened innovation
r = Sv^-1/2 (y - C xb) the dual problem is

    max_{|u| <= 1} lam u'r - (lam^2/4) u' G u,      G = M Q^-1 M' = V diag(g) V',      xh = xb + (lam/2) Q^-1 M' u

In the axes of V, with w = V'r and c = lam g / 2, u_k = w_k / (c_k + mu) with the least mu >= 0 at which |u| <= 1. mu = 0 is an exact fit,
y = C xh. Else Newton's iteration on 1/|u| = 1, concave in mu, from the lower bound mu0 = max(|w| - max c, max_k (|w_k| - c_k), 0) rises
to the solution and needs no safeguard. An axis that the prediction cannot move along, g_k = 0, has u_k = w_k / mu, and 0 where w_k = 0.

Sensors that are not accepted leave the problem: each set of sensors of an agent has its own V and g. Erratum: (5.11) of the thesis has the
factors in an order that does not multiply; the bound is in tailgate.thesis.resilience.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Model, Positive, Prior, Received, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, Score
from tailgate.estimators.distributed.distributed_kalman import DistributedKalmanFilter, FusionPlan, one_row
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanState, alone
from tailgate.estimators.filters.robust import ACCURACY, load_cvxpy
from tailgate.estimators.parts import Detector, Filter, Mitigation

ROUNDS = 100  # largest number of Newton's rounds; about five are enough


class Axes(NamedTuple):
    """Constants of P problems: turn = V' Sv^-1/2 (P, q, q), half = g / 2 (P, q) and push = Q^-1 M' V / 2 (P, n, q)."""

    turn: Array
    half: Array
    push: Array


def axes(C: Array, R: Array, spread: Array) -> Axes:
    """Return the constants for C (P, q, n), R (P, q, q) and a root of Q^-1, spread' spread (P, n, n).

    Any root of Sv^-1 gives the same norm.

    V makes the rows of V' M Q^-1/2 orthogonal. G itself is not formed: its small eigenvalues would drown in the rounding of the large ones.
    """
    _, white = num.root(R)
    rows, turn = num.orthogonal(num.matmul(num.matmul(white, C), num.transpose(spread)), white)
    return Axes(turn, 0.5 * num.dot(rows, rows), 0.5 * num.transpose(num.matmul(rows, spread)))


@np.errstate(all="ignore")  # rows that have stopped, and prices beyond all measure
def in_ball(w: Array, c: Array) -> Array:
    """Return u_k = w_k / (c_k + mu), 0/0 = 0, with the least mu >= 0 at which |u| <= 1; w (B, P, q), c (B or 1, P, q) >= 0."""
    there, q = w != 0.0, range(w.shape[-1])

    def parts(mu: Array) -> Array:
        return np.where(there, w / np.where(there, c + mu[..., None], 1.0), 0.0)

    exact = _summed(parts(np.zeros(w.shape[:-1])), 2)
    outside = exact > 1.0
    short = np.maximum(0.0, np.abs(w[..., 0]) - c[..., 0])
    for k in q[1:]:
        short = np.maximum(short, np.abs(w[..., k]) - c[..., k])
    least = np.maximum(short, np.sqrt(num.dot(w, w)) - np.max(c, axis=-1))

    def newton(mu: Array, size: Array) -> tuple[Array, list[Array]]:
        z = parts(mu)
        s = _summed(z, 2)
        t = z * z / np.where(there, c + mu[..., None], 1.0)
        size = np.sqrt(s)
        step = s * (size - 1.0) / _summed(t, 1)
        further = step > 1e-15 * mu
        return further, [np.where(further, mu + step, mu), size]

    mu, size = num.until(newton, [np.where(outside, least, 0.0), np.ones(outside.shape)], outside, ROUNDS)
    return np.asarray(parts(mu) / size[..., None])


def _summed(x: Array, power: int) -> Array:
    """Return sums of x (..., q) or its squares, in ascending order."""
    return num.dot(x, x if power == 2 else np.ones_like(x))


def moved(problem: Axes, r: Array, lam: float) -> tuple[Array, Array]:
    """Return xh - xb (B, P, n) and u (B, P, q), in the axes of V, for the innovations r = y - C xb (B, P, q)."""
    u = in_ball(num.apply(problem.turn, r), lam * problem.half[None])
    return lam * num.apply(problem.push, u), u


@cache
def _problem(q: int, n: int) -> tuple[Any, Any, Any, Any]:
    """Return the cvxpy problem of q sensors and n states: 2 |r - H z| + z'z, its parameters H and r, and z."""
    cp = load_cvxpy()
    z, H, r = cp.Variable(n), cp.Parameter((q, n)), cp.Parameter(q)
    return cp.Problem(cp.Minimize(2.0 * cp.norm(r - cp.matmul(H, z), 2) + cp.sum_squares(z))), H, r, z


def moved_by_cvxpy(C: Array, R: Array, Qinv: Array, r: Array, lam: float) -> Array:
    """Return xh - xb (n,) of one problem by an interior-point solver (Clarabel), to its tolerance. C (q, n), R (q, q), r (q,)."""
    from scipy.linalg import cholesky, solve_triangular

    if not C.any():  # no sensor, or one that sees nothing
        return np.zeros(len(Qinv))
    white, root = cholesky(R, lower=True), cholesky(Qinv, lower=True)
    H = num.product(solve_triangular(white, C, lower=True), root)
    size = float(np.sqrt(np.max(num.dot(H, H))))  # the solver wants numbers near 1
    problem, parameter, offset, z = _problem(*H.shape)
    parameter.value, offset.value = H / size, solve_triangular(white, r, lower=True) * (2.0 / (lam * size * size))
    problem.solve(solver="CLARABEL", warm_start=False, **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), ACCURACY))
    return np.asarray(num.matvec(root, z.value) * (0.5 * lam * size))


def _times(m: Array, v: Array) -> Array:
    """Return m (M, i, k) times v (M, k), as `num.apply`: sums run from 0, and zeros of m are skipped."""
    out = np.zeros(m.shape[:2])
    for k in range(m.shape[2]):
        out = np.where(m[..., k] != 0.0, out + m[..., k] * v[:, k, None], out)
    return out


class NormPlan(NamedTuple):
    """The distributed filter's plan; of the steady filter also the root of Q^-1 (N, n, n), and the problems with all sensors."""

    linear: FusionPlan
    spread: Array | None
    whole: Axes | None


@dataclass(frozen=True)
class Norm:
    """The price of the innovation, and the solver."""

    lam: Positive = param(
        0.4, "price of the norm of the whitened innovation [-]: two attacks differ in one step by at most lam |Q_i^-1 C_i' Sv_i^-1/2|; a "
        "small one is resilient, a large one converges from farther off (0.4 is the thesis's)"
    )  # fmt: skip
    solver: Literal["exact", "cvxpy"] = param("exact", "exact: the secular equation; cvxpy: an interior-point solver, slow")

    def __post_init__(self) -> None:
        if self.solver == "cvxpy":
            load_cvxpy()  # missing: say so here, not in the first step


@register("filter", "norm_resilient", reference="Dutta 2018, (5.8)")
@dataclass(frozen=True)
class NormResilientFilter(Norm):
    """Distributed filter whose correction weighs the norm of the whitened innovation, so that no attack moves it far."""

    steady: bool = param(True, "hold the covariance where it settles when nothing is missed; else each row solves its own problem, slowly")

    @property
    def linear(self) -> DistributedKalmanFilter:
        """The distributed Kalman filter that predicts, and whose correction the norm replaces."""
        return DistributedKalmanFilter(self.steady)

    def prepare(self, model: Model) -> NormPlan:
        linear = self.linear.prepare(model)
        if linear.held is None:
            return NormPlan(linear, None, None)
        spread, _ = num.root(linear.held)
        return NormPlan(linear, spread, axes(linear.C, linear.R, spread))

    def start(self, plan: NormPlan, prior: Prior) -> KalmanState:
        return self.linear.start(plan.linear, prior)

    def predict(self, plan: NormPlan, state: KalmanState, known_u: Array) -> KalmanState:
        return self.linear.predict(plan.linear, state, known_u)

    def innovation(self, plan: NormPlan, state: KalmanState, received: Received) -> Innovation:
        return self.linear.innovation(plan.linear, state, received)

    def gain(self, plan: NormPlan, state: KalmanState, innovation: Innovation) -> Array:
        """Return the linear filter's gain; the correction itself is not linear."""
        return self.linear.gain(plan.linear, state, innovation)

    def forget(self, plan: NormPlan, state: KalmanState, where: Array) -> KalmanState:
        return self.linear.forget(plan.linear, state, where)

    def estimate(self, state: KalmanState) -> Array:
        return state.x

    def update(self, plan: NormPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        linear, r = plan.linear, np.where(accept, innovation.r, 0.0)
        x = state.x + self._move(plan, state.P, r, accept)
        if linear.held is not None:
            return KalmanState(x, None)
        return KalmanState(x, self.linear.update(linear, state, Innovation(np.zeros_like(r), innovation.S), accept).P)

    def _move(self, plan: NormPlan, P: Array | None, r: Array, accept: Array) -> Array:
        """Return xh - xb (B, N, n)."""
        linear, held = plan.linear, plan.linear.held if P is None else one_row(P)
        assert held is not None
        held = held.reshape(-1, *held.shape[-3:])  # (1, N, n, n), or (B, N, n, n) where the rows differ
        if self.solver == "cvxpy":
            return self._by_cvxpy(linear, held, r, accept)
        if P is None:
            assert plan.spread is not None and plan.whole is not None
            spread, whole = plan.spread[None], plan.whole
        else:
            spread = num.root(held.reshape(-1, *held.shape[2:]))[0].reshape(held.shape)
            whole = axes(linear.C, linear.R, spread[0])
        if len(held) == 1:
            out, known = moved(whole, r, self.lam)[0], accept.all(axis=-1)
        else:
            out, known = num.zeros((*r.shape[:2], held.shape[-1])), np.zeros(r.shape[:2], bool)
        return np.asarray(num.elsewhere(known, out, self._apart, r, accept, linear.C[None], linear.R[None], spread))

    def _apart(self, r: Array, accept: Array, C: Array, R: Array, spread: Array) -> Array:
        """Return xh - xb (M, 1, n) of problems that are decomposed one by one: r, accept (M, 1, q); C, R and spread (M, 1, ...)."""
        each = axes(C[:, 0] * accept[:, 0, :, None], alone(R, accept)[:, 0], spread[:, 0])
        u = in_ball(_times(each.turn, r[:, 0])[:, None], self.lam * each.half[:, None])
        return self.lam * _times(each.push, u[:, 0])[:, None]

    def _by_cvxpy(self, linear: FusionPlan, held: Array, r: Array, accept: Array) -> Array:
        out = num.zeros((*r.shape[:2], held.shape[-1]))
        for b, i in np.ndindex(*r.shape[:2]):
            on = accept[b, i]
            out[b, i] = moved_by_cvxpy(linear.C[i][on], linear.R[i][on][:, on], held[b % len(held), i], r[b, i, on], self.lam)
        return out


@register("defence", "norm_resilient", reference="Dutta 2018, (5.8)")
@dataclass(frozen=True)
class NormResilient(Norm, Composed):
    """Resilient distributed estimator: however many sensors are attacked, a step's correction stays bounded."""

    gain: Gain = param("steady", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return NormResilientFilter(self.lam, self.solver, self.gain == "steady"), Score(), AcceptAll()
