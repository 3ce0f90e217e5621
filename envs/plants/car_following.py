"""Car following: a leader, a follower with adaptive cruise control, and a human-like driver behind (thesis 4.6).

The follower's actuator is a first-order lag, tau a' + a = a_des (4.15), discretised exactly (vehicle.py):

    X+ = A X + B a_des + w,     w ~ N(0, Q)

State [x_f m, v_f m/s, a_f m/s^2], readings y = [x_f, v_f] + noise. Errata: the thesis's A_a, A_d switch on
the sign of the acceleration, and A_a is unstable; (4.14) has its sign wrong and omits d_r (see controllers.py).
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Controller, Model, Prior, Scene, Sensor, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Accel, Gap, Lag, Position, Speed, Spread, Step, Time, Variance
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import LEADER
from tailgate.envs.controllers.idm import Behind, BehindState
from tailgate.envs.vehicle import SIGMAS, check_reaction, drive, lag, roll

Spreads = Annotated[tuple[Spread, Spread, Spread], Field(min_length=3, max_length=3)]
Variances = Annotated[tuple[Variance, Variance, Variance], Field(min_length=3, max_length=3)]


class FollowingPlan(NamedTuple):
    A: Array
    B: Array
    noise_sd: Array  # (3,)
    behind: Behind | None


class FollowingState(NamedTuple):
    """Every leaf has B first."""

    lead_x: Array  # (B,)
    lead_v: Array  # (B,)
    ego: Array  # (B, 1, 3)
    behind: BehindState | None


@register("plant", "car_following", reference="Dutta 2018, section 4.6; equation (4.15)")
@dataclass(frozen=True)
class CarFollowing:
    """Leader, ACC follower with actuator lag, and optionally a human-like driver behind."""

    dt: Step = param(0.1, "step [s]")
    tau: Lag = param(1.008, "actuator lag [s]")
    gap: Gap = param(85.5, "initial gap [m]")
    lead_speed: Speed = param(29.05, "leader's initial speed [m/s]")
    position: Position = param(2.0, "follower's initial position [m]")
    speed: Speed = param(26.82, "follower's initial speed [m/s]")
    accel: Accel = param(0.112, "follower's initial acceleration [m/s^2]")
    process_var: Variances = param((1e-4, 4e-4, 2.5e-3), "process noise variance a step, of x, v and a [m^2, (m/s)^2, (m/s^2)^2]")
    initial_sd: Spreads = param((0.0, 0.0, 0.0), "spread of the true initial state about the prior mean [m, m/s, m/s^2]")
    prior_var: Variances = param((1.0, 1.0, 0.25), "variance of the prior that the defence assumes")
    rear: bool = param(True, "a human-like driver follows behind")
    rear_reaction: Time = param(1.0, "reaction time of the driver behind [s]")

    def __post_init__(self) -> None:
        least = SIGMAS * self.initial_sd[0]
        if self.gap <= least:
            wanted = f"more than {SIGMAS:g} times initial_sd of the position ({least:g}): else some begin in a collision"
            raise InputError("plant car_following.gap", self.gap, wanted)
        check_reaction("plant car_following.rear_reaction", self.rear_reaction, self.dt)

    @property
    def size(self) -> tuple[int, int]:
        return 1, 3

    def dynamics(self) -> tuple[Array, Array]:
        """Return A (3, 3) and B (3, 1)."""
        return lag(self.dt, self.tau)

    def prepare(self, model: Model) -> FollowingPlan:
        behind = Behind(self.dt, round(self.rear_reaction / self.dt)) if self.rear else None
        return FollowingPlan(model.A, model.B, np.sqrt(np.array(self.process_var)), behind)

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        (A, B), (sensors, C, R) = self.dynamics(), sensor.matrices(self)
        return Model(
            A=A, B=B, c=np.zeros(3), C=C, Q=np.diag(self.process_var), R=R, graph=np.eye(1, dtype=bool), dt=self.dt,
            sensors=sensors, v2v=LEADER, actuators=("acceleration",),
            gap=np.array([[-1.0, 0.0, 0.0]]), speed=np.array([[0.0, 1.0, 0.0]]),
        )  # fmt: skip

    def prior(self, plan: FollowingPlan, state: FollowingState, held: Array, draws: Draws) -> Prior:
        return Prior(self._mean(len(state.lead_x)), num.full((len(state.lead_x), 1, 3, 3), np.diag(self.prior_var)))

    def _mean(self, batch: int) -> Array:
        return num.full((batch, 1, 3), np.array([self.position, self.speed, self.accel]))

    def start(self, plan: FollowingPlan, draws: Draws) -> FollowingState:
        batch = len(draws.key)
        ego = self._mean(batch) + np.array(self.initial_sd) * draws.normal((1, 3))
        behind = plan.behind.start(ego[:, 0, 0], self.speed) if plan.behind else None
        return FollowingState(np.full(batch, self.position + self.gap), np.full(batch, self.lead_speed), ego, behind)

    def step(self, plan: FollowingPlan, state: FollowingState, u: Array, exo: Array, draws: Draws) -> FollowingState:
        noise = plan.noise_sd[:, None] * num.first_to_last(draws.normal((3,)))  # (3, B)
        x, v = state.ego[:, 0, 0], state.ego[:, 0, 1]
        ego = self.move(plan, state.ego, u, noise)
        lead_x, lead_v = roll(state.lead_x, state.lead_v, exo, self.dt)
        behind = plan.behind.step(state.behind, x, v) if plan.behind and state.behind else None
        return FollowingState(lead_x, lead_v, ego, behind)

    def move(self, plan: FollowingPlan, ego: Array, u: Array, noise: Array) -> Array:
        """Return the follower (B, 1, 3) one step later, under u (B, 1, 1) [m/s^2] and noise (3, B)."""
        x, v, a = drive(plan.A, plan.B, ego[:, 0, 0], ego[:, 0, 1], ego[:, 0, 2], u[:, 0, 0], noise)
        return num.stack([x[:, None], v[:, None], a[:, None]])

    def known(self, plan: FollowingPlan, u: Array, exo: Array, state: FollowingState) -> Array:
        return u

    def truth(self, plan: FollowingPlan, state: FollowingState, held: Array) -> Array:
        return state.ego

    def odometry(self, plan: FollowingPlan, state: FollowingState) -> Array:
        return np.zeros((len(state.lead_x), 1, 0))

    def lead_speed_of(self, state: FollowingState) -> Array:
        return state.lead_v

    def scene(self, plan: FollowingPlan, state: FollowingState) -> Scene:
        x, v, a = state.ego[..., 0], state.ego[..., 1], state.ego[..., 2]
        rear = state.behind
        rear_gap, rear_v = (np.full_like(x, np.inf), v) if rear is None else (x - rear.x[:, None], rear.v[:, None])
        return Scene(state.lead_x[:, None] - x, v, a, state.lead_v[:, None], rear_gap, rear_v, x)

    def v2v(self, plan: FollowingPlan, state: FollowingState) -> Array:
        return num.stack([state.lead_x[:, None], state.lead_v[:, None]])
