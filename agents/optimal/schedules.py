"""Optimal attackers where they can be computed: a budget of losses against a Kalman filter, and a held reading in a scalar loop.

Lost readings. The covariance of the filter follows P+ = F(P) where the readings come and P+ = A P A' + Q where they are lost. Both maps are
monotone in the Loewner order, and a loss is never below a reading. Compare two attackers with the same steps left: the one with the larger
covariance is never worse off, so that the other can be dropped. This is dynamic programming over sets of covariances. Both maps are also
concave, so that F((1 + s) P) <= (1 + s) F(P): dropping what is below (1 + s) times another costs at most that factor in each step.

One state has one covariance per number of steps left. With |a| >= 1 one block of losses at the end is then the best for
the last covariance. It has the whole budget: exchanging a loss and a later reading never helps. This is the answer of H. Zhang, P. Cheng,
L. Shi and J. Chen (Optimal Denial-of-Service Attack Scheduling with Energy Constraint, IEEE TAC 2015), whose sensor sends its own estimate
instead of its readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.base.extras import optional
from tailgate.core import Array, Model
from tailgate.core.threat import ThreatModel

Objective = Literal["final", "sum"]
SLACK = 1e-10  # share by which a covariance may be larger and still count as dominated, in each step
MOST = 5_000  # covariances side by side: beyond, the exact answer takes too long


class Rules(NamedTuple):
    """The rule by which a threat model accepts an attack step, as in the channel; limits that are not set equal the horizon."""

    onset: int
    last: int
    budget: int
    duration: int
    cooldown: int

    @classmethod
    def of(cls, threat: ThreatModel, horizon: int) -> Rules:
        last = horizon if threat.end is None else min(threat.end, horizon)
        budget = horizon if threat.budget is None else threat.budget
        return cls(threat.onset, last, min(budget, horizon), horizon if threat.duration is None else threat.duration, threat.cooldown)

    def after(self, k: int, held: tuple[int, int, int], attack: bool) -> tuple[int, int, int] | None:
        """Return (used, burst, cooldown) after step k with an attack or without; None where it would be refused."""
        used, burst, pause = held
        if attack:
            ok = self.onset <= k <= self.last and pause == 0 and used < self.budget and burst < self.duration
            return (used + 1, burst + 1, 0) if ok else None
        return used, 0, max((self.cooldown if burst else pause) - 1, 0)

    def key(self, held: tuple[int, int, int]) -> tuple[int, int, int]:
        """Return the part that matters for the future: the length of a burst only where bursts are limited or followed by a pause."""
        used, burst, pause = held
        if self.duration < self.budget:
            return held
        return used, min(burst, 1) if self.cooldown > 1 else 0, pause


@dataclass(frozen=True, eq=False)
class Filtering:
    """A linear system as a Kalman filter takes it: A (n, n), C (q, n), Q (n, n), R (q, q).

    `lost` (q,) bool names the readings that an attack stops.
    """

    A: Array
    C: Array
    Q: Array
    R: Array
    lost: Array

    def predicted(self, P: Array) -> Array:
        """Return A P A' + Q for P (M, n, n)."""
        return np.asarray(self.A @ P @ self.A.T + self.Q)

    def updated(self, P: Array, keep: Array) -> Array:
        """Return the covariance (M, n, n) after the readings `keep` (q,) bool of a predicted one."""
        if not keep.any():
            return P
        C = self.C[keep]
        cross = C @ P
        S = cross @ C.T + self.R[np.ix_(keep, keep)]
        out = P - np.swapaxes(cross, 1, 2) @ np.linalg.solve(S, cross)
        return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))

    def step(self, P: Array, attack: bool) -> Array:
        """Return the covariance (M, n, n) one step later."""
        return self.updated(self.predicted(P), ~self.lost if attack else np.ones_like(self.lost))

    def covariances(self, P: Array, schedule: Array) -> Array:
        """Return the covariances (K, n, n) after each of K steps from P (n, n), with an attack where `schedule` (K,) bool is true."""
        out = []
        held = P[None]
        for attack in schedule.tolist():
            held = self.step(held, attack)
            out.append(held[0])
        return np.array(out)


class Front(NamedTuple):
    """Attackers with the same steps left, none of which is dominated: P (M, n, n), total (M,), schedule (M, K) bool."""

    P: Array
    total: Array
    schedule: Array


def undominated(P: Array, total: Array | None = None, slack: float = SLACK) -> Array:
    """Return indices of the members of P (M, n, n), with `total` (M,) where it counts, that no other one dominates."""
    size = np.trace(P, axis1=1, axis2=2)
    order = np.argsort(-size, kind="stable")
    if P.shape[1] == 1 and total is None:
        return order[:1]
    kept: list[int] = []
    left = order
    while len(left):
        best = left[0]
        kept.append(int(best))
        left = left[1:]
        below = _positive((1.0 + slack) * P[best] - P[left])
        if total is not None:
            below &= total[left] <= (1.0 + slack) * total[best]
        left = left[~below]
    return np.array(kept)


def _positive(D: Array) -> Array:
    """Return (M,) bool: the symmetric D (M, n, n) is positive semidefinite."""
    if D.shape[1] == 1:
        return np.asarray(D[:, 0, 0] >= 0.0)
    if D.shape[1] == 2:
        a, b, d = D[:, 0, 0], D[:, 0, 1], D[:, 1, 1]
        return np.asarray((a >= 0.0) & (d >= 0.0) & (a * d >= b * b))
    ok = np.asarray((np.diagonal(D, axis1=1, axis2=2) >= 0.0).all(axis=1))
    ok[ok] = np.linalg.eigvalsh(D[ok])[:, 0] >= 0.0
    return ok


def best_losses(system: Filtering, P: Array, rules: Rules, horizon: int, objective: Objective = "final", slack: float = SLACK) -> Array:
    """Return (horizon,) bool: the steps 1 .. horizon whose loss makes the trace of the covariance largest, at the horizon or summed.

    P (n, n) is the covariance before step 1. Exact up to the factor (1 + slack)^horizon. Raises NotApplicable where the sets grow too
    large.
    """
    fronts = {(0, 0, 0): Front(P[None], np.zeros(1), np.zeros((1, 0), bool))}
    for k in range(1, horizon + 1):
        gathered: dict[tuple[int, int, int], list[Front]] = {}
        for held, front in fronts.items():
            for attack in (True, False):
                after = rules.after(k, held, attack)
                if after is None:
                    continue
                fresh = system.step(front.P, attack)
                total = front.total + np.trace(fresh, axis1=1, axis2=2)
                schedule = np.concatenate([front.schedule, np.full((len(fresh), 1), attack)], axis=1)
                gathered.setdefault(rules.key(after), []).append(Front(fresh, total, schedule))
        fronts = {key: _best(parts, objective, slack) for key, parts in gathered.items()}
        if sum(len(front.P) for front in fronts.values()) > MOST:
            raise NotApplicable("attack optimal_dos: model", f"{P.shape[0]} states over {horizon} steps", "a smaller system or budget")
    whole = Front(*(np.concatenate(part) for part in zip(*fronts.values(), strict=True)))
    value = whole.total if objective == "sum" else np.trace(whole.P, axis1=1, axis2=2)
    return np.asarray(whole.schedule[int(np.argmax(value))])


def _best(parts: list[Front], objective: Objective, slack: float) -> Front:
    whole = Front(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    rows = undominated(whole.P, whole.total if objective == "sum" else None, slack)
    return Front(*(part[rows] for part in whole))


class Steady(NamedTuple):
    """The Kalman filter at rest: predicted and updated covariance (n, n), innovation covariance (q, q), gain (n, q)."""

    before: Array
    after: Array
    S: Array
    K: Array


def updated(before: Array, C: Array, R: Array) -> Steady:
    """Return one measurement update of the covariance P- (n, n)."""
    S = C @ before @ C.T + R
    K = np.linalg.solve(S, C @ before).T
    after = before - K @ S @ K.T
    return Steady(before, 0.5 * (after + after.T), S, K)


def reach(A: Array, P: Array, C: Array, R: Array, Q: Array, steps: int) -> list[Array]:
    """Return L_j = S^1/2' K' (A')^j (q, n), j = steps - 1 .. 0, of a filter with the covariance P- (n, n) at the first step.

    Unnoticed innovations move the estimate along e by sqrt(gate) sum_j |L_j e| in all (`bounds.stealth_bound`).
    """
    moves = []
    for _ in range(steps):
        step = updated(P, C, R)
        moves.append(step.K @ np.linalg.cholesky(step.S))
        P = A @ step.after @ A.T + Q
    out, power = [], np.eye(len(A))
    for move in reversed(moves):
        out.append(move.T @ power)
        power = A.T @ power
    return out[::-1]


def farthest(model: Model, P: Array, steps: int) -> Array:
    """Return the unit vector e (n,) with the largest sum_j |L_j e|: the best of ascents from every axis and from the longest of each L_j.

    The sum is convex in e, and e <- its gradient, of length one, never lowers it.
    """
    moves = np.array(reach(model.A, P, model.C[0], model.R[0], model.Q, steps))
    starts = np.concatenate([np.eye(model.states), np.linalg.svd(moves)[2][:, 0]])
    best, most = starts[0], -np.inf
    for e in starts:
        for _ in range(200):
            along = moves @ e
            length = np.linalg.norm(along, axis=1)
            gradient = np.einsum("jqn,jq,j->n", moves, along, 1.0 / np.maximum(length, 1e-300))
            size = np.linalg.norm(gradient)
            if size == 0.0:
                break
            e = gradient / size
        value = float(np.linalg.norm(moves @ e, axis=1).sum())
        if value > most * (1.0 + 1e-12) or most == -np.inf:
            best, most = e, value
    return np.asarray(best)


def stealth_programme(model: Model, P: Array, direction: Array, gate: float, bound: float, steps: int) -> tuple[float, Array]:
    """Return the largest e' (x^ - x) after `steps` steps without noise, and the injected values (steps, q), by cvxpy.

    The bound is on the injected value, not on the innovation: r_k = a_k - C A d_(k-1) for a deviation d. It ties the steps together.
    P (n, n) is the predicted covariance at the first step.
    """
    cvxpy = optional("cvxpy", "cvxpy", "cvxpy is missing")
    C, R = model.C[0], model.R[0]
    q, size = len(C), steps * len(C)
    a, deviation = cvxpy.Variable(size), np.zeros((model.states, size))  # what each value that is injected adds to the deviation
    limits = [a <= bound, a >= -bound]
    for k in range(steps):
        step = updated(P, C, R)
        before = model.A @ deviation
        r = np.eye(size)[k * q : (k + 1) * q] - C @ before
        limits.append(cvxpy.norm(np.linalg.inv(np.linalg.cholesky(step.S)) @ r @ a) <= np.sqrt(gate))
        deviation = before + step.K @ r
        P = model.A @ step.after @ model.A.T + model.Q
    problem = cvxpy.Problem(cvxpy.Maximize((direction @ deviation) @ a), limits)
    problem.solve(solver="CLARABEL")
    return float(problem.value), np.asarray(a.value).reshape(steps, q)


class Holding(NamedTuple):
    """x+ = a x - g h + w. The loop acts on the reading h: x itself, or an old one that is held. w has the standard deviation `sd`."""

    a: float
    g: float  # b times the feedback gain
    sd: float


class Grid(NamedTuple):
    """Evenly spaced values of the state and of the held reading."""

    points: Array  # (G,)
    step: float
    weights: Array  # (2 M + 1,) of the noise at -M .. M steps of the grid

    @classmethod
    def of(cls, sd: float, reach: float, spacing: int) -> Grid:
        """Return a grid of up to `reach` standard deviations on either side of 0, `spacing` points to each."""
        half, wide = math.ceil(reach * spacing), 6 * spacing
        raw = num.exp(-0.5 * (np.arange(-wide, wide + 1) / spacing) ** 2)
        return cls(np.arange(-half, half + 1) * (sd / spacing), sd / spacing, raw / math.fsum(raw.tolist()))

    def blurred(self, V: Array) -> Array:
        """Return E V(m + w, .) at every m of the grid, from V (G, ...); beyond the grid V is that at its end."""
        wide = len(self.weights) // 2
        padded = np.concatenate([np.repeat(V[:1], wide, axis=0), V, np.repeat(V[-1:], wide, axis=0)])
        out = np.zeros_like(V)
        for s, weight in enumerate(self.weights.tolist()):
            out += weight * padded[s : s + len(V)]
        return out

    def nearest(self, x: Array) -> Array:
        """Return indices of the points nearest to x."""
        half = len(self.points) // 2
        return np.clip(np.floor(x / self.step + 0.5).astype(np.int64) + half, 0, len(self.points) - 1)

    def cubic(self, m: Array) -> tuple[Array, list[Array]]:
        """Return the first of the four points about each m, and their weights in the cubic through them."""
        place = np.clip(m / self.step + len(self.points) // 2, 0.0, len(self.points) - 1.0)
        first = np.clip(np.floor(place).astype(np.int64) - 1, 0, len(self.points) - 4)
        t = place - first
        return first, [
            -(t - 1) * (t - 2) * (t - 3) / 6.0, t * (t - 2) * (t - 3) / 2.0, -t * (t - 1) * (t - 3) / 2.0, t * (t - 1) * (t - 2) / 6.0
        ]  # fmt: skip


class HoldTable(NamedTuple):
    """A table of when to hold.

    `hold` (K, budget + 1, G, G) bool by step, budget left, state and last good reading; value (G, G) before step 1.
    """

    grid: Grid
    hold: Array
    value: Array

    def decide(self, k: Array, left: Array, x: Array, good: Array) -> Array:
        """Return (B,) bool: hold at steps k, with `left` of the budget, for a state x and a last good reading."""
        whole = np.minimum(left, float(self.hold.shape[1] - 1)).astype(np.int64)
        return np.asarray(self.hold[k - 1, whole, self.grid.nearest(x), self.grid.nearest(good)])


def best_holds(loop: Holding, rules: Rules, horizon: int, objective: Objective, grid: Grid) -> HoldTable:
    """Return when to hold, by dynamic programming backwards over the state x, the last good reading h and the budget left.

    The attack maximises the expected squared error of a defence that believes the reading. While the reading is held at h, the error
    is (x - h)^2, and x+ = a x - g h + w. Else it is 0, x+ = (a - g) x + w, and x is the last good reading.
    """
    x, h = grid.points[:, None], grid.points[None, :]
    size, budget = len(grid.points), rules.budget
    columns = np.broadcast_to(np.arange(size), (size, size))
    held_first, held_weights = grid.cubic(loop.a * x - loop.g * h)
    free_first, free_weights = grid.cubic((loop.a - loop.g) * grid.points)
    later = np.zeros((budget + 1, size, size))
    hold = np.zeros((horizon, budget + 1, size, size), bool)
    for k in range(horizon, 0, -1):
        left = range(budget + 1) if k >= rules.onset else (budget,)  # before the onset nothing is spent
        blurred = {b: grid.blurred(later[b]) if k < horizon else later[b] for b in left}
        now = np.zeros_like(later)
        for b in left:
            own = np.arange(size)  # column of h = x
            quiet = np.zeros(size)
            for i, weight in enumerate(free_weights):
                quiet += weight * blurred[b][free_first + i, own]
            now[b] = quiet[:, None]
            if b and rules.onset <= k <= rules.last:
                active = (x - h) ** 2 if objective == "sum" or k == horizon else np.zeros((size, size))
                for i, weight in enumerate(held_weights):
                    active = active + weight * blurred[b - 1][held_first + i, columns]
                hold[k - 1, b] = active > now[b]
                now[b] = np.maximum(active, now[b])
        later = now
    return HoldTable(grid, hold, later[budget])
