"""Lane keeping: one car at constant speed between two lines, by the bicycle model in error coordinates.

    x = [e_y m, e_y' m/s, e_psi rad, e_psi' rad/s],     x' = A x + B1 delta + B2 v kappa

with the offset e_y of the centre of gravity from the middle of the lane (left is positive) and the heading error e_psi against the road.
The inputs are the steering angle delta [rad] and the curvature kappa [1/m] (a left bend is positive). C_f, C_r are of one tyre, two to an
axle. The step is exact for inputs that are held over it. A steady bend has

    e_psi = (-l_r + l_f m v^2 / (2 C_r L)) kappa,     delta = (L + (m v^2 / L) (l_r / (2 C_f) - l_f / (2 C_r))) kappa

when the car is in the middle of the lane. The road as others see it (`Scene`): the nearer line takes the place of a car ahead. `gap` is
the distance to it, and the speed at which the car comes closer to it is `speed` - `lead_speed`.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Controller, Model, Prior, Scene, Sensor, param
from tailgate.core.draws import Draws
from tailgate.core.nouns import Lane
from tailgate.core.quantities import Gap, Positive, PositiveSpeed, Spread, Step, Variance
from tailgate.core.registry import register
from tailgate.envs.controllers.lane_lqr import CURVATURE, STEERING
from tailgate.envs.controllers.lane_stanley import LaneStanley
from tailgate.envs.plants.sampled import zero_order_hold
from tailgate.envs.vehicle import SIGMAS

STATES = 4
Spreads = Annotated[tuple[Spread, Spread, Spread, Spread], Field(min_length=4, max_length=4)]
Variances = Annotated[tuple[Variance, Variance, Variance, Variance], Field(min_length=4, max_length=4)]
GROWTH = 1.5  # largest growth of the state in a step: a car that is as unstable leaves any lane at once


def bicycle(mass: float, inertia: float, front: float, rear: float, front_stiffness: float, rear_stiffness: float, speed: float) -> tuple[
    Array, Array
]:  # fmt: skip
    """Return A (4, 4) and B = [B1, v B2] (4, 2) of the bicycle model in error coordinates, for the inputs steering and curvature.

    Parameters
    ----------
    mass, inertia
        Of the car [kg], about its vertical axis [kg m^2].
    front, rear
        Distances l_f, l_r from the centre of gravity to the axles [m].
    front_stiffness, rear_stiffness
        Cornering stiffness of one front and of one rear tyre [N/rad].
    speed
        Speed v [m/s].

    References
    ----------
    R. Rajamani, Vehicle Dynamics and Control, second edition, Springer 2012, equation (2.45).
    """
    cf, cr = 2.0 * front_stiffness, 2.0 * rear_stiffness
    turn, damp = cf * front - cr * rear, cf * front * front + cr * rear * rear
    A = np.array([
        [0.0, 1.0, 0.0, 0.0],
        [0.0, -(cf + cr) / (mass * speed), (cf + cr) / mass, -turn / (mass * speed)],
        [0.0, 0.0, 0.0, 1.0],
        [0.0, -turn / (inertia * speed), turn / inertia, -damp / (inertia * speed)],
    ])  # fmt: skip
    bend = [0.0, -turn / (mass * speed) - speed, 0.0, -damp / (inertia * speed)]
    return A, np.array([[0.0, 0.0], [cf / mass, bend[1] * speed], [0.0, 0.0], [cf * front / inertia, bend[3] * speed]])


class LanePlan(NamedTuple):
    A: Array
    B: Array
    noise_sd: Array  # (4,)


class LaneState(NamedTuple):
    """Every leaf has B first. `curvature` acts on the next step, `bent` acted on the last one."""

    x: Array  # (B, 1, 4)
    position: Array  # (B,) along the road [m]
    curvature: Array  # (B,) [1/m]
    bent: Array  # (B,) [1/m]


@register("plant", "lane_keeping", reference="Rajamani, Vehicle Dynamics and Control, 2nd edition, 2012, (2.45)")
@dataclass(frozen=True)
class LaneKeeping:
    """One car that keeps its lane at constant speed: the bicycle model, with the curvature of the road as its known second input."""

    dt: Step = param(0.05, "step [s]")
    lane_speed: PositiveSpeed = param(20.0, "speed, which stays [m/s]")
    mass: Positive = param(1573.0, "mass [kg]")
    inertia: Positive = param(2873.0, "moment of inertia about the vertical axis [kg m^2]")
    front: Positive = param(1.1, "distance from the centre of gravity to the front axle [m]")
    rear: Positive = param(1.58, "distance from the centre of gravity to the rear axle [m]")
    front_stiffness: Positive = param(80_000.0, "cornering stiffness of one front tyre [N/rad]")
    rear_stiffness: Positive = param(80_000.0, "cornering stiffness of one rear tyre [N/rad]")
    half_lane: Gap = param(1.75, "largest offset of the centre of gravity from the middle: half of the lane [m]")
    process_var: Variances = param(
        (1e-6, 1e-3, 1e-8, 4e-5), "process noise variance a step, of e_y, e_y', e_psi, e_psi' [m^2, (m/s)^2, rad^2, (rad/s)^2]"
    )
    initial_sd: Spreads = param((0.1, 0.0, 0.005, 0.0), "spread of the true initial state about 0 [m, m/s, rad, rad/s]")
    prior_var: Variances = param((0.04, 0.01, 1e-4, 1e-4), "variance of the prior that the defence assumes")

    def __post_init__(self) -> None:
        if self.half_lane <= SIGMAS * self.initial_sd[0]:
            wanted = f"more than {SIGMAS:g} times initial_sd of the offset ({SIGMAS * self.initial_sd[0]:g}): else some begin off the lane"
            raise InputError("plant lane_keeping.half_lane", self.half_lane, wanted)
        if (growth := num.spectral_radius(self.dynamics()[0])) > GROWTH:
            wanted = f"a car whose error grows at most {GROWTH:g} times a step; it grows {growth:.3g} times"
            raise InputError("plant lane_keeping.lane_speed", self.lane_speed, wanted)

    @property
    def size(self) -> tuple[int, int]:
        return 1, STATES

    def dynamics(self) -> tuple[Array, Array]:
        """Return A (4, 4) and B (4, 2) of a step; the inputs are steering [rad] and curvature [1/m]."""
        A, B = bicycle(
            self.mass, self.inertia, self.front, self.rear, self.front_stiffness, self.rear_stiffness, self.lane_speed
        )
        return zero_order_hold(A, B, self.dt)

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """Return the public model. Raise InputError for a controller that reckons with another car."""
        if isinstance(controller, LaneStanley):
            for field, own in (("speed", "lane_speed"), ("front", "front")):
                if getattr(controller, field) != getattr(self, own):
                    wanted = f"the plant's {own} ({getattr(self, own):g})"
                    raise InputError(f"controller lane_stanley.{field}", getattr(controller, field), wanted)
        (A, B), (names, C, R) = self.dynamics(), sensor.matrices(self)
        row = np.eye(STATES)
        return Model(
            A=A, B=B, c=np.zeros(STATES), C=C, Q=np.diag(self.process_var), R=R, graph=np.eye(1, dtype=bool), dt=self.dt,
            sensors=names, v2v=(CURVATURE,), actuators=(STEERING,), gap=-row[:1], speed=row[1:2], lane=self.half_lane,
        )  # fmt: skip

    def prepare(self, model: Model) -> LanePlan:
        return LanePlan(model.A, model.B, np.sqrt(np.array(self.process_var)))

    def start(self, plan: LanePlan, draws: Draws) -> LaneState:
        batch = len(draws.key)
        x = np.array(self.initial_sd) * draws.normal((1, STATES))
        return LaneState(x, np.zeros(batch), np.zeros(batch), np.zeros(batch))

    def prior(self, plan: LanePlan, state: LaneState, held: Array, draws: Draws) -> Prior:
        batch = len(state.position)
        return Prior(num.zeros((batch, 1, STATES)), num.full((batch, 1, STATES, STATES), np.diag(self.prior_var)))

    def step(self, plan: LanePlan, state: LaneState, u: Array, exo: Array, draws: Draws) -> LaneState:
        """Return the state one step later; `exo` (B,) is the curvature of the step after this one [1/m]."""
        inputs = num.stack([u[..., 0], state.curvature[:, None]])
        x = num.matvec(plan.A, state.x) + num.matvec(plan.B, inputs) + plan.noise_sd * draws.normal((1, STATES))
        return LaneState(x, state.position + self.lane_speed * self.dt, exo, state.curvature)

    def known(self, plan: LanePlan, u: Array, exo: Array, state: LaneState) -> Array:
        """Return steering and curvature (B, 1, 2): the map is on board."""
        return num.stack([u[..., 0], state.bent[:, None]])

    def truth(self, plan: LanePlan, state: LaneState, held: Array) -> Array:
        return state.x

    def lead_speed_of(self, state: LaneState) -> Array:
        """Return the own speed (B,) [m/s], which stays: the manoeuvre drives the road."""
        return np.full(len(state.position), self.lane_speed)

    def scene(self, plan: LanePlan, state: LaneState) -> Scene:
        """Return the lane; `accel` is the lateral acceleration v (e_psi' + v kappa) [m/s^2]."""
        offset, rate, turn = state.x[..., 0], state.x[..., 1], state.x[..., 3]
        v = num.full(offset.shape, self.lane_speed)
        nearer = np.where(offset < 0.0, -rate, rate)  # how fast the offset grows
        bend = state.curvature[:, None]
        lateral = self.lane_speed * (turn + self.lane_speed * bend)
        return Scene(
            self.half_lane - np.abs(offset), v, lateral, v - nearer, num.full(offset.shape, np.inf), v, state.position[:, None],
            Lane(offset, rate, bend),
        )  # fmt: skip

    def v2v(self, plan: LanePlan, state: LaneState) -> Array:
        """Return the curvature (B, 1, 1) of the next step [1/m], as the map's service sends it to the controller."""
        return state.curvature[:, None, None]

    def odometry(self, plan: LanePlan, state: LaneState) -> Array:
        return np.zeros((len(state.position), 1, 0))
