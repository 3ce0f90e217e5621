"""The estimators' optimisation problems: ours in a batch, and cvxpy's parametrised solve of the same ones, one after the other.

cvxpy compiles each problem once, and only the innovation differs between two solves: the least work possible. It solves by Clarabel with
its default tolerances, without warm start, with whitened constants. Every second problem has the innovation of an attacked step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation
from tailgate.core.scenario import load_scenario
from tailgate.estimators.distributed.distributed_kalman import fixed_point
from tailgate.estimators.distributed.norm_resilient import axes, moved
from tailgate.estimators.filters.kalman import KalmanPlan, KalmanState
from tailgate.estimators.filters.robust import RobustKalmanFilter, believed, load_cvxpy

from .lines import Go, Missing, Sample, repeated

Form = Literal["norm", "lasso"]  # (5.8), (6.26)
CASES: dict[Form, tuple[str, int, float, float]] = {  # scenario, agent, price, standard deviation of an attack
    "norm": ("thesis-ch5-v0", 0, 0.4, 700.0),
    "lasso": ("thesis-ch6-v0", 2, 0.1, 2.8),
}
ROWS = 60  # problems that cvxpy solves before it looks at the clock


class Case(NamedTuple):
    """One agent: C (q, n), R = Sv (q, q), Q and Q^-1 (n, n), the price, and innovations r (B, q)."""

    C: Array
    R: Array
    Q: Array
    Qinv: Array
    lam: float
    r: Array


@cache
def case(form: Form, batch: int) -> Case:
    """Return innovations of honest steps, with an injection added to every second one."""
    scenario, agent, lam, sd = CASES[form]
    model = load_scenario(scenario).brief().model
    C, R, Qinv = model.C[agent], model.R[agent], fixed_point(model).Qinv[agent]
    return Case(C, R, np.linalg.inv(Qinv), Qinv, lam, _innovations(R + C @ Qinv @ C.T, sd, batch))


def _innovations(S: Array, sd: float, batch: int) -> Array:
    rng = np.random.default_rng(0)
    honest = rng.normal(size=(batch, len(S))) @ np.linalg.cholesky(S).T
    return np.asarray(honest + sd * (np.arange(batch)[:, None] % 2) * rng.normal(size=honest.shape))


def exactly(c: Case, form: Form) -> Callable[[], Array]:
    """Return the problems as the filter solves them in a step: xh - xb (B, n)."""
    r = num.batch_last(c.r[:, None])
    if form == "norm":
        constants = axes(c.C[None], c.R[None], num.root(c.Qinv[None])[0])
        return lambda: moved(constants, r, c.lam)[0][:, 0]
    S = c.R + c.C @ c.Qinv @ c.C.T
    K = (c.Qinv @ c.C.T @ np.linalg.inv(S))[None]
    wide, price = np.broadcast_to(S, (len(c.r), 1, *S.shape)), np.full(r.shape, c.lam)
    return lambda: num.apply(K, believed(r, wide, price))[:, 0]


def _cvxpy() -> ModuleType:
    try:
        package: ModuleType = load_cvxpy()
        return package
    except ImportError as error:
        raise Missing(str(error)) from None


def by_cvxpy(c: Case, form: Form) -> Callable[[], Array]:
    """Return the same, one parametrised solve each: xh - xb (B, n)."""
    cp = _cvxpy()
    white, root = np.linalg.inv(np.linalg.cholesky(c.R)), np.linalg.cholesky(c.Q).T
    d, a, r = cp.Variable(len(c.Q)), cp.Variable(len(c.C)), cp.Parameter(len(c.C))
    prior = cp.sum_squares(root @ d)
    if form == "norm":
        price = c.lam * cp.norm(r - white @ c.C @ d, 2) + prior
    else:
        price = cp.sum_squares(r - white @ c.C @ d - white @ a) + c.lam * cp.norm1(a) + prior
    return _solves(cp.Problem(cp.Minimize(price)), r, d, c.r @ white.T)


def _solves(problem: Any, parameter: Any, wanted: Any, values: Array) -> Callable[[], Array]:
    def go() -> Array:
        out = []
        for row in values:
            parameter.value = row
            problem.solve(solver="CLARABEL", warm_start=False)
            out.append(wanted.value)
        return np.array(out)

    return go


def objective(c: Case, form: Form, d: Array) -> Array:
    """Return (B,) the value of (5.8), or of (6.26) with the best a for this X (Huber's loss; Sv is diagonal there)."""
    e, prior = c.r - d @ c.C.T, np.einsum("bn,nm,bm->b", d, c.Q, d)
    if form == "norm":
        return np.asarray(c.lam * np.sqrt(np.einsum("bq,ql,bl->b", e, np.linalg.inv(c.R), e)) + prior)
    variance = np.diag(c.R)
    rest = np.clip(e, -0.5 * c.lam * variance, 0.5 * c.lam * variance)
    return np.asarray(np.sum(rest * rest / variance + c.lam * np.abs(e - rest), axis=1) + prior)


def _counted(solve: Callable[[], Array]) -> Go:
    return repeated(lambda: len(solve()))


def ours(form: Form, batch: int) -> Go:
    """Return problems per second of the exact solver, `batch` at once."""
    return _counted(exactly(case(form, batch), form))


def theirs(form: Form) -> Go:
    """Return problems per second of cvxpy."""
    return _counted(by_cvxpy(case(form, ROWS), form))


def above(form: Form) -> Go:
    """Measure by how much, relatively, an exact objective is above cvxpy's at most; negative if it is below everywhere."""
    c = case(form, ROWS)
    mine, other = exactly(c, form), by_cvxpy(c, form)
    return lambda seconds: Sample(float(np.max(objective(c, form, mine()) / objective(c, form, other()) - 1.0)), 1.0)


# -- the robust Kalman filter of two sensors


class Robust(NamedTuple):
    """Predicted states x (B, 1, 3), their innovations, and the constants of the filter `rkf` on stop-and-go-v0."""

    filter: RobustKalmanFilter
    plan: KalmanPlan
    x: Array
    innovation: Innovation


@cache
def robust(batch: int) -> Robust:
    """Return states of which every second one has the innovation of an attacked step."""
    model, filter = load_scenario("stop-and-go-v0").brief().model, RobustKalmanFilter()
    plan = filter.prepare(model)
    S = num.matmul(num.matmul(plan.C, plan.held), num.transpose(plan.C)) + plan.R
    r = num.batch_last(_innovations(S[0], 10.0, batch)[:, None])
    return Robust(filter, plan, num.zeros((batch, 1, 3)), Innovation(r, np.broadcast_to(S, (batch, *S.shape))))


def robust_updates(batch: int) -> Go:
    """Update the filter `rkf` with two sensors, `batch` at once."""
    held = robust(batch)
    accept = num.full(held.innovation.r.shape, True, bool)

    def go() -> int:
        held.filter.update(held.plan, KalmanState(held.x, None), held.innovation, accept)
        return batch

    return repeated(go)


def robust_by_cvxpy() -> Go:
    """Return the same update with a parametrised solve of its problem, one after the other."""
    cp = _cvxpy()
    held = robust(ROWS)
    S, lam = held.innovation.S[0, 0], held.filter.price(held.innovation.S[:1])[0, 0]
    K, root = np.asarray(held.plan.held)[0] @ held.plan.C[0].T @ np.linalg.inv(S), np.linalg.cholesky(np.linalg.inv(S)).T
    z, known = cp.Variable(2), cp.Parameter(2)
    solve = _solves(cp.Problem(cp.Minimize(cp.sum_squares(known - root @ z) + lam @ cp.abs(z))), known, z, held.innovation.r[:, 0] @ root.T)

    def go() -> int:
        outliers = solve()
        for x, r, off in zip(held.x[:, 0], held.innovation.r[:, 0], outliers, strict=True):
            _ = x + K @ (r - off)
        return ROWS

    return repeated(go)
