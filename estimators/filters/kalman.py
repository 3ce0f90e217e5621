"""The Kalman filter (Kalman 1960), each agent on its own measurements.

    x- = A x + B u + c          P- = A P A' + Q                                                        (4.5)
    r = y - C x-                S = C P- C' + R          K = P- C' S^-1                                 (4.6)
    x = x- + K r                P = P- - K S K'                                                        (4.7)

For a sensor that is not accepted, its row of C and its covariances in S are zero. No sensor at all gives x = x-, P = P-.

The steady filter holds P- at the solution of P- = A (P- - K S K') A' + Q. Its gain is constant for each set of sensors. Where some are
left out, the others correct with the gain that they have alone at the same P-. Missing readings do not widen its S.
"""

from dataclasses import dataclass
from typing import Generic, Literal, NamedTuple, Protocol, cast

import numpy as np
from typing_extensions import TypeVar

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.base.memo import remembered
from tailgate.core import Array, Innovation, Model, Prior, Received, param
from tailgate.core.reach import blind
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, Score
from tailgate.estimators.parts import Detector, Filter, Mitigation

Gain = Literal["varying", "steady"]
LEAST = 1e-18  # variance that a filter divides by, at least
SMALL = 4  # states: matrices up to here are multiplied as they stand, larger ones by kernels of whole passes, to the same bits
GAIN = "varying: the gain follows the covariance; steady: both are held where they settle when nothing is missed"


class KalmanPlan(NamedTuple):
    A: Array
    B: Array
    c: Array
    C: Array  # (N, q, n)
    Q: Array
    R: Array  # (N, q, q)
    broad: Array  # (n,) variances of a filter that has forgotten; the same for all agents
    held: Array | None = None  # (N, n, n) P- of the steady filter


class LinearPlan(Protocol):
    """The constants that the recursion reads; see KalmanPlan for their shapes."""

    @property
    def A(self) -> Array: ...
    @property
    def B(self) -> Array: ...
    @property
    def c(self) -> Array: ...
    @property
    def C(self) -> Array: ...
    @property
    def R(self) -> Array: ...
    @property
    def Q(self) -> Array: ...
    @property
    def broad(self) -> Array: ...
    @property
    def held(self) -> Array | None: ...


L = TypeVar("L", bound=LinearPlan, default=KalmanPlan)


class KalmanState(NamedTuple):
    """x (B, N, n) and P (B, N, n, n), predicted or updated. P is None in a steady filter: its plan holds it."""

    x: Array
    P: Array | None
    trust: Array | None = None  # (B, N, N) in [0, 1], [i, j] that of i in j; of a filter that weighs its neighbours by it


def alone(S: Array, keep: Array) -> Array:
    """Return S with the covariances of the sensors outside `keep` (B, N, q) set to zero: the others keep their own marginal."""
    return cast(Array, num.elsewhere(keep.all(axis=-1), S, _marginal, S, keep))


def _marginal(S: Array, keep: Array) -> Array:
    out = S * (keep[..., :, None] & keep[..., None, :])
    for i in range(S.shape[-1]):
        out[..., i, i] = S[..., i, i]
    return out


def gain_of(S: Array, cross: Array) -> Array:
    """Return the gain P- C' S^-1 (..., n, q) from S (..., q, q) and C P- (..., q, n)."""
    return num.transpose(num.matmul(num.inverse(S), cross))


def updated(x: Array, P: Array, r: Array, S: Array, cross: Array) -> tuple[Array, Array]:
    """Return x (..., n) and P (..., n, n) after the update (4.7) with the innovation r (..., q), from S and `cross` = C P-."""
    K = gain_of(S, cross)
    P = P - num.matmul(K, cross)
    return x + num.matvec(K, r), 0.5 * (P + num.transpose(P))


def precision(R: Array) -> Array:
    """Return R^-1 (q, q). Raise NotApplicable where a reading has no noise: the filter divides by it."""
    told = R.diagonal()
    if (told < LEAST).any():
        raise NotApplicable("sensor: noise variance", told.tolist(), f"{LEAST:g} or more in every reading: this filter divides by it")
    return num.inverse(R)


@remembered("A", "C", "Q", "R")
def broad(model: Model) -> Array:
    """Return variances (n,) so large that the next measurement decides: a million times those after 100 steps of the filter."""
    P = np.array(model.Q)
    if (model.R.diagonal(axis1=1, axis2=2) < LEAST).any():  # then the process has to be noisy
        unsure = (num.matmul(num.matmul(model.C, P), num.transpose(model.C)) + model.R).diagonal(axis1=1, axis2=2)
        if (unsure < LEAST).any():
            wanted = f"noise of sensor or process, {LEAST:g} or more in every reading: a filter divides by its variance"
            raise NotApplicable("model: variance of a reading", unsure.tolist(), wanted)
    for _ in range(100):
        C, R = model.C[0], model.R[0]
        S = num.matmul(num.matmul(C, P), num.transpose(C)) + R
        K = num.matmul(num.matmul(P, num.transpose(C)), num.inverse(S))
        P = P - num.matmul(num.matmul(K, C), P)
        P = num.matmul(num.matmul(model.A, P), num.transpose(model.A)) + model.Q
    return np.asarray(1e6 * np.maximum(P.diagonal(), 1e-12))


def riccati(A: Array, G: Array, Q: Array) -> Array | None:
    """Return P = A (P^-1 + G)^-1 A' + Q (n, n), predicted for one agent with the information G = C' R^-1 C; None where it grows.

    By structured doubling (Anderson 1978): round j gives what 2^j steps of the filter give.
    """
    F, H, eye = np.array(A.T), np.array(Q), np.eye(len(A))
    with np.errstate(all="ignore"):  # without a limit it overflows
        for _ in range(64):
            W = num.solve(eye + num.product(G, H), eye)
            FW = num.product(F, W)
            grown = num.product(num.product(num.product(F.T, H), W), F)
            G = G + num.product(num.product(FW, G), F.T)
            H = H + 0.5 * (grown + grown.T)
            F = num.product(FW, F)  # the closed loop to the power 2^j
            scale = np.sqrt(H.diagonal()[:, None] * H.diagonal())
            if (np.abs(grown) <= 1e-15 * scale).all() and (np.abs(F) <= 1e-8).all():
                return H
    return None


def _settle(A: Array, C: Array, Q: Array, R: Array, P: Array) -> Array:
    """Return P- (n, n) after 64 more steps of the filter in Joseph's form, which wash out the rounding of the doubling."""
    for _ in range(64):
        S = num.matmul(num.matmul(C, P), C.T) + R
        K = num.matmul(num.matmul(P, C.T), num.inverse(S))
        left = np.eye(len(A)) - num.matmul(K, C)
        P = num.matmul(num.matmul(left, P), left.T) + num.matmul(num.matmul(K, R), K.T)
        P = num.matmul(num.matmul(A, P), A.T) + Q
        P = 0.5 * (P + P.T)
    return P


@remembered("A", "C", "Q", "R")
def steady_state(model: Model) -> Array:
    """Return P- (N, n, n) at which the predicted covariances settle. Raise NotApplicable, naming the agents, where they do not."""
    lost = blind(model, np.eye(model.agents, dtype=bool))  # the doubling may let an unseen mode settle
    out = []
    for i in range(0 if lost else model.agents):
        C = model.C[i]
        P = riccati(model.A, num.matmul(num.matmul(C.T, precision(model.R[i])), C), model.Q)
        if P is None:
            lost.append(i)
        else:
            out.append(_settle(model.A, C, model.Q, model.R[i], P))
    if lost:
        wanted = "(A, C) detectable and process noise on every mode that does not die out, so that the filter has a steady state"
        raise NotApplicable("model", f"agents {', '.join(map(str, lost))} on their own sensors", wanted)
    return np.stack(out)


def kalman_plan(model: Model, steady: bool) -> KalmanPlan:
    """Return the constants of the recursion; a steady one holds P- where it settles."""
    held = steady_state(model) if steady else None
    return KalmanPlan(model.A, model.B, model.c, model.C, model.Q, model.R, broad(model), held)


class LinearFilter(Generic[L]):
    """The recursion. A subclass makes the plan, a KalmanPlan or another type with its fields."""

    def start(self, plan: L, prior: Prior) -> KalmanState:
        return KalmanState(prior.mean, prior.cov if plan.held is None else None)

    def predict(self, plan: L, state: KalmanState, known_u: Array) -> KalmanState:
        x = num.matvec(plan.A, state.x) + num.matvec(plan.B, known_u) + plan.c
        if state.P is None:
            return KalmanState(x, None)
        if len(plan.A) > SMALL:
            return KalmanState(x, num.congruent(plan.A, state.P, plan.Q))
        half = num.matmul(plan.A, state.P)
        return KalmanState(x, num.matmul(plan.A, num.transpose(half)) + plan.Q)

    def innovation(self, plan: L, state: KalmanState, received: Received) -> Innovation:
        r = np.where(received.valid, received.y - num.matvec(plan.C, state.x), 0.0)
        S = num.matmul(plan.C, num.transpose(self._cross(plan, state))) + plan.R
        return Innovation(r, alone(np.broadcast_to(S, (*r.shape, r.shape[-1])), received.valid))

    def gain(self, plan: L, state: KalmanState, innovation: Innovation) -> Array:
        cross = num.transpose(self._cross(plan, state))  # P- C'
        return num.matmul(cross, num.inverse(innovation.S))

    def update(self, plan: L, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        S, r = innovation.S, innovation.r
        if len(plan.A) > SMALL and state.P is not None and plan.held is None:
            return KalmanState(*num.corrected(plan.C, num.inverse(alone(S, accept)), state.x, state.P, r, accept))
        cross = self._cross(plan, state)
        if not num.every(accept):  # multiplying by one would change no bit of the other rows
            keep = accept.astype(np.float64)
            cross = cross * keep[..., None]
            S = alone(S, accept)
            r = r * keep
        if state.P is None or plan.held is not None:
            return KalmanState(state.x + num.matvec(gain_of(S, cross), r), None)
        return KalmanState(*updated(state.x, state.P, r, S, cross))

    def forget(self, plan: L, state: KalmanState, where: Array) -> KalmanState:
        """Return the state with the broad covariance in the rows of `where` (B, N); a steady filter forgets for this one step."""
        return KalmanState(state.x, np.where(where[..., None, None], np.diag(plan.broad), self._predicted(plan, state)))

    def estimate(self, state: KalmanState) -> Array:
        return state.x

    def _predicted(self, plan: L, state: KalmanState) -> Array:
        P = plan.held if state.P is None else state.P
        assert P is not None
        return P

    def _cross(self, plan: L, state: KalmanState) -> Array:
        """Return C P- (B, N, q, n), or (N, q, n) where it is the same for all."""
        return num.matmul(plan.C, self._predicted(plan, state))


@register("filter", "kf", reference="R. E. Kalman, A New Approach to Linear Filtering and Prediction Problems, 1960")
@dataclass(frozen=True)
class KalmanFilter(LinearFilter):
    """The textbook filter, with a time-varying gain or in steady state."""

    steady: bool = param(False, "hold gain and covariance where they settle when nothing is missed")

    def prepare(self, model: Model) -> KalmanPlan:
        return kalman_plan(model, self.steady)


@register("defence", "kf", reference="R. E. Kalman, A New Approach to Linear Filtering and Prediction Problems, 1960")
@dataclass(frozen=True)
class Kalman(Composed):
    """Kalman filter that believes every measurement."""

    gain: Gain = param("varying", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(self.gain == "steady"), Score(), AcceptAll()
