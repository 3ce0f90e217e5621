"""The l1/lr decoder (Fawzi, Tabuada and Diggavi 2014; thesis, [3]): the state that disagrees with the fewest sensors, relaxed.

    min_x  f(x) = sum_i |Y_i - O_i x|_r,        r = 2: the norm of a sensor's window; r = 1: the sum over its readings

Solved by Weiszfeld's method, weighted least squares with w = 1/|residual|, in the form of a correction, which keeps its digits however
large an attack is. The least residual that counts starts at the largest one and falls, or the iteration could stick to a reading that it
happens to meet. x is optimal where sum_i O_i' u_i = 0, with u_i = res_i/|res_i|, or |u_i| <= 1 where res_i = 0. At
the end a residual counts as no less than SMALLEST; this moves f by at most that for each term.

With r = 1 this converges slowly. `solver=program` then takes the exact optimum, a linear program for each window (scipy, HiGHS):

    min sum_m t_m     s.t.  -t_m <= Y_m - O_m x <= t_m

Missing readings have no row. Where the others do not determine x, or HiGHS finds no optimum, the estimate is that of the steady Kalman
filter. So it is before the window is full.

s sensors can be corrected where no x has sum_{i in K} |O_i x| >= sum_{i not in K} |O_i x| for any K of s sensors, without noise. Rows over
the sensors' noise (`rows=sigmas`) break this where the most accurate sensors are attacked.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Model, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.sparse_attacks.window import (
    Centred,
    Decoded,
    DecoderPlan,
    Relaxed,
    WindowPlan,
    floor_of,
    grams,
    known,
    least_squares,
    modelled,
    pulled,
    solvable,
    weighed,
)

SMALLEST = 1e-9  # residual [unit of the rows]
STILL = 1e-9  # a step whose effect on all rows is this small ends the iteration [unit of the rows]
DEPENDENT = 1e-9  # the part of a column that is left without those before it, where it counts as a combination of them
FALL = 0.7  # of the least residual that counts, a round
Rounds = Annotated[int, Field(ge=1, le=100_000)]


class Windows(NamedTuple):
    """Windows of readings as terms of the objective: g groups of T rows; of r = 1 each row is a group."""

    O: Array  # (N, g, T, n)
    Y: Array  # (B, N, g, T)
    there: Array  # (B, N, g, T) bool


def decoded(held: Windows, rounds: int) -> Array:
    """Return the state (B, N, n) that minimises the sum of the groups' norms, after `rounds` rounds at most."""
    gram, floor = grams(held.O, held.there), floor_of(held.O)
    every = np.ones(held.there.shape[:3])
    first = least_squares(held.O, held.Y, gram, every, floor)

    r = np.where(held.there, held.Y - modelled(held.O, first), 0.0)
    begin = np.maximum(np.max(np.abs(r), axis=(-2, -1)), SMALLEST)

    def step(x: Array, least: Array) -> tuple[Array, list[Array]]:
        r = np.where(held.there, held.Y - modelled(held.O, x), 0.0)
        w = 1.0 / np.sqrt(num.dot(r, r) + (least * least)[..., None])
        ridge = floor * np.min(w, axis=-1)[..., None, None]  # below what the least weight sees
        move = num.matvec(num.inverse(solvable(weighed(w, gram) + ridge)), weighed(w, pulled(held.O, r)))
        far = np.max(np.abs(modelled(held.O, move)), axis=(-2, -1))
        return (far > STILL) | (least > SMALLEST), [x + move, np.maximum(FALL * least, SMALLEST)]

    return num.until(step, [first, begin], np.ones(first.shape[:2], bool), rounds)[0]


def programmed(O: Array, Y: Array) -> Array | None:
    """Return the x (n,) with the least sum of |Y - O x|, for rows O (M, n) and Y (M,); None where x stays open, or HiGHS finds none."""
    from scipy.optimize import linprog

    (count, n), slack = O.shape, -np.eye(len(O))
    if count < n or dependent(O):
        return None
    answer = linprog(
        np.array([*np.zeros(n), *np.ones(count)]), A_ub=np.concatenate([np.column_stack([O, slack]), np.column_stack([-O, slack])]),
        b_ub=np.concatenate([Y, -Y]), bounds=[(None, None)] * n + [(0.0, None)] * count, method="highs",
    )  # fmt: skip
    return np.asarray(answer.x[:n]) if answer.status == 0 else None


def dependent(O: Array) -> bool:
    """Return True if a column of O (M, n) is a combination of those before it, by Gram and Schmidt."""
    found: list[Array] = []
    for column in O.T:
        rest = column
        for one in found:
            rest = rest - num.dot(one, rest) * one
        size = num.dot(rest, rest)
        if size <= DEPENDENT * DEPENDENT * num.dot(column, column):
            return True
        found.append(rest / np.sqrt(size))
    return False


def grouped(O: Array, Y: Array, there: Array, norm: int) -> Windows:
    """Return the terms of the objective for r = `norm`."""
    if norm == 2:
        return Windows(O, Y, there)
    agents, q, T, n = O.shape
    return Windows(O.reshape(agents, q * T, 1, n), Y.reshape(*Y.shape[:2], q * T, 1), there.reshape(*there.shape[:2], q * T, 1))


@register(
    "defence", "l1_decoder",
    reference="H. Fawzi, P. Tabuada, S. Diggavi, Secure Estimation and Control for Cyber-Physical Systems Under Adversarial Attacks, 2014",
)  # fmt: skip
@dataclass(frozen=True)
class L1Decoder(Relaxed):
    """The state whose window disagrees least with the sensors in the sum of their norms, so that few may be far off."""

    name = "l1_decoder"
    threshold_field: ClassVar[str] = "threshold"
    norm: Literal[1, 2] = param(2, "r: the norm of one sensor's residuals; 2 makes a sensor one term, 1 each of its readings [-]")
    threshold: Positive = param(6.0, "alarm where a residual is larger [standard deviations]")
    rounds: Rounds = param(200, "rounds of the iteration, at most")
    solver: Literal["weighted", "program"] = param(
        "weighted", "weighted: weighted least squares again and again; program: exact for r = 1, a linear program for each window, and slow"
    )

    def __post_init__(self) -> None:
        if self.solver == "program" and self.norm != 1:
            raise InputError("defence l1_decoder.solver", self.solver, "norm=1 with it: only that is a linear program")

    @property
    def untraced(self) -> str:
        """Why the engine cannot trace it; empty where it can."""
        return "it solves linear programs, one episode after the other" if self.solver == "program" else ""

    def constants(self, plan: WindowPlan, model: Model) -> Array:
        return self.units(plan)

    def decode(self, plan: DecoderPlan, own: None, held: Centred) -> tuple[None, Decoded]:
        O, units = plan.window.O, plan.own[..., None]
        rows, Y = O * units[..., None], held.Y * units
        if self.solver == "program":
            x, answered = num.zeros((*held.full.shape, O.shape[-1])), np.zeros_like(held.full)
            for b, i in np.argwhere(held.full).tolist():
                there = held.there[b, i]
                if (one := programmed(rows[i][there], Y[b, i][there])) is not None:
                    x[b, i], answered[b, i] = one, True
        else:
            x = decoded(grouped(rows, Y, held.there, self.norm), int(self.rounds))
            answered = known(held, grams(O, held.there), np.ones(held.there.shape[:3]))
        score = np.max(np.where(held.there, np.abs(held.Y - modelled(O, x)), 0.0), axis=(-2, -1))
        return None, Decoded(x, score, score > self.threshold, answered)
