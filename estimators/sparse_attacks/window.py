"""The last T readings of each sensor, with the known inputs taken out: what the decoders of this room solve.

    ybar(t) = y(t) - C xi(t),     xi+ = A xi + B u + c,     xi = 0 at the start of the window         Y_i = O_i x(k-T+1) + noise + attack
    O_i = [c_i; c_i A; ...; c_i A^(T-1)]  (T, n)                                                      xh(k) = A^(T-1) x(k-T+1) + xi(k)

Rows are divided by the standard deviation of their sensor's noise: the unit of a reading decides nothing. Until T readings have come, a
steady Kalman filter on all sensors gives the estimate. It does so too where those that arrived do not determine x.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Count, Estimate, Mode, Model, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.estimators.filters.kalman import KalmanFilter, KalmanPlan, KalmanState, precision
from tailgate.estimators.sparse_attacks.subsets import require

Length = Annotated[int, Field(ge=0, le=100)]
WINDOW = "length T of the window; 0: the number of states [steps]"
SINGULAR = 1e-10  # share of a column's square that is left without those before it, where it counts as a combination of them


class WindowPlan(NamedTuple):
    A: Array
    B: Array
    c: Array
    C: Array  # (N, q, n)
    sd: Array  # (N, q) of each sensor's noise
    O: Array  # (N, q, T, n) rows over sd
    last: Array  # (n, n) A^(T-1)
    kalman: KalmanPlan


class WindowState(NamedTuple):
    """Every leaf has B first. The newest entries come last."""

    y: Array  # (B, N, q, T) readings
    there: Array  # (B, N, q, T) bool: they arrived
    pushed: Array  # (B, N, T, n) B u + c before each reading
    steps: Array  # (B, N) int64: how many readings have come, at most T
    kalman: KalmanState


class Centred(NamedTuple):
    """Readings without what the known inputs do, over sd, and that part of the state."""

    Y: Array  # (B, N, q, T)
    there: Array  # (B, N, q, T) bool
    xi: Array  # (B, N, n) at the end of the window
    full: Array  # (B, N) bool: T readings have come
    pushed: Array  # (B, N, n) B u + c by which the window's start moved


def window_plan(model: Model, length: int) -> WindowPlan:
    """Return the constants of a window of `length` steps; 0: as many as states. Raise NotApplicable where a reading has no noise."""
    T = length or model.states
    for R in model.R:
        precision(R)  # refuses what is divided by below
    sd = np.sqrt(model.R.diagonal(axis1=1, axis2=2))
    powers = [np.eye(model.states)]
    for _ in range(T - 1):
        powers.append(num.product(model.A, powers[-1]))
    O = np.stack([num.matmul(model.C, P) for P in powers], axis=2) / sd[:, :, None, None]
    return WindowPlan(model.A, model.B, model.c, model.C, sd, O, powers[-1], KalmanFilter(steady=True).prepare(model))


def window_start(plan: WindowPlan, prior: Prior) -> WindowState:
    """Return a window without a reading, for B episodes."""
    batch, agents, n = prior.mean.shape
    q, T = plan.O.shape[1:3]
    y = num.zeros((batch, agents, q, T))
    return WindowState(
        y, num.zeros(y.shape, bool), num.zeros((batch, agents, T, n)), num.zeros((batch, agents), np.int64),
        KalmanFilter(steady=True).start(plan.kalman, prior),
    )  # fmt: skip


def window_step(plan: WindowPlan, state: WindowState, received: Received, known_u: Array) -> WindowState:
    """Return the window one reading later."""
    push = num.matvec(plan.B, known_u) + plan.c
    kf = KalmanFilter(steady=True)
    belief = kf.predict(plan.kalman, state.kalman, known_u)
    belief = kf.update(plan.kalman, belief, kf.innovation(plan.kalman, belief, received), received.valid)
    return WindowState(
        np.concatenate([state.y[..., 1:], received.y[..., None]], axis=-1),
        np.concatenate([state.there[..., 1:], received.valid[..., None]], axis=-1),
        np.concatenate([state.pushed[..., 1:, :], push[..., None, :]], axis=-2),
        np.minimum(state.steps + 1, plan.O.shape[2]), belief,
    )  # fmt: skip


def centred(plan: WindowPlan, state: WindowState) -> Centred:
    """Return the window without what the known inputs do."""
    T, xi = plan.O.shape[2], np.zeros_like(state.pushed[..., 0, :])
    columns = [state.y[..., 0]]
    for t in range(1, T):
        xi = num.matvec(plan.A, xi) + state.pushed[..., t, :]
        columns.append(state.y[..., t] - num.matvec(plan.C, xi))
    full = state.steps == T
    there = state.there | ~full[..., None, None]  # before that, T readings of 0: a window that can be solved, for an answer nobody uses
    Y = np.where(state.there & full[..., None, None], np.stack(columns, axis=-1) / plan.sd[..., None], 0.0)
    return Centred(Y, there, xi, full, state.pushed[..., 0, :])


def modelled(O: Array, x: Array) -> Array:
    """Return O_i x (B, N, q, T) for O (N or B, N, q, T, n) and x (B, N, n), summed in ascending order."""
    out = O[..., 0] * x[..., None, None, 0]
    for j in range(1, x.shape[-1]):
        out = out + O[..., j] * x[..., None, None, j]
    return np.asarray(out)


def pulled(O: Array, r: Array) -> Array:
    """Return sum_t O_i' r_i (B, N, q, n) for O (N, q, T, n) and r (B, N, q, T), summed in ascending order."""
    out = O[..., 0, :] * r[..., 0, None]
    for t in range(1, r.shape[-1]):
        out = out + O[..., t, :] * r[..., t, None]
    return np.asarray(out)


def weighed(w: Array, parts: Array) -> Array:
    """Return sum_i w_i parts_i (B, N, ...) for weights w (B, N, q) and parts (B or 1, N, q, ...), in ascending order."""
    wide = w[(..., *(None,) * (parts.ndim - 3))]
    out = wide[:, :, 0] * parts[:, :, 0]
    for i in range(1, w.shape[-1]):
        out = out + wide[:, :, i] * parts[:, :, i]
    return np.asarray(out)


def grams(O: Array, there: Array) -> Array:
    """Return O_i' O_i (B, N, q, n, n) of the rows that are `there` (B, N, q, T) bool."""
    mask = there.astype(np.float64)
    outer = O[..., :, None] * O[..., None, :]  # (N, q, T, n, n)
    out = mask[..., 0, None, None] * outer[:, :, 0]
    for t in range(1, O.shape[2]):
        out = out + mask[..., t, None, None] * outer[:, :, t]
    return np.asarray(out)


def least_squares(O: Array, Y: Array, gram: Array, w: Array, floor: Array) -> Array:
    """Return argmin sum_i w_i |Y_i - O_i x|^2 + floor |x|^2 (B, N, n).

    Y is 0 where nothing arrived; `gram` (B, N, q, n, n) leaves it out.
    """
    G = weighed(w, gram) + floor
    return num.matvec(num.inverse(G), weighed(w, pulled(O, Y)))


def floor_of(O: Array) -> Array:
    """Return a ridge (n, n) for windows in which too much is missing: 1e-12 of the largest gram's trace."""
    rows = O.reshape(len(O), -1)
    return np.asarray(1e-12 * float(np.max(num.dot(rows, rows))) * np.eye(O.shape[-1]))


def solvable(G: Array) -> Array:
    """Return G (B, N, n, n) with 1e-14 of its trace added to its diagonal: no pivot of it is 0."""
    n = G.shape[-1]
    trace = G[..., 0, 0]
    for j in range(1, n):
        trace = trace + G[..., j, j]
    return np.asarray(G + 1e-14 * trace[..., None, None] * np.eye(n))


def determined(G: Array) -> Array:
    """Return True (B, N) where rows with the gram G (B, N, n, n) determine x: no column is a combination of those before it."""
    left, out = G, np.ones(G.shape[:2], bool)
    for j in range(G.shape[-1]):
        out = out & (left[..., j, j] > SINGULAR * G[..., j, j])
        pivot = np.where(out, left[..., j, j], 1.0)
        left = left - left[..., :, j, None] * (left[..., j, None, :] / pivot[..., None, None])
    return np.asarray(out)


def known(held: Centred, gram: Array, w: Array) -> Array:
    """Return True (B, N) where the readings that arrived, of sensors with weights w (B, N, q) of 1, determine x; always if all arrived."""
    return held.there.all(axis=(-2, -1)) | determined(weighed(w, gram))


class Decoded(NamedTuple):
    """A decoder's answer for one window."""

    x: Array  # (B, N, n) at the window's start
    score: Array  # (B, N)
    alarm: Array  # (B, N) bool
    known: Array  # (B, N) bool: there is an answer


class DecoderPlan(NamedTuple):
    window: WindowPlan
    own: Any


class DecoderState(NamedTuple):
    window: WindowState
    own: Any


@dataclass(frozen=True)
class Decoder:
    """Base of defences that solve for the state at the start of a window. A subclass's `decode` solves."""

    name = "decoder"  # as it is registered

    window: Length = param(0, WINDOW)
    s: Count = param(1, "sensors that may be attacked at the same time")

    def constants(self, plan: WindowPlan, model: Model) -> Any:
        """Return what `decode` reads besides the window's constants."""
        return None

    def begin(self, plan: DecoderPlan, batch: int) -> Any:
        """Return the memory of `decode`."""
        return None

    def decode(self, plan: DecoderPlan, own: Any, held: Centred) -> tuple[Any, Decoded]:
        """Return the next memory, and the state that explains the window."""
        raise TypeError(f"{type(self).__name__} must define decode()")

    def prepare(self, model: Model) -> DecoderPlan:
        require(model, self.s, f"defence {self.name}")
        plan = window_plan(model, self.window)
        return DecoderPlan(plan, self.constants(plan, model))

    def start(self, plan: DecoderPlan, prior: Prior) -> DecoderState:
        return DecoderState(window_start(plan.window, prior), self.begin(plan, len(prior.mean)))

    def step(
        self, plan: DecoderPlan, state: DecoderState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[DecoderState, Estimate]:
        window = window_step(plan.window, state.window, received, known_u)
        held = centred(plan.window, window)
        own, found = self.decode(plan, state.own, held)
        known = held.full & found.known
        x = np.where(known[..., None], num.matvec(plan.window.last, found.x) + held.xi, window.kalman.x)
        score, alarm = np.where(known, found.score, 0.0), known & found.alarm
        return DecoderState(window, own), Estimate(
            x, score, alarm, num.full(score.shape, Mode.NORMAL, np.int8), np.ones_like(alarm)
        )


@dataclass(frozen=True)
class Relaxed(Decoder):
    """Base of decoders whose answer depends on how the rows of different sensors compare."""

    rows: Literal["readings", "sigmas"] = param(
        "readings", "readings: rows as read, as in the papers; sigmas: over each sensor's noise, where an accurate one outvotes many"
    )

    def units(self, plan: WindowPlan) -> Array:
        """Return by what rows over sd are multiplied (N, q)."""
        return plan.sd if self.rows == "readings" else np.ones_like(plan.sd)
