"""A platoon: a leader and a string of followers with cooperative adaptive cruise control (thesis chapter 6; SI units).

    d_i' = v_{i-1} - v_i          v_i' = a_i          tau a_i' = -a_i + u_i                              (6.4)

State and laws are those of cacc.py. No car knows the others' commands, so that the public model is the closed loop, in continuous time

    X' = Ac X + cc + Br u_r,      discretised by zero-order hold: X+ = Ad X + cd + Bd u_r

with the leader's input u_r. (The open loop, as the thesis prints it, has an integrator in every gap that only its own car can see. It is
refused as undetectable.) `platoon` drives cars, which have limits and do not roll back, on the estimates. `platoon_linear` is the thesis's
simulation, the linear closed loop on the true state. Erratum: the leader's fourth, all-zero state in (6.10) cannot be detected, and is
dropped.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Controller, Model, Prior, Received, Scene, Sensor, Sized, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Gap, Lag, Length, PositiveSpread, PositiveVariance, Speed, Spread, Step, Variance
from tailgate.core.reach import require_detectable
from tailgate.core.registry import register
from tailgate.envs.controllers.cacc import PER_CAR, V2V, Column, Gains, Law
from tailgate.envs.plants.sampled import zero_order_hold
from tailgate.envs.vehicle import SIGMAS, drive, lag

GEARED = ("distance", "velocity")  # wires of the spacing error and of its rate
Followers = Annotated[int, Field(ge=1, le=80)]
Topology = Literal["predecessor_leader", "predecessor", "bidirectional", "two_predecessor"]
Spreads = Annotated[tuple[Spread, Spread, Spread], Field(min_length=3, max_length=3)]
Variances = Annotated[tuple[Variance, Variance, Variance], Field(min_length=3, max_length=3)]


def hears(topology: Topology, cars: int) -> Array:
    """Return the graph (N, N) bool of a topology, [i, j] when car i receives messages and estimates of car j."""
    i, j = np.indices((cars, cars))
    heard = (i == j) | (i == j + 1)
    if topology == "predecessor_leader":
        heard |= j == 0
    elif topology == "bidirectional":
        heard |= j == i + 1
    elif topology == "two_predecessor":
        heard |= i == j + 2
    return np.asarray(heard)


def closed_loop(gains: Gains, tau: float) -> tuple[Array, Array, Array]:
    """Return Ac (n, n), Br (n,) of the leader's input, and cc (n,) of a string of cars with actuator lag tau [s], in continuous time."""
    cars, n = gains.K.shape
    A, B, c, col = np.zeros((n, n)), np.zeros(n), np.zeros(n), Column
    A[0, 1] = A[1, 2] = 1.0
    A[2, 2], B[2] = -1.0 / tau, 1.0 / tau
    for i in range(1, cars):
        A[col.gap(i), col.speed(i - 1)], A[col.gap(i), col.speed(i)] = 1.0, -1.0
        A[col.speed(i), col.accel(i)] = 1.0
        A[col.accel(i)] += gains.K[i] / tau
        A[col.accel(i), col.accel(i)] -= 1.0 / tau
        c[col.accel(i)] = gains.k0[i] / tau
        f, V = col.controller(i), gains.V[i]
        A[f] += gains.G[i]
        A[f, col.accel(i - 1)] += V[0]
        A[f, 2] += V[1]
        A[f] += V[2] * gains.K[i - 1]
        A[f, f] -= 1.0
        A[f] /= gains.tau_f
        c[f] = (gains.g0[i] + V[2] * gains.k0[i - 1]) / gains.tau_f
        B[f] = V[2] / gains.tau_f if i == 1 else 0.0
    return A, B, c


@dataclass(frozen=True)
class String:
    """Base of the platoons: who they are, what they hear, and their public model."""

    followers: Followers = param(4, "cars behind the leader")
    topology: Topology = param("predecessor_leader", "who hears whom; predecessor_leader is the thesis's")
    leader_input_known: bool = param(False, "the followers know the leader's command")
    dt: Step = param(0.1, "step [s]")
    tau: Lag = param(1.008, "actuator lag [s]")
    gap: Gap = param(65.0, "mean initial gap [m]")
    gap_sd: Length = param(0.0, "Gaussian spread of the initial gaps [m]")
    gap_range: Length = param(2.0, "uniform spread of the initial gaps, to either side [m]")
    speed: Speed = param(20.0, "initial speed of all cars [m/s]")
    process_var: PositiveVariance = param(
        1e-3, "process noise variance a step that the defence assumes, of all states but the accelerations"
    )
    accel_sd: PositiveSpread = param(0.397, "standard deviation a step that it assumes of the accelerations: what it does not know [m/s^2]")
    initial_sd: Spread = param(0.1, "spread of each car's prior mean about the true initial state")
    prior_var: PositiveVariance = param(0.01, "variance of that prior, as the defence assumes it")

    def __post_init__(self) -> None:
        least = self.gap_range + SIGMAS * self.gap_sd
        if self.gap <= least:
            wanted = f"more than gap_range + {SIGMAS:g} gap_sd ({least:g}): else some begin in a collision"
            raise InputError("plant platoon.gap", self.gap, wanted)

    @property
    def size(self) -> tuple[int, int]:
        return 1 + self.followers, 3 + PER_CAR * self.followers

    @property
    def lead_speed(self) -> float:
        """The leader's initial speed [m/s]."""
        return self.speed

    def hears(self) -> Array:
        """Return the graph (N, N) bool, [i, j] when car i hears car j."""
        return hears(self.topology, self.size[0])

    def gains(self, controller: Controller) -> Gains:
        """Return the matrices of the law that drives this string."""
        if not isinstance(controller, Law):
            wanted = "a law of cooperative adaptive cruise control: cacc, ploeg_cacc or consensus_cacc"
            raise InputError("plant platoon: controller", type(controller).__name__, wanted)
        return controller.gains(self.hears(), controller.headway)

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """Return the public model: the closed loop. Raise InputError, naming the cars, where it is not detectable."""
        (cars, n), (names, C, R) = self.size, sensor.matrices(self)
        A, B, c = closed_loop(self.gains(controller), self.tau)
        A, inputs = zero_order_hold(A, np.stack([B, c], axis=1), self.dt)
        told, gap, speed = np.full(n, self.process_var), np.zeros((cars, n)), np.zeros((cars, n))
        for i in range(cars):
            told[Column.accel(i)] = self.accel_sd * self.accel_sd
            speed[i, Column.speed(i)] = 1.0
            if i:
                gap[i, Column.gap(i)] = 1.0
        model = Model(
            A=A, B=inputs[:, :1], c=inputs[:, 1], C=C, Q=np.diag(told), R=R, graph=self.hears(), dt=self.dt, sensors=names, v2v=V2V,
            actuators=("command",), gap=gap, speed=speed,
        )  # fmt: skip
        require_detectable(model, "plant platoon")
        return model

    def initial_gaps(self, draws: Draws) -> Array:
        """Return the gaps (B, F) [m] at the start."""
        behind = (self.followers,)
        return np.asarray(self.gap + self.gap_sd * draws.normal(behind) + self.gap_range * (2.0 * draws.uniform(behind, 1) - 1.0))

    def told(self, truth: Array, draws: Draws) -> Prior:
        """Return each car's prior knowledge of the initial state (B, N, n)."""
        shape = (*truth.shape, truth.shape[2])
        mean = truth + self.initial_sd * draws.normal(truth.shape[1:], 16)
        return Prior(mean, np.broadcast_to(self.prior_var * np.eye(shape[-1]), shape))

    def known(self, plan: object, u: Array, exo: Array, state: object) -> Array:
        """Return the known inputs: the leader knows its command; the others where the scenario grants it."""
        out = num.zeros(u.shape)
        out[:, :, 0] = exo[:, None] if self.leader_input_known else 0.0
        out[:, 0, 0] = exo
        return out

    def odometry(self, plan: object, state: tuple[Array, ...]) -> Array:
        return np.zeros((len(state[0]), self.size[0], 0))


class PlatoonPlan(NamedTuple):
    A: Array  # (3, 3) of one car
    B: Array  # (3, 1)
    noise_sd: Array  # (3,)
    leader_heard: Array  # (N,) 1 where the leader's messages arrive, else 0


class PlatoonState(NamedTuple):
    """Every leaf has B first; (B, N), the leader first. Positions are such that their differences are the gaps."""

    x: Array
    v: Array
    a: Array
    u: Array  # last commands of the actuators


@register("plant", "platoon", reference="Dutta 2018, (6.4), (6.8)-(6.16)")
@dataclass(frozen=True)
class Platoon(String):
    """A leader and followers with actuator lag, driven on what they believe of the string."""

    noise_var: Variances = param((0.0, 0.0, 0.0), "process noise variance a step of each car's position, speed and acceleration")

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """Return the public model. An insider can scale the gains of a car's law: that of the spacing error, and that of its rate."""
        model = super().model(sensor, controller)
        named = isinstance(controller, Law) and controller.error_gains and controller.rate_gains and {*GEARED} <= {*model.sensors}
        return replace(model, gains=GEARED) if named else model

    def prepare(self, model: Model) -> PlatoonPlan:
        return PlatoonPlan(*lag(self.dt, self.tau), np.sqrt(np.array(self.noise_var)), model.graph[:, 0].astype(np.float64))

    def start(self, plan: PlatoonPlan, draws: Draws) -> PlatoonState:
        gaps = self.initial_gaps(draws)
        shape = (len(gaps), 1 + self.followers)
        x = num.zeros(shape)
        x[:, 1:] = -np.add.accumulate(gaps, axis=1)
        return PlatoonState(x, num.full(shape, self.speed), num.zeros(shape), num.zeros(shape))

    def prior(self, plan: PlatoonPlan, state: PlatoonState, held: Array, draws: Draws) -> Prior:
        return self.told(self.truth(plan, state, held), draws)

    def step(self, plan: PlatoonPlan, state: PlatoonState, u: Array, exo: Array, draws: Draws) -> PlatoonState:
        applied = u[..., 0].copy(order="K")
        applied[:, 0] = exo
        noise = plan.noise_sd * draws.normal((self.size[0], 3)) if plan.noise_sd.any() else np.zeros((1, 1, 3))
        x, v, a = drive(plan.A, plan.B, state.x, state.v, state.a, applied, num.last_to_first(noise))
        return PlatoonState(x, v, a, applied)

    def truth(self, plan: PlatoonPlan, state: PlatoonState, held: Array) -> Array:
        """Return X (B, N, n), the same for all cars; the f_i are those that the controllers hold."""
        cars, n = self.size
        X = num.zeros((len(state.x), n))
        X[:, 0] = state.x[:, 0]
        X[:, 1], X[:, 2] = state.v[:, 0], state.a[:, 0]
        X[:, Column.gap(1) :: PER_CAR] = state.x[:, :-1] - state.x[:, 1:]
        X[:, Column.speed(1) :: PER_CAR], X[:, Column.accel(1) :: PER_CAR] = state.v[:, 1:], state.a[:, 1:]
        X[:, Column.controller(1) :: PER_CAR] = held[:, 1:, 0]
        return np.broadcast_to(X[:, None], (len(X), cars, n))

    def lead_speed_of(self, state: PlatoonState) -> Array:
        return state.v[:, 0]

    def scene(self, plan: PlatoonPlan, state: PlatoonState) -> Scene:
        gap, ahead = num.full(state.x.shape, np.inf), state.v.copy(order="K")
        gap[:, 1:] = state.x[:, :-1] - state.x[:, 1:]
        ahead[:, 1:] = state.v[:, :-1]
        nobody = num.full(gap.shape, np.inf)
        return Scene(gap, state.v, state.a, ahead, nobody, num.zeros(gap.shape), state.x)

    def v2v(self, plan: PlatoonPlan, state: PlatoonState) -> Array:
        """Return the message (B, N, 3) to each car: accelerations of predecessor and leader, and the predecessor's last command.

        The leader's acceleration is 0 for cars that do not hear the leader.
        """
        out = num.zeros((*state.x.shape, 3))
        out[:, 1:, 0], out[:, 1:, 2] = state.a[:, :-1], state.u[:, :-1]
        out[:, 1:, 1] = plan.leader_heard[1:] * state.a[:, :1]
        return out


@register("sensor", "platoon_sensors", reference="Dutta 2018, (6.9), (6.16)")
@dataclass(frozen=True)
class PlatoonSensors:
    """Each car's gap to the one ahead (the leader's position), speed and acceleration."""

    noise_sd: Spreads = param((0.1, 0.1, 0.05), "standard deviations of the sensors' noise [m, m/s, m/s^2]")
    told_sd: Spreads | None = param(None, "the same as the defence assumes them (Sigma_v); none: the true ones")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if not isinstance(plant, String):
            raise InputError("sensor platoon_sensors", type(plant).__name__, "the plant platoon or platoon_linear")
        cars, n = plant.size
        C = np.zeros((cars, 3, n))
        C[0, range(3), range(3)] = 1.0
        for i in range(1, cars):
            C[i, range(3), [Column.gap(i), Column.speed(i), Column.accel(i)]] = 1.0
        told = np.array(self.noise_sd if self.told_sd is None else self.told_sd)
        if (told <= 0.0).any():
            raise InputError("sensor platoon_sensors.told_sd", self.told_sd, "standard deviations above 0; needed where noise_sd has a 0")
        return ("distance", "velocity", "acceleration"), C, np.repeat(np.diag(told * told)[None], cars, axis=0)

    def prepare(self, model: Model) -> tuple[Array, Array]:
        return np.argmax(model.C, axis=2), np.array(self.noise_sd)

    def measure(self, plan: tuple[Array, Array], truth: Array, probe: Array, draws: Draws) -> Received:
        columns, sd = plan
        y = num.zeros((len(truth), *columns.shape))
        for s in range(columns.shape[1]):
            y[..., s] = truth[:, 0][:, columns[:, s]]
        if sd.any():
            y = y + sd * draws.normal(columns.shape)
        return Received(y, num.full(y.shape, True, bool), num.zeros(y.shape[:2]))
