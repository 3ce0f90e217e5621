"""A recording as a loop: readings come from the file, and nobody drives on the estimates (open loop).

The model of the defence is that of a car with a radar (radar_car.py), x = [d, dv, a_ahead, v], with the recorded own speed as its input.
The channel lies between the recorded readings and the defence, as on a simulated road, so that any attack can be laid on top.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Controller, Defence, Estimate, Model, Prior, Received, Scene, Sensor, Sized
from tailgate.core.draws import Draws, Keys, counted, keys
from tailgate.core.loop import Loop
from tailgate.core.threat import ThreatModel
from tailgate.envs.controllers.adaptive_cruise import OneCar
from tailgate.envs.controllers.radar_car import STATES, radar_model
from tailgate.envs.manoeuvres import Constant
from tailgate.roads.recording import Recording, Segment

RANGE_SD, SPEED_SD = 0.15, 0.1  # of the readings, as road-v0 tells its defences [m], [m/s]
ACCEL_VAR = 0.4  # growth of the variance of the acceleration ahead, as road-v0 tells it [m^2/s^4 per s]
PRIOR = (1.0, 0.25, 0.25, 1e-6)


class Noise(NamedTuple):
    """The standard deviations that a defence assumes [m], [m/s]."""

    range_sd: float = RANGE_SD
    speed_sd: float = SPEED_SD


def process_var(dt: float) -> tuple[float, float, float, float]:
    """Return the variances of a step dt [s] that defences assume, of d, dv, a_ahead and v."""
    return 1e-6, 1e-5, ACCEL_VAR * dt, 1e-6


class RowsPlan(NamedTuple):
    """Columns of all pieces, one after the other."""

    first: Array  # (R,) where each piece begins
    gap: Array  # (S,) [m]; NaN where a reading is missing
    relative: Array  # [m/s]
    speed: Array  # [m/s]
    place: Array  # [m] that the car has covered
    shown: Array  # gap without holes [m]
    shown_relative: Array  # [m/s]


class RowsState(NamedTuple):
    """The sample of each row."""

    at: Array  # (B,) int64


@dataclass(frozen=True, eq=False)
class Pieces:
    """The plant: R pieces of K samples dt [s] apart, (R, K) each. Row b of a batch plays the piece of its episode's number."""

    dt: float
    noise: Noise
    gap: Array
    relative: Array
    speed: Array
    seen: Array = field(repr=False)

    @property
    def size(self) -> tuple[int, int]:
        return 1, STATES

    @property
    def lead_speed(self) -> float:
        """The leader's speed, for the loop's check: none is wanted."""
        return 0.0

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        return radar_model(self, sensor, self.dt, process_var(self.dt))

    def prepare(self, model: Model) -> RowsPlan:
        rows, samples = self.gap.shape
        place = np.concatenate([np.zeros((rows, 1)), np.cumsum(0.5 * self.dt * (self.speed[:, 1:] + self.speed[:, :-1]), axis=1)], axis=1)
        hidden = (np.where(self.seen, x, np.nan) for x in (self.gap, self.relative))
        return RowsPlan(samples * np.arange(rows), *(x.ravel() for x in (*hidden, self.speed, place, self.gap, self.relative)))

    def start(self, plan: RowsPlan, draws: Draws) -> RowsState:
        return RowsState(num.take(plan.first, counted(draws.episode).astype(np.int64)))

    def prior(self, plan: RowsPlan, state: RowsState, held: Array, draws: Draws) -> Prior:
        columns = (plan.shown, plan.shown_relative)
        gap, relative = (num.take(column, state.at)[:, None] for column in columns)
        mean = num.stack([gap, relative, np.zeros_like(gap), num.take(plan.speed, state.at)[:, None]])
        return Prior(mean, num.full((len(state.at), 1, STATES, STATES), np.diag(PRIOR)))

    def step(self, plan: RowsPlan, state: RowsState, u: Array, exo: Array, draws: Draws) -> RowsState:
        return RowsState(np.minimum(state.at + 1, len(plan.speed) - 1))

    def known(self, plan: RowsPlan, u: Array, exo: Array, state: RowsState) -> Array:
        return num.take(plan.speed, state.at)[:, None, None]

    def truth(self, plan: RowsPlan, state: RowsState, held: Array) -> Array:
        """Return the recorded readings: nobody knows the truth."""
        gap, relative, speed = (num.take(column, state.at)[:, None] for column in (plan.gap, plan.relative, plan.speed))
        return num.stack([gap, relative, np.zeros_like(gap), speed])

    def scene(self, plan: RowsPlan, state: RowsState) -> Scene:
        gap, relative, speed, place = (
            num.take(column, state.at)[:, None] for column in (plan.shown, plan.shown_relative, plan.speed, plan.place)
        )
        nobody = num.full(gap.shape, np.inf)
        return Scene(np.maximum(gap, 1e-3), speed, np.zeros_like(gap), speed + relative, nobody, speed, place)

    def v2v(self, plan: RowsPlan, state: RowsState) -> Array:
        return np.zeros((len(state.at), 1, 0))

    def odometry(self, plan: RowsPlan, state: RowsState) -> Array:
        return num.stack([num.take(plan.place, state.at)[:, None], num.take(plan.speed, state.at)[:, None]])

    def lead_speed_of(self, state: RowsState) -> Array:
        return np.zeros(len(state.at))


@dataclass(frozen=True)
class Readings:
    """The sensor: what was recorded."""

    noise: Noise

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        R = np.diag([self.noise.range_sd * self.noise.range_sd, self.noise.speed_sd * self.noise.speed_sd])
        return ("distance", "relative_speed"), np.eye(STATES)[None, :2], R[None]

    def prepare(self, model: Model) -> None:
        return None

    def measure(self, plan: None, truth: Array, probe: Array, draws: Draws) -> Received:
        there = np.isfinite(truth[..., :2])
        return Received(np.where(there, truth[..., :2], 0.0), there, num.zeros(truth.shape[:2]))


class Nobody(OneCar):
    """The controller: the car drove as it was recorded."""

    def prepare(self, model: Model) -> None:
        return None

    def step(self, plan: None, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        return None, num.zeros((*estimate.score.shape, 1))

    def desired_gap(self, speed: Array) -> Array:
        return np.zeros_like(speed)


class Cut(NamedTuple):
    """Pieces of a recording side by side, and how many samples of each count."""

    plant: Pieces
    length: Array  # (R,)
    begin: Array  # (R,) [s]


def cut(recording: Recording, noise: Noise, window: float | None) -> Cut:
    """Return whole segments side by side, or windows of `window` seconds."""
    parts: list[tuple[float, Segment]] = []
    for segment in recording.segments:
        if window is None:
            parts.append((segment.begin, segment))
            continue
        size = max(2, round(window / recording.dt))
        for at in range(0, len(segment.gap) - size + 1, size):
            columns = (x[at : at + size] for x in segment[1:])
            parts.append((segment.begin + at * recording.dt, Segment(segment.begin + at * recording.dt, *columns)))
    most = max((len(part.gap) for _, part in parts), default=0)
    padded = [[np.concatenate([x, np.repeat(x[-1:], most - len(x))]) for x in part[1:]] for _, part in parts]
    gap, relative, speed, seen = (np.array([columns[i] for columns in padded]) for i in range(4))
    plant = Pieces(recording.dt, noise, gap, relative, speed, seen.astype(bool))
    return Cut(plant, np.array([len(part.gap) for _, part in parts]), np.array([begin for begin, _ in parts]))


def loop_over(held: Cut, defence: Defence, uses: tuple[str, ...], threat: ThreatModel) -> Loop:
    """Return the loop of a defence over the pieces."""
    horizon = held.plant.gap.shape[1] - 1
    return Loop(held.plant, Readings(held.plant.noise), Nobody(), Constant(0.0), threat, horizon, defence, uses, ends_on_collision=False)


def rows(held: Cut) -> Keys:
    """Return the keys of all pieces: the draws of defence and attack, and the number of the piece."""
    count = len(held.length)
    made = keys("report", range(count))
    return Keys(made.key, made.episode + np.arange(count).astype(np.uint32))
