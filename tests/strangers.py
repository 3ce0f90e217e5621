"""Plain classes of a user: a plant with its sensor and controller, a defence, an attack, a reward, a metric. None mentions the engine."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Kind, Model, Prior, Received, Scene
from tailgate.envs.gym.rewards import Reward
from tailgate.estimators import ChiSquare, GateOut, compose
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.play.metrics import metric


class Swing(NamedTuple):
    angle: np.ndarray  # (B,)
    rate: np.ndarray


@dataclass(frozen=True)
class Pendulum:
    """A rod that feedback holds upright, in gusts of wind."""

    pull: float = 0.8
    gust: float = 0.05
    dt: float = 0.1

    @property
    def size(self):
        return 1, 2

    def model(self, sensor, controller):
        A = np.array([[1.0, self.dt], [self.dt * self.pull, 1.0]])
        names, C, R = sensor.matrices(self)
        Q = np.diag([1e-6, (self.gust * self.dt) ** 2])
        return Model(A, np.array([[0.0], [self.dt]]), np.zeros(2), C, Q, R, np.eye(1, dtype=bool), self.dt, names, ("torque",))

    def prepare(self, model):
        return None

    def start(self, plan, draws):
        angle, rate = np.moveaxis(draws.normal((2,)), -1, 0)
        return Swing(0.02 * angle, 0.05 * rate)

    def prior(self, plan, state, held, draws):
        rows = len(state.angle)
        return Prior(num.zeros((rows, 1, 2)), num.full((rows, 1, 2, 2), np.diag([4e-4, 25e-4])))

    def step(self, plan, state, u, exo, draws):
        wind = self.gust * draws.normal() * np.where(draws.uniform(tag=1) < 0.1, 3.0, 1.0)
        fall = state.angle - state.angle * state.angle * state.angle / 6.0
        rate = state.rate + self.dt * (self.pull * fall + u[:, 0, 0] + wind)
        return Swing(np.clip(state.angle + self.dt * rate, -1.5, 1.5), rate)

    def known(self, plan, u, exo, state):
        return u

    def truth(self, plan, state, held):
        return num.stack([state.angle, state.rate])[:, None]

    def odometry(self, plan, state):
        return np.zeros((len(state.angle), 1, 0))

    v2v = odometry

    def lead_speed_of(self, state):
        return np.zeros(len(state.angle))

    def scene(self, plan, state):
        still = num.zeros((len(state.angle), 1))
        nobody = num.full(still.shape, np.inf)
        return Scene(nobody, still, still, still, nobody, still, still)


@dataclass(frozen=True)
class Gyroscope:
    """Angle and rate, each with noise."""

    sd: tuple[float, float] = (0.01, 0.02)

    def matrices(self, plant):
        return ("angle", "rate"), np.eye(2)[None], np.diag(np.square(self.sd))[None]

    def prepare(self, model):
        return np.array(self.sd)

    def measure(self, plan, truth, probe, draws):
        y = truth + plan * draws.normal(truth.shape[1:])
        return Received(y, num.full(y.shape, True, bool), num.zeros(y.shape[:2]))


@dataclass(frozen=True)
class Upright:
    """Torque against angle and rate, within what the motor has."""

    most: float = 2.0

    def prepare(self, model):
        return np.array([4.0, 2.5])

    def start(self, plan, batch):
        return None

    def step(self, plan, state, estimate, v2v, odometry):
        u = -num.dot(plan, estimate.x)
        return None, np.minimum(np.maximum(u, -self.most), self.most)[..., None]

    def held(self, plan, state, batch):
        return np.zeros((batch, 1, 0))

    def desired_gap(self, speed):
        return np.zeros_like(speed)


def stubborn(eta: float = 12.0):
    """A Kalman filter that believes no reading which is far off."""
    return compose(KalmanFilter(), ChiSquare(eta=eta), GateOut())


class Nudging(NamedTuple):
    seen: np.ndarray  # (B,) largest angle so far


@dataclass(frozen=True)
class Nudge:
    """Pushes the readings away from upright, harder the farther the rod has leant, in two steps of three."""

    gain: float = 0.4

    def prepare(self, brief):
        return brief

    def start(self, plan, batch, draws):
        return Nudging(num.zeros((batch,)))

    def decide(self, plan, state, view, draws):
        angle = view.received.y[:, 0, 0]
        seen = np.maximum(state.seen, np.abs(angle))
        on = (view.k % 3 != 0) & (draws.uniform() < 0.9)
        value = self.gain * seen * np.where(angle > 0.0, 1.0, -1.0)
        return Nudging(seen), plan.command(on, Kind.FDI, plan.granted, np.where(seen > 0.1, 2.0 * value, value)[:, None, None])


@dataclass(frozen=True)
class Scare(Reward):
    """Pays for braking harder than is comfortable, twice as much while nothing alarms."""

    comfort: float = 1.0

    def __call__(self, model, frame, fall, last, rise=0.0):
        hard = np.maximum(-frame.scene.accel[:, 0] - self.comfort, 0.0)
        return hard * np.where(frame.estimate.alarm.any(axis=1), 1.0, 2.0) + super().__call__(model, frame, fall, last, rise)


@metric("rad")
def largest_lean(trace):
    """Farthest that the rod leant."""
    return np.max(np.where(trace.live, np.abs(trace.truth[:, :, 0, 0]), 0.0), axis=0)
