"""Whole episodes of a network in the fused engine: the nouns of the plain loop from its rows, and what a trace keeps of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate.agents.scripted import NoAttack
from tailgate.core import Array, Command, Received, Scene
from tailgate.envs.network import NetworkState

from . import constants as of
from . import rows as at
from . import script, wires
from .lanes import Lanes
from .memory import OBEY
from .rows import LANES


def _groups(f: Array) -> dict[str, Array]:
    """The rows of every signal that is recorded of a step; below 0: -1 - row of one that stands in the window."""
    agents, states, q, count = (int(f[place]) for place in (of.CARS, of.STATES, of.SENSED, of.WIRED))

    def of_wires(first: int, row: np.uint64) -> Array:
        return np.asarray(first + int(row) + np.arange(count) * wires.WIRE)

    def rows(first: int, number: int) -> Array:
        return np.asarray(first + np.arange(number) * LANES)

    hunted, aims = int(f[of.HUNTED]), int(f[of.AIMS])
    return {
        "kind": rows(int(at.KIND), 1), "refused": rows(int(at.REFUSED), 1), "truth": rows(f[of.TRUTHS], states),
        "estimate": -1 - rows(f[of.BELIEFS], agents * states), "score": rows(f[of.SCORES], agents), "alarm": rows(f[of.ALARMS], agents),
        "wires": rows(f[of.ARRIVALS], agents * q), "valid": rows(f[of.VALIDS], agents * q), "clean": of_wires(aims, wires.CLEAN),
        "target": -1 - of_wires(hunted, wires.TARGET), "value": -1 - of_wires(hunted, wires.VALUE),
    }  # fmt: skip


def columns(f: Array) -> Array:
    """The rows that are recorded of every step."""
    return np.concatenate(list(_groups(f).values())).astype(np.int64)


def signals(loop: Any, record: Array, f: Array, asked: float) -> dict[str, Array]:
    """The signals of a Trace from a record (K, columns, B); asked: the mode of the controller."""
    held, first = {}, 0
    for name, part in _groups(f).items():
        held[name], first = np.moveaxis(record[:, first : first + len(part)], 1, 2), first + len(part)  # (K, B, .)
    (steps, batch), agents = held["kind"].shape[:2], int(f[of.CARS])
    several, granted = (steps, batch, agents), loop.plan.channel.granted
    estimate, arrived, valid = (held[name].reshape(*several, -1) for name in ("estimate", "wires", "valid"))

    def spread(name: str, rest: Array) -> Array:
        """What belongs to the wires that may be attacked among what the others have, of the same type."""
        out = np.array(rest)
        out[:, :, granted] = held[name]
        return out

    still, nobody, nothing = np.zeros(several), np.full(several, np.inf), np.zeros((*several, granted.shape[1]))
    return {
        "gap": nobody, "speed": still, "accel": still, "lead_speed": still, "rear_gap": nobody, "rear_speed": still, "position": still,
        "truth": np.broadcast_to(held["truth"][:, :, None], estimate.shape), "estimate": estimate, "score": held["score"],
        "clean": spread("clean", arrived), "wires": arrived, "valid": valid != 0.0, "energy": still, "probe": np.ones(several, bool),
        "control": np.zeros((*several, 0)), "applied": np.zeros((*several, 0)), "value": spread("value", nothing),
        "target": spread("target", nothing.astype(bool)), "kind": held["kind"][..., 0].astype(np.int8), "alarm": held["alarm"] != 0.0,
        "mode": np.full(several, asked, np.int8), "refused": held["refused"][..., 0] != 0.0,
        "collided": np.zeros((steps, batch), bool), "rear_collided": np.zeros((steps, batch), bool),
    }  # fmt: skip


def numbers(loop: Any, attack: Any, plan: Any) -> Array | None:
    """A script as (PLACES + 2 wires,) numbers, None where it has no lane: what aims at wires that are not granted has none."""
    granted = loop.plan.channel.granted
    if not script.known(attack):
        return None
    target = getattr(plan, "target", np.zeros(granted.shape, bool))
    if (target & ~granted).any() or (type(attack) is not NoAttack and not target.any()):
        return None
    sign = script.signs(attack, plan) if target.any() else np.ones(granted.shape)
    return np.concatenate([script.law(attack, plan), target[granted], sign[granted]])


class Network(Lanes):
    """B episodes of a network."""

    columns, numbers = staticmethod(columns), staticmethod(numbers)

    def signals(self, steps: int) -> dict[str, Array]:
        """Those of a Trace, of so many steps."""
        return signals(self.loop, self.record[:steps], self.constants.f, self.constants.c[of.ASKED])

    def advance(self, command: Command, t: int = 0) -> None:
        asked, granted = self.memory.asked, self.loop.plan.channel.granted
        count = np.count_nonzero(granted)
        asked[0], asked[1] = command.kind, np.count_nonzero(command.target & ~granted, axis=(1, 2))
        asked[2 : 2 + count], asked[2 + count :] = command.target[:, granted].T, command.value[:, granted].T
        self.run(OBEY, 1, first_step=t)

    def last(self) -> Command:
        granted, first = self.loop.plan.channel.granted, int(self.constants.f[of.HUNTED])
        target, value = (np.zeros((self.batch, *granted.shape)) for _ in range(2))
        for out, row in ((target, wires.TARGET), (value, wires.VALUE)):
            out[:, granted] = self._rows(first + int(row), int(np.count_nonzero(granted)), wires.WIRE)
        return Command(self.row(at.KIND).astype(np.int8), target != 0.0, value)

    def _rows(self, first: int, count: int, apart: int = LANES) -> Array:
        """(B, count) rows of the window, so far apart."""
        held = [self.memory.window[:, first + j * apart : first + j * apart + LANES].reshape(-1) for j in range(count)]
        return np.stack(held, axis=1)[: self.batch]

    def control(self) -> Array:
        return np.zeros((self.batch, self.loop.model.agents, 0))

    def scene(self) -> Scene:
        return self.loop.plant.scene(self.loop.plan.plant, NetworkState(self._rows(0, self.loop.model.states)))

    def received(self) -> Received:
        C = self.loop.model.C
        y = self._rows(int(self.constants.f[of.SENTS]), C.shape[0] * C.shape[1]).reshape(self.batch, *C.shape[:2])
        return Received(y, np.ones(y.shape, bool), np.zeros(y.shape[:2]))
