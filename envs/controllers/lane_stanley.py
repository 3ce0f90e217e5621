"""Lane keeping by Stanley's law: heading error plus the angle to the path, at the front axle."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Model, NonNegative, Positive, param
from tailgate.core.quantities import Gap, PositiveGain, PositiveSpeed
from tailgate.core.registry import register
from tailgate.envs.controllers.lane_lqr import LaneController, require_lane, steady_bend

TERMS = 11  # of the series: the next is below the rounding of the first


def arctangent(x: Array) -> Array:
    """Return the arctangent, elementwise, with the same bits on every machine: 8 times that of an angle of pi / 16 at most."""
    x = num.clip(x, -1e150, 1e150)  # its square is finite
    for _ in range(3):
        x = x / (1.0 + np.sqrt(1.0 + x * x))
    square, out = x * x, np.full_like(x, 1.0 / (2 * TERMS - 1))
    for j in range(TERMS - 2, -1, -1):
        out = 1.0 / (2 * j + 1) - square * out
    return np.asarray(8.0 * x * out)


class StanleyPlan(NamedTuple):
    heading: float  # e_psi of the steady bend for each curvature [rad m]
    steering: float  # steering angle of the steady bend for each curvature [rad m]


@register(
    "controller", "lane_stanley",
    reference="G. M. Hoffmann, C. J. Tomlin, M. Montemerlo, S. Thrun, Autonomous Automobile Trajectory Tracking for Off-Road Driving, 2007",
)  # fmt: skip
@dataclass(frozen=True)
class LaneStanley(LaneController):
    """Steers by delta = delta_s kappa - psi - arctan(k e / v) - d e_psi', with psi = e_psi - psi_s kappa and e = e_y + l_f psi.

    psi_s and delta_s are those of the steady bend, without which a car cuts corners. The curvature kappa is the one that the map's
    message says. A mode that a defence asks for changes nothing.
    """

    gain: PositiveGain = param(1.0, "gain k of the offset at the front axle [1/s]")
    damping: NonNegative = param(0.0, "gain d of the yaw rate against the road [s]")
    front: Positive = param(1.1, "distance l_f from the centre of gravity to the front axle, as the plant's [m]")
    speed: PositiveSpeed = param(20.0, "speed v that it reckons with, as the plant's [m/s]")
    limit: Positive = param(0.03, "largest steering angle [rad]")
    margin: Gap = param(1.75, "distance to the nearer line that it steers for: half of the lane [m]")

    def prepare(self, model: Model) -> StanleyPlan:
        require_lane("lane_stanley", model, self.margin)
        return StanleyPlan(*steady_bend(model))

    def step(self, plan: StanleyPlan, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        """Return the steering angle (B, 1, 1) [rad] for estimate.x (B, 1, 4) and the curvature v2v (B, 1, 1) [1/m]."""
        x, bend = estimate.x, v2v[..., 0]
        turned = x[..., 2] - plan.heading * bend
        off = turned + arctangent(self.gain * (x[..., 0] + self.front * turned) / self.speed) + self.damping * x[..., 3]
        return None, num.clip(plan.steering * bend - off, -self.limit, self.limit)[..., None]
