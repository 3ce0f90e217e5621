"""A string of cars with adaptive cruise control behind a leader: no messages, each car on its own radar.

Each car i has the lag tau a' + a = u (vehicle.py). It estimates its own

    x_i = [d, dv, a_ahead, v, d(k-1), dv(k-1), ..., d(k-L), dv(k-L)]

with the gap d [m] to the car ahead, dv = v_ahead - v [m/s] (positive: opening), the acceleration ahead [m/s^2], and the own speed [m/s]
by trusted odometry. The rest is what the radar saw in the L cycles that it may be late. The model of every car is that of radar_car.py:

    d+ = d + T (dv + dv+)/2        dv+ = dv + T a_ahead - (v+ - v)        a_ahead+ = a_ahead + w        v+ = input

It has no coupling: no car hears another. `Model` has one state for all agents; here each agent has the same model and its own state.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Controller, Model, Prior, Scene, Sensor, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Gap, Lag, Speed, Spread, Step, Time, Variance
from tailgate.core.registry import register
from tailgate.envs.controllers.emergency import BrakeState, EmergencyBrake
from tailgate.envs.controllers.radar_car import GAP, OWN_SPEED, STATES, kinematic
from tailgate.envs.vehicle import SIGMAS, drive, lag, roll

Cars = Annotated[int, Field(ge=1, le=20)]
Kept = Annotated[int, Field(ge=0, le=20)]
Triple = Annotated[tuple[Variance, Variance, Variance], Field(min_length=3, max_length=3)]
Quadruple = Annotated[tuple[Variance, Variance, Variance, Variance], Field(min_length=4, max_length=4)]
_NOISE, _AEB = 0, 1  # tags of the draws


class StringPlan(NamedTuple):
    A: Array  # (3, 3) of one car
    B: Array  # (3, 1)
    noise_sd: Array  # (3,)
    aeb_sd: Array  # (2,)


class StringState(NamedTuple):
    """Every leaf has B first; (B,) of the leader, (B, N) of the cars. Positions are such that their differences are the gaps."""

    lead_x: Array
    lead_v: Array
    x: Array
    v: Array
    a: Array
    ahead_a: Array  # of the car ahead, over the last step
    past: Array  # (B, N, 2 L) [d, dv] of the last L steps, the newest first
    brake: BrakeState | None


@register("plant", "acc_string", reference="Makridis et al., OpenACC, Transportation Research Part C 125, 2021")
@dataclass(frozen=True)
class AccString:
    """A leader and a string of cars with actuator lag, each of which knows its own speed and sees the car ahead by radar."""

    cars: Cars = param(1, "cars behind the leader, all of them agents")
    dt: Step = param(0.05, "step, and cycle of the radar [s]")
    tau: Lag = param(0.4, "actuator lag [s]")
    kept: Kept = param(1, "cycles of which the state keeps gap and relative speed, for a radar that is late")
    gap: Gap = param(3.5, "initial gap at standstill [m]")
    time_gap: Time = param(1.2, "initial gap for each m/s of the initial speed [s]")
    gap_sd: Spread = param(0.0, "Gaussian spread of the initial gaps [m]")
    lead_speed: Speed = param(20.0, "initial speed of all cars, where the manoeuvre has none [m/s]")
    noise_var: Triple = param((0.0, 0.0, 0.0), "process noise variance a step of each car's position, speed and acceleration")
    process_var: Quadruple = param(
        (1e-6, 1e-5, 2e-2, 1e-6), "process noise variance a step that the defence assumes, of d, dv, a_ahead and v"
    )
    prior_var: Quadruple = param((1.0, 0.25, 0.25, 1e-6), "variance of the prior that the defence assumes")
    aeb: Literal["own"] | None = param(None, "own: emergency braking on a second sensor that nobody attacks; none: without")
    aeb_sd: Annotated[tuple[Spread, Spread], Field(min_length=2, max_length=2)] = param(
        (0.25, 0.2), "standard deviations of that sensor's gap and closing speed [m, m/s]"
    )

    def __post_init__(self) -> None:
        if self.gap <= SIGMAS * self.gap_sd:
            wanted = f"more than {SIGMAS:g} gap_sd ({SIGMAS * self.gap_sd:g}): else some begin in a collision"
            raise InputError("plant acc_string.gap", self.gap, wanted)

    @property
    def size(self) -> tuple[int, int]:
        return self.cars, STATES + 2 * self.kept

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """Return the model of each car."""
        (cars, n), (names, C, R) = self.size, sensor.matrices(self)
        A, B, rows, told = np.zeros((n, n)), np.zeros((n, 1)), np.eye(n), np.zeros(n)
        A[:STATES, :STATES], B[:STATES] = kinematic(self.dt)
        A[range(STATES, n), [*range(2), *range(STATES, n - 2)][: n - STATES]] = 1.0
        told[:STATES] = self.process_var
        return Model(
            A=A, B=B, c=np.zeros(n), C=C, Q=np.diag(told), R=R, graph=np.eye(cars, dtype=bool), dt=self.dt, sensors=names,
            actuators=("acceleration",), gap=np.repeat(rows[[GAP]], cars, axis=0), speed=np.repeat(rows[[OWN_SPEED]], cars, axis=0),
        )  # fmt: skip

    def prepare(self, model: Model) -> StringPlan:
        return StringPlan(*lag(self.dt, self.tau), np.sqrt(np.array(self.noise_var)), np.array(self.aeb_sd))

    def start(self, plan: StringPlan, draws: Draws) -> StringState:
        speed = np.full(len(draws.key), self.lead_speed)
        return self._at(plan, speed, self.gap_sd * draws.normal((self.cars,)) if self.gap_sd else num.zeros((len(speed), self.cars)))

    def _at(self, plan: StringPlan, speed: Array, off: Array) -> StringState:
        """Return the state of cars at a speed (B,), at their gaps but for `off` (B, N) [m]."""
        shape = off.shape
        gaps = self.gap + self.time_gap * speed[:, None] + off
        x, zero = -np.add.accumulate(gaps, axis=1), num.zeros(shape)
        past = num.zeros((*shape, 2 * self.kept))
        past[..., ::2] = gaps[..., None]
        brake = EmergencyBrake().start(shape) if self.aeb else None
        return StringState(num.zeros(shape[:1]), speed, x, speed[:, None] + zero, zero, num.zeros(shape), past, brake)

    def paced(self, plan: StringPlan, state: StringState, speed: Array) -> StringState:
        d, _ = self._seen(state)
        return self._at(plan, speed, d - self.gap - self.time_gap * state.v)

    def prior(self, plan: StringPlan, state: StringState, held: Array, draws: Draws) -> Prior:
        n = self.size[1]
        told = np.array([*self.prior_var, *([*self.prior_var[:2]] * self.kept)])
        return Prior(self.truth(plan, state, held), num.full((*state.x.shape, n, n), np.diag(told)))

    def _ahead(self, state: StringState) -> tuple[Array, Array]:
        """Return position and speed (B, N) of the car ahead of each."""
        x, v = num.zeros(state.x.shape), num.zeros(state.x.shape)
        x[:, 0], v[:, 0] = state.lead_x, state.lead_v
        x[:, 1:], v[:, 1:] = state.x[:, :-1], state.v[:, :-1]
        return x, v

    def _seen(self, state: StringState) -> tuple[Array, Array]:
        """Return gap and relative speed (B, N)."""
        x, v = self._ahead(state)
        return x - state.x, v - state.v

    def step(self, plan: StringPlan, state: StringState, u: Array, exo: Array, draws: Draws) -> StringState:
        (d, dv), (_, v_ahead), applied, brake = self._seen(state), self._ahead(state), u[..., 0], state.brake
        if brake is not None:
            off = plan.aeb_sd * draws.normal((self.cars, 2), tag=_AEB)
            brake = EmergencyBrake().step(brake, d + off[..., 0], off[..., 1] - dv, state.v)
            applied = EmergencyBrake().limited(brake, applied)
        noise = plan.noise_sd * draws.normal((self.cars, 3), tag=_NOISE) if plan.noise_sd.any() else np.zeros((1, 1, 3))
        x, v, a = drive(plan.A, plan.B, state.x, state.v, state.a, applied, num.last_to_first(noise))
        lead_x, lead_v = roll(state.lead_x, state.lead_v, exo, self.dt)
        past = state.past
        if self.kept:
            past = num.stack([d, dv, *(state.past[..., i] for i in range(2 * self.kept - 2))])
        after = StringState(lead_x, lead_v, x, v, a, state.ahead_a, past, brake)
        return after._replace(ahead_a=(self._ahead(after)[1] - v_ahead) / self.dt)

    def known(self, plan: StringPlan, u: Array, exo: Array, state: StringState) -> Array:
        """Return the own speeds, by odometry."""
        return state.v[..., None]

    def truth(self, plan: StringPlan, state: StringState, held: Array) -> Array:
        """Return each car's own state (B, N, n)."""
        d, dv = self._seen(state)
        return num.stack([d, dv, state.ahead_a, state.v, *(state.past[..., i] for i in range(2 * self.kept))])

    def lead_speed_of(self, state: StringState) -> Array:
        return state.lead_v

    def scene(self, plan: StringPlan, state: StringState) -> Scene:
        x, v = self._ahead(state)
        return Scene(x - state.x, state.v, state.a, v, num.full(state.x.shape, np.inf), state.v, state.x)

    def v2v(self, plan: StringPlan, state: StringState) -> Array:
        return np.zeros((*state.x.shape, 0))

    def odometry(self, plan: StringPlan, state: StringState) -> Array:
        return num.stack([state.x, state.v])
