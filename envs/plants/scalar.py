"""One state that feedback holds near zero (dimensionless): the smallest loop in which it matters when a reading is held.

    x+ = a x + b u + w          y = x          u = -g x^

The reading is exact: a defence that believes it knows the state. An attacker who holds the reading decides what the loop acts on.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import (
    Array,
    Controller,
    Estimate,
    Model,
    Prior,
    Received,
    Scene,
    Sensor,
    Sized,
    param,
)  # fmt: skip
from tailgate.core.draws import Draws
from tailgate.core.quantities import PositiveVariance, Spread, Step
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import OneCar

Factor = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False)]
GROWTH = 1.5  # largest growth of the state in a step: 1000 steps still give a finite number
WIRE, ACTUATOR = "y", "u"


class ScalarState(NamedTuple):
    """Every leaf has B first."""

    x: Array  # (B,)


@register("plant", "scalar_loop")
@dataclass(frozen=True)
class ScalarLoop:
    """x+ = a x + b u + w, one state and one input, which starts near zero."""

    a: Factor = param(1.0, "how much of the state lasts a step [-]")
    b: Factor = param(1.0, "how much of the input arrives [-]")
    noise_var: PositiveVariance = param(1.0, "variance of w, known to everybody")
    initial_sd: Spread = param(1.0, "spread of the initial state about 0, which the defence takes it for")
    dt: Step = param(1.0, "step [s]; nothing depends on it")

    @property
    def size(self) -> tuple[int, int]:
        return 1, 1

    def prepare(self, model: Model) -> float:
        return float(np.sqrt(self.noise_var))

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        names, C, R = sensor.matrices(self)
        return Model(
            A=np.array([[self.a]]), B=np.array([[self.b]]), c=np.zeros(1), C=C, Q=np.array([[self.noise_var]]), R=R,
            graph=np.eye(1, dtype=bool), dt=self.dt, sensors=names, actuators=(ACTUATOR,),
        )  # fmt: skip

    def start(self, plan: float, draws: Draws) -> ScalarState:
        return ScalarState(self.initial_sd * draws.normal())

    def prior(self, plan: float, state: ScalarState, held: Array, draws: Draws) -> Prior:
        batch = len(state.x)
        return Prior(num.zeros((batch, 1, 1)), num.full((batch, 1, 1, 1), max(self.initial_sd, 1e-6) ** 2))

    def step(self, plan: float, state: ScalarState, u: Array, exo: Array, draws: Draws) -> ScalarState:
        return ScalarState(self.a * state.x + self.b * u[:, 0, 0] + plan * draws.normal())

    def known(self, plan: float, u: Array, exo: Array, state: ScalarState) -> Array:
        return u

    def truth(self, plan: float, state: ScalarState, held: Array) -> Array:
        return state.x[:, None, None]

    def odometry(self, plan: float, state: ScalarState) -> Array:
        return np.zeros((len(state.x), 1, 0))

    def lead_speed_of(self, state: ScalarState) -> Array:
        return np.zeros(len(state.x))

    def scene(self, plan: float, state: ScalarState) -> Scene:
        """Return an empty road: nothing drives."""
        still = num.zeros((len(state.x), 1))
        nobody = num.full(still.shape, np.inf)
        return Scene(nobody, still, still, still, nobody, still, still)

    def v2v(self, plan: float, state: ScalarState) -> Array:
        return np.zeros((len(state.x), 1, 0))


@register("sensor", "exact_reading")
@dataclass(frozen=True)
class ExactReading:
    """y = x, the state of a scalar loop without noise."""

    told_var: PositiveVariance = param(1.0, "noise variance that a filter assumes")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if not isinstance(plant, ScalarLoop):
            raise InputError("sensor exact_reading", type(plant).__name__, "the plant scalar_loop")
        return (WIRE,), np.ones((1, 1, 1)), np.full((1, 1, 1), self.told_var)

    def prepare(self, model: Model) -> None:
        return None

    def measure(self, plan: None, truth: Array, probe: Array, draws: Draws) -> Received:
        return Received(truth.copy(order="K"), num.full(truth.shape, True, bool), num.zeros(truth.shape[:2]))


@register("controller", "state_feedback")
@dataclass(frozen=True)
class StateFeedback(OneCar):
    """u = -g x^ on the estimate of the one state."""

    gain: Factor = param(0.25, "feedback gain g [-]")

    def prepare(self, model: Model) -> None:
        if model.states != 1 or model.actuators != (ACTUATOR,):
            raise InputError("controller state_feedback", list(model.actuators), f"the plant scalar_loop, whose actuator is {ACTUATOR}")
        if abs(model.A[0, 0] - model.B[0, 0] * self.gain) > GROWTH:
            raise InputError("controller state_feedback.gain", self.gain, f"at most {GROWTH:g} as |a - b gain|, by which the loop grows")

    def step(self, plan: None, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        return None, -self.gain * estimate.x

    def desired_gap(self, speed: Array) -> Array:
        return np.zeros_like(speed)
