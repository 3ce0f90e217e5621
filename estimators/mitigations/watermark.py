"""A physical watermark against replay (Mo and Sinopoli 2009; Mo, Weerakkody and Sinopoli 2015; thesis, section 4.7, [63]).

    u = u_controller + du,       du ~ N(0, Qu) iid, from the defence's own random numbers

The filter knows du, as it is part of the command. A replayed reading answers another du. Take the loop of the Kalman filter with gain K and
the feedback u = L xh, with calA = (A + B L)(I - K C) stable. Under replay E r' S^-1 r rises from q to

    q + 2 tr(C' S^-1 C U),        U = calA U calA' + B Qu B'

Where calA is unstable the replay shows without a watermark (`bounds.replay_mean`).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tailgate.core import Array, Estimate, Model, NonNegative, Positive, PositiveCount, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, ComposedPlan, ComposedState
from tailgate.estimators.detectors.sequential import WindowedChiSquare
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.estimators.parts import Detector, Filter, Mitigation


@dataclass(frozen=True)
class Marking(AcceptAll[Array]):
    """Holds the watermark's standard deviation for each actuator (m,)."""

    sd: NonNegative = param(0.3, "standard deviation of what is added to the command [unit of the actuator]")

    def constants(self, model: Model) -> Array:
        return np.full(len(model.actuators), self.sd)

@register(
    "defence", "watermark",
    reference="Y. Mo, S. Weerakkody, B. Sinopoli, Physical Authentication of Control Systems, 2015; Dutta 2018, section 4.7",
)  # fmt: skip
@dataclass(frozen=True)
class Watermark(Composed):
    """Kalman filter under the windowed chi-square test, which adds secret noise to the command: replayed readings do not show it."""

    threshold_field: ClassVar[str] = "threshold"
    sd: NonNegative = param(Marking.sd, "standard deviation of what is added to the command [unit of the actuator]")
    threshold: Positive = param(WindowedChiSquare.threshold, "threshold on the sum of r' S^-1 r [-]")
    window: PositiveCount = param(WindowedChiSquare.window, "length of the window [steps]")

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), WindowedChiSquare(self.threshold, self.window), Marking(sd=self.sd)

    def step(
        self, plan: ComposedPlan, state: ComposedState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[ComposedState, Estimate]:
        state, estimate = super().step(plan, state, received, known_u, draws)
        sd = plan.mitigation_plan.own
        return state, estimate._replace(offset=sd * draws.normal((known_u.shape[1], len(sd))))
