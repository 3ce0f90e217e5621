"""Sentinels: degenerate defences that a sound score must fail. Each names the gate that it has to fail."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Mode, Received
from tailgate.registry import register

from .compose import AcceptAll, Composed, Detector, Filter, Mitigation, Score, Stateless
from .kalman import KalmanFilter


@dataclass(frozen=True)
class AlwaysAlarm(Stateless):
    """Alarms at every step."""

    def step(self, plan: Any, state: Any, innovation: Innovation) -> tuple[Any, Array, Array]:
        score = np.ones(innovation.r.shape[:2])
        return None, score, np.ones_like(score, bool)


@dataclass(frozen=True)
class AlwaysMode(Stateless):
    """Asks for one mode at every step."""

    mode: Mode

    def step(self, plan: Any, state: Any, alarm: Array, received: Received) -> tuple[Any, Array, Array]:
        return None, received.valid, num.full(alarm.shape, self.mode, np.int8)


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
