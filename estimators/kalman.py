"""The Kalman filter (Kalman 1960), each agent on its own measurements.

    x- = A x + B u + c          P- = A P A' + Q                                                        (4.5)
    r = y - C x-                S = C P- C' + R          K = P- C' S^-1                                 (4.6)
    x = x- + K r                P = P- - K S K'                                                        (4.7)

A sensor that is not accepted has its row of C, and its covariances in S, set to zero: no sensor at all gives x = x-, P = P-.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Model, Prior, Received
from tailgate.registry import register

from .compose import AcceptAll, Composed, Detector, Filter, Mitigation, Score


class KalmanPlan(NamedTuple):
    A: Array
    B: Array
    c: Array
    C: Array  # (N, q, n)
    Q: Array
    R: Array  # (N, q, q)
    broad: Array  # (n,) variances of a filter that has forgotten


class KalmanState(NamedTuple):
    """x (B, N, n) and P (B, N, n, n); predicted or updated."""

    x: Array
    P: Array


def alone(S: Array, keep: Array) -> Array:
    """S with the covariances of the sensors that `keep` (B, N, q) leaves out set to zero: those that stay see their own marginal."""
    if keep.all():
        return S
    out = S * (keep[..., :, None] & keep[..., None, :])
    for i in range(S.shape[-1]):
        out[..., i, i] = S[..., i, i]
    return out


def broad(model: Model) -> Array:
    """(n,) variances so large that the next measurement decides: a million times those after 100 steps of the filter."""
    P = np.array(model.Q)
    for _ in range(100):
        C, R = model.C[0], model.R[0]
        S = num.matmul(num.matmul(C, P), num.transpose(C)) + R
        K = num.matmul(num.matmul(P, num.transpose(C)), num.inverse(S))
        P = P - num.matmul(num.matmul(K, C), P)
        P = num.matmul(num.matmul(model.A, P), num.transpose(model.A)) + model.Q
    return np.asarray(1e6 * np.maximum(P.diagonal(), 1e-12))


@register("filter", "kf", reference="R. E. Kalman, A New Approach to Linear Filtering and Prediction Problems, 1960")
@dataclass(frozen=True)
class KalmanFilter:
    """The textbook filter, time-varying gain."""

    def prepare(self, model: Model) -> KalmanPlan:
        return KalmanPlan(model.A, model.B, model.c, model.C, model.Q, model.R, broad(model))

    def start(self, plan: KalmanPlan, prior: Prior) -> KalmanState:
        return KalmanState(prior.mean, prior.cov)

    def predict(self, plan: KalmanPlan, state: KalmanState, known_u: Array) -> KalmanState:
        x = num.matvec(plan.A, state.x) + num.matvec(plan.B, known_u) + plan.c
        half = num.matmul(plan.A, state.P)
        return KalmanState(x, num.matmul(plan.A, num.transpose(half)) + plan.Q)

    def innovation(self, plan: KalmanPlan, state: KalmanState, received: Received) -> Innovation:
        r = np.where(received.valid, received.y - num.matvec(plan.C, state.x), 0.0)
        cross = num.matmul(plan.C, state.P)
        return Innovation(r, alone(num.matmul(plan.C, num.transpose(cross)) + plan.R, received.valid))

    def gain(self, plan: KalmanPlan, state: KalmanState, innovation: Innovation) -> Array:
        cross = num.transpose(num.matmul(plan.C, state.P))  # P- C'
        return num.matmul(cross, num.inverse(innovation.S))

    def update(self, plan: KalmanPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        cross = num.matmul(plan.C, state.P)  # C P-
        S, r = innovation.S, innovation.r
        if not accept.all():  # multiplying by one would change no bit of the other rows
            keep = accept.astype(np.float64)
            cross = cross * keep[..., None]
            S = alone(S, accept)
            r = r * keep
        K = num.transpose(num.matmul(num.inverse(S), cross))
        x = state.x + num.matvec(K, r)
        P = state.P - num.matmul(K, cross)
        return KalmanState(x, 0.5 * (P + num.transpose(P)))

    def forget(self, plan: KalmanPlan, state: KalmanState, where: Array) -> KalmanState:
        return KalmanState(state.x, np.where(where[..., None, None], np.diag(plan.broad), state.P))

    def estimate(self, state: KalmanState) -> Array:
        return state.x


@register("defence", "kf", reference="R. E. Kalman, A New Approach to Linear Filtering and Prediction Problems, 1960")
@dataclass(frozen=True)
class Kalman(Composed):
    """Kalman filter that believes every measurement."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Score(), AcceptAll()
