"""The constants of a network, or why it has no lane."""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate import num
from tailgate.agents.observation import spread
from tailgate.core import Array, Attack
from tailgate.envs.network import LinearSensors, NoControl, SensorNetwork
from tailgate.estimators.consensus import ConsensusFilter
from tailgate.estimators.distributed import neighbours
from tailgate.estimators.kalman import KalmanFilter
from tailgate.loop import Loop

from . import constants as of
from . import platoon_build as platoon
from . import platoon_gains as gains
from . import several
from .constants import Table
from .rows import LANES, ROWS


def unknown(loop: Loop, attack: Attack | None) -> str:
    """Why this loop is no network with a lane; empty where it is one."""
    for part, known in zip((loop.plant, loop.sensor, loop.controller), (SensorNetwork, LinearSensors, NoControl), strict=True):
        if type(part) is not known:
            return f"{type(part).__name__} has no lane"
    if min(len(loop.model.sensors), loop.model.states) < 2:
        return "a single sensor or state has no lane"
    R = loop.model.R
    if platoon.drops(loop, attack) and (R * (1.0 - np.eye(R.shape[1]))).any():
        return "noises that depend on each other have no lane"
    return platoon.defence(loop, attack)


def fill(loop: Loop, attack: Attack | None, c: Array, f: Array, profile: Array) -> tuple[Array, int]:
    """Fills in c and f. -> the table, and the rows of the window. No manoeuvre moves anything."""
    plant, sensor, table = loop.plan.plant, loop.plan.sensor, Table(profile)
    assert isinstance(loop.plant, SensorNetwork)
    f[of.CARS], f[of.STATES] = loop.plant.size
    f[of.SENSED], f[of.WIRED] = len(loop.model.sensors), np.count_nonzero(loop.plan.channel.granted)
    f[of.IN_OWN], f[of.IN_MEASURE] = table.add(plant.A[0]), table.add(sensor.C)
    c[of.DT], c[of.STATE_SD], c[of.WALK_SD], c[of.READ_SD] = loop.plant.dt, loop.plant.initial_sd, plant.noise_sd, sensor.sd
    c[of.SPREAD] = spread(loop.model)
    window = _places(f, f[of.CARS] if loop.threat.sees_measurement else 0)
    several.listed(loop, f, table, lambda i, w: _wires(f, i, w))
    _filter(loop, platoon.drops(loop, attack), c, f, table)
    platoon.detector(loop.plan.defence, c, f)
    return np.concatenate(table.parts), window


def _places(f: Array, sizes: int) -> int:
    """Where what begins; of so many agents the size of what is read is shown. -> rows of the window."""
    agents, states, q, count = (int(f[at]) for at in (of.CARS, of.STATES, of.SENSED, of.WIRED))
    from .network_defence import room

    last = states
    for name, rows in ((of.SENTS, agents * q), (of.BELIEFS, agents * states), (of.HUNTED, count * several.WIRE_ROWS)):
        f[name], last = last * LANES, last + rows
    window, last = last, ROWS
    for name, rows in (
        (of.AIMS, count * several.WIRE_ROWS + agents), (of.TRUTHS, states), (of.FUSED, agents * states), (of.SENDS, agents * states),
        (of.FORE, states), (of.ARRIVALS, agents * q), (of.VALIDS, agents * q), (of.RESIDUES, agents * q), (of.TAKEN, agents * q),
        (of.SCORES, agents), (of.ALARMS, agents), (of.ABSENT, agents), (of.ASIDE, room(q, states)), (of.DEALT, max(states, agents * q) + 1),
        (of.SIZES, int(sizes)),
    ):  # fmt: skip
        f[name], last = last * LANES, last + rows
    f[of.ROOM], f[of.SIZES] = last - ROWS, f[of.SIZES] if sizes else 0
    return window


def _wires(f: Array, i: Array, w: Array) -> tuple[Array, Array, Array, Array]:
    """Where what is sent to agents i on wires w stands, what arrives, and whether it does: all of them are readings."""
    at = (i * f[of.SENSED] + w) * LANES
    return f[of.SENTS] + at, f[of.ARRIVALS] + at, f[of.VALIDS] + at, np.zeros(len(i))


def _filter(loop: Loop, drops: bool, c: Array, f: Array, table: Table) -> None:
    """A, what fuses, C, S^-1 and the gain; where readings may be missing, what the gain is made of."""
    held, model = loop.plan.defence, loop.model
    part: Any = held.filter
    plan: Any = getattr(held.filter_plan, "linear", held.filter_plan)
    f[of.IN_A], f[of.IN_READS], f[of.IN_HEARD] = table.add(model.A), table.add(model.C), platoon.lists(neighbours(model.graph), table)
    f[of.ESTIMATOR], c[of.PRICE], c[of.FACTOR] = platoon.ESTIMATORS[type(part)], getattr(part, "gamma", 0.0), 1.0
    f[of.ALONE] = type(part) in (KalmanFilter, ConsensusFilter)
    misses = np.flatnonzero(loop.plan.channel.granted.any(axis=1) & drops)
    f[of.MISSES], f[of.IN_MISSES] = len(misses), table.add(misses.astype(np.int64))
    if f[of.ESTIMATOR] == of.LINEAR:
        f[of.TAKEN] = f[of.RESIDUES]
    if not part.steady:
        each = gains.by_step(part, held.mitigation, model, loop.plant.prior_var, platoon.steps(loop))  # type: ignore[attr-defined]
        f[of.STEPPED], f[of.STEP_WIDE], f[of.IN_W] = len(each), each[0].size, table.add(each)
        f[of.PULLED] = type(part) is ConsensusFilter and part.consensus > 0.0
        return
    K, parts = plan.K, [plan.S, plan.cross]
    if f[of.ESTIMATOR] == of.NORM:
        whole, spread = held.filter_plan.whole, held.filter_plan.spread
        K, c[of.FACTOR] = whole.push, part.lam
        f[of.IN_SHAPE] = table.add(_each([whole.turn, part.lam * whole.half]))
        white = num.root(model.R)[1]
        parts += [num.matmul(num.matmul(white, model.C), num.transpose(spread)), white.diagonal(axis1=1, axis2=2), spread]
    elif f[of.ESTIMATOR] == of.LASSO:
        f[of.IN_SHAPE] = table.add(_each([0.5 * part.price(plan.S), plan.S.diagonal(axis1=1, axis2=2)]))
    f[of.IN_L], f[of.IN_MERGE], f[of.IN_W], f[of.IN_K] = (table.add(m) for m in (plan.L, plan.merge, num.inverse(plan.S[None])[0], K))
    some = _each(parts)
    f[of.IN_SOME], f[of.IN_SOME_WIDE] = table.add(some), some.shape[1]


def _each(parts: list[Array]) -> Array:
    """(N, .) of each agent all parts (N, ...), one after the other."""
    return np.concatenate([np.ascontiguousarray(part).reshape(len(part), -1) for part in parts], axis=1)
