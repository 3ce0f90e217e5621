"""HighwayEnv's drawing of a road and the cars on it, as pixels (extras: highway, viz).

HighwayEnv's own viewer draws with RoadGraphics and VehicleGraphics. The viewer itself (EnvViewer) belongs to an environment of
HighwayEnv, opens the display, and draws nothing under a dummy video driver. Here a surface in memory replaces it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

try:
    import pygame
    from highway_env.road.graphics import RoadGraphics, WorldSurface  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.road.lane import LineType, SineLane  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.road.road import Road, RoadNetwork  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.vehicle.graphics import VehicleGraphics  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.vehicle.kinematics import Vehicle  # type: ignore[import-untyped,import-not-found,unused-ignore]
except ImportError as error:
    raise ImportError("highway-env is missing, which draws the road: pip install 'tailgate[highway,viz]'") from error

from tailgate.core import Array
from tailgate.envs.render.stage import LANE, Car, Stage

FAR = 1e6  # length of the road [m]
COLOURS = {"defended": VehicleGraphics.EGO_COLOR, "leader": VehicleGraphics.DEFAULT_COLOR, "driver": VehicleGraphics.BLUE}


class Window(NamedTuple):
    """The stretch of road that is seen: its middle [m], and pixels a metre."""

    x: float
    y: float
    scale: float


@lru_cache
def _network(lanes: int, bend: float, period: float) -> Any:
    network = RoadNetwork()
    for lane in range(lanes):
        lines = [LineType.STRIPED if lane else LineType.CONTINUOUS, LineType.NONE if lane < lanes - 1 else LineType.CONTINUOUS]
        y = lane * LANE
        network.add_lane("0", "1", SineLane([0.0, y], [FAR, y], bend, 2.0 * math.pi / period, 0.0, LANE, line_types=lines))
    return network


def _vehicle(car: Car) -> Any:
    vehicle = Vehicle(None, [car.x, car.y], car.heading, car.speed)
    vehicle.color = VehicleGraphics.RED if car.crashed else COLOURS[car.role]
    return vehicle


def paint(stage: Stage, window: Window, width: int, height: int) -> Array:
    """Return (height, width, 3) uint8: road and cars as HighwayEnv draws them."""
    surface = WorldSurface((width, height), 0, pygame.Surface((width, height)))
    surface.scaling = window.scale
    surface.centering_position = [0.5, 0.5]
    surface.move_display_window_to(np.array([window.x, window.y]))
    road = Road(_network(stage.lanes, stage.bend, stage.period), [_vehicle(car) for car in stage.cars])
    RoadGraphics.display(road, surface)
    RoadGraphics.display_traffic(road, surface, offscreen=True)
    return np.moveaxis(pygame.surfarray.array3d(surface), 0, 1)
