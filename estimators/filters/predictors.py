"""Predictors that know no motion: each reading is extrapolated from its own past. They are baselines.

    hold_last          y(k) = the last reading
    autoregressive     y(k) = w1 y(k-1) + ... + wp y(k-p), w by least squares; a prediction replaces a missing one
    polynomial         y(k) = the polynomial that fits the last W readings best, at k

A state that a sensor reads equals the reading where that is used, else the prediction. A state that the known input alone decides, such as
an own speed by odometry, follows that input. Any other keeps its prior. S is that of a regression with the sensor's noise: R where nothing
had to be learned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, NamedTuple, TypeVar

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Innovation, Model, Positive, Prior, Received, param
from tailgate.core.registry import register

LARGEST = 1e6  # an extrapolation does not pass this [unit of the sensor]: an unstable one would leave the numbers
RIDGE = 1e-6  # on the coefficients of a polynomial, which its samples may leave open [-]
Order = Annotated[int, Field(ge=1, le=20)]
Degree = Annotated[int, Field(ge=0, le=4)]
Samples = Annotated[int, Field(ge=2, le=1000)]


def read_states(model: Model, where: str) -> Array:
    """Return the state (N, q) that each sensor reads.

    Raise NotApplicable unless each reads one state itself, all different within an agent.
    """
    direct = np.isin(model.C, (0.0, 1.0)).all() and (np.count_nonzero(model.C, axis=2) == 1).all()
    state = np.argmax(model.C, axis=2)
    if not direct or any(len(set(row)) < len(row) for row in state.tolist()):
        raise NotApplicable(where, "this sensor matrix", "sensors that each read one state directly, no two of an agent the same")
    return np.asarray(state)


M = TypeVar("M")  # memory of a predictor


class PredictorPlan(NamedTuple):
    C: Array  # (N, q, n)
    R: Array  # (N, q) variances
    agent: Array  # (N, 1)
    state: Array  # (N, q) which state a sensor reads
    inputs: Array  # (n, m) B in the rows of the states that the known input alone decides, else 0
    by_input: Array  # (n,) bool: these states


class PredictorState(NamedTuple, Generic[M]):
    """Every leaf has B first."""

    x: Array  # (B, N, n)
    spread: Array  # (B, N, q) variance of the next reading about its prediction
    past: M


@dataclass(frozen=True)
class Predictor(Generic[M]):
    """Base class: a subclass chooses what it keeps (`begin`), what follows from it (`ahead`) and what it learns (`learn`)."""

    def begin(self, plan: PredictorPlan, y: Array) -> M:
        """Return the memory before the first reading; y (B, N, q) are the readings that the prior predicts."""
        raise TypeError(f"{type(self).__name__} must define begin()")

    def ahead(self, plan: PredictorPlan, past: M) -> tuple[M, Array, Array]:
        """Return one step later: the memory, the predicted readings (B, N, q), and their variance."""
        raise TypeError(f"{type(self).__name__} must define ahead()")

    def learn(self, plan: PredictorPlan, past: M, y: Array, accept: Array) -> M:
        """Return the memory after the readings y (B, N, q) of `accept` (B, N, q)."""
        raise TypeError(f"{type(self).__name__} must define learn()")

    def prepare(self, model: Model) -> PredictorPlan:
        by_input = np.asarray(~model.A.any(axis=1) & model.B.any(axis=1))
        R = model.R.diagonal(axis1=-2, axis2=-1).copy()
        agent = np.arange(model.agents)[:, None]
        state = read_states(model, f"filter {type(self).__name__}")
        return PredictorPlan(model.C, R, agent, state, model.B * by_input[:, None], by_input)

    def start(self, plan: PredictorPlan, prior: Prior) -> PredictorState[M]:
        y = num.matvec(plan.C, prior.mean)
        return PredictorState(prior.mean, num.full(y.shape, plan.R), self.begin(plan, y))

    def predict(self, plan: PredictorPlan, state: PredictorState[M], known_u: Array) -> PredictorState[M]:
        past, y, spread = self.ahead(plan, state.past)
        x = np.where(plan.by_input, num.matvec(plan.inputs, known_u), state.x)
        x[:, plan.agent, plan.state] = np.clip(y, -LARGEST, LARGEST)
        return PredictorState(x, spread, past)

    def innovation(self, plan: PredictorPlan, state: PredictorState[M], received: Received) -> Innovation:
        r = np.where(received.valid, received.y - num.matvec(plan.C, state.x), 0.0)
        S = num.zeros((*r.shape, r.shape[-1]))
        for i in range(r.shape[-1]):
            S[..., i, i] = state.spread[..., i]
        return Innovation(r, S)

    def update(self, plan: PredictorPlan, state: PredictorState[M], innovation: Innovation, accept: Array) -> PredictorState[M]:
        y = num.matvec(plan.C, state.x) + np.where(accept, innovation.r, 0.0)
        x = state.x.copy(order="K")
        x[:, plan.agent, plan.state] = y
        return PredictorState(x, state.spread, self.learn(plan, state.past, y, accept))

    def forget(self, plan: PredictorPlan, state: PredictorState[M], where: Array) -> PredictorState[M]:
        """Return the state: the next reading is believed entirely anyway."""
        return state

    def gain(self, plan: PredictorPlan, state: PredictorState[M], innovation: Innovation) -> Array:
        return np.broadcast_to(num.transpose(plan.C), (*innovation.r.shape[:2], *plan.C.shape[:0:-1]))

    def estimate(self, state: PredictorState[M]) -> Array:
        return state.x


class Last(NamedTuple):
    y: Array  # (B, N, q)


@register("filter", "hold_last")
@dataclass(frozen=True)
class HoldLast(Predictor[Last]):
    """Holds the last reading."""

    def begin(self, plan: PredictorPlan, y: Array) -> Last:
        return Last(y)

    def ahead(self, plan: PredictorPlan, past: Last) -> tuple[Last, Array, Array]:
        return past, past.y, num.full(past.y.shape, 2.0 * plan.R)

    def learn(self, plan: PredictorPlan, past: Last, y: Array, accept: Array) -> Last:
        return Last(y)


class Lags(NamedTuple):
    h: Array  # (B, N, q, p) the last readings, or their predictions, the newest first
    w: Array  # (B, N, q, p) coefficients
    P: Array  # (B, N, q, p, p) their covariance over the variance of a reading
    seen: Array  # (B, N, q) readings so far


@register("filter", "autoregressive", reference="S. Haykin, Adaptive Filter Theory, 2002: recursive least squares")
@dataclass(frozen=True)
class Autoregressive(Predictor[Lags]):
    """Autoregression of each reading on its own last ones, by recursive least squares; it holds the last one at first."""

    order: Order = param(4, "readings that the next one is regressed on")
    delta: Positive = param(1.0, "variance of a coefficient before the first reading, over that of a reading [1/unit^2]")

    def begin(self, plan: PredictorPlan, y: Array) -> Lags:
        shape, first = (*y.shape, self.order), np.eye(self.order)[0]
        P = num.full((*shape, self.order), self.delta * np.eye(self.order))
        return Lags(num.full(shape, y[..., None]), num.full(shape, first), P, num.zeros(y.shape))

    def ahead(self, plan: PredictorPlan, past: Lags) -> tuple[Lags, Array, Array]:
        y = np.clip(num.dot(past.w, past.h), -LARGEST, LARGEST)
        return past, y, plan.R * (1.0 + num.quadratic(past.h, past.P))

    def learn(self, plan: PredictorPlan, past: Lags, y: Array, accept: Array) -> Lags:
        h, w, P, seen = past
        known = accept & (seen >= self.order)  # the values before the first reading would be learned for good
        g = num.matvec(P, h)
        j = g / (1.0 + num.dot(h, g))[..., None]
        error = y - np.clip(num.dot(w, h), -LARGEST, LARGEST)
        w = np.where(known[..., None], w + j * error[..., None], w)
        P = np.where(known[..., None, None], P - j[..., :, None] * g[..., None, :], P)
        return Lags(num.stack([y, *(h[..., i] for i in range(self.order - 1))]), w, P, seen + accept)


class Ring(NamedTuple):
    base: Array  # (B, N, q) the last reading, from which the others are counted
    y: Array  # (B, N, q, W) the last readings, the newest first
    age: Array  # (B, N, q, W) steps since each
    there: Array  # (B, N, q, W) bool


@register("filter", "polynomial", reference="W. S. Cleveland, Robust locally weighted regression, 1979: local least squares, unweighted")
@dataclass(frozen=True)
class Polynomial(Predictor[Ring]):
    """Least-squares polynomial through the last readings of each sensor, extrapolated."""

    degree: Degree = param(2, "degree of the polynomial")
    window: Samples = param(20, "readings that it is fitted to")

    def __post_init__(self) -> None:
        if self.window <= self.degree:
            raise InputError("filter polynomial.window", self.window, f"more than the degree ({self.degree})")

    def begin(self, plan: PredictorPlan, y: Array) -> Ring:
        shape = (*y.shape, self.window)
        return Ring(y, num.zeros(shape), num.zeros(shape), num.zeros(shape, bool))

    def ahead(self, plan: PredictorPlan, past: Ring) -> tuple[Ring, Array, Array]:
        past, size = past._replace(age=past.age + past.there), self.degree + 1
        now = past.age[..., 0] / self.window  # from the newest reading, in windows
        t = now[..., None] - past.age / self.window
        M, b = num.full((*now.shape, size, size), RIDGE * np.eye(size)), num.zeros((*now.shape, size))
        for j in range(self.window):
            h = _powers(t[..., j], size)
            weight = past.there[..., j].astype(np.float64)
            M += weight[..., None, None] * (h[..., :, None] * h[..., None, :])
            b += (weight * (past.y[..., j] - past.base))[..., None] * h
        P, h = num.inverse(M), _powers(now, size)
        return past, past.base + num.dot(h, num.matvec(P, b)), plan.R * (1.0 + num.quadratic(h, P))

    def learn(self, plan: PredictorPlan, past: Ring, y: Array, accept: Array) -> Ring:
        shifted = [num.zeros(past.age.shape, leaf.dtype) for leaf in past[1:]]
        for new, leaf, first in zip(shifted, past[1:], (y, 0.0, True), strict=True):
            new[..., 1:], new[..., 0] = leaf[..., :-1], first
        held = [np.where(accept[..., None], new, leaf) for new, leaf in zip(shifted, past[1:], strict=True)]
        return Ring(np.where(accept, y, past.base), *held)


def _powers(t: Array, size: int) -> Array:
    """Return (..., size): 1, t, t^2, ..."""
    out = [np.ones_like(t)]
    for _ in range(size - 1):
        out.append(out[-1] * t)
    return num.stack(out)
