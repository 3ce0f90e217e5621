"""The oracle: it knows which measurements are attacked. An upper yardstick, shown and never ranked."""

from dataclasses import dataclass

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Mode, Received, param
from tailgate.core.registry import register
from tailgate.estimators.compose import Composed, Score
from tailgate.estimators.distributed.distributed_kalman import DistributedKalmanFilter
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanFilter
from tailgate.estimators.parts import Decision, Detector, Filter, Mitigation, Stateless, Verdict


@dataclass(frozen=True)
class RejectAttacked(Stateless):
    """Accepts exactly the sensors that are not attacked."""

    def step(self, plan: None, state: None, verdict: Verdict, received: Received) -> tuple[None, Decision]:
        if received.attacked is None:
            raise InputError("oracle", None, "a loop that grants `truth`")
        return None, Decision(received.valid & ~received.attacked, np.full_like(verdict.alarm, Mode.NORMAL, np.int8))


@register("defence", "oracle", uses=("measurements", "truth"))
@dataclass(frozen=True)
class Oracle(Composed):
    """Kalman filter that knows which measurements are attacked and ignores those."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Score(), RejectAttacked()


@register("defence", "dkf_oracle", uses=("measurements", "truth"), reference="Dutta 2018, (6.19)-(6.25)")
@dataclass(frozen=True)
class DistributedOracle(Composed):
    """Distributed Kalman filter in which every agent knows which of its readings are attacked and ignores those."""

    gain: Gain = param("varying", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return DistributedKalmanFilter(self.gain == "steady"), Score(), RejectAttacked()
