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
from tailgate.core import Array, Controller, Finite, Model, NonNegative, Positive, Prior, Scene, Sensor, param
from tailgate.draws import Draws
from tailgate.registry import register

from .vehicle import drive, lag

Triple = Annotated[tuple[NonNegative, NonNegative, NonNegative], Field(min_length=3, max_length=3)]

# The Intelligent Driver Model (Treiber, Hennecke, Helbing 2000) of the human behind, with a reaction time.
IDM_SPEED = 33.3  # desired speed [m/s]
IDM_HEADWAY = 1.5  # desired time headway [s]
IDM_GAP = 2.0  # gap at standstill [m]
IDM_ACCEL = 1.4  # largest acceleration [m/s^2]
IDM_DECEL = 2.0  # comfortable deceleration [m/s^2]
IDM_BRAKE = 8.0  # physical limit [m/s^2]


def idm_accel(gap: Array, speed: Array, lead_speed: Array) -> Array:
    """IDM acceleration [m/s^2] for gap [m] and speeds [m/s], elementwise."""
    closing = speed * (speed - lead_speed) / (2.0 * np.sqrt(IDM_ACCEL * IDM_DECEL))
    wanted = IDM_GAP + np.maximum(0.0, speed * IDM_HEADWAY + closing)
    free = (speed / IDM_SPEED) * (speed / IDM_SPEED)
    near = wanted / np.maximum(gap, 0.1)
    return np.asarray(np.clip(IDM_ACCEL * (1.0 - free * free - near * near), -IDM_BRAKE, IDM_ACCEL))


class FollowingPlan(NamedTuple):
    A: Array
    B: Array
    noise_sd: Array  # (3,)
    reaction: int  # steps


class FollowingState(NamedTuple):
    """Every leaf has B first."""

    lead_x: Array  # (B,)
    lead_v: Array  # (B,)
    ego: Array  # (B, 1, 3)
    rear_x: Array  # (B,)
    rear_v: Array  # (B,)
    rear_intent: Array  # (B, reaction): accelerations that the driver behind has decided and not yet made
    rear_slot: Array  # (B,) where the next one goes


@register("plant", "car_following", reference="Dutta 2018, section 4.6; equation (4.15)")
@dataclass(frozen=True)
class CarFollowing:
    """Leader, ACC follower with actuator lag, and optionally a human-like driver behind."""

    dt: Positive = param(0.1, "step [s]")
    tau: Positive = param(1.008, "actuator lag [s]")
    gap: Finite = param(85.5, "initial gap [m]")
    lead_speed: NonNegative = param(29.05, "leader's initial speed [m/s]")
    position: Finite = param(2.0, "follower's initial position [m]")
    speed: NonNegative = param(26.82, "follower's initial speed [m/s]")
    accel: Finite = param(0.112, "follower's initial acceleration [m/s^2]")
    process_var: Triple = param((1e-4, 4e-4, 2.5e-3), "process noise variance a step, of x, v and a [m^2, (m/s)^2, (m/s^2)^2]")
    initial_sd: Triple = param((0.0, 0.0, 0.0), "spread of the true initial state about the prior mean [m, m/s, m/s^2]")
    prior_var: Triple = param((1.0, 1.0, 0.25), "variance that the defence is told of the prior")
    rear: bool = param(True, "a human-like driver follows behind")
    rear_reaction: NonNegative = param(1.0, "reaction time of the driver behind [s]")

    @property
    def size(self) -> tuple[int, int]:
        return 1, 3

    def dynamics(self) -> tuple[Array, Array]:
        """A (3, 3) and B (3, 1)."""
        return lag(self.dt, self.tau)

    def prepare(self, model: Model) -> FollowingPlan:
        reaction = round(self.rear_reaction / self.dt) if self.rear else 0
        return FollowingPlan(model.A, model.B, np.sqrt(np.array(self.process_var)), reaction)

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        (A, B), (sensors, C, R) = self.dynamics(), sensor.matrices(self)
        return Model(
            A=A, B=B, c=np.zeros(3), C=C, Q=np.diag(self.process_var), R=R, graph=np.eye(1, dtype=bool), dt=self.dt,
            sensors=sensors, v2v=("leader_position", "leader_velocity"), actuators=("acceleration",),
            gap=np.array([[-1.0, 0.0, 0.0]]), speed=np.array([[0.0, 1.0, 0.0]]),
        )  # fmt: skip

    def prior(self, plan: FollowingPlan, state: FollowingState, held: Array, draws: Draws) -> Prior:
        return Prior(self._mean(len(state.lead_x)), num.full((len(state.lead_x), 1, 3, 3), np.diag(self.prior_var)))

    def _mean(self, batch: int) -> Array:
        return num.full((batch, 1, 3), np.array([self.position, self.speed, self.accel]))

    def start(self, plan: FollowingPlan, draws: Draws) -> FollowingState:
        batch = len(draws.key)
        ego = self._mean(batch) + np.array(self.initial_sd) * draws.normal((1, 3))
        rear_gap = IDM_GAP + IDM_HEADWAY * self.speed
        lead_x = np.full(batch, self.position + self.gap)
        return FollowingState(
            lead_x, np.full(batch, self.lead_speed), ego, ego[:, 0, 0] - rear_gap, np.full(batch, self.speed),
            num.zeros((batch, plan.reaction)), np.zeros(batch, np.int64),
        )  # fmt: skip

    def step(self, plan: FollowingPlan, state: FollowingState, u: Array, exo: Array, draws: Draws) -> FollowingState:
        dt, half = self.dt, 0.5 * self.dt
        noise = plan.noise_sd[:, None] * np.moveaxis(draws.normal((3,)), 0, -1)  # (3, B)
        x, v = state.ego[:, 0, 0], state.ego[:, 0, 1]
        ego = self.move(plan, state.ego, u, noise)
        lead_v = np.maximum(0.0, state.lead_v + exo * dt)
        lead_x = state.lead_x + half * (state.lead_v + lead_v)
        rear_x, rear_v, intent, slot = state.rear_x, state.rear_v, state.rear_intent, state.rear_slot
        if self.rear:
            decided = idm_accel(x - rear_x, rear_v, v)
            if plan.reaction:
                rows = np.arange(len(slot))
                made = intent[rows, slot]
                intent = intent.copy(order="K")
                intent[rows, slot] = decided
                slot = (slot + 1) % plan.reaction
            else:
                made = decided
            rear_v = np.maximum(0.0, rear_v + made * dt)
            rear_x = rear_x + half * (state.rear_v + rear_v)
        return FollowingState(lead_x, lead_v, ego, rear_x, rear_v, intent, slot)

    def move(self, plan: FollowingPlan, ego: Array, u: Array, noise: Array) -> Array:
        """The follower (B, 1, 3) one step later, under u (B, 1, 1) [m/s^2] and noise (3, B)."""
        x, v, a = drive(plan.A, plan.B, ego[:, 0, 0], ego[:, 0, 1], ego[:, 0, 2], u[:, 0, 0], noise)
        return num.stack([x[:, None], v[:, None], a[:, None]])

    def known(self, plan: FollowingPlan, u: Array, exo: Array) -> Array:
        return u

    def truth(self, plan: FollowingPlan, state: FollowingState, held: Array) -> Array:
        return state.ego

    def lead_speed_of(self, state: FollowingState) -> Array:
        return state.lead_v

    def scene(self, plan: FollowingPlan, state: FollowingState) -> Scene:
        x, v, a = state.ego[..., 0], state.ego[..., 1], state.ego[..., 2]
        behind = (x - state.rear_x[:, None]) if self.rear else np.full_like(x, np.inf)
        return Scene(state.lead_x[:, None] - x, v, a, state.lead_v[:, None], behind, state.rear_v[:, None], x)

    def v2v(self, plan: FollowingPlan, state: FollowingState) -> Array:
        return num.stack([state.lead_x[:, None], state.lead_v[:, None]])
