"""The closed loop of a Kalman filter and a linear controller as one linear system with bounded inputs.

        s = [x, p, z]         x^ = p + K_k (C x + v + a - C p)          u = F x^ + H h + u0
        x+ = A x + B (u, e) + c + w          p+ = A x^ + B (u, e) + c          z+ = Z z + E d

x (n) is the true state, p (n) the filter's prediction. z holds the leader and its delayed messages, or the curvature; h is what is heard.
The noise w and v, the start and the exogenous d lie in boxes. The attacker's a lies within +-a_max on the wires that are granted.
F, H and u0 are read off the controller by probing it, as is the range within which it is linear.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple, TypedDict

import numpy as np

from tailgate.agents.optimal.schedules import updated
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Model
from tailgate.core.scenario import Scenario
from tailgate.core.threat import Brief
from tailgate.envs.controllers.adaptive_cruise import LEADER
from tailgate.envs.plants.car_following import CarFollowing
from tailgate.envs.plants.lane_keeping import LaneKeeping
from tailgate.envs.plants.scalar import ScalarLoop
from tailgate.envs.plants.sensor_network import SensorNetwork
from tailgate.estimators.filters.kalman import steady_state
from tailgate.trust.leaders import accelerations
from tailgate.trust.probing import Law, probed

SETTLE = (300, 30.0)  # steps and seconds before an episode that begins at rest, at least
STILL = 1e-6  # by how much gap, speed and command may still change in a step after them [m], [m/s], [m/s^2]
UNIFORM = 3.0**0.5  # standard deviations from the middle of a uniform law to its end
SPREAD = 4.0  # standard deviations of noise that count as its largest value
PLANTS = (CarFollowing, LaneKeeping, SensorNetwork, ScalarLoop)  # whose vehicles or systems are linear while they move


@dataclass(frozen=True, eq=False)
class Step:
    """One step of the loop: s+ = M s + m0 + N e + W a, and the outputs estimate error and command, each D s + d0 + V e + U a.

    e (g,) in [-1, 1] are the bounded inputs; a (r,) in [-a_max, a_max] are the injected values on the granted wires.
    """

    M: Array
    m0: Array
    N: Array
    W: Array
    error: tuple[Array, Array, Array, Array]
    command: tuple[Array, Array, Array, Array]


@dataclass(frozen=True, eq=False)
class AffineLoop:
    """The loop over a horizon. `steps[k - 1]` leads from step k to k + 1; `start` is the centre of s at step 1, `box` its generators."""

    model: Model
    law: Law | None
    steps: tuple[Step, ...]
    start: Array
    box: Array  # (size, .)
    gaps: tuple[tuple[Array, float], ...]  # rows r and offsets o: r s + o is a gap [m] that has to stay above 0
    moving: tuple[tuple[Array, float], ...]  # the same of a speed [m/s]: at 0 a car halts, which is not linear
    attacked: Array  # (K,) bool: steps in which an attack is accepted
    budget: int
    bend: float = 0.0  # largest curvature [1/m], where the last state is one
    spread: float = SPREAD  # standard deviations that the generators of noise are long
    chance: int = 0  # of the bounded inputs, the first that are noise; the others are the leader's or the road's
    begun: int = 0  # of the generators of the start, the first that are noise
    burn: int = 0  # first steps that nobody looks at: the loop settles
    lengths: tuple[float, ...] = ()  # of each bounded input that is noise, the generator's standard deviations; empty: `spread` of all
    uniform: bool = False  # the readings' noise is uniform: its generators hold all of it


def gains(model: Model, prior: Array, steps: int, steady: bool) -> Array:
    """Return the gains (steps, n, q) of the Kalman filter of agent 0, from the covariance `prior` (n, n)."""
    C, R, P = model.C[0], model.R[0], steady_state(model)[0] if steady else model.A @ prior @ model.A.T + model.Q
    out = []
    for _ in range(steps):
        step = updated(P, C, R)
        out.append(step.K)
        if not steady:
            P = model.A @ step.after @ model.A.T + model.Q
    return np.array(out)


class Outside(NamedTuple):
    """The part z of the state: z+ = Z z + E d + z0 with d in [-1, 1]; h = heard z; the model's input gets e = known z."""

    Z: Array
    E: Array
    z0: Array
    start: Array
    heard: Array
    known: Array
    gaps: tuple[tuple[Array, Array, float], ...]  # rows of x and of z, and an offset


def outside_of(place: Scenario, model: Model, delay: int, stale: bool, lead: tuple[float, float] | None, bound: float | None) -> Outside:
    """Return what lies outside of the car: leader or curvature, and the gaps that have to stay above 0.

    Raises
    ------
    NotApplicable
        For a plant whose loop is not linear.
    """
    plant, manoeuvre = place.plant, place.manoeuvre
    if type(plant) not in PLANTS and model.v2v[:2] == LEADER:
        raise NotApplicable("--prove: plant", type(plant).__name__, "one whose motion is known to be linear, such as car_following")
    if model.lane:
        if delay or lead is not None:
            given = ("--lead-accel", lead) if lead is not None else ("delay", delay)
            raise InputError(given[0], given[1], "nothing: nobody who drives ahead is in the loop of a lane")
        radius, ease = getattr(manoeuvre, "radius", None), getattr(manoeuvre, "ease", None)
        if radius is None or ease is None:
            raise NotApplicable("--prove: manoeuvre", type(manoeuvre).__name__, "curves")
        one = np.ones((1, 1))
        row = np.array(model.gap)[0]
        gaps = tuple((sign * row, np.zeros(1), model.lane) for sign in (1.0, -1.0))
        return Outside(one, np.array([[model.dt / (ease * radius[0])]]), np.zeros(1), np.zeros(1), one, one, gaps)
    if not model.followers.any() and not model.inputs:
        if bound is None:
            raise InputError("--bound", None, "an error that counts as damage: nobody drives here")
        empty = np.zeros((0, 0))
        return Outside(empty, empty, np.zeros(0), np.zeros(0), empty, empty, ())
    if model.v2v[:2] != LEADER or model.agents != 1 or place.truth:
        wanted = "car_following, lane_keeping, or a network of one agent without a controller"
        raise NotApplicable("--prove: plant", type(plant).__name__, wanted)
    low, high = lead if lead is not None else accelerations(manoeuvre)
    dt, many = model.dt, 2 * (1 + delay)
    Z, E, z0 = np.zeros((many, many)), np.zeros((many, 1)), np.zeros(many)
    Z[0, :2], Z[1, 1] = (1.0, dt), 1.0
    push = np.array([0.5 * dt * dt, dt])
    E[:2, 0], z0[:2] = 0.5 * (high - low) * push, 0.5 * (high + low) * push
    Z[range(2, many), range(many - 2)] = 1.0
    x, v = plant.position + plant.gap, plant.lead_speed
    start = np.concatenate([[x - j * dt * v, v] for j in range(1 + delay)])
    heard = np.zeros((2, many))
    heard[:, -2:] = np.eye(2)
    heard[0, -1] = 0.0 if stale else delay * dt
    ahead = np.zeros(many)
    ahead[0] = 1.0
    return Outside(Z, E, z0, start, heard, np.zeros((0, many)), ((np.array(model.gap)[0], ahead, 0.0),))


def injectable(brief: Brief) -> Array:
    """Return (w,) bool: the wires of agent 0 that false data may be injected on, granted and not authenticated."""
    return np.asarray(brief.granted[0] & ~brief.sealed)


class LoopOptions(TypedDict, total=False):
    """Arguments of `affine_loop` that others pass on."""

    at_rest: bool
    spread: float
    stale: bool
    lead: tuple[float, float] | None
    steps: int | None


def affine_loop(
    place: Scenario, at_rest: bool = False, spread: float = SPREAD, delay: int = 0, stale: bool = False,
    lead: tuple[float, float] | None = None, bound: float | None = None, steps: int | None = None,
) -> AffineLoop:  # fmt: skip
    """Return the loop of a scenario under `kf`, as a linear system.

    Parameters
    ----------
    at_rest
        The loop has settled before step 1, with the filter's constant gain, under noise alone, behind a leader at constant speed. Else it
        begins as the scenario does, with the gain that follows from the prior.
    spread
        Standard deviations that count as the largest value of Gaussian noise.
    delay
        Steps by which the leader's message is late.
    stale
        The receiver takes a late position as it is; else it adds the way that the leader made since, at the speed that it said.
    lead
        Least and largest acceleration of the leader [m/s^2]; none: those of the manoeuvre.
    bound
        Size of an error that counts as damage, where nobody drives.

    Raises
    ------
    InputError, NotApplicable
        For numbers and scenarios that do not fit.
    """
    if not 0.0 < spread <= 100.0:
        raise InputError("--spread", spread, "standard deviations, above 0 and at most 100")
    if not 0 <= delay <= 100:
        raise InputError("delay", delay, "steps, 0 to 100")
    if lead is not None and not -np.inf < lead[0] <= lead[1] < np.inf:
        raise InputError("--lead-accel", list(lead), "two finite numbers, the smaller first")
    brief = place.brief()
    model, threat = brief.model, brief.threat
    if model.agents != 1 or place.truth:
        raise NotApplicable("--prove: scenario", place.name, "one agent, whose vehicle is the one that is known")
    granted = injectable(brief)
    q, n, many = len(model.sensors), model.states, place.horizon if steps is None else min(steps, place.horizon)
    if granted[q:].any():
        raise NotApplicable("--prove: threat_model.targets", list(threat.targets), "sensors, not messages or actuators")
    out = outside_of(place, model, delay, stale, lead, bound)  # first: a controller of another plant may not be asked at all
    law = probed(place.controller, model) if model.actuators else None
    first = _start(place, model, spread)
    start, box = _first(model, law, out, first, place, spread, at_rest)
    rows = tuple((np.concatenate([x, np.zeros(n), z]), offset) for x, z, offset in out.gaps)
    burn = 0
    if at_rest:
        calm = _step(model, law, out, gains(model, first[2], 1, True)[0], granted[:q], place, spread, True)
        burn = _settled(calm, start, [row for row, _ in rows], model.dt)
    K = gains(model, first[2], burn + many, at_rest)
    made = tuple(_step(model, law, out, K[k], granted[:q], place, spread, k < burn) for k in range(burn + many))
    k = np.arange(1 - burn, many + 1)
    last = many if threat.end is None else min(threat.end, many)
    budget = many if threat.budget is None else threat.budget
    speeds = () if model.lane or law is None else ((np.concatenate([np.array(model.speed)[0], np.zeros(n + len(out.start))]), 0.0),)
    return AffineLoop(
        model, law, made, start, box, rows, speeds, (k >= threat.onset) & (k <= last), budget,
        1.0 / place.manoeuvre.radius[0] if model.lane else 0.0,
        spread, made[0].N.shape[1] - out.E.shape[1], box.shape[1] - out.E.shape[1], burn, *_lengths(place, model, spread),
    )  # fmt: skip


def _settled(step: Step, start: Array, rows: list[Array], dt: float) -> int:
    """Return after how many calm steps gap and command rest, SETTLE at least; raise NotApplicable where they do not."""
    looked = np.concatenate([np.array(rows).reshape(-1, len(start)), step.command[0]])
    least, now = max(SETTLE[0], ceil(SETTLE[1] / dt)), start
    for count in range(1, 20 * least):
        before, now = now, step.M @ now + step.m0
        if (off := float(np.abs(looked @ (now - before)).max(initial=0.0))) <= STILL and count >= least:
            return count
    got = f"gap or command move by {off:.2g} a step after {count} steps"
    raise NotApplicable("--at-rest", got, f"a loop that settles, to {STILL:g} a step")


def _noise(place: Scenario, model: Model, spread: float) -> tuple[Array, Array]:
    """Return generators of the process noise (n, .) and of the readings' noise (q, .)."""
    plant, sensor = place.plant, place.sensor
    told = getattr(plant, "noise_var", None)
    Q = model.Q if not isinstance(told, float) else np.eye(model.states) * told
    other = getattr(sensor, "noise_var", None)
    R = np.eye(len(model.sensors)) * other if isinstance(other, float) else model.R[0]
    return _box(Q, spread), _box(R, UNIFORM if _uniform(place) else spread)


def _uniform(place: Scenario) -> bool:
    return getattr(place.sensor, "noise", None) == "uniform"


def _lengths(place: Scenario, model: Model, spread: float) -> tuple[tuple[float, ...], bool]:
    """Return how many standard deviations each generator of `_noise` is long, and if the readings' noise is uniform."""
    process, readings = _noise(place, model, spread)
    uniform = _uniform(place)
    return (spread,) * process.shape[1] + (UNIFORM if uniform else spread,) * readings.shape[1], uniform


def _box(cov: Array, spread: float) -> Array:
    """Return generators of the box that holds a noise of this covariance within these standard deviations of its principal axes."""
    value, axis = np.linalg.eigh(np.asarray(cov))
    kept = value > 0.0
    return np.asarray(spread * axis[:, kept] * np.sqrt(value[kept]))


def _start(place: Scenario, model: Model, spread: float) -> tuple[Array, Array, Array]:
    """Return mean (n,), generators (n, .) and the covariance (n, n) that the filter has of the initial state."""
    from tailgate.core.draws import Role, keys
    from tailgate.core.loop import START

    plant, sd = place.plant, np.atleast_1d(np.array(place.plant.initial_sd, float))
    sd = np.full(model.states, sd[0]) if len(sd) == 1 else sd
    plan, draws = plant.prepare(model), keys("tune", range(1)).at(Role.PRIOR, np.full(1, START))
    held = plant.prior(plan, plant.start(plan, draws), np.zeros((1, 1, 0)), draws)
    return held.mean[0, 0], spread * np.diag(sd)[:, sd > 0.0], held.cov[0, 0]


def _parts(model: Model, law: Law | None, out: Outside, estimate: Array) -> tuple[Array, Array]:
    """Return the command (m, size) and the model's input (inputs, size) as rows on [x, p, z], from the rows of the estimate."""
    n, size = model.states, 2 * model.states + len(out.start)
    z = np.eye(size)[2 * n :]
    u = np.zeros((0, size)) if law is None else law.F @ estimate + law.H @ (out.heard @ z)
    return u, np.concatenate([u, out.known @ z]) if model.inputs else np.zeros((0, size))


def _step(model: Model, law: Law | None, out: Outside, K: Array, granted: Array, place: Scenario, spread: float, calm: bool) -> Step:
    n, many = model.states, len(out.start)
    size, C = 2 * n + many, model.C[0]
    eye = np.eye(size)
    x, p, z = eye[:n], eye[n : 2 * n], eye[2 * n :]
    process, readings = _noise(place, model, spread)
    g = process.shape[1] + readings.shape[1] + out.E.shape[1]
    w, v, d = _cut(process.shape[1], readings.shape[1], out.E.shape[1])
    estimate = p + K @ C @ (x - p)
    noise, wires = np.zeros((n, g)), np.eye(len(C))[:, granted]
    noise[:, v] = K @ readings
    bias = K @ wires
    u, inputs = _parts(model, law, out, estimate)
    lift = np.zeros((model.inputs, n))
    if law is not None:
        lift[: len(law.u0)] = law.F
    shift = np.zeros(model.inputs)
    if law is not None:
        shift[: len(law.u0)] = law.u0
    A, B = model.A, model.B
    M, N = np.zeros((size, size)), np.zeros((size, g))
    M[:n], M[n : 2 * n], M[2 * n :] = A @ x + B @ inputs, A @ estimate + B @ inputs, out.Z @ z
    N[:n], N[n : 2 * n] = B @ lift @ noise, (A + B @ lift) @ noise
    N[:n, w] += process
    N[2 * n :, d] = 0.0 if calm else out.E
    W = np.concatenate([B @ lift @ bias, (A + B @ lift) @ bias, np.zeros((many, bias.shape[1]))])
    m0 = np.concatenate([model.c + B @ shift, model.c + B @ shift, np.zeros(many) if calm else out.z0])
    error = (estimate - x, np.zeros(n), noise, bias)
    command = (u, np.zeros(0), np.zeros((0, g)), np.zeros((0, bias.shape[1])))
    if law is not None:
        command = (u, law.u0, law.F @ noise, law.F @ bias)
    return Step(M, m0, N, W, error, command)


def _cut(*sizes: int) -> tuple[slice, ...]:
    ends = np.cumsum([0, *sizes]).tolist()
    return tuple(slice(a, b) for a, b in itertools.pairwise(ends))


def _first(
    model: Model, law: Law | None, out: Outside, first: tuple[Array, Array, Array], place: Scenario, spread: float, at_rest: bool
) -> tuple[Array, Array]:
    """Return centre and generators of s at step 1: the controller has driven step 0 on the prior."""
    (mean, box, _), n = first, model.states
    inputs = np.zeros(model.inputs)
    if law is not None:
        inputs[: len(law.u0)] = law.F @ mean + law.H @ (out.heard @ out.start) + law.u0
    inputs[len(model.actuators) :] = out.known @ out.start
    moved = model.A @ mean + model.B @ inputs + model.c
    process = _noise(place, model, spread)[0]
    generators = np.concatenate([model.A @ box, process], axis=1)
    wide = np.zeros((2 * n + len(out.start), generators.shape[1] + out.E.shape[1]))
    wide[:n, : generators.shape[1]] = generators
    wide[2 * n :, generators.shape[1] :] = 0.0 if at_rest else out.E
    return np.concatenate([moved, moved, out.Z @ out.start + (0.0 if at_rest else out.z0)]), wide
