"""The robust Kalman filter of Mattingley and Boyd (Real-time convex optimization in signal processing, 2010; reference [29] of the thesis).

    y = C x + v + z, z sparse:      z = argmin (r - z)' W (r - z) + sum_i lam_i |z_i|,      W = S^-1
                                    x = x- + K (r - z),      with the steady P-, S and K

The problem is strictly convex, so that z is unique, and r' W r is the price of z = 0. The code computes y = r - z, the believed part of
the innovation. It is the fixed point of

    y_i = clip(r_i, (-lam_i/2 - b_i) / W_ii, (lam_i/2 - b_i) / W_ii),      b_i = sum_{j != i} W_ij y_j

and satisfies |2 W y|_i <= lam_i, however large r is. Where |2 W r|_i <= lam_i for every i, z = 0 and the step is the steady filter's.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Literal, cast

import numpy as np

from tailgate import num
from tailgate.base.extras import optional
from tailgate.core import Array, Innovation, Model, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed
from tailgate.estimators.detectors.chi_square import ChiSquare
from tailgate.estimators.filters.kalman import KalmanPlan, KalmanState, LinearFilter, alone, kalman_plan, steady_state
from tailgate.estimators.parts import Detector, Filter, Memoryless, Mitigation, Verdict, normalised

ROUNDS = 1000  # far above what was ever seen: a guard against rounding
ACCURACY = 1e-9  # asked of the interior-point solver
PATIENCE = 3  # rounds of block changes without progress
TOLERANCE = 1e-12  # error of the optimality conditions, relative to lam
ROUNDING = 8 * float(np.finfo(np.float64).eps)  # error of a sum, relative to its largest term


def believed(r: Array, S: Array, lam: Array) -> Array:
    """Return y = r - z (B, N, q) for r and lam (B, N, q) and S (B, N, q, q). A sensor without outlier keeps every bit of its r."""
    W = num.inverse(S)
    if r.shape[-1] == 2:
        return _pair(r, S, W, 0.5 * lam)
    half, found = 0.5 * lam, np.asarray((2.0 * np.abs(num.matvec(W, r)) > lam).any(axis=-1))
    if r.shape[-1] == 1:
        return np.where(found[..., None], np.clip(r, -half * S[..., 0], half * S[..., 0]), r)
    return cast(Array, num.elsewhere(~found, r, _pivot, r, W, half, S.diagonal(axis1=-2, axis2=-1)))


def _pair(r: Array, S: Array, W: Array, half: Array) -> Array:
    """Solve for two sensors in closed form: r and lam/2 (B, N, 2), S and W (B, N, 2, 2).

    Nothing is an outlier, or both are, with one of four pairs of signs s and y = S (s lam) / 2, or one is.
    """
    (r0, r1), (half0, half1) = (r[..., 0], r[..., 1]), (half[..., 0], half[..., 1])
    (S00, S01), (S10, S11) = ((S[..., i, 0], S[..., i, 1]) for i in (0, 1))
    (W00, W01), (W10, W11) = ((W[..., i, 0], W[..., i, 1]) for i in (0, 1))
    out0, out1, best = r0, r1, np.full(r0.shape, -np.inf)
    for s0, s1 in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        price0, price1 = s0 * half0, s1 * half1
        y0, y1 = S00 * price0 + S01 * price1, S10 * price0 + S11 * price1
        left0, left1 = price0 - (W00 * y0 + W01 * y1), price1 - (W10 * y0 + W11 * y1)
        y0, y1 = y0 + (S00 * left0 + S01 * left1), y1 + (S10 * left0 + S11 * left1)  # mends the rounding
        least = np.minimum(s0 * (r0 - y0), s1 * (r1 - y1))  # negative where a sign is wrong
        out0, out1 = np.where(least > best, y0, out0), np.where(least > best, y1, out1)
        best = np.maximum(least, best)
    one = _within(r0, (-half0 - W01 * r1) / W00, (half0 - W01 * r1) / W00)
    alone0 = np.abs(W10 * one + W11 * r1) <= half1
    out0, out1 = np.where(alone0, one, out0), np.where(alone0, r1, out1)
    one = _within(r1, (-half1 - W10 * r0) / W11, (half1 - W10 * r0) / W11)
    alone1 = np.abs(W00 * r0 + W01 * one) <= half0
    out0, out1 = np.where(alone1, r0, out0), np.where(alone1, one, out1)
    found = (np.abs(W00 * r0 + W01 * r1) > half0) | (np.abs(W10 * r0 + W11 * r1) > half1)
    return np.where(found[..., None], num.stack([out0, out1]), r)


def _within(x: Array, low: Array, high: Array) -> Array:
    x = np.where(x <= low, low, x)
    return np.where(x >= high, high, x)


def _pivot(r: Array, W: Array, half: Array, size: Array) -> Array:
    """Solve for any number of sensors: block principal pivoting (Judice and Pires 1992), which ends in a finite number of rounds.

    A round solves for the outliers of presumed signs, and changes the presumptions that its solution contradicts. It changes all of them
    while they grow fewer, else the last one alone. (Coordinate descent is simpler, and takes thousands of sweeps where sensors are
    correlated.) r, half and size (B, N, q), W (B, N, q, q).
    """
    q = r.shape[-1]
    sensors = np.arange(q)

    def step(sign: Array, y: Array, fewest: Array, left: Array) -> tuple[Array, list[Array]]:
        y = _solved(sign, r, W, half)
        g, largest = np.zeros(y.shape), np.zeros(y.shape)
        for j in range(q):
            part = W[..., j] * y[..., j : j + 1]
            g, largest = g + part, np.maximum(largest, np.abs(part))
        beyond = np.abs(g) > half + (TOLERANCE * half + ROUNDING * largest)
        slack = TOLERANCE * half * size + ROUNDING * (np.abs(r) + np.abs(y))
        wrong = np.where(sign == 0.0, beyond, sign * (r - y) < -slack)
        toward = np.where(sign == 0.0, np.copysign(1.0, g), 0.0)
        count, last = np.zeros(left.shape, np.int64), np.zeros(left.shape, np.int64)
        for i in range(q):
            count, last = count + wrong[..., i], np.where(wrong[..., i], i, last)
        left, fewest = np.where(count < fewest, PATIENCE, left - 1), np.minimum(count, fewest)
        changed = np.where(wrong & ((left >= 0)[..., None] | (last[..., None] == sensors)), toward, sign)
        return count > 0, [changed, y, fewest, left]

    alone = np.where(np.abs(r) > half * size, np.copysign(1.0, r), 0.0)  # sign that each sensor alone would have
    whole = np.zeros(r.shape[:-1], np.int64)
    begin = [alone, r, whole + (q + 1), whole + PATIENCE]
    _, y, fewest, _ = num.until(step, begin, whole == 0, ROUNDS)
    if not num.tracing() and (fewest > 0).any():
        left = np.count_nonzero(fewest > 0)
        raise ArithmeticError(f"believed: {left} problems of {q} sensors are not solved after {ROUNDS} rounds of pivoting")
    return np.asarray(y)


def _solved(sign: Array, r: Array, W: Array, half: Array) -> Array:
    """Return y (B, N, q) for presumed signs: an outlier is at its price, any other sensor is believed."""
    q = r.shape[-1]
    out, price = sign != 0.0, sign * half
    y = np.where(out, 0.0, r)
    L: list[Array] = []  # columns from the diagonal down: L L' = W of the outliers, 1 for the others
    for j in range(q):
        held = W[..., j:, j]
        for k in range(j):
            held = held - L[k][..., j - k :] * L[k][..., j - k : j - k + 1]
        held = np.where(out[..., j:] & out[..., j : j + 1], held, np.eye(1, q - j)[0])
        root = np.sqrt(held[..., :1])
        L.append(np.concatenate([root, held[..., 1:] / root], axis=-1))
    for _ in range(2):  # the second time mends the rounding of the first
        part, left, z = W * y[..., None, :], price, list[Array]()
        for i in range(q):
            held = left[..., 0]
            for j in range(i, q):
                held = held - part[..., i, j]
            z.append(np.where(out[..., i], held, price[..., i]) / L[i][..., 0])
            left = left[..., 1:] - (part[..., i + 1 :, i] + L[i][..., 1:] * z[i][..., None])
        for i in reversed(range(q)):
            for k in range(i + 1, q):
                z[i] = z[i] - L[i][..., k - i] * z[k]
            z[i] = z[i] / L[i][..., 0]
        y = y + num.stack(z)
    return y


@cache
def _problem(q: int) -> tuple[Any, dict[str, Any], Any]:
    """Return the cvxpy problem of q sensors, its parameters and its variable. W = F'F, d = F r."""
    cp = load_cvxpy()
    z, known = cp.Variable(q), {"F": cp.Parameter((q, q)), "d": cp.Parameter(q), "lam": cp.Parameter(q, nonneg=True)}
    price = cp.sum_squares(known["d"] - cp.matmul(known["F"], z)) + cp.norm1(cp.multiply(known["lam"], z))
    return cp.Problem(cp.Minimize(price)), known, z


def load_cvxpy() -> Any:
    """Return the package cvxpy. Raise ImportError with the command that installs it."""
    return optional("cvxpy", "cvxpy", "cvxpy is missing")


def believed_by_cvxpy(r: Array, S: Array, lam: Array) -> Array:
    """Return what `believed` returns, from an interior-point solver (Clarabel), row by row, to the solver's tolerance."""
    from scipy.linalg import cholesky

    problem, known, z = _problem(r.shape[-1])
    sigma, y = np.sqrt(S.diagonal(axis1=-2, axis2=-1)), r.copy(order="K")
    for row in np.ndindex(r.shape[:-1]):
        scale = np.array(sigma[row] * max(1.0, float(np.max(np.abs(r[row] / sigma[row])))))  # the solver wants numbers near 1
        F = cholesky(num.inverse(S[row] / (sigma[row] * sigma[row][:, None])))
        known["F"].value, known["d"].value = F, num.matvec(F, r[row] / scale)
        known["lam"].value = lam[row] * sigma[row] * (sigma[row] / scale)
        problem.solve(solver="CLARABEL", warm_start=False, **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), ACCURACY))
        y[row] = r[row] - z.value * scale
    return y


@dataclass(frozen=True)
class Penalty:
    """The price of an outlier."""

    lam: Positive = param(1.3, "price of an outlier: alone, a reading counts as noise up to lam/2 sigma off (tuned, docs/filters.md)")
    unit: Literal["sigma", "sensor"] = param(
        "sigma", "unit of lam: sigma: 1/sqrt(S_ii), the same for every noise level; sensor: 1/unit of the sensor, as in the paper"
    )

    def price(self, S: Array) -> Array:
        """Return lam_i (..., q) for S (..., q, q) [1/unit of the sensor]."""
        variance = S.diagonal(axis1=-2, axis2=-1)
        return self.lam / np.sqrt(variance) if self.unit == "sigma" else np.full(variance.shape, self.lam)


@dataclass(frozen=True)
class Solved(Penalty):
    """The price, and the solver."""

    solver: Literal["exact", "cvxpy"] = param("exact", "exact: closed form or block pivoting; cvxpy: an interior-point solver, slow")

    def __post_init__(self) -> None:
        if self.solver == "cvxpy":
            load_cvxpy()  # missing: say so here, not in the first step

    def cleaned(self, innovation: Innovation, accept: Array) -> Innovation:
        """Return the innovation of the sensors in `accept` (B, N, q), less its outliers."""
        r, S = innovation
        if not num.every(accept):
            r, S = r * accept, alone(S, accept)
        solve = believed if self.solver == "exact" else believed_by_cvxpy
        return Innovation(solve(r, S, self.price(S)), S)


@register("filter", "rkf", reference="Mattingley and Boyd, Real-time convex optimization in signal processing, 2010; Dutta 2018, [29]")
@dataclass(frozen=True)
class RobustKalmanFilter(Solved, LinearFilter):
    """Steady-state filter that first takes sparse outliers out of the innovation."""

    def prepare(self, model: Model) -> Any:  # a KalmanPlan whose `held` is an array
        return kalman_plan(model, steady=True)

    def update(self, plan: KalmanPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        return super().update(plan, state, self.cleaned(innovation, accept), accept)


@register("detector", "outlier", reference="Mattingley and Boyd 2010: the optimality condition of z = 0")
@dataclass(frozen=True)
class Outlier(Penalty, Memoryless):
    """Alarms, and blames the sensor, where the robust Kalman filter of the same lam would find an outlier."""

    def prepare(self, model: Model) -> Array:
        """Return the gate (N,) in steady state."""
        P = steady_state(model)
        S = num.matmul(model.C, num.matmul(P, num.transpose(model.C))) + model.R
        lam, W = self.price(S), num.inverse(S).diagonal(axis1=-2, axis2=-1)
        return np.asarray((1.0 - 1e-12) * np.min(lam * lam / (4.0 * W), axis=-1))

    def step(self, plan: Array, state: None, innovation: Innovation) -> tuple[None, Verdict]:
        r, S = innovation
        suspect = believed(r, S, self.price(S)) != r
        return None, Verdict(normalised(innovation), suspect.any(axis=-1), suspect)

    def gate(self, plan: Array, state: None) -> Array:
        """Return the largest ellipsoid r' S^-1 r inside |2 S^-1 r|_i <= lam_i, for the steady S.

        Some innovations outside raise no alarm either.
        """
        return plan


@register("defence", "rkf", reference="Mattingley and Boyd, Real-time convex optimization in signal processing, 2010; Dutta 2018, [29]")
@dataclass(frozen=True)
class RobustKalman(Solved, Composed):
    """Robust Kalman filter: corrects with what is left of the innovation after its outliers."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive | None = param(
        20.0, "alarm above this r' S^-1 r; none: wherever an outlier is found, which with a lam tuned for estimation is in most steps [-]"
    )

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        detector = Outlier(self.lam, self.unit) if self.eta is None else ChiSquare(self.eta)
        return RobustKalmanFilter(self.lam, self.unit, self.solver), detector, AcceptAll()
