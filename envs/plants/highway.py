"""A road scene: an ACC car with a radar among traffic that follows IDM and MOBIL, cuts in and brakes hard (HighwayEnv).

The plant is not linear: cars steer (a bicycle model on a winding road), change lanes, and react to each other and to the car. The
defence's model is the radar car's (radar_following.py), x = [d, dv, a_L, v_F]:

    d+ = d + T (dv + dv+)/2        dv+ = dv + T a_L - (v_F+ - v_F)        a_L+ = a_L + w        v_F+ = input

which knows nothing of lanes: where somebody cuts in, or the car ahead leaves the lane, d and dv jump. The car's command goes through the
lag tau a' + a = a_des (vehicle.py). Its speed is exact, and the scene moves it with the speed at the beginning of the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Controller, Model, Positive, Prior, Scene, Sensor, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Gap, Lag, Length, PositiveSpeed, Rate, Step, Variance, check_order
from tailgate.core.registry import register
from tailgate.envs.controllers.radar_car import STATES, radar_model
from tailgate.envs.vehicle import drive, lag

if TYPE_CHECKING:
    from tailgate.envs.plants.highway_scene import Bench, Sight

Quadruple = Annotated[tuple[Variance, Variance, Variance, Variance], Field(min_length=4, max_length=4)]
Span = Annotated[tuple[Positive, Positive], Field(min_length=2, max_length=2)]
Lanes = Annotated[int, Field(ge=1, le=20)]
Lane = Annotated[int, Field(ge=0, le=19)]
Ahead = Annotated[int, Field(ge=1, le=50)]
Behind = Annotated[int, Field(ge=0, le=50)]
Speeds = Annotated[tuple[PositiveSpeed, PositiveSpeed], Field(min_length=2, max_length=2)]
Gaps = Annotated[tuple[Gap, Gap], Field(min_length=2, max_length=2)]
START = 1000.0  # where the car begins [m]
SPEED_LIMIT = 30.0  # speed limit of the road [m/s]
DELTAS = (3.5, 4.5)  # exponents of IDM among the drivers, HighwayEnv's range
_PLACES, _CLOCKS = 0, 1  # tags of the draws


class HighwayPlan(NamedTuple):
    A: Array  # (3, 3) of the lag
    B: Array  # (3, 1)
    bench: Bench


class Seen(NamedTuple):
    """The cars ahead and behind in the lane, (B,) each, as `Scene` has them; lead_a [m/s^2] over the last step."""

    gap: Array
    lead_v: Array
    lead_a: Array
    rear_gap: Array
    rear_v: Array


class HighwayState(NamedTuple):
    """The state; every leaf has B first, (B,) where nothing is noted. After the car has crashed everything keeps its place."""

    cars: Array  # (B, V, features) all cars, as highway_scene numbers them; the first is the car
    accel: Array  # own [m/s^2]
    clock: Array  # (B, 2) time to the next hard braking and to the next cut-in [s]; inf: never
    seen: Seen
    over: Array  # bool


@register("plant", "highway", reference="Leurent, An environment for autonomous driving decision-making (HighwayEnv), 2018")
@dataclass(frozen=True)
class Highway:
    """An ACC car that keeps its lane on a road with traffic, sees the car ahead by radar and knows its own motion.

    The car ahead is the next one with a part of it in the lane. If there is none nearer than `reach`, it is a car at `reach` that keeps
    the own speed.
    """

    dt: Step = param(0.1, "step [s]")
    tau: Lag = param(1.008, "actuator lag [s]")
    lanes: Lanes = param(3, "lanes")
    lane: Lane = param(1, "the car's lane, from 0")
    ahead: Ahead = param(2, "other cars in each lane that begin ahead")
    behind: Behind = param(1, "other cars in each lane that begin behind")
    spacing: Gaps = param((40.0, 75.0), "distance from car to car at the beginning, uniform on this span [m]")
    speed: PositiveSpeed = param(25.0, "the car's initial speed [m/s]")
    traffic_speed: Speeds = param((22.0, 27.0), "speed that a driver wants, uniform on this span [m/s]")
    lane_changes: bool = param(True, "drivers change lanes for their own advantage (MOBIL)")
    bend: Length = param(8.0, "amplitude of the road's winding [m]")
    period: Gap = param(600.0, "length of one winding [m]")
    reach: Gap = param(150.0, "distance at which a car is seen [m]")
    braking: Span | None = param(None, "time between hard brakings of the car ahead, uniform on this span [s]; none: none")
    decel: Rate = param(6.0, "deceleration of a hard braking [m/s^2]")
    lasting: Span = param((1.5, 3.0), "duration of a hard braking, uniform on this span [s]")
    cut_in: Span | None = param(None, "time between cut-ins in front of the car, uniform on this span [s]; none: only MOBIL's")
    cut_gap: Gaps = param((12.0, 30.0), "gap at which a car cuts in [m]")
    process_var: Quadruple = param(
        (3e-3, 1e-1, 3.0, 1e-6), "process noise variance a step that the defence assumes, of d, dv, a_L and v_F; the plant has none"
    )
    prior_var: Quadruple = param((1.0, 1.0, 0.25, 1e-6), "variance of the prior that the defence assumes")

    def __post_init__(self) -> None:
        if self.lane >= self.lanes:
            raise InputError("plant highway.lane", self.lane, f"a lane from 0 to {self.lanes - 1}")
        for name in ("spacing", "traffic_speed", "braking", "lasting", "cut_in", "cut_gap"):
            check_order(f"plant highway.{name}", getattr(self, name))
        if self.spacing[0] < 10.0:
            raise InputError("plant highway.spacing", self.spacing, "at least 10 m: cars are 5 m long")

    @property
    def size(self) -> tuple[int, int]:
        return 1, STATES

    @property
    def cars(self) -> int:
        return 1 + self.lanes * (self.ahead + self.behind)

    def prepare(self, model: Model) -> HighwayPlan:
        """Return the plan. Raise ImportError where highway-env is missing."""
        from tailgate.envs.plants.highway_scene import Bench

        bench = Bench(self.cars, self.lanes, SPEED_LIMIT, self.dt, self.decel, self.bend, self.period, self.lane_changes)
        return HighwayPlan(*lag(self.dt, self.tau), bench)

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        return radar_model(self, sensor, self.dt, self.process_var)

    def start(self, plan: HighwayPlan, draws: Draws) -> HighwayState:
        from tailgate.envs.plants.highway_scene import FEATURES

        batch = len(draws.key)
        u, clocks = draws.uniform((self.cars, 5), tag=_PLACES), draws.uniform((2,), tag=_CLOCKS)
        cars, seen = np.zeros((batch, self.cars, FEATURES)), np.zeros((batch, 5))
        for row in range(batch):
            self._place(plan.bench, cars[row], u[row])
            plan.bench.put(cars[row])
            seen[row] = self._seen(plan.bench.look(), self.speed, 0.0, cars[row])
        clock = np.full((batch, 2), np.inf)
        for i, span in enumerate((self.braking, self.cut_in)):
            if span:
                clock[:, i] = span[0] + (span[1] - span[0]) * clocks[:, i]
        return HighwayState(cars, np.zeros(batch), clock, Seen._make(seen.T.copy()), np.zeros(batch, bool))

    def _place(self, bench: Bench, cars: Array, u: Array) -> None:
        """Return the cars (V, features) at the beginning, from uniforms u (V, 5)."""
        from tailgate.envs.plants.highway_scene import DELTA, HEADING, LANE, SPEED, TARGET, TIMER, WANTED, X, Y

        def put(i: int, lane: int, x: float, speed: float) -> None:
            cars[i, [X, Y, HEADING]] = bench.place(lane, x)
            cars[i, [SPEED, WANTED]], cars[i, [LANE, TARGET]] = speed, lane
            cars[i, TIMER], cars[i, DELTA] = u[i, 2], _within(DELTAS, u[i, 3])

        put(0, self.lane, START, self.speed)
        i = 1
        for lane in range(self.lanes):
            shift = 0.0 if lane == self.lane else -self.spacing[1] * u[i, 4]  # in other lanes somebody may be anywhere
            for way, count in ((1.0, self.ahead), (-1.0, self.behind)):
                x = START + shift
                for _ in range(count):
                    x += way * _within(self.spacing, u[i, 0])
                    put(i, lane, x, _within(self.traffic_speed, u[i, 1]))
                    i += 1

    def prior(self, plan: HighwayPlan, state: HighwayState, held: Array, draws: Draws) -> Prior:
        return Prior(self.truth(plan, state, held), num.full((len(state.over), 1, STATES, STATES), np.diag(self.prior_var)))

    def step(self, plan: HighwayPlan, state: HighwayState, u: Array, exo: Array, draws: Draws) -> HighwayState:
        from tailgate.envs.plants.highway_scene import SPEED, X

        if exo.any():
            raise InputError("manoeuvre", exo[exo != 0.0][0], "constant with value 0: a road scene drives itself")
        batch = len(state.over)
        before = state.cars[:, 0, SPEED]
        _, v, a = drive(plan.A, plan.B, state.cars[:, 0, X], before, state.accel, u[:, 0, 0], np.zeros((3, batch)))
        pull = (v - before) / self.dt
        fresh, clock = draws.uniform((3,)), state.clock - self.dt
        cars, over = state.cars.copy(order="K"), state.over.copy()
        seen = np.stack(state.seen, axis=1)
        for row in np.flatnonzero(~state.over).tolist():
            numbers = cars[row]
            plan.bench.put(numbers)
            if self.braking and clock[row, 0] <= 0.0 and plan.bench.brake(_within(self.lasting, fresh[row, 2]), self.reach):
                clock[row, 0] = _within(self.braking, fresh[row, 0])
            if self.cut_in and clock[row, 1] <= 0.0 and plan.bench.cut_in(*self.cut_gap):
                clock[row, 1] = _within(self.cut_in, fresh[row, 1])
            plan.bench.step(float(pull[row]))
            after, sight = np.array(list(plan.bench.take())), plan.bench.look()
            after[0, SPEED] = v[row]  # the same but for rounding
            seen[row] = self._seen(sight, v[row], pull[row], numbers, after)
            cars[row], over[row] = after, sight.crashed
        a = np.where(state.over, state.accel, a)
        return HighwayState(cars, a, clock, Seen._make(seen.T.copy()), over)

    def _seen(self, sight: Sight, v: float, a: float, before: Array, after: Array | None = None) -> tuple[float, ...]:
        """Return gap, lead_v, lead_a, rear_gap and rear_v as seen at the own speed v and acceleration a."""
        from tailgate.envs.plants.highway_scene import SPEED

        rear = (np.inf, v) if sight.rear_gap is None else (sight.rear_gap, sight.rear_speed)
        if sight.gap is None or sight.lead is None or sight.gap >= self.reach:
            return self.reach, v, a, *rear
        gained = 0.0 if after is None else after[sight.lead, SPEED] - before[sight.lead, SPEED]
        return sight.gap, sight.lead_speed, gained / self.dt, *rear

    def known(self, plan: HighwayPlan, u: Array, exo: Array, state: HighwayState) -> Array:
        """Return the own speed, by odometry."""
        return self.odometry(plan, state)[..., 1:]

    def truth(self, plan: HighwayPlan, state: HighwayState, held: Array) -> Array:
        v, seen = self._own(state)[1], state.seen
        return num.stack([seen.gap[:, None], (seen.lead_v - v)[:, None], seen.lead_a[:, None], v[:, None]])

    def _own(self, state: HighwayState) -> tuple[Array, Array]:
        """Return the car's position along the road [m] and its speed [m/s], (B,) each."""
        from tailgate.envs.plants.highway_scene import SPEED, X

        return state.cars[:, 0, X], state.cars[:, 0, SPEED]

    def lead_speed_of(self, state: HighwayState) -> Array:
        return state.seen.lead_v

    def scene(self, plan: HighwayPlan, state: HighwayState) -> Scene:
        (x, v), seen = self._own(state), state.seen
        shown = (seen.gap, v, state.accel, seen.lead_v, seen.rear_gap, seen.rear_v, x)
        gap, speed, accel, ahead, rear_gap, rear_speed, position = (each[:, None] for each in shown)
        return Scene(gap, speed, accel, ahead, rear_gap, rear_speed, position)

    def v2v(self, plan: HighwayPlan, state: HighwayState) -> Array:
        return np.zeros((len(state.over), 1, 0))

    def odometry(self, plan: HighwayPlan, state: HighwayState) -> Array:
        return num.stack([each[:, None] for each in self._own(state)])


def _within(span: tuple[float, float], u: float) -> float:
    return span[0] + (span[1] - span[0]) * u
