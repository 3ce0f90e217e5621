"""What measures."""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Model, NonNegative, Received, Sized, param
from tailgate.draws import Draws
from tailgate.errors import InputError
from tailgate.registry import register

Pair = Annotated[tuple[NonNegative, NonNegative], Field(min_length=2, max_length=2)]


class OdometryPlan(NamedTuple):
    C: Array  # (q, n)
    sd: Array  # (q,)


@register("sensor", "odometry", reference="Dutta 2018, (4.17)")
@dataclass(frozen=True)
class Odometry:
    """The follower's own position and speed, each with Gaussian noise; both can be attacked."""

    noise_var: Pair = param((1.0, 1.0), "noise variance of position and velocity [m^2, (m/s)^2]")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if plant.size != (1, 3):
            raise InputError("sensor odometry", type(plant).__name__, "a car-following plant: one follower, [x, v, a]")
        C = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
        return ("position", "velocity"), C, np.diag(self.noise_var)[None]

    def prepare(self, model: Model) -> Any:
        return OdometryPlan(model.C[0], np.sqrt(np.array(self.noise_var)))

    def measure(self, plan: OdometryPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        """y = C x + v (4.17). `probe` does not apply: odometry transmits nothing."""
        y = num.matvec(plan.C, truth) + plan.sd * draws.normal((1, len(plan.sd)))
        return Received(y, num.full(y.shape, True, bool), np.zeros(y.shape[:2]))
