"""The follower of thesis 4.6.1 as printed, kept for the reproduction of its figures alone.

    X+ = (I + dt A_k) X + dt B u          u = x_l - x_f                                               (4.16)

            | 0   1        0   |                        | (1 + 1/h) / (tau^2 h) - gamma / (tau h) |
    A_a,d = | 0   0        1   |                   B =  | -1 / (tau h)                            |
            | 0  -k gamma  +-k |   k = (1+1/h)/tau      | 0                                       |

A_a (with +k) while the car accelerates, A_d (with -k) while it does not. A_a is unstable, the velocity falls when the gap opens, and the
car does not keep its distance: do not use it as a car. `car_following` holds the corrected equations.
"""

from dataclasses import dataclass

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Model, param
from tailgate.core.quantities import Headway, Length, PositiveGain
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import OneCar
from tailgate.envs.plants.car_following import CarFollowing, FollowingPlan


@register("plant", "car_following_literal", reference="Dutta 2018, section 4.6.1 and (4.16), as printed")
@dataclass(frozen=True)
class CarFollowingLiteral(CarFollowing):
    """The thesis's matrices as printed. The public model has A_d: the filter does not know when the car accelerates."""

    headway: Headway = param(3.0, "time headway h [s]")
    gamma: PositiveGain = param(0.9, "gap gain [1/s]")

    def dynamics(self) -> tuple[Array, Array]:
        dt, tau, h = self.dt, self.tau, self.headway
        k = (1.0 + 1.0 / h) / tau
        A = np.array([[1.0, dt, 0.0], [0.0, 1.0, dt], [0.0, -dt * k * self.gamma, 1.0 - dt * k]])
        B = dt * np.array([[(1.0 + 1.0 / h) / (tau * tau * h) - self.gamma / (tau * h)], [-1.0 / (tau * h)], [0.0]])
        return A, B

    def move(self, plan: FollowingPlan, ego: Array, u: Array, noise: Array) -> Array:
        """Return the follower (B, 1, 3) one step later, under u (B, 1, 1) [m] and noise (3, B)."""
        fixed = num.matvec(plan.A, ego) + num.matvec(plan.B, u)
        switch = np.where(ego[..., 2] > 0.0, 2.0 * (1.0 - plan.A[2, 2]), 0.0) * ego[..., 2]  # from A_d to A_a
        moved = [fixed[..., i] + noise[i][:, None] for i in range(3)]
        return num.stack([moved[0], moved[1], moved[2] + switch])


@register("controller", "relative_distance", reference="Dutta 2018, (4.16): the input u of the printed model")
@dataclass(frozen=True)
class RelativeDistance(OneCar):
    """Feeds the printed model: u = x_l - x_f [m], the follower's position as estimated."""

    headway: Headway = param(3.0, "time headway h of the spacing policy (4.13) [s]")
    standstill: Length = param(5.0, "minimum stopping distance d_r [m]")

    def prepare(self, model: Model) -> None:
        return None

    def step(self, plan: None, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        """Return u (B, N, 1) [m] for estimate.x (B, N, 3) and v2v (B, N, 2) = [x_l, v_l]."""
        return None, (v2v[..., 0] - estimate.x[..., 0])[..., None]

    def desired_gap(self, speed: Array) -> Array:
        """Return d_r + h v [m] (4.13)."""
        return np.asarray(self.standstill + self.headway * speed)
