"""The Intelligent Driver Model (Treiber, Hennecke, Helbing 2000): a human-like driver behind, and a controller to compare with.

a = a_max (1 - (v/v0)^4 - (s*/s)^2)        s* = s0 + max(0, v T + v (v - v_l) / (2 sqrt(a_max b)))
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Model, param
from tailgate.core.quantities import Headway, Length, PositiveSpeed, Rate
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import OneCar, limited, obeyed, widened
from tailgate.envs.controllers.radar_car import GAP, RELATIVE_SPEED, check_radar_car
from tailgate.envs.vehicle import roll

# The driver behind.
IDM_SPEED = 33.3  # desired speed [m/s]
IDM_HEADWAY = 1.5  # desired time headway [s]
IDM_GAP = 2.0  # gap at standstill [m]
IDM_ACCEL = 1.4  # largest acceleration [m/s^2]
IDM_DECEL = 2.0  # comfortable deceleration [m/s^2]
IDM_BRAKE = 8.0  # physical limit [m/s^2]


def idm(gap: Array, v: Array, lead: Array, v0: float, headway: Array | float, s0: float, accel: float, decel: float) -> Array:
    """Return the model's acceleration [m/s^2] for gap [m] and speeds [m/s], elementwise, without its physical limits."""
    closing = v * (v - lead) / (2.0 * np.sqrt(accel * decel))
    wanted = s0 + np.maximum(0.0, v * headway + closing)
    free = (v / v0) * (v / v0)
    near = wanted / np.maximum(gap, 0.1)
    out: Array = accel * (1.0 - free * free - near * near)
    return out


def idm_accel(gap: Array, speed: Array, lead_speed: Array) -> Array:
    """Return the acceleration [m/s^2] of the driver behind for gap [m] and speeds [m/s], elementwise."""
    out: Array = num.clip(idm(gap, speed, lead_speed, IDM_SPEED, IDM_HEADWAY, IDM_GAP, IDM_ACCEL, IDM_DECEL), -IDM_BRAKE, IDM_ACCEL)
    return out


class BehindState(NamedTuple):
    """The driver behind; every leaf has B first."""

    x: Array  # (B,)
    v: Array  # (B,)
    intent: Array  # (B, reaction): accelerations decided and not yet made
    slot: Array  # (B,) where the next one goes


@dataclass(frozen=True)
class Behind:
    """A human-like driver who follows the last car and reacts `reaction` steps late."""

    dt: float
    reaction: int

    def start(self, x: Array, speed: float) -> BehindState:
        """Return a driver behind a car at x (B,) [m], at its speed and at the gap that it wants there."""
        batch = len(x)
        gap = IDM_GAP + IDM_HEADWAY * speed
        return BehindState(x - gap, np.full(batch, speed), num.zeros((batch, self.reaction)), np.zeros(batch, np.int64))

    def step(self, state: BehindState, x: Array, v: Array) -> BehindState:
        """Return the state one step later; x [m] and v [m/s] (B,) of the car ahead at the beginning of the step."""
        decided = idm_accel(x - state.x, state.v, v)
        intent, slot = state.intent, state.slot
        if self.reaction:
            made = num.pick(intent, slot)
            intent, slot = num.put(intent, slot, decided), num.ring_next(slot, self.reaction)
        else:
            made = decided
        return BehindState(*roll(state.x, state.v, made, self.dt), intent, slot)


@register("controller", "idm", reference="Treiber, Hennecke, Helbing, Congested traffic states in empirical observations, 2000")
@dataclass(frozen=True)
class IntelligentDriver(OneCar):
    """The Intelligent Driver Model on a radar's estimates and the trusted own speed.

    The thesis speaks of a "modified IDM" (3.5.1) and never writes it down: this is the published model, for comparison with its ACC.
    """

    set_speed: PositiveSpeed = param(29.95168, "desired speed v0 [m/s]; 67 mph")
    headway: Headway = param(3.0, "desired time headway T [s]")
    standstill: Length = param(5.0, "gap at standstill s0 [m]")
    accel: Rate = param(1.4, "largest acceleration [m/s^2]")
    decel: Rate = param(2.0, "comfortable deceleration b [m/s^2]")
    brake: Rate = param(5.0, "largest deceleration [m/s^2]")

    def prepare(self, model: Model) -> None:
        check_radar_car(model, "controller idm")

    def step(self, plan: None, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        """Return the acceleration (B, N, 1) [m/s^2] for estimate.x (B, N, 4) = [gap, relative speed, ...] and the own odometry."""
        gap, v, mode = estimate.x[..., GAP], odometry[..., 1], estimate.mode
        lead, headway = v + estimate.x[..., RELATIVE_SPEED], widened(self.headway, mode)
        a = idm(gap, v, lead, self.set_speed, headway, self.standstill, self.accel, self.decel)
        return None, limited(obeyed(a, mode), -self.brake, self.accel)[..., None]

    def desired_gap(self, speed: Array) -> Array:
        """Return the gap at which it keeps a speed below v0 [m]."""
        ratio = np.minimum(speed / self.set_speed, 0.99)
        return np.asarray((self.standstill + self.headway * speed) / np.sqrt(1.0 - ratio * ratio * ratio * ratio))
