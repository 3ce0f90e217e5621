"""Whole episodes of a platoon in the fused engine: the nouns of the plain loop from its records, and what a trace keeps of them."""

from __future__ import annotations

import numpy as np

from tailgate.core import Array, Received, Scene
from tailgate.envs.platoon import PlatoonState

from . import constants as of
from . import platoon_rows as of_car
from . import rows as at
from .platoon_filter import WORK
from .platoon_rows import LINKS, SENSORS
from .rows import LANES
from .several import Several, recorded, spread


class Platoon(Several):
    """B episodes of a platoon."""

    @staticmethod
    def groups(f: Array) -> dict[str, Array]:
        cars, car, work, states = (int(f[place]) for place in (of.CARS, of.CAR, of.WORKS, of.STATES))

        def of_each(row: np.uint64, apart: int, width: int) -> Array:
            return (int(row) + apart * np.arange(cars)[:, None] + LANES * np.arange(width)).ravel()

        def record(row: np.uint64, width: int = 1) -> Array:
            return np.asarray(-1 - of_each(row, car, width))

        def worked(row: np.uint64, width: int = 1) -> Array:
            return np.asarray(work + of_each(row, WORK, width))

        return {
            "position": record(of_car.X), "speed": record(of_car.V), "accel": record(of_car.A), "control": record(of_car.COMMAND),
            "estimate": record(of_car.BELIEF, states), "gap": worked(of_car.GAP), "ahead": worked(of_car.AHEAD),
            "score": worked(of_car.SCORE), "alarm": worked(of_car.ALARM), "valid": worked(of_car.VALID, SENSORS),
            "wires": worked(of_car.ARRIVED, LINKS), "applied": worked(of_car.APPLIED), "kind": np.array([int(at.KIND)]),
            "refused": np.array([int(at.REFUSED)]), "hit": np.array([int(at.HIT)]), "truth": f[of.TRUTHS] + LANES * np.arange(states),
            **recorded(f),
        }  # fmt: skip

    def signals(self, steps: int) -> dict[str, Array]:
        held = self.recorded(steps)
        shape = held["gap"].shape
        estimate, arrived, valid = (held[name].reshape(*shape, -1) for name in ("estimate", "wires", "valid"))
        return {
            "gap": held["gap"], "speed": held["speed"], "accel": held["accel"], "lead_speed": held["ahead"],
            "rear_gap": np.full(shape, np.inf), "rear_speed": np.zeros(shape), "position": held["position"],
            "truth": np.broadcast_to(held["truth"][:, :, None], estimate.shape), "estimate": estimate, "score": held["score"],
            **spread(self.loop, held, arrived), "wires": arrived, "valid": valid != 0.0, "energy": np.zeros(shape),
            "probe": np.ones(shape, bool), "control": held["control"][..., None], "applied": held["applied"][..., None],
            "kind": held["kind"][..., 0].astype(np.int8), "alarm": held["alarm"] != 0.0,
            "mode": np.full(shape, self.constants.c[of.ASKED], np.int8), "refused": held["refused"][..., 0] != 0.0,
            "collided": held["hit"][..., 0] != 0.0, "rear_collided": np.zeros(shape[:2], bool),
        }  # fmt: skip

    def _of_cars(self, row: np.uint64) -> Array:
        """(B, N) a row of every car's record."""
        return self.window(int(row), int(self.constants.f[of.CARS]), int(self.constants.f[of.CAR]))

    def control(self) -> Array:
        return self._of_cars(of_car.COMMAND)[..., None]

    def scene(self) -> Scene:
        x, v, a = (self._of_cars(row) for row in (of_car.X, of_car.V, of_car.A))
        return self.loop.plant.scene(self.loop.plan.plant, PlatoonState(x, v, a, np.zeros_like(x)))

    def received(self) -> Received:
        y = np.stack([self._of_cars(of_car.SENT + np.uint64(j * LANES)) for j in range(SENSORS)], axis=2)
        valid, there = np.ones(y.shape, bool), self.constants.f[of.THERE]
        if there:
            valid = np.stack([self._of_cars(np.uint64(there + j * LANES)) != 0.0 for j in range(SENSORS)], axis=2)
        return Received(y, valid, np.zeros(y.shape[:2]))
