"""Event-triggered projected gradient and Luenberger observer (Shoukry and Tabuada 2016; thesis, [8]).

    z = (x, E),     f(z) = |Y - O x - E|^2,     E has a block of T numbers for each sensor, of which s at most may differ from 0

    gradient    z <- z + L (Y - O x - E),   L = [O I]' / 2,   until f <= (1 - nu) f(after the last projection)
    project     keep the s blocks E_i of the largest norm, zero the others;   end where f <= eps

`etpg` starts from E = 0 in each window. `etpl` goes on from its last z: x by A, E by a shift, with the newest residual of each sensor.
x has coordinates in which O'O = I, so that |[O I]|^2 = 2 and the gradient's steps do not depend on how the states are scaled. eps is the
energy T tr R that noise alone has. A window that passes the chi-square test of its least squares needs no attack: E = 0. The estimate is
least squares on the sensors outside of the support of E, weighed by their noise.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Model, Positive, param
from tailgate.core.quantities import Fraction
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
    weighed,
)

PAPER = "Y. Shoukry, P. Tabuada, Event-Triggered State Observers for Sparse Sensor Noise/Attacks, 2016"
Rounds = Annotated[int, Field(ge=1, le=100_000)]
Tail = Annotated[float, Field(gt=0, lt=1)]


class ProjectedPlan(NamedTuple):
    O: Array  # (N, q, T, n) in the coordinates in which O'O = I
    turn: Array  # (N, n, n) from x to these coordinates
    back: Array  # (N, n, n)
    move: Array  # (N, n, n) A in them
    units: Array  # (N, q, 1) of the rows, over sd
    eps: Array  # (N,)
    threshold: float


class ProjectedState(NamedTuple):
    x: Array  # (B, N, n) in these coordinates
    E: Array  # (B, N, q, T)


class Solved(NamedTuple):
    x: Array  # (B, N, n)
    E: Array  # (B, N, q, T) projected
    energy: Array  # (B, N) f after the last projection
    projections: Array  # (B, N)


def orthonormal(O: Array) -> tuple[Array, Array]:
    """Return O R^-1 with orthonormal columns (N, q, T, n), and R (N, n, n); by the method of Gram and Schmidt, twice."""
    agents, q, T, n = O.shape
    out, turn = np.zeros_like(O), np.zeros((agents, n, n))
    for i in range(agents):
        columns: list[Array] = []
        for j in range(n):
            v = O[i, :, :, j].reshape(-1)
            for _ in range(2):
                for p, u in enumerate(columns):
                    share = num.dot(u, v)
                    turn[i, p, j] += share
                    v = v - share * u
            turn[i, j, j] = np.sqrt(num.dot(v, v))
            columns.append(v / turn[i, j, j])
        out[i] = np.stack(columns, axis=-1).reshape(q, T, n)
    return out, turn


def largest(E: Array, s: int) -> Array:
    """Return (B, N, q) bool: the s blocks of E (B, N, q, T) of the largest norm that is not 0."""
    size = num.dot(E, E)
    kept, sensors = np.zeros_like(size, bool), np.arange(size.shape[-1])
    for _ in range(s):
        left = np.where(kept, -1.0, size)
        kept = kept | ((sensors == np.argmax(left, axis=-1)[..., None]) & (left > 0.0))
    return kept


def energy(r: Array) -> Array:
    """Return the sum of squares (B, N) of r (B, N, q, T), in ascending order."""
    each = num.dot(r, r)
    return num.dot(each, np.ones(each.shape[-1]))


def solved(plan: ProjectedPlan, held: Centred, x: Array, E: Array, s: int, nu: float, rounds: int) -> Solved:
    """Return the answer of the projected gradient from x (B, N, n) and E (B, N, q, T)."""
    O = plan.O

    def left(x: Array, E: Array) -> Array:
        return np.where(held.there, held.Y - modelled(O, x) - E, 0.0)

    def step(x: Array, E: Array, last: Array, projections: Array) -> tuple[Array, list[Array]]:
        r = left(x, E)
        pull = pulled(O, r)
        x, E = x + 0.5 * weighed(np.ones(pull.shape[:3]), pull), E + 0.5 * r
        triggered = energy(left(x, E)) <= (1.0 - nu) * last
        cut = np.where(largest(E, s)[..., None], E, 0.0)
        after = energy(left(x, cut))
        E = np.where(triggered[..., None, None], cut, E)
        last, projections = np.where(triggered, after, last), projections + triggered
        return ~(triggered & (after <= plan.eps)), [x, E, last, projections]

    first = energy(left(x, E))
    x, E, last, projections = num.until(step, [x, E, first, np.zeros_like(first, np.int64)], first > plan.eps, rounds)
    return Solved(x, np.where(largest(E, s)[..., None], E, 0.0), last, projections)


@dataclass(frozen=True)
class ProjectedGradient(Relaxed):
    """Base of `etpg` and `etpl`."""

    warm = False

    threshold_field: ClassVar[str] = "threshold"
    nu: Fraction = param(0.3, "share by which f falls before a projection is triggered [-]")
    threshold: Positive | None = param(None, "alarm where the least squares of all sensors leaves more, over the noise; none: by alpha [-]")
    eps: Positive | None = param(None, "f at which the iteration ends; none: what noise has, T tr R [unit of the rows, squared]")
    alpha: Tail = param(1e-4, "probability that a window of a model without process noise exceeds the threshold [-]")
    rounds: Rounds = param(100, "gradient steps in a period, at most")

    def constants(self, plan: WindowPlan, model: Model) -> ProjectedPlan:
        from scipy import special  # not loaded where no threshold is made

        units = self.units(plan)[..., None]
        O, turn = orthonormal(plan.O * units[..., None])
        q, T, n = O.shape[1:]
        back = np.stack([num.solve(R, np.eye(n)) for R in turn])
        move = np.stack([num.product(num.product(R, model.A), inverse) for R, inverse in zip(turn, back, strict=True)])
        h = float(special.chdtri(max(q * T - n, 1), self.alpha)) if self.threshold is None else self.threshold
        eps = T * num.dot(units[..., 0], units[..., 0])
        return ProjectedPlan(O, turn, back, move, units, eps if self.eps is None else np.full_like(eps, self.eps), h)

    def begin(self, plan: DecoderPlan, batch: int) -> ProjectedState | None:
        agents, q, T, n = plan.own.O.shape
        return ProjectedState(num.zeros((batch, agents, n)), num.zeros((batch, agents, q, T))) if self.warm else None

    def search(self, plan: DecoderPlan, own: ProjectedState | None, held: Centred) -> Solved:
        """Return the answer of the iteration for a window, after the memory `own`; its energy is above eps where `rounds` ended it."""
        p: ProjectedPlan = plan.own
        scaled = held._replace(Y=held.Y * p.units)
        pull = pulled(p.O, scaled.Y)
        x, E = weighed(np.ones(pull.shape[:3]), pull), np.zeros_like(held.Y)  # least squares of these rows, where all have arrived
        if own is not None:
            x = num.matvec(p.move, own.x) + num.matvec(p.turn, held.pushed)
            newest = np.where(held.there, scaled.Y - modelled(p.O, x), 0.0)[..., -1:]
            E = np.concatenate([own.E[..., 1:], newest], axis=-1)
        return solved(p, scaled, x, E, self.s, self.nu, int(self.rounds))

    def decode(self, plan: DecoderPlan, own: ProjectedState | None, held: Centred) -> tuple[ProjectedState | None, Decoded]:
        p: ProjectedPlan = plan.own
        O = plan.window.O
        gram, floor = grams(O, held.there), floor_of(O)
        fitted = least_squares(O, held.Y, gram, np.ones(held.there.shape[:3]), floor)
        score = energy(np.where(held.there, held.Y - modelled(O, fitted), 0.0))
        alarm = score > p.threshold
        found = self.search(plan, own, held)
        support = alarm[..., None] & (num.dot(found.E, found.E) > 0.0)
        left = np.where(support, 0.0, 1.0)
        x = least_squares(O, held.Y, gram, left, floor)
        if own is not None:
            own = ProjectedState(found.x, np.where(alarm[..., None, None], found.E, 0.0))
        return own, Decoded(x, score, alarm, known(held, gram, left))


@register("defence", "etpg", reference=PAPER)
@dataclass(frozen=True)
class Etpg(ProjectedGradient):
    """Event-triggered projected gradient: steps on state and attack, projected on few attacked sensors when the error has fallen."""

    name = "etpg"


@register("defence", "etpl", reference=PAPER)
@dataclass(frozen=True)
class Etpl(ProjectedGradient):
    """Event-triggered projected Luenberger observer: as `etpg`, but it goes on from the state and the attack of the step before."""

    name = "etpl"
    warm = True
