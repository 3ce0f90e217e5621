"""The resilient distributed estimator of chapter 6 (thesis (6.26)): an attack on single sensors is estimated with the state, and priced.

    xh_i = argmin_{X, a}  (y_i - C_i X - a)' Sv_i^-1 (y_i - C_i X - a) + lam |a|_1 + (X - xb_i)' Q_i (X - xb_i)        (6.26)

The neighbours' predictions fuse to xb_i and Q_i^-1 (distributed.py). Put S = Sv + C Q^-1 C' and r = y - C xb. For a given a, the best X is
the linear update of r - a. The robust Kalman filter's problem (robust.py) remains,

    a = argmin (r - a)' S^-1 (r - a) + lam |a|_1,      p = S^-1 (r - a),  |p_l| <= lam/2,      xh = xb + Q^-1 C' p

so that no attack moves the estimate by more than |Q^-1 C' s| lam/2 with some s in {-1, 1}^q. Sensors that are not accepted leave the
problem.

Price: lam is in 1/unit of the sensor, one number for all sensors, as in (6.26): a reading off by less than lam Sv / 2 counts as noise. A
small one is resilient, and slow to follow what the model does not foresee. The default 5 was tuned on platoon-braking, where it cuts at a
quarter of a standard deviation of the gap's noise. There most honest readings pay a little. The thesis's own case, whose filter expects a
noise of 1, has 0.1. With 0.1 the braking platoon cannot follow its brakes: half of the runs without any attack collide.
"""

from dataclasses import dataclass
from typing import Literal

from tailgate.core import Array, Innovation, Positive, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, Score
from tailgate.estimators.distributed.distributed_kalman import DistributedFilter, FusionPlan
from tailgate.estimators.filters.kalman import GAIN, Gain, KalmanState
from tailgate.estimators.filters.robust import Solved
from tailgate.estimators.parts import Detector, Filter, Mitigation


@dataclass(frozen=True)
class Lasso(Solved):
    """The price of an attack, and the solver."""

    lam: Positive = param(5.0, "price of an attack on a sensor: 5 fits a noise of 0.1 units, the thesis's case has 0.1 at a noise of 1")
    unit: Literal["sigma", "sensor"] = param(
        "sensor", "unit of lam: sensor: 1/unit of the sensor, as in (6.26); sigma: 1/sqrt(S_ii), the same for every noise level"
    )


@register("filter", "lasso", reference="Dutta 2018, (6.26)")
@dataclass(frozen=True)
class LassoFilter(Lasso, DistributedFilter):
    """Distributed filter that takes sparse attacks out of the innovation before the own sensors correct."""

    steady: bool = param(True, "hold gain and covariance where they settle when nothing is missed")

    def update(self, plan: FusionPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        return super().update(plan, state, self.cleaned(innovation, accept), accept)


@register("defence", "lasso_dkf", reference="Dutta 2018, (6.26)")
@dataclass(frozen=True)
class LassoKalman(Lasso, Composed):
    """Distributed Kalman filter that estimates sparse attacks with the state and subtracts them."""

    gain: Gain = param("steady", GAIN)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return LassoFilter(self.lam, self.unit, self.solver, self.gain == "steady"), Score(), AcceptAll()
