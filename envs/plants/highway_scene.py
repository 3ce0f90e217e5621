"""A road scene of HighwayEnv (Leurent 2018) as a function: the numbers of all its cars in, one step, their numbers out.

Traffic follows the Intelligent Driver Model and changes lanes by MOBIL. Every step puts all that the objects of
HighwayEnv remember into them and takes it out again, so that nothing of one episode reaches another. The first car is the one with the
controller; the scene steers it along its lane and accelerates it by the given command.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array

try:
    from highway_env.road.lane import SineLane  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.road.road import Road, RoadNetwork  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.vehicle.behavior import IDMVehicle  # type: ignore[import-untyped,import-not-found,unused-ignore]
    from highway_env.vehicle.controller import ControlledVehicle  # type: ignore[import-untyped,import-not-found,unused-ignore]
except ImportError as error:
    raise ImportError("highway-env is missing, which drives the road scene: pip install 'tailgate[highway]'") from error

# Columns of a car: all that it remembers from step to step.
X, Y, HEADING, SPEED, LANE, TARGET, WANTED, TIMER, DELTA, CRASHED, HIT, PUSH_X, PUSH_Y, BRAKING, COMMITTED = range(15)
FEATURES = 15
LENGTH = float(IDMVehicle.LENGTH)  # length of every car [m]
WIDTH = float(IDMVehicle.WIDTH)
LANE_WIDTH = float(SineLane.DEFAULT_WIDTH)
TOUCHES = 0.5 * (LANE_WIDTH + WIDTH)  # a car whose middle is nearer to a lane's middle has a part in the lane [m]
ROAD = 1e6  # length of the road [m]
COMMITMENT = 6.0  # time for which a car that cuts in, or has just braked, keeps to its lane [s]
SLOWER, FASTER = 5.0, 6.0  # by how much a car that cuts in may be slower or faster than the one that it cuts in on [m/s]
ROOM = 15.0  # gap that a car that cuts in leaves to the next ahead [m]


class Sight(NamedTuple):
    """The cars that the first car has ahead and behind in its lane, bumper to bumper [m, m/s]; None where nobody is."""

    gap: float | None
    lead: int | None  # number of the car ahead
    lead_speed: float
    rear_gap: float | None
    rear_speed: float
    crashed: bool  # the first car has hit somebody, or was hit


class _Undrawn:
    """A replacement of a scene's random source: drawing from it is an error, as a scene draws nothing."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # Python's own requests, as when a scene is copied
            raise AttributeError(name)
        raise RuntimeError(f"a road scene drew {name}: all its randomness comes with its numbers")


class _Lane(SineLane):  # type: ignore[misc]
    """A lane along x that winds as a sine; the same coordinates as its base, on plain numbers."""

    def local_coordinates(self, position: Array) -> tuple[float, float]:
        x, y = float(position[0]), float(position[1])
        return x, y - float(self.start[1]) - self.amplitude * math.sin(self.pulsation * x)


class _Network(RoadNetwork):  # type: ignore[misc]
    """Lanes side by side, of one shape: the nearest is that of the least lateral offset, as the base finds with all lanes' headings."""

    def get_closest_lane_index(self, position: Array, heading: float | None = None) -> tuple[str, str, int]:
        offsets = [abs(lane.local_coordinates(position)[1]) for lane in self.graph["0"]["1"]]
        return "0", "1", offsets.index(min(offsets))


class _Road(Road):  # type: ignore[misc]
    """The base's answers on one road without obstacles, in fewer words: asked for some ten times a step."""

    def neighbour_vehicles(self, vehicle: ControlledVehicle, lane_index: tuple[str, str, int] | None = None) -> tuple[Any, Any]:
        lane, s = self.network.get_lane(lane_index or vehicle.lane_index), float(vehicle.position[0])
        front, rear, s_front, s_rear = None, None, math.inf, -math.inf
        for car in self.vehicles:
            s_car, lateral = lane.local_coordinates(car.position)
            if car is vehicle or abs(lateral) > 0.5 * LANE_WIDTH + 1.0:
                continue
            if s <= s_car <= s_front:
                front, s_front = car, s_car
            elif s > s_car > s_rear:
                rear, s_rear = car, s_car
        return front, rear


class _Near:
    """Asks HighwayEnv for a collision only where the cars are near enough for its own first check to pass."""

    position: Array
    speed: float
    diagonal: float

    def handle_collisions(self, other: ControlledVehicle, dt: float = 0.0) -> None:
        if abs(float(self.position[0]) - float(other.position[0])) <= self.diagonal + abs(self.speed) * dt:
            super().handle_collisions(other, dt)  # type: ignore[misc]


class _Ego(_Near, ControlledVehicle):  # type: ignore[misc]
    """Keeps to its lane and accelerates at `pull` [m/s^2]."""

    pull = 0.0

    def act(self, action: dict[str, float] | str | None = None) -> None:
        self.action = {"steering": self.steering_control(self.target_lane_index), "acceleration": self.pull}


class _Driver(_Near, IDMVehicle):  # type: ignore[misc]
    """Drives by IDM and MOBIL, brakes hard while `braking` [s] is left, and does not roll back."""

    braking, committed = 0.0, 0.0  # [s]
    decel, pace = 6.0, 0.1  # deceleration of a hard braking [m/s^2], and the step [s]
    changes = True  # lanes, of itself

    def act(self, action: dict[str, float] | str | None = None) -> None:
        self.enable_lane_change = self.changes and self.committed <= 0.0
        super().act(action)
        if not self.crashed:
            a = float(self.action["acceleration"])
            a = min(a, -self.decel) if self.braking > 0.0 else a
            self.action["acceleration"] = max(a, -self.speed / self.pace)


class Bench:
    """The workbench: one road with as many cars as an episode has, the first with the controller.

    bend [m] and period [m] of the road's winding; limit [m/s] its speed limit; decel [m/s^2] of a car that brakes hard.
    """

    def __init__(
        self, cars: int, lanes: int, limit: float, dt: float, decel: float, bend: float, period: float, lane_changes: bool
    ) -> None:
        network, turn = _Network(), 2.0 * math.pi / period
        for lane in range(lanes):
            y = lane * LANE_WIDTH
            network.add_lane("0", "1", _Lane([0.0, y], [ROAD, y], bend, turn, 0.0, speed_limit=limit))
        self.dt = dt
        self.indices = [("0", "1", lane) for lane in range(lanes)]
        self.lanes = [network.get_lane(index) for index in self.indices]
        self.road = _Road(network, np_random=_Undrawn())
        self.ego = _Ego(self.road, self.lanes[0].position(0.0, 0.0))
        self.traffic: list[Any] = [_Driver(self.road, self.lanes[0].position(0.0, 0.0), timer=1.0) for _ in range(cars - 1)]
        for car in self.traffic:
            car.decel, car.pace, car.changes = decel, dt, lane_changes
        self.cars: list[Any] = [self.ego, *self.traffic]
        self.road.vehicles = self.cars

    def place(self, lane: int, x: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad] of a car in the middle of a lane."""
        y = self.lanes[lane].position(x, 0.0)[1]
        return x, float(y), float(self.lanes[lane].heading_at(x))

    def put(self, numbers: Array) -> None:
        """Set the scene to `numbers` (V, FEATURES)."""
        for car, n in zip(self.cars, numbers.tolist(), strict=True):
            car.position = np.array([n[X], n[Y]])
            car.heading, car.speed, car.target_speed, car.crashed = n[HEADING], n[SPEED], n[WANTED], n[CRASHED] != 0.0
            car.lane_index, car.target_lane_index = self.indices[int(n[LANE])], self.indices[int(n[TARGET])]
            car.lane = self.lanes[int(n[LANE])]
            car.impact = np.array([n[PUSH_X], n[PUSH_Y]]) if n[HIT] else None
            car.timer, car.DELTA, car.braking, car.committed = n[TIMER], n[DELTA], n[BRAKING], n[COMMITTED]

    def take(self) -> Iterable[list[float]]:
        """Return the numbers of all cars, as `put` takes them."""
        for car in self.cars:
            push = (1.0, *car.impact) if car.impact is not None else (0.0, 0.0, 0.0)
            yield [
                *car.position, car.heading, car.speed, car.lane_index[2], car.target_lane_index[2], car.target_speed, car.timer, car.DELTA,
                car.crashed, *push, car.braking, car.committed,
            ]  # fmt: skip

    def look(self) -> Sight:
        """Look at the present scene. A car counts when a part of it is in the first one's lane and all of it is ahead, or behind."""
        lane = self.lanes[self.ego.target_lane_index[2]]
        here = lane.local_coordinates(self.ego.position)[0]
        gap, lead, rear_gap, rear = math.inf, None, math.inf, None
        for i, car in enumerate(self.traffic, start=1):
            s, lateral = lane.local_coordinates(car.position)
            if abs(lateral) > TOUCHES:
                continue
            if 0.0 < s - here - LENGTH < gap:
                gap, lead = s - here - LENGTH, i
            elif 0.0 < here - s - LENGTH < rear_gap:
                rear_gap, rear = here - s - LENGTH, i
        crashed = bool(self.ego.crashed or self.ego.impact is not None)
        if crashed:  # into, or by, the nearest of those that have crashed
            hit = [i for i, car in enumerate(self.traffic, start=1) if car.crashed or car.impact is not None]
            who = min(hit, key=lambda i: float(np.square(self.cars[i].position - self.ego.position)[0]))
            off = lane.local_coordinates(self.cars[who].position)[0] - here
            if off >= 0.0:
                gap, lead = min(off - LENGTH, 0.0), who
            else:
                rear_gap, rear = min(-off - LENGTH, 0.0), who
        return Sight(
            None if lead is None else gap, lead, 0.0 if lead is None else float(self.cars[lead].speed),
            None if rear is None else rear_gap, 0.0 if rear is None else float(self.cars[rear].speed), crashed,
        )  # fmt: skip

    def step(self, pull: float) -> None:
        """Move everybody by one step; the first car accelerates at `pull` [m/s^2]."""
        self.ego.pull = pull
        self.road.act()
        self.road.step(self.dt)
        for car in self.traffic:
            car.braking, car.committed = max(car.braking - self.dt, 0.0), max(car.committed - self.dt, 0.0)

    # -- events

    def brake(self, lasting: float, within: float) -> bool:
        """Let the car ahead, if it is nearer than `within` [m], brake hard for `lasting` seconds; return if there is one."""
        sight = self.look()
        if sight.lead is None or sight.gap is None or sight.gap > within or self.cars[sight.lead].crashed:
            return False
        car = self.cars[sight.lead]
        car.braking, car.committed = lasting, lasting + COMMITMENT
        car.target_lane_index = car.lane_index
        return True

    def cut_in(self, least: float, most: float) -> bool:
        """Let the nearest car in another lane cut in with a gap [m] from least to most; return if there is one."""
        sight = self.look()
        mine, here = self.ego.target_lane_index[2], float(self.ego.position[0])
        free = math.inf if sight.gap is None else sight.gap - LENGTH - ROOM  # the largest gap that leaves room ahead
        found = None
        for car in self.traffic:
            gap = float(car.position[0]) - here - LENGTH
            beside = abs(car.lane_index[2] - mine) == 1 and car.target_lane_index == car.lane_index
            like = self.ego.speed - SLOWER <= car.speed <= self.ego.speed + FASTER
            if beside and like and not car.crashed and least <= gap <= min(most, free) and (found is None or gap < found[0]):
                found = gap, car
        if found is None:
            return False
        found[1].target_lane_index, found[1].committed = self.ego.target_lane_index, COMMITMENT
        return True
