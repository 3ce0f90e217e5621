"""Whole episodes of a platoon in the fused engine: the nouns of the plain loop from its records, and what a trace keeps of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.scripted import NoAttack
from tailgate.core import Array, Command, Received, Scene
from tailgate.envs.platoon import PlatoonState

from . import constants as of
from . import platoon_rows as of_car
from . import rows as at
from . import script
from .lanes import Lanes
from .memory import OBEY
from .platoon_channel import VICTIM
from .platoon_filter import AIM, WORK
from .platoon_rows import LINKS, SENSORS, WIRES
from .rows import LANES


class _Part(NamedTuple):
    """A signal: its first row of the first car, how many they are, and how much further those of the next are. Below 0: in the window."""

    first: int
    width: int
    apart: int


def _held(row: int) -> int:
    """A row of the window as the kernel takes it."""
    return -1 - row


def _parts(f: Array) -> dict[str, _Part]:
    """What a step leaves of every car."""
    car, work, states = int(f[of.CAR]), int(f[of.WORKS]), int(f[of.STATES])

    def record(row: np.uint64, width: int = 1) -> _Part:
        return _Part(_held(int(row)), width, -car)

    def worked(row: np.uint64, width: int = 1) -> _Part:
        return _Part(work + int(row), width, WORK)

    return {
        "position": record(of_car.X), "speed": record(of_car.V), "accel": record(of_car.A), "control": record(of_car.COMMAND),
        "estimate": record(of_car.BELIEF, states), "gap": worked(of_car.GAP), "ahead": worked(of_car.AHEAD), "score": worked(of_car.SCORE),
        "alarm": worked(of_car.ALARM), "valid": worked(of_car.VALID, SENSORS),
        "wires": worked(of_car.ARRIVED, LINKS), "applied": worked(of_car.APPLIED),
    }  # fmt: skip


def _of_victims(f: Array) -> dict[str, _Part]:
    """And of every victim."""
    hunted, aims = int(f[of.HUNTED]), int(f[of.AIMS])
    return {
        "target": _Part(_held(hunted + int(of_car.TARGET)), WIRES, -VICTIM),
        "value": _Part(_held(hunted + int(of_car.VALUE)), WIRES, -VICTIM),
        "clean": _Part(aims + int(of_car.CLEAN), LINKS, AIM),
    }  # fmt: skip


def _of_all(f: Array) -> dict[str, _Part]:
    """And of the episode."""
    one = {"kind": at.KIND, "refused": at.REFUSED, "hit": at.HIT}
    return {name: _Part(int(row), 1, 0) for name, row in one.items()} | {"truth": _Part(int(f[of.TRUTHS]), int(f[of.STATES]), 0)}


def _groups(f: Array) -> list[tuple[str, _Part, int]]:
    """Every signal, and of how many it is."""
    each = (_parts(f), int(f[of.CARS])), (_of_victims(f), int(f[of.VICTIMS])), (_of_all(f), 1)
    return [(name, part, count) for parts, count in each for name, part in parts.items()]


def columns(f: Array) -> Array:
    """The rows that are recorded of every step."""
    return np.array([
        part.first + i * part.apart + (LANES if part.first >= 0 else -LANES) * j
        for _, part, count in _groups(f) for i in range(count) for j in range(part.width)
    ])  # fmt: skip


def signals(loop: Any, record: Array, f: Array, asked: float) -> dict[str, Array]:
    """The signals of a Trace from a record (K, columns, B); asked: the mode of the controller."""
    held, first = {}, 0
    for name, part, count in _groups(f):
        block = record[:, first : first + count * part.width]
        held[name] = np.moveaxis(block.reshape(len(record), count, part.width, -1), 3, 1)  # (K, B, N, width)
        first += count * part.width
    one = {name: block[..., 0] for name, block in held.items()}  # (K, B, N)
    shape, victims = held["wires"].shape[:3], np.flatnonzero(loop.plan.channel.granted.any(axis=1))

    def spread(name: str, rest: Array) -> Array:
        """What belongs to the victims among what the others have, of the same type."""
        out = np.array(rest)
        out[:, :, victims] = held[name]
        return out

    return {
        "gap": one["gap"], "speed": one["speed"], "accel": one["accel"], "lead_speed": one["ahead"], "rear_gap": np.full(shape, np.inf),
        "rear_speed": np.zeros(shape), "position": one["position"],
        "truth": np.broadcast_to(held["truth"], held["estimate"].shape), "estimate": held["estimate"], "score": one["score"],
        "clean": spread("clean", held["wires"]), "wires": held["wires"], "valid": held["valid"] != 0.0,
        "energy": np.zeros(shape), "probe": np.ones(shape, bool), "control": held["control"], "applied": held["applied"],
        "value": spread("value", np.zeros((*shape, WIRES))), "target": spread("target", np.zeros((*shape, WIRES), bool)),
        "kind": one["kind"][..., 0].astype(np.int8), "alarm": one["alarm"] != 0.0, "mode": np.full(shape, asked, np.int8),
        "refused": one["refused"][..., 0] != 0.0,
        "collided": one["hit"][..., 0] != 0.0, "rear_collided": np.zeros(shape[:2], bool),
    }  # fmt: skip


def numbers(loop: Any, attack: Any, plan: Any) -> Array | None:
    """A script as (PLACES + 2 WIRES V,) numbers, None where it has no lane: what aims at wires that are not granted has none."""
    granted = loop.plan.channel.granted
    if not script.known(attack):
        return None
    p, victims = script.law(attack, plan), np.flatnonzero(granted.any(axis=1))
    target = getattr(plan, "target", np.zeros(granted.shape, bool))
    if (target & ~granted).any() or (type(attack) is not NoAttack and not target.any()):
        return None
    sign = script.signs(attack, plan) if target.any() else np.ones(granted.shape)
    return np.concatenate([p, *(part for i in victims for part in (target[i], sign[i]))])


class Platoon(Lanes):
    """B episodes of a platoon."""

    columns, numbers = staticmethod(columns), staticmethod(numbers)

    def signals(self, steps: int) -> dict[str, Array]:
        """Those of a Trace, of so many steps."""
        return signals(self.loop, self.record[:steps], self.constants.f, self.constants.c[of.ASKED])

    @property
    def _victims(self) -> Array:
        return np.flatnonzero(self.loop.plan.channel.granted.any(axis=1))

    def _window(self, first: int) -> Array:
        """(B,) a row of the window."""
        return self.memory.window[:, first : first + LANES].reshape(-1)[: self.batch]

    def _of_cars(self, row: np.uint64) -> Array:
        """(B, N) a row of every car's record."""
        f = self.constants.f
        return np.stack([self._window(i * int(f[of.CAR]) + int(row)) for i in range(int(f[of.CARS]))], axis=1)

    def advance(self, command: Command, t: int = 0) -> None:
        asked, granted = self.memory.asked, self.loop.plan.channel.granted
        asked[0], asked[1] = command.kind, np.count_nonzero(command.target & ~granted, axis=(1, 2))
        for h, i in enumerate(self._victims):
            first = 2 + 2 * WIRES * h
            asked[first : first + WIRES] = (command.target[:, i] & granted[i]).T
            asked[first + WIRES : first + 2 * WIRES] = command.value[:, i].T
        self.run(OBEY, 1, first_step=t)

    def last(self) -> Command:
        granted, hunted = self.loop.plan.channel.granted, int(self.constants.f[of.HUNTED])
        target, value = (np.zeros((self.batch, *granted.shape)) for _ in range(2))
        for h, i in enumerate(self._victims):
            for w in range(WIRES):
                for out, row in ((target, of_car.TARGET), (value, of_car.VALUE)):
                    out[:, i, w] = self._window(hunted + h * VICTIM + int(row) + w * LANES)
        return Command(self.row(at.KIND).astype(np.int8), target != 0.0, value)

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
