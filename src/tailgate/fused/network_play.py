"""Whole episodes of a network in the fused engine: the nouns of the plain loop from its rows, and what a trace keeps of them."""

from __future__ import annotations

import numpy as np

from tailgate.core import Array, Received, Scene
from tailgate.envs.network import NetworkState

from . import constants as of
from . import rows as at
from .rows import LANES
from .several import Several, recorded, spread


class Network(Several):
    """B episodes of a network."""

    @staticmethod
    def groups(f: Array) -> dict[str, Array]:
        agents, states, q = (int(f[place]) for place in (of.CARS, of.STATES, of.SENSED))

        def rows(first: int, number: int) -> Array:
            return np.asarray(int(first) + np.arange(number) * LANES)

        return {
            "kind": rows(int(at.KIND), 1), "refused": rows(int(at.REFUSED), 1), "truth": rows(f[of.TRUTHS], states),
            "estimate": -1 - rows(f[of.BELIEFS], agents * states), "score": rows(f[of.SCORES], agents),
            "alarm": rows(f[of.ALARMS], agents), "wires": rows(f[of.ARRIVALS], agents * q), "valid": rows(f[of.VALIDS], agents * q),
            **recorded(f),
        }  # fmt: skip

    def signals(self, steps: int) -> dict[str, Array]:
        held = self.recorded(steps)
        shape = held["score"].shape
        estimate, arrived, valid = (held[name].reshape(*shape, -1) for name in ("estimate", "wires", "valid"))
        still, nobody = np.zeros(shape), np.full(shape, np.inf)
        return {
            "gap": nobody, "speed": still, "accel": still, "lead_speed": still, "rear_gap": nobody, "rear_speed": still, "position": still,
            "truth": np.broadcast_to(held["truth"][:, :, None], estimate.shape), "estimate": estimate, "score": held["score"],
            **spread(self.loop, held, arrived), "wires": arrived, "valid": valid != 0.0, "energy": still, "probe": np.ones(shape, bool),
            "control": np.zeros((*shape, 0)), "applied": np.zeros((*shape, 0)), "kind": held["kind"][..., 0].astype(np.int8),
            "alarm": held["alarm"] != 0.0, "mode": np.full(shape, self.constants.c[of.ASKED], np.int8),
            "refused": held["refused"][..., 0] != 0.0, "collided": np.zeros(shape[:2], bool), "rear_collided": np.zeros(shape[:2], bool),
        }  # fmt: skip

    def control(self) -> Array:
        return np.zeros((self.batch, self.loop.model.agents, 0))

    def scene(self) -> Scene:
        return self.loop.plant.scene(self.loop.plan.plant, NetworkState(self.window(0, self.loop.model.states)))

    def received(self) -> Received:
        C = self.loop.model.C
        y = self.window(int(self.constants.f[of.SENTS]), C.shape[0] * C.shape[1]).reshape(self.batch, *C.shape[:2])
        return Received(y, np.ones(y.shape, bool), np.zeros(y.shape[:2]))
