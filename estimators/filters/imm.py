"""The interacting multiple model filter (Blom and Bar-Shalom 1988): one plant, several beliefs about its sensors.

Model j takes the noise of every sensor for factor_j R. With mode probabilities mu, Markov transition probabilities T, and c = mu T:

    mix        x0_j = sum_i w_ij x_i,    P0_j = sum_i w_ij (P_i + (x_i - x0_j)(x_i - x0_j)'),    w_ij = T_ij mu_i / c_j
    filter     a Kalman step of each model from (x0_j, P0_j): x_j, P_j, r_j, S_j
    weigh      mu_j ~ c_j N(r_j; 0, S_j), over the sensors that were received
    combine    x = sum_j mu_j x_j

The score is the log odds of "some sensor noise is inflated" against the nominal model; an alarm at 0 is one at probability 1/2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Estimate, Finite, Innovation, Mode, Model, Positive, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.filters.kalman import SMALL, KalmanFilter, KalmanPlan, KalmanState

Inside = Annotated[float, Field(gt=0, lt=1)]
Factors = Annotated[tuple[Positive, ...], Field(min_length=1)]
LOG_2_PI = 1.8378770664093453
LEAST = 1e-300  # a model never has probability 0: the chain could not divide by it


class ImmPlan(NamedTuple):
    models: tuple[KalmanPlan, ...]
    moves: Array  # (M, M) transition probabilities, from row to column
    start: Array  # (M,) mode probabilities of the prior


class ImmState(NamedTuple):
    models: tuple[KalmanState, ...]
    mu: Array  # (B, N, M) mode probabilities


@dataclass(frozen=True)
class Modes:
    """The models, and the chances of moving from one to another."""

    factors: Factors = param((1.0, 1e4), "factor on R in each model, the nominal one first [-]")
    leave: Inside = param(0.01, "probability a step of leaving the nominal model, shared among the others [-]")
    back: Inside = param(0.1, "probability a step of each other model to return to the nominal one [-]")

    def moves(self) -> Array:
        """Return (M, M) transition probabilities, from row to column."""
        others = len(self.factors) - 1
        out = np.diag([1.0 - self.leave if others else 1.0, *[1.0 - self.back] * others])
        out[0, 1:], out[1:, 0] = self.leave / max(others, 1), self.back
        return out

    def share(self) -> Array:
        """Return the long-run share (M,) of each model: its probability before the first measurement."""
        others = len(self.factors) - 1
        if not others:
            return np.ones(1)
        odd = self.leave / (self.leave + self.back)
        return np.array([1.0 - odd, *[odd / others] * others])


@register(
    "defence", "imm",
    reference="Blom and Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching coefficients, 1988",
)  # fmt: skip
@dataclass(frozen=True)
class InteractingModels(Modes):
    """Interacting multiple model filter: Kalman filters that trust the sensors more or less, weighed by how well each predicts."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Finite = param(0.0, "alarm above these log odds of an inflated noise; 0: probability 1/2 [-]")

    def prepare(self, model: Model) -> ImmPlan:
        nominal = KalmanFilter().prepare(model)
        return ImmPlan(tuple(nominal._replace(R=factor * model.R) for factor in self.factors), self.moves(), self.share())

    def start(self, plan: ImmPlan, prior: Prior) -> ImmState:
        mu = num.full((*prior.mean.shape[:2], len(plan.start)), plan.start)
        return ImmState(tuple(KalmanFilter().start(model, prior) for model in plan.models), mu)

    def step(self, plan: ImmPlan, state: ImmState, received: Received, known_u: Array, draws: Draws) -> tuple[ImmState, Estimate]:
        kf, logs, models = KalmanFilter(), [], []
        for model, (mixed, c) in zip(plan.models, mix(state, plan.moves), strict=True):
            belief = kf.predict(model, mixed, known_u)
            innovation = kf.innovation(model, belief, received)
            logs.append(num.log(c) + log_likelihood(innovation, received.valid))
            models.append(kf.update(model, belief, innovation, received.valid))
        mu, odds = weigh(logs)
        x = combine([m.x for m in models], mu)
        alarm = odds > self.threshold
        estimate = Estimate(x, odds, alarm, num.full(alarm.shape, Mode.NORMAL, np.int8), np.ones_like(alarm))
        return ImmState(tuple(models), mu), estimate


def mix(state: ImmState, moves: Array) -> list[tuple[KalmanState, Array]]:
    """Return the mixed start of each model's step, and its probability c (B, N) before the measurement."""
    out = []
    for j in range(len(state.models)):
        parts = [moves[i, j] * state.mu[..., i] for i in range(len(state.models))]
        c = summed(parts)
        w = [part / c for part in parts]
        x = summed([w[i][..., None] * m.x for i, m in enumerate(state.models)])
        out.append((KalmanState(x, _spread(w, [m.P for m in state.models], [m.x - x for m in state.models])), c))
    return out


def merged(held: Sequence[KalmanState], weights: Sequence[Array]) -> KalmanState:
    """Return the Gaussian with mean and covariance of a mixture of weights (B, N), up to a factor; the first alone where all are 0."""
    total = summed(weights)
    some = total > 0.0
    w = [np.where(some, part / np.where(some, total, 1.0), 1.0 if j == 0 else 0.0) for j, part in enumerate(weights)]
    x = summed([part[..., None] * one.x for part, one in zip(w, held, strict=True)])
    return KalmanState(x, _spread(w, [one.P for one in held], [one.x - x for one in held]))


def _spread(w: Sequence[Array], P: Sequence[Any], off: Sequence[Array]) -> Array:
    """Return sum_i w_i (P_i + off_i off_i') (B, N, n, n)."""
    if off[0].shape[-1] > SMALL:
        return num.moment(w, P, off)
    return summed([a[..., None, None] * (p + d[..., :, None] * d[..., None, :]) for a, p, d in zip(w, P, off, strict=True)])


def log_likelihood(innovation: Innovation, valid: Array) -> Array:
    """Return log N(r; 0, S) (B, N) of the readings that were received."""
    r, S = innovation
    left = np.where(valid[..., :, None] & valid[..., None, :], S, np.eye(r.shape[-1]))  # a missing one weighs the same in every model
    out = -0.5 * (num.quadratic(r, num.inverse(left)) + np.count_nonzero(valid, axis=-1) * LOG_2_PI)
    left = left.copy()
    for p in range(r.shape[-1]):
        out = out - 0.5 * num.log(left[..., p, p])
        for i in range(p + 1, r.shape[-1]):
            left[..., i, :] -= left[..., i, p, None] / left[..., p, p, None] * left[..., p, :]
    return np.asarray(out)


def weigh(logs: Sequence[Array]) -> tuple[Array, Array]:
    """Return mode probabilities (B, N, M) from logarithms up to a constant, and the log odds (B, N) against the first; 0 if it is alone."""
    largest = logs[0]
    for log in logs[1:]:
        largest = np.maximum(largest, log)
    weights = [np.maximum(num.exp(log - largest), LEAST) for log in logs]
    total = summed(weights)
    if len(logs) == 1:
        return num.stack([weights[0] / total]), np.zeros_like(total)
    other = logs[1]
    for log in logs[2:]:
        other = np.maximum(other, log)
    odds = other + num.log(summed([num.exp(log - other) for log in logs[1:]])) - logs[0]
    return num.stack([w / total for w in weights]), odds


def combine(columns: Sequence[Array], mu: Array) -> Array:
    """Return sum_j mu_j x_j (B, N, n)."""
    return summed([mu[..., j, None] * x for j, x in enumerate(columns)])


def summed(terms: Sequence[Array]) -> Array:
    """Return the sum in the order of the terms."""
    out = terms[0]
    for term in terms[1:]:
        out = out + term
    return out
