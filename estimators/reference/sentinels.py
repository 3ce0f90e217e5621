"""Sentinels: useless defences that a sound score must fail. Each names the gate that it has to fail."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Mode, Model, PositiveCount, Received, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, Score
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.estimators.parts import Decision, Detector, Filter, Mitigation, Stateless, Verdict, blame_all


@dataclass(frozen=True)
class AlwaysAlarm(Stateless):
    """Alarms at every step."""

    def step(self, plan: None, state: None, innovation: Innovation) -> tuple[None, Verdict]:
        score = np.ones(innovation.r.shape[:2])
        return None, blame_all(score, np.ones_like(score, bool), innovation)

    def gate(self, plan: None, state: None) -> None:
        return None


@dataclass(frozen=True)
class AlwaysMode(Stateless):
    """Asks for one mode at every step."""

    mode: Mode

    def step(self, plan: None, state: None, verdict: Verdict, received: Received) -> tuple[None, Decision]:
        return None, Decision(received.valid, num.full(verdict.alarm.shape, self.mode, np.int8))


class CoastPlan(NamedTuple):
    steps: int


@dataclass(frozen=True)
class AcceptFirst(Mitigation):
    """Uses what is received in the first steps, and nothing after them."""

    steps: PositiveCount = param(20, "steps")

    def prepare(self, model: Model) -> CoastPlan:
        return CoastPlan(self.steps)

    def start(self, plan: CoastPlan, batch: int) -> Array:
        return np.zeros(batch, np.int64)

    def step(self, plan: CoastPlan, state: Array, verdict: Verdict, received: Received) -> tuple[Array, Decision]:
        use = received.valid & (state < plan.steps)[:, None, None]
        return state + 1, Decision(use, num.full(verdict.alarm.shape, Mode.NORMAL, np.int8))


@register("defence", "always_alarm", sentinel="false alarms")
@dataclass(frozen=True)
class AlarmSentinel(Composed):
    """Kalman filter with an alarm at every step: perfect detection, and useless."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), AlwaysAlarm(), AcceptAll()


@register("defence", "always_brake", sentinel="progress")
@dataclass(frozen=True)
class BrakeSentinel(Composed):
    """Kalman filter that asks for gentle braking at every step."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Score(), AlwaysMode(Mode.BRAKE)


@register("defence", "stand_still", sentinel="progress")
@dataclass(frozen=True)
class StandStillSentinel(Composed):
    """Kalman filter that stops the car and never lets it move again."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Score(), AlwaysMode(Mode.STOP)


@register("defence", "coast", sentinel="collisions")
@dataclass(frozen=True)
class CoastSentinel(Composed):
    """Kalman filter that reads nothing after its first steps: no attack that comes later can touch it, and nothing else can."""

    steps: PositiveCount = param(20, "steps in which it reads")

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Score(), AcceptFirst(self.steps)
