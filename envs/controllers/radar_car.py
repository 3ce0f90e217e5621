"""The model of a car with a radar, and the controllers that drive it."""

from dataclasses import dataclass

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Model, Plant, Receiver, Sensor, param
from tailgate.core.quantities import Accel, Headway, Lag, Length, PositiveGain, PositiveSpeed, check_order
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import OneCar, limited, obeyed, widened

GAP, RELATIVE_SPEED, LEAD_ACCEL, OWN_SPEED = range(4)
STATES = 4


def kinematic(T: float) -> tuple[Array, Array]:
    """Return A (4, 4) and B (4, 1) of x = [d, dv, a_L, v_F] for a step T [s]; the input is the own speed at its end."""
    A = np.array([[1.0, T, T * T / 2.0, T / 2.0], [0.0, 1.0, T, 1.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    return A, np.array([[-T / 2.0], [-1.0], [0.0], [1.0]])


def radar_model(plant: Plant, sensor: Sensor, T: float, process_var: tuple[float, ...]) -> Model:
    """Return the public model of a car with a radar, for steps of T [s] and variances of the process noise (4,)."""
    (sensors, C, R), (A, B), rows = sensor.matrices(plant), kinematic(T), np.eye(STATES)
    return Model(
        A=A, B=B, c=np.zeros(STATES), C=C, Q=np.diag(process_var), R=R, graph=np.eye(1, dtype=bool), dt=T, sensors=sensors,
        actuators=("acceleration",), gap=rows[[GAP]], speed=rows[[OWN_SPEED]],
        challenge=sensor.challenge if isinstance(sensor, Receiver) else 0,
    )  # fmt: skip


def check_radar_car(model: Model, where: str) -> None:
    """Raise InputError where the state is not [gap, relative speed, leader's acceleration, own speed]."""
    if model.agents != 1 or model.states != STATES or model.gap is None or not np.array_equal(model.gap, np.eye(STATES)[[GAP]]):
        raise InputError(where, f"{model.agents} agents, {model.states} states", "the plant radar_following")


def wanted(
    d: Array, dv: Array, v: Array, headway: Array, standstill: float, g: float, tau: float, gain: float, set_speed: float
) -> Array:  # fmt: skip
    """Return v_des [m/s] for a gap d [m], a relative speed dv and the own speed v [m/s], elementwise: (3.12), (3.13)."""
    off = d - (standstill + headway * v)
    spacing = v / gain + tau / (headway * gain) * (dv + g * off)
    free = d > standstill + headway * set_speed
    out: Array = np.where(free, set_speed, np.minimum(spacing, set_speed))
    return out


@register("controller", "acc_radar", reference="Dutta 2018, (3.12), (3.13), (3.16), corrected")
@dataclass(frozen=True)
class RadarCruise(OneCar):
    """Adaptive cruise control with a speed and a spacing mode, on a radar's estimates and the trusted own speed.

        d_des = d0 + tau_h v_F                                                                                    (3.12)
        v_des = v_F/KL + TL/(tau_h KL) (dv + g (d - d_des))        spacing mode                                   (3.13)
        v_des = v_set when d > d0 + tau_h v_set                    speed mode;   v_des <= v_set in both
        a_des = clip((v_des - v_F)/T, a_min, a_max)                                                               (3.16)

    Erratum: the "1/k" of (3.13) is a constant gain g [1/s], not the time index.
    """

    headway: Headway = param(3.0, "time headway tau_h [s]")
    standstill: Length = param(5.0, "minimum stopping distance d0 [m]")
    g: PositiveGain = param(0.9, "gap gain [1/s]")
    tau: Lag = param(1.008, "time constant TL [s]")
    gain: PositiveGain = param(1.0, "gain KL [-]")
    sample: Lag = param(1.0, "time T in which the desired speed is to be reached [s]")
    set_speed: PositiveSpeed = param(29.95168, "driver's set speed v_set [m/s]; 67 mph")
    accel_min: Accel = param(-5.0, "lower limit of the command [m/s^2]")
    accel_max: Accel = param(2.0, "upper limit of the command [m/s^2]")

    def __post_init__(self) -> None:
        check_order("controller acc_radar.accel_min, accel_max", (self.accel_min, self.accel_max))

    def prepare(self, model: Model) -> None:
        check_radar_car(model, "controller acc_radar")

    def step(self, plan: None, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        """Return the command a_des (B, N, 1) [m/s^2] for estimate.x (B, N, 4) = [d, dv, ...] and odometry (B, N, 2) = [x_F, v_F]."""
        d, dv, v = estimate.x[..., GAP], estimate.x[..., RELATIVE_SPEED], odometry[..., 1]
        headway = widened(self.headway, estimate.mode)
        a = (wanted(d, dv, v, headway, self.standstill, self.g, self.tau, self.gain, self.set_speed) - v) / self.sample
        return None, limited(obeyed(a, estimate.mode), self.accel_min, self.accel_max)[..., None]

    def desired_gap(self, speed: Array) -> Array:
        """Return d0 + tau_h v [m] (3.12)."""
        return np.asarray(self.standstill + self.headway * speed)
