"""The lane as a camera and a gyroscope see it."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Model, Received, Sized, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import PositiveSpread
from tailgate.core.registry import register

WIRES = ("lane_offset", "lane_heading", "yaw_rate")
Spreads = Annotated[tuple[PositiveSpread, PositiveSpread, PositiveSpread], Field(min_length=3, max_length=3)]


class CameraPlan(NamedTuple):
    C: Array  # (3, 4)
    sd: Array  # (3,)


@register("sensor", "lane_camera")
@dataclass(frozen=True)
class LaneCamera:
    """Offset e_y [m] and heading error e_psi [rad] by camera, yaw rate by gyroscope, each with Gaussian noise.

    The gyroscope feels e_psi' + v kappa. Speed and curvature are known on board, so its reading here is what is left: e_psi' [rad/s].
    """

    noise_sd: Spreads = param((0.05, 0.005, 0.005), "standard deviations of offset, heading error and yaw rate [m, rad, rad/s]")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if not hasattr(plant, "half_lane"):
            raise InputError("sensor lane_camera", type(plant).__name__, "the plant lane_keeping")
        C = np.eye(4)[None, [0, 2, 3]]
        return WIRES, C, np.diag(np.array(self.noise_sd) ** 2)[None]

    def prepare(self, model: Model) -> CameraPlan:
        return CameraPlan(model.C[0], np.array(self.noise_sd))

    def measure(self, plan: CameraPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        """Return y = C x + v; `probe` does not apply, as nothing is transmitted."""
        y = num.matvec(plan.C, truth) + plan.sd * draws.normal((1, len(WIRES)))
        return Received(y, num.full(y.shape, True, bool), np.zeros(y.shape[:2]))
