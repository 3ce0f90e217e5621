"""The fewest attacked sensors that explain a window under bounded errors (Pajic, Lee and Pappas 2017; thesis, [13]).

    min #{i : E_i != 0}     s.t.  Y_i = O_i x + E_i + dw_i,  |dw_i| <= D_i

For |K| = 0, 1, ..., s: K explains the window where an x has |Y_i - O_i x| <= D_i for all i outside of K. The least squares on these
sensors decide that where the residuals are inside, or so far outside that no x can be inside. With the projection P on the residuals'
space, |P Y| <= |P| D is needed. Else a linear program decides (scipy, HiGHS). Of several K of one size the first counts. The bounds are

    D_i(t) = sigmas (R_ii + sum_{j<t} c_i A^j Q A^j' c_i')^(1/2)
"""

from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Model, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.sparse_attacks.l1_decoder import dependent
from tailgate.estimators.sparse_attacks.window import (
    Centred,
    Decoded,
    Decoder,
    DecoderPlan,
    WindowPlan,
    floor_of,
    grams,
    known,
    least_squares,
    modelled,
)

MOST = 3000  # linear programs in a step


class RobustPlan(NamedTuple):
    D: Array  # (N, q, T) over the sensors' noise


class Explained(NamedTuple):
    """A set of sensors that explains a window, and the state that it leaves."""

    attacked: tuple[int, ...]
    x: Array  # (n,)
    found: bool


def bounds_of(plan: WindowPlan, model: Model, sigmas: float) -> Array:
    """Return D (N, q, T) over the standard deviation of each sensor's noise."""
    T, spread = plan.O.shape[2], np.zeros_like(model.Q)
    out = []
    for _ in range(T):
        through = num.matmul(model.C, num.matmul(spread, num.transpose(model.C)))
        out.append(np.sqrt(1.0 + through.diagonal(axis1=1, axis2=2) / (plan.sd * plan.sd)))
        spread = num.product(num.product(model.A, spread), model.A.T) + model.Q
    return sigmas * np.stack(out, axis=-1)


def feasible(O: Array, Y: Array, D: Array) -> Array | None:
    """Return an x (n,) with |Y - O x| <= D for rows O (M, n), Y and D (M,): the Chebyshev centre; None where there is none."""
    from scipy.optimize import linprog

    size, n = np.sqrt(num.dot(O, O)), O.shape[1]
    A = np.concatenate([np.column_stack([O, size]), np.column_stack([-O, size])])
    answer = linprog(
        np.array([*np.zeros(n), -1.0]), A_ub=A, b_ub=np.concatenate([Y + D, D - Y]), bounds=[(None, None)] * n + [(0.0, None)],
        method="highs",
    )  # fmt: skip
    if answer.status == 3:  # unbounded: any centre will do
        return num.matvec(fitting(O), Y)
    return np.asarray(answer.x[:n]) if answer.status == 0 else None


def fitting(O: Array) -> Array:
    """Return the matrix (n, M) that makes the least squares of readings (M,) with rows O (M, n)."""
    G = num.product(O.T, O)
    return num.solve(G + 1e-13 * G.trace() * np.eye(len(G)), O.T)


def explains(O: Array, Y: Array, D: Array, fit: Array) -> Array | None:
    """Return an x (n,) with |Y - O x| <= D, the least squares where it will do; None where there is none."""
    x = num.matvec(fit, Y)
    r = Y - num.matvec(O, x)
    if (np.abs(r) <= D).all():
        return x
    outside = np.eye(len(O)) - num.product(O, fit)
    if (np.abs(r) > num.matvec(np.abs(outside), D) + 1e-9 * (1.0 + np.abs(Y).max())).any():
        return None
    return feasible(O, Y, D)


def explanation(O: Array, Y: Array, D: Array, there: Array, s: int, centre: str = "least_squares") -> Explained:
    """Return the smallest set of at most s sensors that explains a window: O (q, T, n), Y, D and `there` (q, T).

    Where none does, the set of s whose least squares is outside of D by the smallest factor.
    """
    q, best = len(O), (np.inf, Explained((), np.zeros(O.shape[-1]), False))
    for size in range(s + 1):
        for K in combinations(range(q), size):
            rows = there & ~np.isin(np.arange(q), K)[:, None]
            fit = fitting(O[rows])
            x = explains(O[rows], Y[rows], D[rows], fit)
            if x is not None:
                inner = feasible(O[rows], Y[rows], D[rows]) if centre == "chebyshev" else None
                return Explained(K, x if inner is None else inner, True)
            x = num.matvec(fit, Y[rows])
            over = float(np.max(np.abs(Y[rows] - num.matvec(O[rows], x)) / D[rows]))
            if size == s and over < best[0]:
                best = over, Explained(K, x, False)
    return best[1]


@register(
    "defence", "l0_robust",
    reference="M. Pajic, I. Lee, G. J. Pappas, Attack-Resilient State Estimation for Noisy Dynamical Systems, 2017",
)  # fmt: skip
@dataclass(frozen=True)
class RobustDecoder(Decoder):
    """The state left by the fewest sensors whose absence explains the window under bounded errors; it tries all subsets, and is slow."""

    name = "l0_robust"
    untraced = "it solves linear programs, one episode after the other"
    threshold_field: ClassVar[str] = "sigmas"
    sigmas: Positive = param(6.0, "bound of an honest error [standard deviations]")
    centre: Literal["least_squares", "chebyshev"] = param(
        "least_squares", "least_squares: on the sensors that are left; chebyshev: centre of the largest ball in the set, a linear program"
    )

    def constants(self, plan: WindowPlan, model: Model) -> RobustPlan:
        q = len(model.sensors)
        if (programs := sum(comb(q, k) for k in range(self.s + 1))) > MOST:
            raise InputError("defence l0_robust.s", self.s, f"fewer subsets than {programs}: at most {MOST}")
        return RobustPlan(bounds_of(plan, model, self.sigmas))

    def decode(self, plan: DecoderPlan, own: None, held: Centred) -> tuple[None, Decoded]:
        O, D = plan.window.O, plan.own.D
        gram = grams(O, held.there)
        every = np.ones(held.there.shape[:3])
        x, answered = least_squares(O, held.Y, gram, every, floor_of(O)), np.array(known(held, gram, every))
        score = self.sigmas * np.max(np.where(held.there, np.abs(held.Y - modelled(O, x)), 0.0) / D, axis=(-2, -1))
        alarm = np.zeros_like(score, bool)
        hard = held.full & answered & ((score > self.sigmas) if self.centre == "least_squares" else np.ones_like(alarm))
        x = np.array(x)
        for b, i in np.argwhere(hard).tolist():
            Y, there = np.ascontiguousarray(held.Y[b, i]), np.ascontiguousarray(held.there[b, i])
            found = explanation(O[i], Y, D[i], there, self.s, self.centre)
            x[b, i], alarm[b, i] = found.x, bool(found.attacked) or not found.found
            left = there & ~np.isin(np.arange(len(there)), found.attacked)[:, None]
            answered[b, i] = not dependent(O[i][left])
        score = np.where(alarm, score, np.minimum(score, self.sigmas))  # else some x has all errors within the bounds
        return None, Decoded(x, score, alarm, answered)
