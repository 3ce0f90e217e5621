"""The chi-square gated Bayesian Kalman filter (thesis, Algorithm 3).

    g = r' S^-1 r;     g > eta: x = x-, P = P-  (open loop);     else the Kalman update

Erratum: the thesis's g uses P^-1 in one place; S^-1 is meant. Per step and with two sensors, the false-alarm rate is exp(-eta/2).

A shut gate widens with P, and so re-opens in time. With the steady gain it does not.
"""

from dataclasses import dataclass
from typing import ClassVar

from tailgate.core import Innovation, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.compose import Composed, GateOut
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanFilter
from tailgate.estimators.parts import Detector, Filter, Mitigation, Stateless, Verdict, blame_all, normalised


@register("detector", "chi2", reference="Dutta 2018, section 4.2")
@dataclass(frozen=True)
class ChiSquare(Stateless):
    """Alarms when the normalised innovation squared exceeds eta."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(20.0, "threshold on r' S^-1 r [-]")

    def step(self, plan: None, state: None, innovation: Innovation) -> tuple[None, Verdict]:
        score = normalised(innovation)
        return None, blame_all(score, score > self.eta, innovation)

    def gate(self, plan: None, state: None) -> float:
        return self.eta


@register("defence", "chi2_kf", reference="Dutta 2018, Algorithm 3 and section 4.5")
@dataclass(frozen=True)
class GatedKalman(Composed):
    """Kalman filter that ignores a measurement whose normalised innovation squared exceeds eta."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(20.0, "gate on r' S^-1 r [-]")
    gain: Gain = param("varying", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(self.gain == "steady"), ChiSquare(self.eta), GateOut()
