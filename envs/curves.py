"""Manoeuvres of a road: its curvature [1/m] at each step. They belong to a plant that keeps a lane."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Lag, Time, TimeSpan, check_order
from tailgate.core.registry import register
from tailgate.envs.manoeuvres import Clocked, between

Curvature = Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)]  # [1/m]: no road bends tighter than 10 m
Radius = Annotated[float, Field(ge=10.0, le=1e6, allow_inf_nan=False)]  # [m]
Radii = Annotated[tuple[Radius, Radius], Field(min_length=2, max_length=2)]
BEND = 1  # the phase of a bend; 0 is that of a straight


def eased(curvature: Array, wanted: Array, most: float) -> Array:
    """Return the curvature one step nearer to the wanted one, by at most `most` [1/m], elementwise: a clothoid."""
    out: Array = curvature + num.clip(wanted - curvature, -most, most)
    return out


@register("manoeuvre", "bend")
@dataclass(frozen=True)
class Bend(Clocked):
    """A straight road with one bend of constant curvature, which begins and ends at once."""

    curved: ClassVar[bool] = True

    value: Curvature = param(0.002, "curvature of the bend, positive to the left [1/m]")
    begin: Time = param(2.0, "time at which it begins [s]")
    end: Time = param(1e6, "time at which it ends [s]")

    def __post_init__(self) -> None:
        check_order("manoeuvre bend.begin, end", (self.begin, self.end))

    def accel(self, plan: float, state: None, k: Array, speed: Array, draws: Draws) -> tuple[None, Array]:
        """Return the curvature (B,) [1/m] after step k (B,)."""
        return None, between((k + 1) * plan, self.begin, self.end, self.value, 0.0)


class CurvesState(NamedTuple):
    phase: Array  # (B,) int8
    clock: Array  # (B,) [s] left of the phase
    wanted: Array  # (B,) [1/m]
    curvature: Array  # (B,) [1/m]


@register("manoeuvre", "curves")
@dataclass(frozen=True)
class Curves:
    """Straights and bends in turn, of random length; bends to either side, of random radius, which ease in and out as clothoids."""

    curved: ClassVar[bool] = True

    straight: TimeSpan = param((2.0, 6.0), "length of a straight, uniform on this span [s]")
    bend: TimeSpan = param((3.0, 8.0), "length of a bend, uniform on this span [s]")
    radius: Radii = param((250.0, 800.0), "radius of a bend: its inverse is uniform between those of these two [m]")
    ease: Lag = param(2.0, "time in which the tightest bend eases in or out [s]")

    def __post_init__(self) -> None:
        for name in ("straight", "bend", "radius"):
            check_order(f"manoeuvre curves.{name}", getattr(self, name))
        if self.straight[0] <= 0.0 or self.bend[0] <= 0.0:
            raise InputError("manoeuvre curves.straight, bend", (self.straight[0], self.bend[0]), "lengths above 0 s")

    def prepare(self, dt: float) -> float:
        return dt

    def start(self, plan: float, draws: Draws) -> CurvesState:
        clock = _within(self.straight, draws.uniform())
        zero = np.zeros(len(clock))
        return CurvesState(np.zeros(len(clock), np.int8), clock, zero, zero.copy())

    def accel(self, plan: float, state: CurvesState, k: Array, speed: Array, draws: Draws) -> tuple[CurvesState, Array]:
        """Return the next state and the curvature (B,) [1/m] after step k (B,)."""
        phase, clock, wanted = state.phase, state.clock - plan, state.wanted
        done = clock <= 0.0
        if num.some(done):
            u = draws.uniform((3,))
            phase = np.where(done, 1 - phase, phase).astype(np.int8)
            fresh = np.where(phase == BEND, _within(self.bend, u[:, 0]), _within(self.straight, u[:, 0]))
            size = _within((1.0 / self.radius[1], 1.0 / self.radius[0]), u[:, 1])
            chosen = np.where(phase == BEND, np.where(u[:, 2] < 0.5, -size, size), 0.0)
            clock, wanted = np.where(done, fresh, clock), np.where(done, chosen, wanted)
        curvature = eased(state.curvature, wanted, plan / (self.ease * self.radius[0]))
        return CurvesState(phase, clock, wanted, curvature), curvature


def _within(span: tuple[float, float], u: Array) -> Array:
    return np.asarray(span[0] + (span[1] - span[0]) * u)
