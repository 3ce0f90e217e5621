"""The radar of a production car: range and range rate of the car ahead, once a cycle and some cycles late."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Model, Received, Sized, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Gap, PositiveSpread
from tailgate.core.registry import register
from tailgate.envs.controllers.radar_car import GAP, RELATIVE_SPEED, STATES

Late = Annotated[int, Field(ge=0, le=20)]


class Rows(NamedTuple):
    """Columns of the state that the radar reads."""

    distance: int
    relative_speed: int


def rows_of(late: int) -> Rows:
    """Return the columns of the readings that are `late` cycles old: the state keeps [d, dv] of each of the last cycles."""
    if not late:
        return Rows(GAP, RELATIVE_SPEED)
    first = STATES + 2 * (late - 1)
    return Rows(first, first + 1)


class VehicleRadarPlan(NamedTuple):
    rows: Rows
    sd: Array  # (2,)


@register("sensor", "vehicle_radar", reference="77 GHz long-range radars; comma2k19 (Schafer et al. 2018)")
@dataclass(frozen=True)
class VehicleRadar:
    """Each car's gap to the one ahead and relative speed, positive where the gap grows, with Gaussian noise and a latency.

    A reading says what was `late` cycles ago. The model says so too: a filter that goes by it makes up for the latency.
    """

    range_sd: PositiveSpread = param(0.15, "standard deviation of the range [m]")
    speed_sd: PositiveSpread = param(0.1, "standard deviation of the range rate [m/s]")
    late: Late = param(1, "latency [cycles of the plant's dt]")
    reach: Gap = param(200.0, "largest range that it reports [m]")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        kept = getattr(plant, "kept", None)
        if kept is None:
            raise InputError("sensor vehicle_radar", type(plant).__name__, "the plant acc_string")
        if kept < self.late:
            raise InputError("sensor vehicle_radar.late", self.late, f"at most what the plant keeps ({kept} cycles)")
        cars, n = plant.size
        C = np.zeros((cars, 2, n))
        C[:, range(2), list(rows_of(self.late))] = 1.0
        R = np.diag([self.range_sd * self.range_sd, self.speed_sd * self.speed_sd])
        return ("distance", "relative_speed"), C, np.repeat(R[None], cars, axis=0)

    def prepare(self, model: Model) -> VehicleRadarPlan:
        return VehicleRadarPlan(rows_of(self.late), np.array([self.range_sd, self.speed_sd]))

    def measure(self, plan: VehicleRadarPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        """Return the readings; nothing arrives of a car beyond the reach. `probe` does not apply."""
        true = num.stack([truth[..., plan.rows.distance], truth[..., plan.rows.relative_speed]])
        valid = num.full(true.shape, True, bool)
        valid &= (true[..., :1] <= self.reach)
        y = true + plan.sd * draws.normal(true.shape[1:])
        return Received(np.where(valid, y, 0.0), valid, num.zeros(true.shape[:2]))
