"""The FMCW radar as a sensor: what it reads of the car ahead, and what a jammer and a late echo make of it."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Air, Array, Model, Positive, Received, Sized, param
from tailgate.draws import Draws
from tailgate.errors import InputError
from tailgate.registry import register

from .radar_car import STATES

Span = Annotated[tuple[Positive, Positive], Field(min_length=2, max_length=2)]


class RadarSensorPlan(NamedTuple):
    C: Array  # (2, n)
    sd: Array  # (2,)


@register("sensor", "fmcw_radar", reference="Dutta 2018, section 3.3.1; (3.5)-(3.11)")
@dataclass(frozen=True)
class FmcwRadar:
    """A 77 GHz long-range radar: distance and relative speed of the car ahead."""

    range_sd: Positive = param(0.25, "standard deviation of the distance, from the target's extent [m]")
    speed_sd: Positive = param(0.1, "standard deviation of the relative speed [m/s]")
    reach: Span = param((2.0, 200.0), "least and largest distance that it measures [m]")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if plant.size != (1, STATES):
            raise InputError("sensor fmcw_radar", type(plant).__name__, "the plant radar_following")
        C = np.eye(STATES)[None, :2]
        return ("distance", "relative_speed"), C, np.diag([self.range_sd**2, self.speed_sd**2])[None]

    def prepare(self, model: Model) -> RadarSensorPlan:
        return RadarSensorPlan(model.C[0], np.array([self.range_sd, self.speed_sd]))

    def measure(self, plan: RadarSensorPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        quiet = num.zeros(probe.shape)
        return self.disturbed(plan, truth, probe, draws, Air(quiet, quiet, np.inf))

    def disturbed(self, plan: RadarSensorPlan, truth: Array, probe: Array, draws: Draws, air: Air) -> Received:
        y = num.matvec(plan.C, truth) + plan.sd * draws.normal((1, 2))
        y[..., 0] += air.delay
        seen = probe & (y[..., 0] >= self.reach[0]) & (y[..., 0] <= self.reach[1])
        valid = num.full(y.shape, True, bool)
        valid &= seen[..., None]
        energy = np.where(air.power > 0.0, 1e3, 0.0) + np.where(air.delay > 0.0, 1e3, 0.0) + np.where(probe, 1e3, 0.0)
        return Received(np.where(valid, y, 0.0), valid, energy + 1.0)
