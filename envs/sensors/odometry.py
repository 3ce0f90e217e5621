"""Odometry: position and speed of the follower."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Model, Received, Sized, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Variance
from tailgate.core.registry import register

Pair = Annotated[tuple[Variance, Variance], Field(min_length=2, max_length=2)]


class OdometryPlan(NamedTuple):
    C: Array  # (q, n)
    sd: Array  # (q,)


@register("sensor", "odometry", reference="Dutta 2018, (4.17)")
@dataclass(frozen=True)
class Odometry:
    """The follower's own position and speed, each with noise; both can be attacked.

    Noise is Gaussian, or uniform of the same variance: a sensor that is stated to be accurate to e has uniform noise of variance e^2/3.
    """

    noise_var: Pair = param((1.0, 1.0), "noise variance of position and velocity [m^2, (m/s)^2]")
    noise: Literal["uniform"] | None = dataclasses.field(
        default=None, metadata={"doc": "uniform: on +- (3 noise_var)^0.5; none: Gaussian", "if_any": True}
    )

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if plant.size != (1, 3):
            raise InputError("sensor odometry", type(plant).__name__, "a car-following plant: one follower, [x, v, a]")
        C = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
        return ("position", "velocity"), C, np.diag(self.noise_var)[None]

    def prepare(self, model: Model) -> Any:
        return OdometryPlan(model.C[0], np.sqrt(np.array(self.noise_var)))

    def measure(self, plan: OdometryPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        """Return y = C x + v (4.17). `probe` does not apply: odometry transmits nothing."""
        shape = (1, len(plan.sd))
        noise = draws.normal(shape) if self.noise is None else 3.0**0.5 * (2.0 * draws.uniform(shape) - 1.0)
        y = num.matvec(plan.C, truth) + plan.sd * noise
        return Received(y, num.full(y.shape, True, bool), np.zeros(y.shape[:2]))
