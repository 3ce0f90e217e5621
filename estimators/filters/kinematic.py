"""Joint kinematic recursive least squares: the leader's motion regressed on time, with the trusted odometry of the follower.

    theta = [x_L, v_L, a_L]        d + x_F = [1, t, t^2/2] theta,   weight 1/sd^2        dv + v_F = [0, 1, t] theta,   weight 1/sv^2

Taking theta at the present instant, theta(t + T) = F(T) theta(t), changes nothing of the regression and keeps its numbers small. It is
then the recursion of a Kalman filter without process noise (kalman.py) on x = [d, dv, a_L, v_F] from the covariance delta I.

*Stop.* The fitted leader does not roll back: where its speed has passed zero, time is held at the instant t* at which it did. There the
derivative of v(t*) = 0 by theta is zero, so that the speed's reading says nothing more, and x_L(t*) has the row [1, t*, t*^2/2].

*Reset.* Two-sided CUSUMs of each normalised innovation z = r / sqrt(S) (Page 1954) notice that the leader changed its acceleration:

    s+ = max(0, s+ + z - drift)        s- = max(0, s- - z - drift)        reset: one of them > threshold

The regression then starts again on the last few samples.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Innovation, Model, NonNegative, Positive, Prior, Received, param
from tailgate.core.registry import register
from tailgate.envs.controllers.radar_car import GAP, LEAD_ACCEL, OWN_SPEED, RELATIVE_SPEED, STATES, kinematic
from tailgate.estimators.filters.kalman import KalmanPlan, KalmanState, LinearFilter, alone

LINE = LinearFilter()
Window = Annotated[int, Field(ge=3, le=1000)]
Forgetting = Annotated[float, Field(ge=0.01, le=1)]


def require_kinematic(model: Model, where: str) -> None:
    """Raise NotApplicable unless the model is that of one radar behind a leader of constant acceleration, its own speed known."""
    A, B = kinematic(model.dt)
    same = (np.array_equal(model.A, A), np.array_equal(model.B, B), np.array_equal(model.C, np.eye(STATES)[None, :2]))
    if not all(same):
        raise NotApplicable(f"{where}: sensors", list(model.sensors), "a radar's distance and relative speed, with trusted odometry")


class RegressionPlan(NamedTuple):
    line: KalmanPlan  # plan of the fit, without process noise
    T: float  # [s]
    rows: Array  # (W, 2, 3): of the present [d, v_L, a_L], the readings that are j steps old, j = 0, 1, ..., W - 1
    weight: Array  # (2,) of a reading [1/unit^2]


class RegressionState(NamedTuple):
    """Every leaf has B first. A sample is the leader's position, seen from where the follower is now, and its speed."""

    fit: KalmanState  # x (B, N, 4), P (B, N, 4, 4): now; of a leader that has stopped, as if it rolled back
    age: Array  # (B, N) time since the first instant of the fit [s]
    sums: Array  # (B, N, 4) CUSUM: s+ of d and dv, s- of d and dv
    samples: Array  # (B, N, W, 2), the newest first
    there: Array  # (B, N, W, 2) bool


@register("filter", "joint_rls", reference="Dutta 2018, Algorithm 1, corrected: a joint kinematic regression; its reset: Page 1954")
@dataclass(frozen=True)
class JointRegression:
    """Recursive least squares of the leader's position, speed and acceleration; it starts again when the acceleration changes."""

    delta: Positive = param(1e4, "variance of the fit before the first sample: the inverse weight of the ridge [m^2, (m/s)^2, (m/s^2)^2]")
    forgetting: Forgetting = param(1.0, "weight of a sample one sample later [-]")
    threshold: Positive | None = param(10.0, "the fit starts again above this CUSUM of a normalised innovation [-]; none: never")
    drift: NonNegative = param(0.5, "allowance of the CUSUM a sample [-]")
    window: Window = param(8, "last steps whose samples the new fit starts on")

    def prepare(self, model: Model) -> RegressionPlan:
        require_kinematic(model, "filter joint_rls")
        variances = np.array([self.delta, self.delta, self.delta, 0.0])  # odometry knows the own speed
        line = KalmanPlan(model.A, model.B, model.c, model.C, np.zeros((STATES, STATES)), model.R, variances)
        ago = -model.dt * np.arange(self.window)
        rows = np.zeros((self.window, 2, 3))
        rows[:, 0, 0], rows[:, 0, 1], rows[:, 0, 2] = 1.0, ago, 0.5 * ago * ago
        rows[:, 1, 1], rows[:, 1, 2] = 1.0, ago
        return RegressionPlan(line, model.dt, rows, 1.0 / model.R[0].diagonal())

    def start(self, plan: RegressionPlan, prior: Prior) -> RegressionState:
        """Return the state at step 1; the ridge is centred on the prior's mean."""
        shape = prior.mean.shape[:2]
        fit = KalmanState(prior.mean, num.full((*shape, STATES, STATES), np.diag(plan.line.broad)))
        past = num.zeros((*shape, self.window, 2))
        return RegressionState(fit, num.zeros(shape), num.zeros((*shape, 4)), past, past != 0.0)

    def predict(self, plan: RegressionPlan, state: RegressionState, known_u: Array) -> RegressionState:
        fit = LINE.predict(plan.line, state.fit, known_u)
        moved = 0.5 * plan.T * (state.fit.x[..., OWN_SPEED] + fit.x[..., OWN_SPEED])
        samples, there = num.zeros(state.samples.shape), num.zeros(state.there.shape, bool)
        samples[..., 1:, :], there[..., 1:, :] = state.samples[..., :-1, :], state.there[..., :-1, :]
        samples[..., 0] -= moved[..., None]
        return RegressionState(fit, state.age + plan.T, state.sums, samples, there)

    def innovation(self, plan: RegressionPlan, state: RegressionState, received: Received) -> Innovation:
        return LINE.innovation(_at_stop(plan, state), state.fit, received)

    def gain(self, plan: RegressionPlan, state: RegressionState, innovation: Innovation) -> Array:
        return LINE.gain(_at_stop(plan, state), state.fit, innovation)

    def update(self, plan: RegressionPlan, state: RegressionState, innovation: Innovation, accept: Array) -> RegressionState:
        line, x, P = _at_stop(plan, state), state.fit.x, state.fit.P
        assert P is not None
        y = innovation.r + num.matvec(line.C, x)
        H = np.where(accept[..., None], line.C, 0.0)
        K = num.transpose(num.matmul(num.inverse(alone(innovation.S, accept)), num.matmul(H, P)))
        left = np.eye(STATES) - num.matmul(K, H)
        # Joseph's form: next to delta the usual difference would lose a variance, and its sign
        P = num.matmul(left, num.transpose(num.matmul(left, P))) + num.matmul(K, num.matmul(line.R, num.transpose(K)))
        if self.forgetting < 1.0:
            some = np.asarray(accept.any(axis=-1))
            P = np.where(some[..., None, None], P / self.forgetting, P)
        fit = KalmanState(x + num.matvec(K, np.where(accept, innovation.r, 0.0)), 0.5 * (P + num.transpose(P)))
        samples, there = state.samples.copy(order="K"), state.there.copy(order="K")
        samples[..., 0, 0], samples[..., 0, 1] = y[..., 0], y[..., 1] + x[..., OWN_SPEED]
        there[..., 0, :] = accept
        size = np.sqrt(innovation.S.diagonal(axis1=-2, axis2=-1))
        z = np.asarray(np.where(accept, innovation.r / size, 0.0))
        signed = num.stack([z[..., 0], z[..., 1], -z[..., 0], -z[..., 1]])
        sums = np.where(accept[..., [0, 1, 0, 1]], np.maximum(0.0, state.sums + signed - self.drift), state.sums)
        state = RegressionState(fit, state.age, sums, samples, there)
        if self.threshold is None:
            return state
        changed = np.asarray((sums > self.threshold).any(axis=-1))
        return self._restart(plan, state, changed) if num.some(changed) else state

    def forget(self, plan: RegressionPlan, state: RegressionState, where: Array) -> RegressionState:
        return state._replace(fit=LINE.forget(plan.line, state.fit, where))

    def estimate(self, state: RegressionState) -> Array:
        """Return x (B, N, 4); a fitted leader that has stopped does not move."""
        x, (s, stopped) = state.fit.x.copy(order="K"), _stop(state)
        x[..., :2] = num.matvec(_rows(s, stopped), state.fit.x)
        x[..., LEAD_ACCEL] = np.where(stopped, 0.0, x[..., LEAD_ACCEL])
        return x

    def _restart(self, plan: RegressionPlan, state: RegressionState, where: Array) -> RegressionState:
        """Return least squares on the kept samples, with the ridge around the present fit, in the rows of `where` (B, N)."""
        x = state.fit.x
        theta = num.stack([x[..., GAP], x[..., RELATIVE_SPEED] + x[..., OWN_SPEED], x[..., LEAD_ACCEL]])
        M, b = num.full((*where.shape, 3, 3), np.eye(3) / self.delta), num.zeros((*where.shape, 3))
        for j in range(self.window):
            for i in range(2):
                h = plan.rows[j, i]
                w = plan.weight[i] * state.there[..., j, i]
                M += w[..., None, None] * (h[:, None] * h)
                b += (w * (state.samples[..., j, i] - num.dot(theta, h)))[..., None] * h
        P3 = num.inverse(M)
        theta = theta + num.matvec(P3, b)
        own, P = x[..., OWN_SPEED], num.zeros((*where.shape, STATES, STATES))
        fresh = num.stack([theta[..., 0], theta[..., 1] - own, theta[..., 2], own])
        P[..., :3, :3] = P3
        assert state.fit.P is not None
        return RegressionState(
            KalmanState(np.where(where[..., None], fresh, x), np.where(where[..., None, None], P, state.fit.P)),
            np.where(where, np.minimum(state.age, plan.T * (self.window - 1)), state.age),
            np.where(where[..., None], 0.0, state.sums), state.samples, state.there,
        )  # fmt: skip


def stop_time(speed: Array, a: Array, age: Array) -> Array:
    """Return the time [s] to the instant at which a leader's fitted speed [m/s] passed zero, elementwise; `_stop` selects the rows."""
    slowing = (speed < 0.0) & (a < 0.0)
    out: Array = np.where(slowing, np.maximum(-speed / np.where(slowing, a, -1.0), -age), 0.0)
    return out


def _stop(state: RegressionState) -> tuple[Array, Array]:
    """Return the time (B, N) [s] from now to the instant at which the fitted leader's speed passed zero, 0 while it moves; and if it did.

    It lies never before the first instant of the fit. A leader that does not slow down does not stop: noise may make one that is at rest
    seem so.
    """
    x = state.fit.x
    speed = x[..., RELATIVE_SPEED] + x[..., OWN_SPEED]
    return stop_time(speed, x[..., LEAD_ACCEL], state.age), speed < 0.0


def _rows(s: Array, stopped: Array) -> Array:
    """Return (B, N, 2, 4): the readings that x predicts; those of a stopped leader as they were at the stop."""
    H = num.zeros((*s.shape, 2, STATES))
    H[..., 0, GAP], H[..., 0, RELATIVE_SPEED], H[..., 0, LEAD_ACCEL], H[..., 0, OWN_SPEED] = 1.0, s, 0.5 * s * s, s
    H[..., 1, RELATIVE_SPEED], H[..., 1, OWN_SPEED] = ~stopped, np.where(stopped, -1.0, 0.0)
    return H


def _at_stop(plan: RegressionPlan, state: RegressionState) -> KalmanPlan:
    """Return the fit's plan with the rows of the present step."""
    return plan.line._replace(C=_rows(*_stop(state)))
