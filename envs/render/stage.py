"""The cars on the road, and each defence's belief of them, as plain numbers: the content of a picture on HighwayEnv's road.

A belief's error is that of the measurement's time, put on the road as it is now: `believed` is the true gap plus that error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.plants.highway import Highway

START = 10_000.0  # where a road without a given place begins [m]: nobody drives back as far as its end
LENGTH, LANE = 5.0, 4.0  # a car and the width of a lane, as HighwayEnv has them [m]


class Car(NamedTuple):
    """A car by its middle [m], heading [rad] and speed [m/s]; role: defended, leader (who drives a manoeuvre) or driver."""

    x: float
    y: float
    heading: float
    speed: float
    role: str
    name: str = ""
    doing: str = ""
    crashed: bool = False

    @property
    def nose(self) -> float:
        return self.x + LENGTH / 2.0

    @property
    def tail(self) -> float:
        return self.x - LENGTH / 2.0


class Follower(NamedTuple):
    """A car under a defence, its gap [m] and the defence's view of it."""

    agent: int
    car: int  # its number among the cars
    gap: float
    believed: float | None  # None before anything was measured
    free: bool  # nobody ahead in reach
    attacked: bool
    alarm: bool
    muted: bool | None  # the radar was silent; None where that is not known
    heard: float  # at a challenge, over the receiver's own noise [dB]
    hit: str  # "", "COLLISION" or "REAR COLLISION"


class Stage(NamedTuple):
    """A road of `lanes`, which winds as a sine (bend [m], period [m]), its cars, and those under a defence."""

    lanes: int
    bend: float
    period: float
    cars: tuple[Car, ...]
    followers: tuple[Follower, ...]
    watched: int  # the follower that the figures are of, by its place among them

    def middle(self, x: float, lane: float) -> float:
        """Return y [m] of a lane's middle at x [m]; lanes are counted from 0 at the top, their edges are half numbers."""
        return lane * LANE + self.bend * math.sin(2.0 * math.pi * x / self.period)


def _errors(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array | None:
    """Return by how much each car overestimates its gap (N,) [m]; None where the last step is not of this episode."""
    if frame is None or frame.k[row] + 1 != state.k[row]:
        return None
    model = loop.model
    off = model.gap_error(state.estimate.x, frame.truth)[row]
    if "leader_position" in model.v2v:  # the controller's gap is to the position that it heard
        wire = model.wires.index("leader_position")
        off = off + frame.wires[row, :, wire] - frame.clean[row, :, wire]
    return np.asarray(off)


def _follower(
    loop: Loop, state: LoopState, frame: Frame | None, row: int, agent: int, car: int, gap: float, free: bool, hit: str
) -> Follower:
    errors, muted, heard = _errors(loop, state, frame, row), None, -math.inf
    if loop.model.air and frame is not None and errors is not None:
        muted = not state.probed[row, agent]
        heard = 10.0 * math.log10(max(float(frame.received.energy[row, agent]), 1e-9))
    return Follower(
        agent, car, gap, None if errors is None else gap + float(errors[agent]), free,
        bool(state.channel.last.target[row, agent].any()), bool(state.estimate.alarm[row, agent]), muted, heard, hit,
    )  # fmt: skip


def _string(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Stage:
    """Return a platoon: the leader first, bumper behind bumper."""
    scene = loop.plant.scene(loop.plan.plant, state.plant)
    gaps, speeds, nose, cars, followers = scene.gap[row], scene.speed[row], START + float(scene.position[row, 0]), [], []
    led = bool(loop.model.followers[0])  # the leader is no agent
    if led:
        nose += max(float(gaps[0]), 0.0) + LENGTH
        cars.append(Car(nose - LENGTH / 2.0, 0.0, 0.0, float(scene.lead_speed[row, 0]), "leader", "leader", crashed=bool(gaps[0] <= 0.0)))
    for i, v in enumerate(speeds.tolist()):
        if i or led:
            nose -= LENGTH + max(float(gaps[i]), 0.0)
        hit = bool((gaps[i : i + 2] <= 0.0).any())
        role, name = ("defended", f"car {i}") if i or led else ("leader", "leader")
        cars.append(Car(nose - LENGTH / 2.0, 0.0, 0.0, v, role, name, crashed=hit))
        if i or led:
            sign = "COLLISION" if gaps[i] <= 0.0 else ""
            followers.append(_follower(loop, state, frame, row, i, i + led, max(float(gaps[i]), 0.0), False, sign))
    watched = next((i for i, f in enumerate(followers) if loop.brief.granted[f.agent].any()), 0)  # may be attacked: always the same one
    return Stage(1, 0.0, 1.0, tuple(cars), tuple(followers), watched)


def _pair(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Stage:
    """Return one car behind another, and perhaps a driver behind it."""
    road = loop.plant.scene(loop.plan.plant, state.plant).road(row, 0)
    rear_hit = road["rear_gap"] <= 0.0
    hit = road["gap"] <= 0.0 or (bool(state.ended[row]) and not rear_hit)
    gap, rear_gap = max(road["gap"], 0.0), max(road["rear_gap"], 0.0)  # a step may end metres beyond a collision
    nose = START + road["position"]
    cars = [
        Car(nose - LENGTH / 2.0, 0.0, 0.0, road["speed"], "defended", "ego", crashed=hit or rear_hit),
        Car(nose + gap + LENGTH / 2.0, 0.0, 0.0, road["lead_speed"], "leader", "ahead", crashed=hit),
    ]
    if math.isfinite(rear_gap):
        cars.append(Car(nose - 1.5 * LENGTH - rear_gap, 0.0, 0.0, road["rear_speed"], "driver", "behind", crashed=rear_hit))
    sign = "REAR COLLISION" if rear_hit else "COLLISION" if hit else ""
    return Stage(1, 0.0, 1.0, tuple(cars), (_follower(loop, state, frame, row, 0, 0, gap, False, sign),), 0)


def _traffic(loop: Loop, state: LoopState, frame: Frame | None, row: int, plant: Highway) -> Stage:
    """Return HighwayEnv's own scene, every car where it is."""
    from tailgate.envs.plants.highway_scene import BRAKING, CRASHED, HEADING, HIT, LANE, SPEED, TARGET, X, Y

    seen, numbers = state.plant.seen, state.plant.cars[row].tolist()
    gap, rear_gap, own = float(seen.gap[row]), float(seen.rear_gap[row]), numbers[0]
    free, over = gap >= plant.reach, bool(state.plant.over[row])
    hit = ("REAR COLLISION" if rear_gap <= 0.0 else "COLLISION") if over else ""
    crashed = [bool(car[CRASHED] or car[HIT]) for car in numbers]
    partner = min((i for i in range(1, len(numbers)) if hit and crashed[i]), key=lambda i: abs(numbers[i][X] - own[X]), default=0)
    cars = []
    for i, car in enumerate(numbers):
        off, name = car[X] - own[X], ""
        if i == 0:
            name = "ego"
        elif i == partner:  # the gap is then no place
            name = "behind" if rear_gap <= 0.0 else "ahead"
        elif not free and abs(off - LENGTH - gap) < 1e-6:
            name = "ahead"
        elif abs(-off - LENGTH - rear_gap) < 1e-6:
            name = "behind"
        doing = "" if crashed[i] else "brakes hard" if car[BRAKING] > 0.0 else "changes lanes" if car[TARGET] != car[LANE] else ""
        role = "driver" if i else "defended"
        cars.append(Car(car[X], car[Y], car[HEADING], car[SPEED], role, name, doing, crashed[i]))
    follower = _follower(loop, state, frame, row, 0, 0, max(gap, 0.0), free, hit)
    return Stage(plant.lanes, plant.bend, plant.period, tuple(cars), (follower,), 0)


def stage_of(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Stage:
    """Return the road of row `row` after `frame`, which is None right after a reset."""
    if isinstance(loop.plant, Highway):
        return _traffic(loop, state, frame, row, loop.plant)
    return _string(loop, state, frame, row) if loop.model.agents > 1 else _pair(loop, state, frame, row)
