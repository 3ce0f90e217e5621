"""The Kalman filter under detectors with memory and under other mitigations, named and calibrated (docs/detectors.md).

Each threshold is the one for a mean time of 1 h between false alarms in car following, whose readings are two (calibration.json in
benchmarks/results). With more readings they alarm more often.
"""

from dataclasses import dataclass
from typing import ClassVar

from tailgate.core import Count, NonNegative, Positive, PositiveCount, param
from tailgate.core.registry import register
from tailgate.estimators.compose import Composed, GateOut
from tailgate.estimators.detectors.chi_square import ChiSquare
from tailgate.estimators.detectors.sequential import Allowance, Cusum, Mewma, Weight, WindowedChiSquare
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.estimators.mitigations.responses import Brake, Latch, Reacquire, Widen
from tailgate.estimators.parts import Detector, Filter, Mitigation

LATCH = "steps that the gate stays shut after the last alarm"
AFTER = "readings rejected in a row before the next one is believed"
LINGER = "time that the mode outlasts the last alarm [s]"


@register("defence", "windowed_chi2_kf", reference="Tunga, Murguia, Ruths 2018")
@dataclass(frozen=True)
class WindowedKalman(Composed):
    """Kalman filter that ignores measurements while the windowed chi-square detector alarms."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(WindowedChiSquare.threshold, "threshold on the sum of r' S^-1 r over the window [-]")
    window: PositiveCount = param(WindowedChiSquare.window, "length of the window [steps]")

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), WindowedChiSquare(self.threshold, self.window), GateOut()


@register("defence", "cusum_kf", reference="Page 1954; Murguia, Ruths 2016")
@dataclass(frozen=True)
class CusumKalman(Composed):
    """Kalman filter that ignores a measurement at which the CUSUM detector alarms."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(Cusum.threshold, "threshold on the cumulative sum [-]")
    drift: Allowance = param(Cusum.drift, "allowance a step, in multiples of the number of sensors; above 1 [-]")
    latch: Count = param(GateOut.latch, LATCH)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Cusum(self.threshold, self.drift), GateOut(self.latch)


@register("defence", "mewma_kf", reference="Lowry, Woodall, Champ, Rigdon 1992")
@dataclass(frozen=True)
class MewmaKalman(Composed):
    """Kalman filter that ignores a measurement at which the MEWMA detector alarms."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(Mewma.threshold, "threshold on z'z / c [-]")
    weight: Weight = param(Mewma.weight, "weight of the newest innovation [-]")
    latch: Count = param(GateOut.latch, LATCH)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Mewma(self.threshold, self.weight), GateOut(self.latch)


@register("defence", "reacquire_kf", reference="Dutta 2018, Algorithm 3, with a way out of the lock-out")
@dataclass(frozen=True)
class ReacquiringKalman(Composed):
    """Gated Kalman filter that starts again from the measurements after a number of rejections in a row."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(20.96, "gate on r' S^-1 r [-]")
    after: PositiveCount = param(Reacquire.after, AFTER)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), ChiSquare(self.eta), Reacquire(after=self.after)


@register("defence", "cusum_reacquire_kf", reference="Page 1954; Murguia, Ruths 2016")
@dataclass(frozen=True)
class CusumReacquiringKalman(Composed):
    """Kalman filter under the CUSUM detector that starts again from the measurements after a number of rejections in a row."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(Cusum.threshold, "threshold on the cumulative sum [-]")
    drift: Allowance = param(Cusum.drift, "allowance a step, in multiples of the number of sensors; above 1 [-]")
    latch: Count = param(Latch.latch, LATCH)
    after: PositiveCount = param(Reacquire.after, AFTER)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Cusum(self.threshold, self.drift), Reacquire(self.latch, self.after)


@register("defence", "widen_kf", reference="Dutta 2018, Algorithm 3, with a longer time headway")
@dataclass(frozen=True)
class WideningKalman(Composed):
    """Gated Kalman filter that asks for a longer time headway while alarmed and for some time after."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(20.96, "gate on r' S^-1 r [-]")
    linger: NonNegative = param(Widen.linger, LINGER)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), ChiSquare(self.eta), Widen(linger=self.linger)


@register("defence", "brake_kf", reference="Dutta 2018, Algorithm 3, with gentle braking")
@dataclass(frozen=True)
class BrakingKalman(Composed):
    """Gated Kalman filter that asks for gentle braking while alarmed and for some time after."""

    threshold_field: ClassVar[str] = "eta"
    eta: Positive = param(21.01, "gate on r' S^-1 r [-]")
    linger: NonNegative = param(Brake.linger, LINGER)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), ChiSquare(self.eta), Brake(linger=self.linger)
