"""filterpy's filters (R. Labbe) as defences: second opinions from an independent implementation, one episode after the other.

Each leaves out the sensors that were not received, keeps the known input, and scores r' S^-1 r. None alarms. The library is imported
when a filter is first made.
"""

import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Finite, Model, NonNegative, Prior, param
from tailgate.core.registry import register
from tailgate.estimators.filters.imm import LEAST, Modes
from tailgate.estimators.filters.kalman import precision
from tailgate.estimators.per_episode import EpisodeByEpisode

Share = Annotated[float, Field(ge=0, lt=1)]
Alpha = Annotated[float, Field(ge=1e-6, le=1e6)]


class KalmanAdapter:
    """filterpy.kalman.KalmanFilter; base of the adapters whose memory is x and P."""

    def build(self, n: int, q: int, m: int) -> Any:
        """Return filterpy's object for n states, q sensors and m inputs."""
        return import_module("filterpy.kalman").KalmanFilter(dim_x=n, dim_z=q, dim_u=m)

    def reset(self, model: Model, prior: Prior) -> None:
        self.model = model
        self.B = np.column_stack([model.B, model.c])  # the constant drift is one more input
        self.filter = self.build(model.states, len(model.sensors), model.inputs + 1)
        self.filter.F, self.filter.B, self.filter.Q = model.A, self.B, model.Q
        self.recall((prior.mean, prior.cov))

    def memory(self) -> tuple[Array, ...]:
        return self.filter.x, self.filter.P

    def recall(self, memory: tuple[Array, ...]) -> None:
        self.filter.x, self.filter.P = memory

    def step(self, y: Array, valid: Array, u: Array) -> tuple[Array, float]:
        self.predict(np.append(u, 1.0))
        score = 0.0
        if valid.any():
            score = self.update(y[valid], self.model.C[0][valid], self.model.R[0][np.ix_(valid, valid)])
        return self.filter.x, score

    def predict(self, u: Array) -> None:
        self.filter.predict(u=u)

    def update(self, y: Array, C: Array, R: Array) -> float:
        """Use the readings y with matrix C and noise R; return r' S^-1 r."""
        self.filter.update(y, R=R, H=C)
        return float(num.quadratic(self.filter.y, self.filter.SI))


class ExtendedAdapter(KalmanAdapter):
    """filterpy.kalman.ExtendedKalmanFilter, whose measurement function is the linear one."""

    def build(self, n: int, q: int, m: int) -> Any:
        return import_module("filterpy.kalman").ExtendedKalmanFilter(dim_x=n, dim_z=q, dim_u=m)

    def update(self, y: Array, C: Array, R: Array) -> float:
        self.filter.update(y, HJacobian=lambda x: C, Hx=lambda x: num.matvec(C, x), R=R)
        return float(num.quadratic(self.filter.y, self.filter.SI))


class UnscentedAdapter(KalmanAdapter):
    """filterpy.kalman.UnscentedKalmanFilter with Merwe's scaled sigma points."""

    def __init__(self, alpha: float, beta: float, kappa: float) -> None:
        self.spread = (alpha, beta, kappa)

    def build(self, n: int, q: int, m: int) -> Any:
        library = import_module("filterpy.kalman")
        points = library.MerweScaledSigmaPoints(n, *self.spread, sqrt_method=root)
        return library.UnscentedKalmanFilter(n, q, self.model.dt, hx=None, fx=self._move, points=points)

    def _move(self, x: Array, dt: float, u: Array) -> Array:
        return num.matvec(self.model.A, x) + num.matvec(self.B, u)

    def update(self, y: Array, C: Array, R: Array) -> float:
        self.filter.update(y, R=R, hx=lambda x: num.matvec(C, x))
        self.filter.P = 0.5 * (self.filter.P + self.filter.P.T)
        return float(num.quadratic(self.filter.y, self.filter.SI))


def root(P: Array) -> Array:
    """Return upper triangular U (n, n) with U' U = P, also where P is singular: a state without variance gets a row of zeros."""
    U = np.zeros_like(P)
    for i in range(len(P)):
        rest = P[i, i:].copy()
        for k in range(i):
            rest -= U[k, i] * U[k, i:]
        if rest[0] > 1e-14 * P[i, i]:
            U[i, i:] = rest / np.sqrt(rest[0])
    return U


class HInfinityAdapter(KalmanAdapter):
    """The a-posteriori H-infinity filter on the measurement update of filterpy.hinfinity.HInfinityFilter.

    filterpy's class warns that it is likely wrong: it scales the correction by F once too often, and predicts no covariance. Its gain is
    the one-step predictor's, which overshoots where P-^-1 > gamma C'R^-1 C fails. So its update is used with F = I and W = 0, with gamma
    for the covariance and without for the gain. The prediction is made here (Hassibi, Sayed and Kailath 1996):

        K = P- C' S^-1          P^-1 = P-^-1 + C'R^-1 C - gamma C'R^-1 C

    With these weights P is positive definite for every gamma < 1: the filter cannot break down, and needs no other guard.
    """

    def __init__(self, gamma: float) -> None:
        self.gamma = gamma

    def build(self, n: int, q: int, m: int) -> Any:
        library = import_module("filterpy.hinfinity")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the warning is heeded, see above
            return library.HInfinityFilter(n, q, m, gamma=self.gamma)

    def predict(self, u: Array) -> None:
        f, A = self.filter, self.model.A
        f.F = A
        f.predict(u)
        f.P = num.matmul(num.matmul(A, f.P), A.T) + self.model.Q

    def update(self, y: Array, C: Array, R: Array) -> float:
        f = self.filter
        x, P, r = f.x, f.P, y - num.matvec(C, f.x)
        f.F, f.H, f.V, f.Q = np.eye(len(x)), C, R, num.matmul(num.matmul(C.T, precision(R)), C)
        f.gamma = self.gamma
        f.update(y)
        after = f.P
        f.x, f.P, f.gamma = x, P, 0.0
        f.update(y)
        f.P = after
        return float(num.quadratic(r, num.inverse(num.matmul(num.matmul(C, P), C.T) + R)))


class InteractingAdapter(KalmanAdapter):
    """filterpy.kalman.IMMEstimator over filterpy's Kalman filters. Its memory is x and P of each model, and the mode probabilities."""

    def __init__(self, modes: Modes) -> None:
        self.modes = modes

    def reset(self, model: Model, prior: Prior) -> None:
        self.model, count = model, len(self.modes.factors)
        library = import_module("filterpy.kalman")
        self.bank = [library.KalmanFilter(model.states, len(model.sensors), model.inputs + 1) for _ in self.modes.factors]
        for f in self.bank:
            f.F, f.B, f.Q = model.A, np.column_stack([model.B, model.c]), model.Q
        self.recall((np.stack([prior.mean] * count), np.stack([prior.cov] * count), self.modes.share()))

    def memory(self) -> tuple[Array, ...]:
        return np.stack([f.x for f in self.bank]), np.stack([f.P for f in self.bank]), np.maximum(self.filter.mu, LEAST)

    def recall(self, memory: tuple[Array, ...]) -> None:
        x, P, mu = memory
        for f, mean, cov in zip(self.bank, x, P, strict=True):
            f.x, f.P = mean, cov
        self.filter = import_module("filterpy.kalman").IMMEstimator(self.bank, mu, self.modes.moves())

    def step(self, y: Array, valid: Array, u: Array) -> tuple[Array, float]:
        _, score = super().step(y, valid, u)
        if not valid.any():  # time passes for the modes as well
            self.filter.mu = self.filter.cbar
        x = np.zeros(self.model.states)
        for f, weight in zip(self.bank, self.filter.mu, strict=True):
            x = x + weight * f.x
        return x, score

    def update(self, y: Array, C: Array, R: Array) -> float:
        """Update every model; return the nominal model's score."""
        for f, factor in zip(self.bank, self.modes.factors, strict=True):
            f.dim_z, f.H, f.R = len(y), C, factor * R
        with np.errstate(invalid="ignore"):  # it prepares the next step with probabilities of 0; ours are floored before that
            self.filter.update(y)
        return float(num.quadratic(self.bank[0].y, self.bank[0].SI))


@register("defence", "filterpy_kf", reference="filterpy, KalmanFilter")
@dataclass(frozen=True)
class FilterpyKalman(EpisodeByEpisode):
    """filterpy's Kalman filter, episode by episode."""

    def make(self) -> KalmanAdapter:
        return KalmanAdapter()


@register("defence", "filterpy_ekf", reference="filterpy, ExtendedKalmanFilter")
@dataclass(frozen=True)
class FilterpyExtended(EpisodeByEpisode):
    """filterpy's extended Kalman filter, episode by episode; on linear sensors the Kalman filter."""

    def make(self) -> ExtendedAdapter:
        return ExtendedAdapter()


@register("defence", "filterpy_ukf", reference="filterpy, UnscentedKalmanFilter; van der Merwe 2004")
@dataclass(frozen=True)
class FilterpyUnscented(EpisodeByEpisode):
    """filterpy's unscented Kalman filter, episode by episode; on a linear plant the Kalman filter."""

    alpha: Alpha = param(1.0, "spread of the sigma points; a small one loses digits of positions far from 0 [-]")
    beta: Finite = param(2.0, "weight of the central point in the covariance; 2 suits a Gaussian [-]")
    kappa: NonNegative = param(0.0, "further spread [-]")

    def make(self) -> UnscentedAdapter:
        return UnscentedAdapter(self.alpha, self.beta, self.kappa)


@register(
    "defence", "filterpy_hinfinity",
    reference="Hassibi, Sayed and Kailath, Linear estimation in Krein spaces, part II: applications, 1996; filterpy, HInfinityFilter",
)  # fmt: skip
@dataclass(frozen=True)
class FilterpyHInfinity(EpisodeByEpisode):
    """H-infinity filter on filterpy's update, episode by episode: bounds the worst that disturbances of any kind do to what is measured."""

    gamma: Share = param(
        0.5, "energy of the error of C x, in units of R, is at most 1/gamma of that of the disturbances; 0: the Kalman filter [-]"
    )

    def make(self) -> HInfinityAdapter:
        return HInfinityAdapter(self.gamma)


@register("defence", "filterpy_imm", reference="filterpy, IMMEstimator; Blom and Bar-Shalom 1988")
@dataclass(frozen=True)
class FilterpyInteracting(Modes, EpisodeByEpisode):
    """filterpy's interacting multiple model filter, episode by episode, with the models of `imm`."""

    def __post_init__(self) -> None:
        if len(self.factors) < 2:
            raise InputError("defence filterpy_imm.factors", self.factors, "at least two")

    def make(self) -> InteractingAdapter:
        return InteractingAdapter(self)
