"""Lane keeping by a linear-quadratic regulator about the steady bend."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Model, param
from tailgate.core.quantities import Gain, Gap, Positive
from tailgate.core.registry import register

CURVATURE, STEERING = "curvature", "steering"  # the wires: the map's message, and the actuator
Weights = Annotated[tuple[Gain, Gain, Gain, Gain], Field(min_length=4, max_length=4)]
ITERATIONS, SETTLED, FAR = 20_000, 1e-13, 1e100


def regulator(A: Array, B: Array, Q: Array, R: float) -> Array:
    """Return the gain K (n,) of u = -K x that minimises the sum of x' Q x + R u^2, for one input B (n,).

    Riccati's recursion in fixed order of summation, so that the gain has the same bits on every machine.

    Raises
    ------
    InputError
        If the recursion does not settle: no steering keeps this car in its lane.
    """
    P = np.array(Q)
    for _ in range(ITERATIONS):
        if not float(np.max(np.abs(P))) < FAR:
            break
        push = num.product(P, B[:, None])[:, 0]
        spent = R + float(num.dot(B, push))
        K = num.product(A.T, push[:, None])[:, 0] / spent
        after = Q + num.product(A.T, num.product(P, A)) - spent * K[:, None] * K[None, :]
        after = 0.5 * (after + after.T)
        still = float(np.max(np.abs(after - P))) <= SETTLED * float(np.max(np.abs(after)))
        P = after
        if still:
            return np.asarray(K)
    raise InputError("controller lane_lqr.weights", Q.diagonal().tolist(), "weights for which the regulator settles: offset above 0")


def require_lane(name: str, model: Model, margin: float) -> None:
    """Raise InputError for a controller `name` in another plant than lane_keeping, or with another margin than its half lane [m]."""
    if model.actuators != (STEERING,) or model.v2v[:1] != (CURVATURE,):
        raise InputError(f"controller {name}", list(model.actuators), "the plant lane_keeping, whose actuator is the steering")
    if margin != model.lane:
        raise InputError(f"controller {name}.margin", margin, f"the plant's half_lane ({model.lane:g} m)")


def steady_bend(model: Model) -> tuple[float, float]:
    """Return e_psi and the steering angle [rad] for each curvature [1/m] of a steady bend, in the middle of the lane.

    Of x = [0, 0, e, 0] two of the four lines of x = A x + B [delta, 1] tell e and delta; the others follow.
    """
    (a, b), (c, d) = ((-model.A[i, 2], -model.B[i, 0]) for i in (1, 3))
    right = model.B[1, 1], model.B[3, 1]
    whole = a * d - b * c
    return float((right[0] * d - b * right[1]) / whole), float((a * right[1] - right[0] * c) / whole)


class LaneController:
    """Base of the controllers of a lane: they remember nothing, and their gap is the distance to a line."""

    margin: float  # half of the lane [m]

    def start(self, plan: object, batch: int) -> None:
        return None

    def held(self, plan: object, state: None, batch: int) -> Array:
        return np.zeros((batch, 1, 0))

    def desired_gap(self, speed: Array) -> Array:
        """Return the distance to the nearer line from the middle of the lane [m]."""
        return np.full_like(speed, self.margin)


class LanePlan(NamedTuple):
    K: Array  # (4,)
    heading: float  # e_psi of the steady bend for each curvature [rad m]
    steering: float  # steering angle of the steady bend for each curvature [rad m]


@register("controller", "lane_lqr", reference="Rajamani, Vehicle Dynamics and Control, 2nd edition, 2012, sections 3.1 to 3.3")
@dataclass(frozen=True)
class LaneLqr(LaneController):
    """Steers by delta = delta_s kappa - K (x^ - x_s kappa), with the steady bend (x_s, delta_s) and the gain K of a regulator.

    The curvature kappa is the one that the map's message says. The speed is not this controller's: a mode that a defence asks for changes
    nothing.
    """

    weights: Weights = param((1.0, 0.0, 1.0, 0.0), "weights of the squares of e_y, e_y', e_psi, e_psi'")
    effort: Positive = param(100.0, "weight of the square of the steering angle")
    limit: Positive = param(0.03, "largest steering angle [rad]")
    margin: Gap = param(1.75, "distance to the nearer line that it steers for: half of the lane [m]")

    def prepare(self, model: Model) -> LanePlan:
        require_lane("lane_lqr", model, self.margin)
        return LanePlan(regulator(model.A, model.B[:, 0], np.diag(self.weights), self.effort), *steady_bend(model))

    def step(self, plan: LanePlan, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        """Return the steering angle (B, 1, 1) [rad] for estimate.x (B, 1, 4) and the curvature v2v (B, 1, 1) [1/m]."""
        x, bend = estimate.x, v2v[..., 0]
        off = plan.K[0] * x[..., 0] + plan.K[1] * x[..., 1] + plan.K[2] * (x[..., 2] - plan.heading * bend) + plan.K[3] * x[..., 3]
        return None, num.clip(plan.steering * bend - off, -self.limit, self.limit)[..., None]
