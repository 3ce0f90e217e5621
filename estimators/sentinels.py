"""Sentinels: degenerate defences that a sound score must fail. Each names the gate that it has to fail."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tailgate import num
from tailgate.core import Innovation, Mode, Received
from tailgate.registry import register

from .compose import AcceptAll, Composed, Decision, Detector, Filter, Mitigation, Score, Stateless, Verdict, blame_all
from .kalman import KalmanFilter


@dataclass(frozen=True)
class AlwaysAlarm(Stateless):
    """Alarms at every step."""

    def step(self, plan: Any, state: Any, innovation: Innovation) -> tuple[Any, Verdict]:
        score = np.ones(innovation.r.shape[:2])
        return None, blame_all(score, np.ones_like(score, bool), innovation)

    def gate(self, plan: Any, state: Any) -> None:
        return None


@dataclass(frozen=True)
class AlwaysMode(Stateless):
    """Asks for one mode at every step."""

    mode: Mode

    def step(self, plan: Any, state: Any, verdict: Verdict, received: Received) -> tuple[Any, Decision]:
        return None, Decision(received.valid, num.full(verdict.alarm.shape, self.mode, np.int8))


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
