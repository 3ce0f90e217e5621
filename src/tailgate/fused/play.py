"""Whole episodes in the fused engine, recorded as the plain loop records them: to the same bits, so to the same hashes."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from tailgate.core import Array, Attack
from tailgate.draws import Keys, Role
from tailgate.loop import Loop

from . import constants as of
from . import rows as at
from . import script
from .build import Constants
from .lanes import Lanes
from .memory import LEAST, SCRIPTED
from .rows import LANES, LINKS, SENSORS, WIRES, wires_of

_GROUPS: dict[str, tuple[np.uint64, int]] = {  # what a step leaves, and in how many rows
    "lead_x": (at.LEAD_X, 1), "lead_speed": (at.LEAD_V, 1), "ego": (at.EGO, 3), "rear_x": (at.REAR_X, 1), "rear_v": (at.REAR_V, 1),
    "truth": (at.TRUTH, 3), "estimate": (at.X, 3), "score": (at.SCORE, 1), "clean": (at.CLEAN, LINKS), "arrived": (at.ARRIVED, LINKS),
    "valid": (at.VALID, SENSORS), "control": (at.U, 1), "applied": (at.APPLIED, 1), "value": (at.VALUE, WIRES), "kind": (at.KIND, 1),
    "target": (at.TARGET, WIRES), "alarm": (at.ALARM, 1), "mode": (at.MODE, 1), "refused": (at.REFUSED, 1), "hit": (at.HIT, 1),
    "rear_hit": (at.REAR_HIT, 1),
}  # fmt: skip
_RADAR_GROUPS = _GROUPS | {"own": (at.OWN, 1), "told": (at.TOLD, 1), "energy": (at.HEARD, 1), "probe": (at.PROBE, 1)}


def _groups(f: Array) -> dict[str, tuple[np.uint64, int]]:
    return _RADAR_GROUPS if f[of.AIRED] else _GROUPS


def columns(f: Array) -> Array:
    """The rows that are recorded of every step."""
    return np.concatenate([[int(row) + LANES * j for j in range(width)] for row, width in _groups(f).values()]).astype(np.uint64)


class Recorded:
    """A record (K, columns, B) by name."""

    def __init__(self, record: Array, f: Array) -> None:
        first = 0
        self.held: dict[str, Array] = {}
        for name, (_, width) in _groups(f).items():
            self.held[name] = np.moveaxis(record[:, first : first + width], 1, 2)[:, :, None, :]
            first += width

    def wide(self, name: str) -> Array:
        """(K, B, 1, width)"""
        return self.held[name]

    def one(self, name: str) -> Array:
        """(K, B, 1)"""
        return self.held[name][..., 0]


def signals(record: Array, f: Array) -> dict[str, Array]:
    """The signals of a Trace from a record (K, columns, B)."""
    kept = Recorded(record, f)
    one, wide, ego = kept.one, kept.wide, kept.wide("ego")
    x, v = ego[..., 0], ego[..., 1]
    rear_gap, rear_v = (x - one("rear_x"), one("rear_v")) if f[of.REAR] else (np.full_like(x, np.inf), v)
    out = {
        "gap": one("lead_x") - x, "speed": v, "accel": ego[..., 2], "lead_speed": one("lead_speed"), "rear_gap": rear_gap,
        "rear_speed": rear_v, "position": x, "truth": wide("truth"), "estimate": wide("estimate"), "score": one("score"),
        "clean": wide("clean"), "wires": wide("arrived"), "valid": wide("valid") != 0.0, "energy": np.zeros_like(x),
        "probe": np.ones(x.shape, bool), "control": wide("control"), "applied": wide("applied"), "value": wide("value"),
        "kind": one("kind")[..., 0].astype(np.int8), "target": wide("target") != 0.0, "alarm": one("alarm") != 0.0,
        "mode": one("mode").astype(np.int8), "refused": one("refused")[..., 0] != 0.0, "collided": one("hit")[..., 0] != 0.0,
        "rear_collided": one("rear_hit")[..., 0] != 0.0,
    }  # fmt: skip
    if f[of.AIRED]:
        mine = wires_of(3)
        out |= {name: out[name][..., mine] for name in ("value", "target")}
        out |= {name: out[name][..., mine[:-1]] for name in ("clean", "wires")}
        fourth = {"truth": wide("own"), "estimate": wide("told" if f[of.MODELED] else "own")}
        out |= {name: np.concatenate([out[name], last], axis=-1) for name, last in fourth.items()}
        out |= {"energy": one("energy"), "probe": one("probe") != 0.0}
    return out


class Car(Lanes):
    """B episodes of one car that follows another."""

    columns = staticmethod(columns)

    @staticmethod
    def numbers(loop: Loop, attack: Attack, plan: Any) -> Array | None:
        """A script as the kernel takes it, None where it has no lane."""
        return script.numbers(attack, plan)

    def signals(self, steps: int) -> dict[str, Array]:
        """Those of a Trace, of so many steps."""
        return signals(self.record[:steps], self.constants.f)


def _kind(f: Array) -> Any:
    """One car, or several agents, whose modules a single car does without."""
    if f[of.SENSED]:
        return import_module("tailgate.fused.network_play").Network
    return import_module("tailgate.fused.platoon_play").Platoon if f[of.CARS] else Car


def play(loop: Loop, k: Constants, attack: Attack, keys: Keys, terminate: bool) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """-> lengths (B,), signals (K, B, ...) and the road before the first step, as `tailgate.trace.Trace` holds them."""
    plan: Any = attack.prepare(loop.brief)
    kind = _kind(k.f)
    lanes = kind(loop, k, keys, kind.columns(k.f), loop.horizon)
    written = kind.numbers(loop, attack, plan)
    lanes.start()
    first = lanes.scene()._asdict()
    if written is None:
        steps = _step_by_step(lanes, attack, plan, terminate)
    else:
        lanes.memory.script[:] = written
        steps = lanes.run(SCRIPTED, loop.horizon, terminate=terminate)
    length = lanes.row(at.LENGTH).astype(np.int64) if terminate else np.full(lanes.batch, steps)
    return length, lanes.signals(steps), first


def nearest(loop: Loop, k: Constants, attack: Attack, keys: Keys) -> tuple[Array, Array] | None:
    """-> lengths (B,) and the smallest gaps (2, B) [m], in front and behind, of episodes that end with a collision.

    Nothing else is kept of them: many at a time take little memory. None where the attack has no lane, or nobody drives.
    """
    kind = _kind(k.f)
    if k.f[of.SENSED]:
        return None
    written = kind.numbers(loop, attack, attack.prepare(loop.brief))
    if written is None:
        return None
    lanes = kind(loop, k, keys, np.zeros(2, np.uint64), 1)
    lanes.record[:] = np.inf
    lanes.memory.script[:], lanes.memory.order[LEAST] = written, 1
    lanes.start()
    lanes.run(SCRIPTED, loop.horizon, terminate=True)
    return lanes.row(at.LENGTH).astype(np.int64), lanes.record[0]


def _step_by_step(lanes: Lanes, attack: Attack, plan: Any, terminate: bool) -> int:
    """Under an attack that has no lane, which decides in every step. -> how many there were."""
    memory = attack.start(plan, lanes.batch, lanes.keys.at(Role.ATTACK, np.zeros(lanes.batch, np.int64)))
    for t in range(lanes.loop.horizon):
        if terminate and lanes.ended.all():
            return t
        memory, command = attack.decide(plan, memory, lanes.view(), lanes.draws(Role.ATTACK))
        lanes.advance(command, t)
    return lanes.loop.horizon
