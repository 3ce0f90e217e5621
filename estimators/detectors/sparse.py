"""A gate per sensor: find the sensors that are attacked and use the rest (thesis, section 4.7).

    g = r' S^-1 r <= eta: nobody is suspected. Else, with W = S^-1 of the sensors still trusted:

    drop the sensor of the largest normalised residual (W r)_i^2 / W_ii, by which g falls; until g <= eta_m for the m that are left

eta_m is the quantile of chi-square with m degrees of freedom that has the same tail as eta has with q. So every test raises a false alarm
with the same probability while all readings arrive: one that is missing counts as trusted. A single attacked sensor is always found as
the smallest set that explains the alarm. For two and more the search is greedy and may take one too many (the largest normalised residual
test of power-system state estimation, Handschin et al. 1975).
With two sensors: g > eta, and the more suspect one is dropped if r_i^2 / S_ii <= eta_1 for the other, else both.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Model, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.compose import Composed, GateOut
from tailgate.estimators.filters.kalman import KalmanFilter, alone
from tailgate.estimators.parts import Detector, Filter, Memoryless, Mitigation, Verdict, normalised


@register("detector", "sparse_chi2", reference="Dutta 2018, section 4.7; Handschin, Schweppe, Kohlas and Fiechter 1975")
@dataclass(frozen=True)
class SparseChiSquare(Memoryless):
    """Alarms when the normalised innovation squared exceeds eta, and blames the fewest sensors that explain it."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(20.0, "threshold on r' S^-1 r of all sensors [-]")

    def prepare(self, model: Model) -> Array:
        """Return thresholds (q + 1,) on r' S^-1 r of m sensors, m = 0, ..., q."""
        from scipy import special  # not loaded where no threshold is made

        q = len(model.sensors)
        tail = special.chdtrc(q, self.eta)
        fewer = [min(float(special.chdtri(m, tail)), self.eta) for m in range(1, q)]  # the minimum: of a tail that is 0 in float64
        return np.array([0.0, *fewer, self.eta])

    def step(self, plan: Array, state: None, innovation: Innovation) -> tuple[None, Verdict]:
        score = normalised(innovation)
        alarm = score > self.eta
        suspect = np.zeros(innovation.r.shape, bool)
        if num.some(alarm):
            suspect = alarm[..., None] & ~self.trusted(plan, innovation.r, innovation.S)
        return None, Verdict(score, alarm, suspect)

    def trusted(self, plan: Array, r: Array, S: Array) -> Array:
        """Return (B, N, q) bool: the sensors left after alarms of r (B, N, q) and S (B, N, q, q).

        A missing reading has r = 0 and goes last.
        """
        keep, sensors = np.ones(r.shape, bool), np.arange(r.shape[-1])
        for _ in sensors:
            W = num.inverse(alone(S, keep))
            pull = num.matvec(W, r * keep)
            g = num.dot(r * keep, pull)
            guilty = g > num.take(plan, np.count_nonzero(keep, axis=-1))
            fall = np.where(keep, pull * pull / W.diagonal(axis1=-2, axis2=-1), -1.0)
            keep = keep & ~(guilty[..., None] & (sensors == np.argmax(fall, axis=-1)[..., None]))
        return keep

    def gate(self, plan: Array, state: None) -> float:
        """Return eta: nobody is suspected up to it.

        Beyond it the attacker loses a sensor, not always the attacked one (docs/filters.md).
        """
        return self.eta


@register("defence", "chi2_kf_sparse", reference="Dutta 2018, Algorithm 3 and section 4.7")
@dataclass(frozen=True)
class SparseGatedKalman(Composed):
    """Kalman filter that ignores the fewest sensors that explain an alarm, and uses the rest."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(20.0, "gate on r' S^-1 r of all sensors [-]")

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), SparseChiSquare(self.eta), GateOut()
