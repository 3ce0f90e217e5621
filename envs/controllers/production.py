"""A production-like adaptive cruise control: constant time gap, the limits of ISO 15622, and a radar in place of messages.

    u_gap = k_g (d - d_0 - h v) + k_v (v_ahead - v)
    u_even = -c^2 / (2 D)                              where it closes in with c = v - v_ahead > 0;  D = max(d - d_near, d_least)
    u_stop = -v^2 / (2 (D + v_ahead^2 / (2 b)))        where the car ahead brakes with b > 1.5 m/s^2
    u = min(u_gap, u_even, u_stop, k_set (v_set - v))

u_even ends the approach at d_near, u_stop stops there if the car ahead brakes to a stop. The command keeps within ISO 15622's limits,
which depend on the speed: acceleration 4 to 2, braking 5 to 3.5 m/s^2, growth of braking 5 to 2.5 m/s^3, each linear between 5 and 20
m/s. The standard limits means over 1 to 2 s; here every command of the law keeps to them. What a defence asks for (BRAKE, STOP, other
limits) acts behind the law, at once. Gains, delay and standstill of the default lie near those that `tailgate fit` finds for one law of
all recorded cars.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Model, param
from tailgate.core.quantities import Headway, Length, PositiveGain, PositiveSpeed, Time
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import obeyed, widened
from tailgate.envs.controllers.emergency import BrakeState, EmergencyBrake
from tailgate.envs.controllers.radar_car import GAP, LEAD_ACCEL, RELATIVE_SPEED, STATES

SLOW, FAST = 5.0, 20.0  # speeds between which the limits change [m/s]
ACCEL = (4.0, 2.0)  # largest acceleration at either [m/s^2]
DECEL = (5.0, 3.5)  # largest deceleration [m/s^2]
JERK = (5.0, 2.5)  # largest growth of the deceleration [m/s^3]
NEAR, LEAST = 2.0, 0.5  # gap at which an approach shall end, and least distance for it [m]
BRAKES = 1.5  # deceleration from which on the car ahead brakes hard [m/s^2]: the leader of asta-leader stays below it 99.9 % of its time
LONGEST = 100  # steps of the delay


def by_speed(limits: tuple[float, float], speed: Array) -> Array:
    """Return a limit at a speed [m/s], elementwise: linear between SLOW and FAST, constant outside."""
    share = num.clip((speed - SLOW) / (FAST - SLOW), 0.0, 1.0)
    out: Array = limits[0] + share * (limits[1] - limits[0])
    return out


def spaced(
    gap: Array, closing: Array, speed: Array, headway: Array | float, standstill: Array | float, gap_gain: Array | float,
    speed_gain: Array | float,
) -> Array:  # fmt: skip
    """Return the command [m/s^2] that keeps the gap d_0 + h v, elementwise; closing: own speed less that of the car ahead [m/s]."""
    out: Array = gap_gain * (gap - standstill - headway * speed) - speed_gain * closing
    return out


def approached(gap: Array, closing: Array, speed: Array, ahead: Array) -> Array:
    """Return the even braking [m/s^2] that ends an approach in time, elementwise; infinity where it does not count.

    gap [m], closing and own speed [m/s], acceleration of the car ahead [m/s^2].
    """
    room, lead = np.maximum(gap - NEAR, LEAST), np.maximum(speed - closing, 0.0)
    even = np.where(closing > 0.0, -closing * closing / (2.0 * room), np.inf)
    stops = -speed * speed / (2.0 * (room + lead * lead / (2.0 * np.maximum(-ahead, BRAKES))))
    out: Array = np.where(ahead < -BRAKES, np.minimum(even, stops), even)
    return out


def within_iso(u: Array, last: Array, speed: Array, dt: float) -> Array:
    """Return a command [m/s^2] within the limits at a speed [m/s], after the command `last` of dt [s] ago, elementwise."""
    u = num.clip(u, -by_speed(DECEL, speed), by_speed(ACCEL, speed))
    out: Array = np.maximum(u, np.minimum(last, 0.0) - by_speed(JERK, speed) * dt)
    return out


def check_radar_cars(model: Model, where: str) -> None:
    """Raise InputError where agents do not estimate [gap, relative speed, acceleration ahead, own speed, ...]."""
    first = np.eye(model.states)[GAP]
    if model.states < STATES or model.gap is None or not (model.gap == first).all() or "distance" not in model.sensors:
        raise InputError(where, f"{model.agents} agents, {model.states} states", "the plant acc_string or radar_following")


class Gains(NamedTuple):
    """The parameters of the law, numbers or arrays that broadcast."""

    headway: Array | float  # h [s]
    standstill: Array | float  # d_0 [m]
    gap_gain: Array | float  # k_g [1/s^2]
    speed_gain: Array | float  # k_v [1/s]
    set_gain: Array | float  # k_set [1/s]
    set_speed: Array | float  # v_set [m/s]


def commanded(law: Gains, gap: Array, closing: Array, speed: Array, ahead: Array, last: Array, dt: float) -> Array:
    """Return the command [m/s^2] of the law, elementwise.

    gap [m], closing and own speed [m/s], acceleration of the car ahead [m/s^2], and the command `last` of dt [s] ago.
    """
    u = spaced(gap, closing, speed, law.headway, law.standstill, law.gap_gain, law.speed_gain)
    u = np.minimum(np.minimum(u, approached(gap, closing, speed, ahead)), law.set_gain * (law.set_speed - speed))
    return within_iso(u, last, speed, dt)


class ProductionPlan(NamedTuple):
    dt: float
    agents: int
    late: int  # steps from a command to its effect


class ProductionState(NamedTuple):
    last: Array  # (B, N) the last command of the law [m/s^2]
    way: Array  # (B, N, late) commands that wait for their effect
    slot: Array  # (B, N) where the next one goes
    brake: BrakeState | None


@register("controller", "acc_production", reference="ISO 15622:2018; Makridis et al., OpenACC, 2021")
@dataclass(frozen=True)
class ProductionCruise:
    """ACC with a constant time gap and ISO 15622's limits, on a radar's estimates and the trusted own speed.

    With `aeb` an emergency brake (emergency.py) acts on the same estimates, beyond these limits.
    """

    headway: Headway = param(1.2, "time gap h [s]")
    standstill: Length = param(3.5, "gap at standstill d_0 [m]")
    gap_gain: PositiveGain = param(0.145, "gain of the gap k_g [1/s^2]")
    speed_gain: PositiveGain = param(0.38, "gain of the relative speed k_v [1/s]")
    set_gain: PositiveGain = param(0.3, "gain of the set speed k_set [1/s]")
    set_speed: PositiveSpeed = param(40.0, "driver's set speed v_set [m/s]")
    delay: Time = param(0.4, "time from a reading to its effect on the actuator, at most 100 steps [s]")
    aeb: bool = param(False, "emergency braking on the estimates of the defence")

    def prepare(self, model: Model) -> ProductionPlan:
        check_radar_cars(model, "controller acc_production")
        late = round(self.delay / model.dt)
        if late > LONGEST:
            raise InputError("controller acc_production.delay", self.delay, f"at most {LONGEST} steps ({LONGEST * model.dt:g} s)")
        return ProductionPlan(model.dt, model.agents, late)

    def start(self, plan: ProductionPlan, batch: int) -> ProductionState:
        shape = (batch, plan.agents)
        brake = EmergencyBrake().start(shape) if self.aeb else None
        return ProductionState(num.zeros(shape), num.zeros((*shape, plan.late)), num.zeros(shape, np.int64), brake)

    def held(self, plan: ProductionPlan, state: ProductionState, batch: int) -> Array:
        return np.zeros((batch, plan.agents, 0))

    def step(
        self, plan: ProductionPlan, state: ProductionState, estimate: Estimate, v2v: Array, odometry: Array
    ) -> tuple[ProductionState, Array]:
        """Return the command (B, N, 1) [m/s^2] for estimate.x (B, N, n) = [d, dv, ...] and odometry (B, N, 2) = [x, v]."""
        d, closing, v, ahead = estimate.x[..., GAP], -estimate.x[..., RELATIVE_SPEED], odometry[..., 1], estimate.x[..., LEAD_ACCEL]
        headway = widened(self.headway, estimate.mode)
        law = Gains(headway, self.standstill, self.gap_gain, self.speed_gain, self.set_gain, self.set_speed)
        last = commanded(law, d, closing, v, ahead, state.last, plan.dt)
        u, way, slot = last, state.way, state.slot
        if plan.late:
            u, way, slot = num.pick(way, slot), num.put(way, slot, last), num.ring_next(slot, plan.late)
        u, brake = obeyed(u, estimate.mode), state.brake
        if brake is not None:
            brake = EmergencyBrake().step(brake, d, closing, v)
            u = EmergencyBrake().limited(brake, u)
        return ProductionState(last, way, slot, brake), u[..., None]

    def desired_gap(self, speed: Array) -> Array:
        """Return d_0 + h v [m]."""
        return np.asarray(self.standstill + self.headway * speed)
