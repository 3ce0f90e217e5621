"""Adaptive cruise control with a constant time headway (thesis 4.6.1)."""

from dataclasses import dataclass

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Mode, Model, param
from tailgate.core.quantities import Accel, Headway, Length, PositiveGain, PositiveSpeed, check_order
from tailgate.core.registry import register

LEADER = ("leader_position", "leader_velocity")  # the leader's message
WIDEN_FACTOR = 1.5  # Mode.WIDEN: time headway times this
BRAKE_ACCEL = -2.0  # Mode.BRAKE: at most this acceleration [m/s^2]
STOP_ACCEL = -5.0  # Mode.STOP [m/s^2], the braking limit of the thesis's follower (section 3.5)


def widened(headway: float, mode: Array) -> Array:
    """Return the time headway [s] under a mode that the defence asks for."""
    out: Array = np.where(mode == Mode.WIDEN, WIDEN_FACTOR * headway, headway)
    return out


def obeyed(a: Array, mode: Array) -> Array:
    """Return the command [m/s^2] under a mode that the defence asks for."""
    a = np.where(mode == Mode.BRAKE, np.minimum(a, BRAKE_ACCEL), a)
    out: Array = np.where(mode == Mode.STOP, STOP_ACCEL, a)
    return out


def limited(a: Array, low: float | None, high: float | None) -> Array:
    """Return the command within its limits; none: unlimited."""
    a = a if low is None else np.maximum(a, low)
    return a if high is None else np.minimum(a, high)


def spaced(x: Array, v: Array, lead_x: Array, lead_v: Array, headway: Array, standstill: float, gamma: float) -> Array:
    """Return (4.14): the acceleration [m/s^2] that keeps the gap d_r + h v, elementwise."""
    gap_error = lead_x - x - standstill - headway * v
    out: Array = ((lead_v - v) + gamma * gap_error) / headway
    return out


class OneCar:
    """Base class of controllers that drive one car and remember nothing."""

    def start(self, plan: None, batch: int) -> None:
        return None

    def held(self, plan: None, state: None, batch: int) -> Array:
        return np.zeros((batch, 1, 0))


@register("controller", "acc", reference="Dutta 2018, (4.13) and (4.14), corrected")
@dataclass(frozen=True)
class AdaptiveCruise(OneCar):
    """Constant-time-headway ACC on the estimated own state and the received state of the leader.

        a_des = ((v_l - v_f) + gamma (x_l - x_f - d_r - h v_f)) / h

    Erratum: (4.14) as printed has the sign wrong and omits d_r. With a set speed, the smaller of a_des and the same law
    without the gap term, (v_set - v_f) / h, is taken (speed mode).
    """

    headway: Headway = param(3.0, "time headway h [s]")
    standstill: Length = param(5.0, "minimum stopping distance d_r [m]")
    gamma: PositiveGain = param(0.9, "gap gain [1/s]")
    set_speed: PositiveSpeed | None = param(29.95, "driver's set speed [m/s]; none: spacing mode only")
    accel_min: Accel | None = param(-5.0, "lower limit of the command [m/s^2]; none: unlimited")
    accel_max: Accel | None = param(2.0, "upper limit of the command [m/s^2]; none: unlimited")

    def __post_init__(self) -> None:
        check_order("controller acc.accel_min, accel_max", (self.accel_min, self.accel_max))

    def prepare(self, model: Model) -> None:
        if model.v2v[:2] != LEADER:
            raise InputError("controller acc", list(model.v2v), "a car-following plant, whose leader sends its position and velocity")

    def step(self, plan: None, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        """Return the command a_des (B, N, 1) [m/s^2] for estimate.x (B, N, 3) = [x, v, a] and v2v (B, N, 2) = [x_l, v_l]."""
        x, v, mode = estimate.x[..., 0], estimate.x[..., 1], estimate.mode
        headway = widened(self.headway, mode)
        a = spaced(x, v, v2v[..., 0], v2v[..., 1], headway, self.standstill, self.gamma)
        if self.set_speed is not None:
            a = np.minimum(a, (self.set_speed - v) / headway)
        return None, limited(obeyed(a, mode), self.accel_min, self.accel_max)[..., None]

    def desired_gap(self, speed: Array) -> Array:
        """Return d_r + h v [m] (4.13)."""
        return np.asarray(self.standstill + self.headway * speed)
