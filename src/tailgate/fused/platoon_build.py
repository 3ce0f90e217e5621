"""The constants of a platoon, or why it has no lane."""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate import num
from tailgate.agents.ghost import GhostState
from tailgate.agents.program import Program
from tailgate.agents.scripted import Dropout, InjectSparse
from tailgate.core import Array, Attack
from tailgate.core import Mode as Asked
from tailgate.envs.cacc import FeedForward
from tailgate.envs.consensus_cacc import Consensus
from tailgate.envs.platoon import Platoon, PlatoonSensors
from tailgate.envs.ploeg import Ploeg
from tailgate.estimators.chi_square import ChiSquare
from tailgate.estimators.compose import AcceptAll, Composed, ComposedPlan, Score
from tailgate.estimators.consensus import ConsensusFilter
from tailgate.estimators.distributed import DistributedKalmanFilter, TailChiSquare, gain_of, neighbours
from tailgate.estimators.kalman import KalmanFilter, alone
from tailgate.estimators.lasso import LassoFilter
from tailgate.estimators.norm_resilient import NormResilientFilter, axes
from tailgate.estimators.raw import Raw
from tailgate.estimators.saturated import SaturatedFilter
from tailgate.estimators.sentinels import AcceptFirst, AlwaysAlarm, AlwaysMode
from tailgate.loop import Loop

from . import constants as of
from . import platoon_gains as gains
from . import script, several
from .constants import Table, put
from .platoon_rows import APPLIED, ARRIVED, BELIEF, CAR_ROWS, COMMAND, LAW, LINKS, SENSORS, SENT, VALID, WORK_ROWS
from .rows import LANES, ROWS
from .several import WIRE_ROWS

PARTS, LAWS = (Platoon, PlatoonSensors), (FeedForward, Consensus, Ploeg)
ESTIMATORS = {
    DistributedKalmanFilter: of.LINEAR, LassoFilter: of.LASSO, SaturatedFilter: of.SATURATED, NormResilientFilter: of.NORM,
    KalmanFilter: of.LINEAR, ConsensusFilter: of.LINEAR,
}  # fmt: skip
DETECTORS = (Score, ChiSquare, TailChiSquare, AlwaysAlarm)


def unknown(loop: Loop, attack: Attack | None) -> str:
    """Why this loop is no platoon with a lane; empty where it is one."""
    return _parts(loop) or defence(loop, attack)


def fill(loop: Loop, attack: Attack | None, c: Array, f: Array, profile: Array) -> tuple[Array, int]:
    """Fills in c and f. -> the table, which begins with the speeds of a profile, and the rows of the window."""
    table = Table(profile if f[of.WAY] == of.PROFILE else np.zeros(0))
    f[of.PROFILED] = table.size
    _vehicles(loop, c, f)
    window = _places(f, c[of.LOSS] > 0.0)
    several.listed(loop, f, table, lambda i, w: _wires(f, i, w))
    _filter(loop, drops(loop, attack), c, f, table)
    detector(loop.plan.defence, c, f)
    _law(loop, c, f, table)
    return np.concatenate(table.parts), window


def _parts(loop: Loop) -> str:
    for part, known in zip((loop.plant, loop.sensor), PARTS, strict=True):
        if type(part) is not known:
            return f"{type(part).__name__} has no lane"
    if type(loop.controller) not in LAWS:
        return f"{type(loop.controller).__name__} has no lane"
    C = loop.model.C
    if C.shape[1] != SENSORS or not np.isin(C, (0.0, 1.0)).all() or (np.count_nonzero(C, axis=2) != 1).any():
        return "sensors that do not read one state each have no lane"
    return "" if loop.model.inputs == 1 and loop.model.states > 1 else "a model with several inputs has no lane"


def drops(loop: Loop, attack: Attack | None) -> bool:
    """Whether readings may be made to go missing: where that is granted, by anybody who is not known to do something else."""
    if isinstance(attack, Program) and type(attack) is Program:
        return any(phase.kind == "dropout" for phase in attack.sheet.phases)
    spares = script.known(attack) or type(attack) in (GhostState, InjectSparse)
    return "dropout" in loop.threat.kinds and (type(attack) is Dropout or not spares)


def defence(loop: Loop, attack: Attack | None) -> str:
    """Why a defence of several agents has no lane."""
    defence = loop.defence
    if type(defence) is Raw:
        return "a state that the known input decides has no lane" if loop.plan.defence.by_input.any() else ""
    if not isinstance(defence, Composed) or type(defence).step is not Composed.step or type(defence).start is not Composed.start:
        return f"defence {type(defence).__name__} has no lane"
    estimator: Any
    estimator, detector, mitigation = defence.parts()
    if type(estimator) not in ESTIMATORS:
        return f"filter {type(estimator).__name__} has no lane"
    if why := "" if estimator.steady else _stepped(estimator, loop, attack):
        return why
    if estimator.steady and type(estimator) is KalmanFilter:
        return "a steady filter on the own sensors has no lane"  # nor a steady state, where cars are behind
    if getattr(estimator, "solver", "exact") != "exact":
        return "the solver is not the exact one"
    if type(detector) not in DETECTORS:
        return f"detector {type(detector).__name__} has no lane"
    known = (
        type(mitigation) is AcceptAll and mitigation.mode == "normal", type(mitigation) is AcceptFirst and not estimator.steady,
        type(mitigation) is AlwaysMode and mitigation.mode in (Asked.NORMAL, Asked.BRAKE, Asked.STOP),
    )  # fmt: skip
    return "" if any(known) else f"mitigation {type(mitigation).__name__} has no lane"


def _stepped(estimator: Any, loop: Loop, attack: Attack | None) -> str:
    """Why a gain that follows the covariance has no lane."""
    if type(estimator) not in (KalmanFilter, ConsensusFilter):
        return "fusion by covariances of each row has no lane"
    if drops(loop, attack) or loop.link.loss:
        return "covariances that depend on what is missed have no lane"
    pulled = type(estimator) is ConsensusFilter
    if pulled and estimator.share:
        return "readings that are shared have no lane"
    return "" if gains.numbers(loop.model, pulled) * steps(loop) <= gains.MOST else "so many gains have no lane"


def steps(loop: Loop) -> int:
    """How many steps have gains of their own: those of an episode, and of one that is over and waits for the next."""
    return loop.horizon + 200


def _vehicles(loop: Loop, c: Array, f: Array) -> None:
    plant, plan = loop.plant, loop.plan.plant
    assert isinstance(plant, Platoon)
    f[of.CARS], f[of.STATES] = plant.size
    f[of.WIRED] = np.count_nonzero(loop.plan.channel.granted)
    f[of.INPUT_KNOWN], f[of.ENDS] = plant.leader_input_known, loop.ends_on_collision
    c[of.DT], c[of.LOAD], c[of.LEAD_START + 1] = plant.dt, loop.load, plant.speed
    put(c, of.OWN_A, plan.A)
    put(c, of.OWN_B, plan.B)
    put(c, of.PROCESS_SD, plan.noise_sd)
    put(c, of.NOISE_SD, loop.plan.sensor[1])
    put(c, of.GAPS, (plant.gap, plant.gap_sd, plant.gap_range))
    c[of.PRIOR_SD], c[of.LOSS] = plant.initial_sd, loop.link.loss


def _wires(f: Array, i: Array, w: Array) -> tuple[Array, Array, Array, Array]:
    """Where what is sent to cars i on wires w stands, what arrives, and whether it does; whether it is a command."""
    car, work, row, acts = i * f[of.CAR], f[of.WORKS] + i * WORK_ROWS * LANES, w * LANES, w == LINKS
    return (
        np.where(acts, car + int(COMMAND), car + int(SENT) + row), np.where(acts, work + int(APPLIED), work + int(ARRIVED) + row),
        np.where(w < SENSORS, work + int(VALID) + row, -1), acts,
    )  # fmt: skip


def _filter(loop: Loop, dropped: bool, c: Array, f: Array, table: Table) -> None:
    """A, B, c, what fuses, and the gain: for each victim also with each set of sensors, or for each step."""
    held, model = loop.plan.defence, loop.model
    f[of.IN_A] = table.listed(model.A, np.arange(model.states) * LANES)
    f[of.IN_B], f[of.IN_C], c[of.FACTOR] = table.add(model.B[:, 0]), table.add(model.c), 1.0
    f[of.IN_HEARD], f[of.IN_READS] = lists(neighbours(model.graph), table), table.add(np.argmax(model.C, axis=2))
    if type(loop.defence) is Raw:
        f[of.ESTIMATOR] = of.READ
        told = [one for each in held.rounds for one in zip(*each, strict=True)]
        f[of.IN_HEARS] = table.add([len(told), *np.array(told).ravel()])
        return
    part, plan = held.filter, getattr(held.filter_plan, "linear", held.filter_plan)
    f[of.ESTIMATOR], c[of.PRICE] = ESTIMATORS[type(part)], getattr(part, "gamma", 0.0)
    f[of.ALONE] = type(part) in (KalmanFilter, ConsensusFilter)
    if not part.steady:
        each = gains.by_step(part, held.mitigation, model, loop.plant.prior_var, steps(loop))  # type: ignore[attr-defined]
        f[of.STEPPED], f[of.STEP_WIDE], f[of.IN_W] = len(each), each[0].size, table.add(each)
        f[of.PULLED] = type(part) is ConsensusFilter and part.consensus > 0.0
        return
    f[of.IN_L], f[of.IN_MERGE] = table.add(plan.L), table.add(plan.merge)
    misses = np.flatnonzero(np.full(len(model.C), c[of.LOSS] > 0.0) | (loop.plan.channel.granted.any(axis=1) & dropped))
    f[of.MISSES], f[of.IN_MISSES] = len(misses), table.add(misses.astype(np.int64))
    _sets(held, plan, misses, c, f, table)


def _sets(held: ComposedPlan, fusion: Any, misses: Array, c: Array, f: Array, table: Table) -> None:
    """S^-1 and gain of each car, and of those that may miss readings with each set of sensors; what is made of an innovation with each."""
    part: Any = held.filter
    plan, kind, S, cross, K = held.filter_plan, f[of.ESTIMATOR], fusion.S, fusion.cross, fusion.K
    keeps = np.array([[some >> q & 1 for q in range(SENSORS)] for some in range(1 << SENSORS)], bool)
    some, shapes = [], []
    for i in range(len(S)):
        for keep in keeps:
            mine = alone(S[i][None], keep[None])
            weight, gain = num.inverse(mine)[0], gain_of(mine, cross[i][None] * keep[:, None])[0]
            if kind == of.LASSO:
                shapes.append(np.concatenate([weight.ravel(), 0.5 * part.price(mine)[0], mine[0].diagonal()]))
            elif kind == of.NORM:
                own = axes(plan.linear.C[i][None] * keep[:, None], alone(plan.linear.R[i][None], keep[None]), plan.spread[i][None])
                gain = own.push[0]
                shapes.append(np.concatenate([own.turn[0].ravel(), part.lam * own.half[0]]))
            if i in misses:
                some.append(np.concatenate([weight, gain]))
    if kind == of.NORM:
        K, c[of.FACTOR] = plan.whole.push, part.lam
    f[of.IN_W], f[of.IN_K], f[of.IN_SOME] = table.add(num.inverse(S[None])[0]), table.add(K), table.add(np.array(some, np.float64))
    f[of.SHAPE], f[of.IN_SHAPE] = (len(shapes[0]) if shapes else 0), table.add(np.array(shapes, np.float64))


def detector(held: Any, c: Array, f: Array) -> None:
    if not isinstance(held, ComposedPlan):  # none, which never alarms
        c[of.THRESHOLD] = np.inf
        return
    part: Any = held.detector
    c[of.ASKED] = getattr(held.mitigation, "mode", 0) if type(held.mitigation) is AlwaysMode else 0.0
    f[of.DETECTOR] = of.ALWAYS if type(part) is AlwaysAlarm else of.CHI2
    c[of.THRESHOLD] = held.detector_plan if type(part) is TailChiSquare else getattr(part, "eta", np.inf)


def lists(heard: tuple[tuple[int, ...], ...], table: Table) -> int:
    """N(i) of all cars, behind where each begins. -> where that is."""
    begin = table.size + len(heard) + 1
    at = table.add(begin + np.cumsum([0, *map(len, heard)]))
    table.add([j for near in heard for j in near])
    return at


def _law(loop: Loop, c: Array, f: Array, table: Table) -> None:
    """The law for each car, on its own belief but for its own f."""
    law: Any = loop.controller
    matrices, keep = loop.plan.controller.normal
    cars, states = matrices.K.shape
    place = int(BELIEF) + np.tile(np.arange(states) * LANES, (cars, 1))
    place[np.arange(1, cars), 6 + 4 * np.arange(cars - 1)] = int(LAW)
    f[of.IN_LAW], f[of.IN_FEED] = table.listed(matrices.K, place), table.listed(matrices.G, place)
    f[of.IN_BIAS], f[of.IN_V] = table.add(np.stack([matrices.k0, matrices.g0], axis=1)), table.add(matrices.V)
    f[of.IN_LED] = table.add(loop.plan.plant.leader_heard)
    c[of.FADES] = keep
    low, high = (limit if given is None else given for given, limit in ((law.accel_min, -np.inf), (law.accel_max, np.inf)))
    put(c, of.ACCEL_MIN, (low, high))


def _places(f: Array, lossy: bool) -> int:
    """Where records begin. -> rows of the window."""
    cars, states, count = int(f[of.CARS]), int(f[of.STATES]), int(f[of.WIRED])
    record, last = CAR_ROWS + states + (SENSORS if lossy else 0), ROWS
    f[of.CAR], f[of.HUNTED], f[of.THERE] = record * LANES, cars * record * LANES, (CAR_ROWS + states) * LANES if lossy else 0
    for name, rows in (
        (of.WORKS, cars * WORK_ROWS), (of.AIMS, count * WIRE_ROWS + cars), (of.TRUTHS, states), (of.FUSED, cars * states),
        (of.SENDS, cars * max(states, LINKS)), (of.FORE, states), (of.DEALT, max(LINKS * cars, states) + 3),
    ):  # fmt: skip
        f[name], last = last * LANES, last + rows
    f[of.ROOM] = last - ROWS
    return cars * record + count * WIRE_ROWS
