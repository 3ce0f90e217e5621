"""Whether a loop can be fused, and its constants if it can.

What is not known here, to the exact type, is played by the plain loop: a subclass may mean something else.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.model_based import Stealth
from tailgate.core import AIRED, Array, Attack, Kind, Mode
from tailgate.envs import manoeuvres as drives
from tailgate.envs.controllers import AdaptiveCruise
from tailgate.envs.following import CarFollowing
from tailgate.envs.idm import IDM_GAP, IDM_HEADWAY
from tailgate.envs.sensors import Odometry
from tailgate.estimators.chi_square import ChiSquare
from tailgate.estimators.compose import AcceptAll, Composed, GateOut, Score
from tailgate.estimators.detectors import Cusum, Mewma, WindowedChiSquare
from tailgate.estimators.imm import InteractingModels
from tailgate.estimators.kalman import KalmanFilter
from tailgate.estimators.mitigations import Brake, Latch, Reacquire, Widen
from tailgate.estimators.oracle import RejectAttacked
from tailgate.estimators.raw import Raw
from tailgate.estimators.reactive_brake import SafeState, SafeStateBrake
from tailgate.estimators.robust import RobustKalmanFilter
from tailgate.estimators.sentinels import AcceptFirst, AlwaysAlarm, AlwaysMode
from tailgate.estimators.sparse import SparseChiSquare
from tailgate.loop import Loop

from . import constants as of
from . import imm, monitor, script
from .constants import put as _put
from .rows import wires_of

_ON_WIRES = {Kind.DOS_JAM, Kind.DOS_HOLD, Kind.DOS_HOLD_FRESH, Kind.DROPOUT, Kind.FDI}
_CAR = (CarFollowing, Odometry, AdaptiveCruise)
_STRUCTURE = np.array([[True, True, True], [False, True, True], [False, False, True]])  # of A: where it is not zero


class Constants(NamedTuple):
    """A loop as the lanes read it."""

    c: Array  # (NUMBERS,) float64
    f: Array  # (CHOICES,) int64
    table: Array  # speeds of a profile [m/s], else one zero
    window: int  # rows of the detector's window, or of what else a defence remembers
    intents: int  # rows of the rear driver's intents


@dataclass(frozen=True)
class Refused:
    """Why a loop is not fused, in a few words."""

    why: str


def _radar() -> Any:
    """What is known of a car with a radar; car following does without, and without the modules of radars."""
    from . import radar_build

    return radar_build


def fuse(loop: Loop, attack: Attack | None = None) -> Constants | Refused:
    """The constants of a loop, or why the plain loop plays it: under the given attack, or under any that does not hold the defence."""
    if loop.threat.hold_from_onset:
        return Refused("what is held from the onset has no lane")
    if loop.model.agents > 1:
        return _several(loop, attack)
    parts = (loop.plant, loop.sensor, loop.controller)
    aired = loop.model.air and type(loop.plant) is _radar().PARTS[0]
    for part, known in zip(parts, _radar().PARTS if aired else _CAR, strict=True):
        if type(part) is not known:
            return Refused(f"{type(part).__name__} has no lane")
    if not loop.link.perfect:
        return Refused("readings are lost or late")
    if why := _white(loop, attack):
        return Refused(why)
    if not {Kind[name.upper()] for name in loop.threat.kinds} <= (_ON_WIRES | set(AIRED) if aired else _ON_WIRES):
        return Refused("delay and replay have no lane" if aired else "delay, replay and what is radiated have no lane")
    c, f = of.blank()
    f[of.AIRED] = aired
    vehicle = _radar().FILLS if aired else (_vehicle, _told, _cruise)
    for fill in (*vehicle, _defence, _threat):
        if why := fill(loop, c, f):
            return Refused(why)
    table = _way(loop, c, f)
    if table is None:
        return Refused(f"manoeuvre {type(loop.manoeuvre).__name__} has no lane")
    return Constants(c, f, table, _remembered(f), int(f[of.REACTION]))


def _several(loop: Loop, attack: Attack | None) -> Constants | Refused:
    """As `fuse`, of several agents: a platoon, or a network that watches what nobody drives."""
    road = bool(loop.model.followers.any())
    if road and not loop.model.v2v:
        return Refused(f"{type(loop.plant).__name__} has no lane")
    if loop.link.latency or not (road or loop.link.perfect):
        return Refused("readings are late" if loop.link.latency else "readings are lost")
    if why := _white(loop, attack):
        return Refused(why)
    if not {Kind[name.upper()] for name in loop.threat.kinds} <= _ON_WIRES:
        return Refused("delay, replay and what is radiated have no lane")
    kind = import_module(f"tailgate.fused.{'platoon' if road else 'network'}_build")  # which a single car does without
    if why := kind.unknown(loop, attack):
        return Refused(why)
    c, f = of.blank()
    _granted(loop, c)
    table = _way(loop, c, f)
    if table is None:
        return Refused(f"manoeuvre {type(loop.manoeuvre).__name__} has no lane")
    table, window = kind.fill(loop, attack, c, f, table)
    return Constants(c, f, table, window, 0)


def _remembered(f: Array) -> int:
    """Rows that the defence keeps beside those of every defence."""
    if f[of.PRINTED] or f[of.CHALLENGED]:
        return int(_radar().remembered(f))
    if f[of.MODELED]:
        return imm.rows(int(f[of.MODELED]))
    return monitor.ROWS if f[of.BOXED] else max(int(f[of.WINDOW]) - 1, 0)


def _white(loop: Loop, attack: Attack | None) -> str:
    """A script sees the road and no more; the one that looks into the defence does it in its lane, where there is something to see."""
    granted = loop.threat.knowledge == "white"
    if type(attack) is Stealth:
        if not granted:
            return "attack stealth needs a white box"  # which the plain loop says
        if loop.model.air or loop.model.agents > 1:
            return "attack stealth has no lane against a radar or several agents"
        shows = getattr(type(loop.defence), "look", None) is Composed.look
        return "" if shows else f"{type(loop.defence).__name__} shows no innovation to a lane"
    return "" if not granted or script.known(attack) else "a white-box attacker holds the defence itself"


def _vehicle(loop: Loop, c: Array, f: Array) -> str:
    plant, plan = loop.plant, loop.plan.plant
    assert isinstance(plant, CarFollowing)
    _put(c, of.DT, plant.dt)
    _put(c, of.LOAD, loop.load)
    _put(c, of.OWN_A, plan.A)
    _put(c, of.OWN_B, plan.B)
    _put(c, of.PROCESS_SD, plan.noise_sd)
    _put(c, of.SENSOR_SD, loop.plan.sensor.sd)
    _put(c, of.START, (plant.position, plant.speed, plant.accel))
    _put(c, of.START_SD, plant.initial_sd)
    _put(c, of.MEAN, (plant.position, plant.speed, plant.accel))
    _put(c, of.PRIOR, np.diag(plant.prior_var))
    _put(c, of.LEAD_START, (plant.position + plant.gap, plant.lead_speed))
    _put(c, of.REAR_START, (IDM_GAP + IDM_HEADWAY * plant.speed, plant.speed))
    f[of.REAR] = plant.rear
    f[of.REACTION] = plan.behind.reaction if plan.behind else 0
    f[of.ENDS] = loop.ends_on_collision
    f[of.UNIFORM_NOISE] = getattr(loop.sensor, "noise", None) is not None
    return ""


def _told(loop: Loop, c: Array, f: Array) -> str:
    model = loop.model
    if not np.array_equal(model.A != 0.0, _STRUCTURE) or (model.B == 0.0).any():
        return "the model's matrices have another structure"
    if not np.array_equal(model.C[0], np.eye(3)[:2]) or model.A[0, 0] != 1.0 or model.A[1, 1] != 1.0:
        return "the model's matrices have another structure"
    for at, value in ((of.A, model.A), (of.B, model.B), (of.C0, model.c), (of.Q, model.Q), (of.RNOISE, model.R)):
        _put(c, at, value)
    return ""


def _cruise(loop: Loop, c: Array, f: Array) -> str:
    acc = loop.controller
    assert isinstance(acc, AdaptiveCruise)
    _put(c, of.HEADWAY, (acc.headway, acc.standstill, acc.gamma))
    free = [
        value if given is None else given for given, value in ((acc.set_speed, np.inf), (acc.accel_min, -np.inf), (acc.accel_max, np.inf))
    ]
    _put(c, of.SET_SPEED, free)
    return ""


def _defence(loop: Loop, c: Array, f: Array) -> str:
    defence = loop.defence
    if type(defence) is Raw:
        f[of.RAW] = 1
        return ""
    if type(defence) is InteractingModels:
        return _models(defence, loop.plan.defence, c, f)
    if f[of.AIRED] and type(defence) in _radar().CHALLENGERS:
        return str(_radar().challenged(loop, c, f))
    if isinstance(defence, SafeState) and not f[of.AIRED] and type(defence) in (SafeState, SafeStateBrake):
        return _safe_set(defence, loop, c, f)
    if not isinstance(defence, Composed):
        return f"defence {type(defence).__name__} has no lane"
    kind = type(defence)
    if kind.step is not Composed.step or kind.start is not Composed.start or kind.prepare is not Composed.prepare:
        return f"defence {type(defence).__name__} has a step of its own"
    parts, plan = defence.parts(), loop.plan.defence
    for fill, part in zip((_filter, _detector, _mitigation), parts, strict=True):
        if why := fill(part, plan, loop, c, f):
            return why
    if f[of.MITIGATION] == of.REACQUIRE and f[of.STEADY]:
        return "a steady filter that forgets has no lane"
    return ""


def _models(defence: InteractingModels, plan: Any, c: Array, f: Array) -> str:
    models = len(plan.models)
    if models > of.MODELS:
        return f"more than {of.MODELS} models have no lane"
    f[of.MODELED], c[of.THRESHOLD] = models, defence.threshold
    for i in range(models):
        _put(c, of.MOVES + of.MODELS * i, plan.moves[i])
        _put(c, of.NOISES + 4 * i, plan.models[i].R)
    _put(c, of.SHARES, plan.start)
    return ""


def _safe_set(defence: SafeState, loop: Loop, c: Array, f: Array) -> str:
    plan = loop.plan.defence
    held, road = plan.set_plan, plan.set_plan.road
    if "v2v" not in loop.uses:
        return "a safe set that hears no leader has no lane"
    if why := _filter(plan.filter, plan, loop, c, f):
        return why
    f[of.BOXED] = 1
    _put(c, of.ACCURATE, held.accuracy[0, :3])
    _put(c, of.BOX_LO, held.least)
    _put(c, of.BOX_HI, held.most)
    low, high = defence.accel_limits
    _put(c, of.AHEAD_LO, (low * held.dt, high * held.dt, held.recover))
    _put(c, of.OWN_OFF, (road.off, road.noise[0] + road.A[0, 2] * road.off, road.noise[1] + road.A[1, 2] * road.off))
    if isinstance(defence, SafeStateBrake):
        f[of.BRAKES], f[of.ALWAYS_ARMED] = 1, defence.when == "always"
        eased = 1.0 - float(num.exp(-plan.reaction / plan.lag))
        _put(c, of.HARD, (defence.brake, 2.0 * max(defence.lead_brake, defence.brake), plan.lag, plan.reaction, eased))
        _put(c, of.RESPONSE, (defence.response, defence.clearance, defence.distance, plan.watch))
    return ""


def _filter(part: Any, plan: Any, loop: Loop, c: Array, f: Array) -> str:
    if type(part) is RobustKalmanFilter:
        if part.solver != "exact":
            return "the solver is not the exact one"
        f[of.ROBUST], f[of.PER_SIGMA], c[of.PRICE] = 1, part.unit == "sigma", part.lam
    elif type(part) is not KalmanFilter:
        return f"filter {type(part).__name__} has no lane"
    f[of.STEADY] = part.steady
    if part.steady:
        _put(c, of.PRIOR, plan.filter_plan.held[0, :3, :3])
    _put(c, of.BROAD, plan.filter_plan.broad[:3])
    c[of.OWN_BROAD] = plan.filter_plan.broad[3] if f[of.AIRED] else 0.0
    return ""


def _detector(part: Any, plan: Any, loop: Loop, c: Array, f: Array) -> str:
    kinds = {
        Score: of.SCORE_ONLY, ChiSquare: of.CHI2, WindowedChiSquare: of.WINDOWED, Cusum: of.CUSUM, Mewma: of.MEWMA, AlwaysAlarm: of.ALWAYS,
        SparseChiSquare: of.SPARSE,
    }  # fmt: skip
    kind = kinds.get(type(part))
    if kind is None:
        return f"detector {type(part).__name__} has no lane"
    f[of.DETECTOR] = kind
    if isinstance(part, SparseChiSquare):
        c[of.FEWER] = plan.detector_plan[1]
    name = getattr(part, "threshold_field", None)
    c[of.THRESHOLD] = np.inf if name is None else getattr(part, name)
    if isinstance(part, WindowedChiSquare):
        f[of.WINDOW] = part.window
    elif isinstance(part, Cusum):
        c[of.DRIFT], f[of.RESET] = plan.detector_plan.drift, part.reset
    elif isinstance(part, Mewma):
        c[of.WEIGHT], c[of.LIMIT] = part.weight, part.weight / (2.0 - part.weight)
        f[of.RESET], f[of.EXACT] = part.reset, part.exact
    return ""


def _mitigation(part: Any, plan: Any, loop: Loop, c: Array, f: Array) -> str:
    kinds = {
        AcceptAll: of.ACCEPT_ALL, GateOut: of.GATE_OUT, Latch: of.GATE_OUT, Widen: of.GATE_OUT, Brake: of.GATE_OUT,
        Reacquire: of.REACQUIRE, AcceptFirst: of.ACCEPT_FIRST, AlwaysMode: of.ALWAYS_MODE,
        RejectAttacked: of.ACCEPT_HONEST,
    }  # fmt: skip
    kind = kinds.get(type(part))
    if kind is None:
        return f"mitigation {type(part).__name__} has no lane"
    f[of.MITIGATION] = kind
    if kind == of.ACCEPT_FIRST:
        c[of.AFTER] = part.steps
    elif kind == of.ALWAYS_MODE:
        c[of.ASKED] = part.mode
    elif kind == of.ACCEPT_HONEST:
        return "" if "truth" in loop.uses else "nobody tells who is attacked"
    else:
        c[of.LATCH], c[of.AFTER] = getattr(part, "latch", 0), getattr(part, "after", 0)
        c[of.LINGER], c[of.ASKED] = plan.mitigation_plan.linger, Mode[part.mode.upper()]
        f[of.MODED] = part.mode != "normal"
    return ""


def _granted(loop: Loop, c: Array) -> None:
    """When and how an attack may be, whoever is attacked."""
    plan, threat = loop.plan.channel, loop.threat
    most = [np.inf if value is None else float(value) for value in (threat.budget, threat.duration)]
    _put(c, of.ONSET, (threat.onset, plan.last_step, *most, threat.cooldown))
    _put(c, of.GRANTED, plan.kinds)


def _threat(loop: Loop, c: Array, f: Array) -> str:
    plan, threat = loop.plan.channel, loop.threat
    _granted(loop, c)
    mine = np.array(wires_of(plan.granted.shape[1]))
    for at, values in ((of.WIRE, plan.granted[0]), (of.BOUND, plan.bounds), (of.LOW, plan.low), (of.HIGH, plan.high)):
        c[at + mine] = values
    c[of.STRONGEST], c[of.LATEST] = threat.jam_power, threat.delay_bound
    f[of.ACTUATED] = plan.granted[0, -1]
    return ""


def _way(loop: Loop, c: Array, f: Array) -> Array | None:
    """Number of the manoeuvre and its parameters as `road.way` reads them; -> the table of a profile, None of an unknown one."""
    way, plan, table = loop.manoeuvre, loop.plan.manoeuvre, np.zeros(1)
    match way:
        case drives.Constant():
            kind, values = of.CONSTANT, [way.value]
        case drives.Pulse():
            kind, values = of.PULSE, [way.value, way.begin, way.end]
        case drives.Switched():
            kind, values = of.SWITCHED, [way.value, way.then, way.at]
        case drives.Sine():
            kind, values = of.SINE, [way.amplitude, plan.cos, plan.sin]
        case drives.Braking():
            kind, values = of.BRAKING, [way.decel, 0.0, 0.0, 0.0, *way.onset]
        case drives.StopAndGo():
            kind, values = of.STOP_AND_GO, [way.low_speed, way.cruise_speed, way.decel, way.accel_rate, *way.cruise, *way.dwell]
        case drives.OrnsteinUhlenbeck():
            kind, values = of.RANDOM, [plan.keep, plan.kick, way.mean_speed, way.pull, way.limit, way.sd]
        case drives.Profile():
            kind, values, table = of.PROFILE, [], np.ascontiguousarray(plan.speed, np.float64)
        case _:
            return None
    f[of.WAY] = kind
    _put(c, of.WAY_PARAM, values)
    return table
