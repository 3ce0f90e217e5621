"""Set-membership safe states: an interval that holds each quantity, whatever bounded noise and disturbances do (docs/safe-state.md).

For each car a box of gap d, speed w of the car ahead, own speed v and own acceleration a. In each step the dynamics move it. Then every
reading y, accurate to e, is tested by itself against the box P that was predicted:

    w+ in w + [a_min, a_max] dt        d+ in d + (w + w+) dt / 2 - s        |y - mid P| <= e + half P, else an attack

s is the way of the own car in the step: its exact average speed, times dt. With the speed at the end of the step, the box would lose the
truth whenever the car brakes. A reading that passes is intersected with P. After one that fails, the sensor's readings are ignored
until they passed for `recover` seconds in a row. Meanwhile the box grows as the dynamics allow.

Where no message gives w, the gaps do. With h_j = d - j dt w,

    h_{j+1}+ = h_j - s - (j alpha + beta / 2) dt^2,  alpha, beta in [a_min, a_max]        w = (d - h_j) / (j dt)
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Model, NonNegative, Positive, Received, param
from tailgate.core.quantities import Accel
from tailgate.envs.controllers.adaptive_cruise import LEADER
from tailgate.envs.controllers.cacc import V2V
from tailgate.envs.controllers.radar_car import kinematic

GAP, LEAD, SPEED, ACCEL = range(4)  # columns of the box
FAR = 1e4  # limit of a gap that nothing limits [m]
EXACT = 1e-6  # accuracy of values known without noise [m/s]
ROUNDING = 1e-9
BACK = 1.0  # how far back gaps tell the speed of the car ahead [s]
Limits = Annotated[tuple[Accel, Accel], Field(min_length=2, max_length=2)]


class Told(NamedTuple):
    """Readings in the columns of the box: y (B, N, 4), valid (B, N, 4) bool."""

    y: Array
    valid: Array


class Span(NamedTuple):
    """Intervals [lo, hi], elementwise."""

    lo: Array
    hi: Array

    def column(self, i: int) -> "Span":
        return Span(self.lo[..., i], self.hi[..., i])

    def padded(self, by: Array | float) -> "Span":
        return Span(self.lo - by, self.hi + by)

    def within(self, low: float, high: float) -> "Span":
        return Span(np.minimum(np.maximum(self.lo, low), high), np.minimum(np.maximum(self.hi, low), high))


class Road(Protocol):
    """The own car and the gap in one kind of model: columns of its sensors, and how the own car moves in a step."""

    def told(self, received: Received, known_u: Array) -> Told: ...

    def accel(self, box: Span, known_u: Array) -> Span:
        """Return the own acceleration at the end of the step, before it is read."""

    def travel(self, box: Span, after: Span, known_u: Array) -> tuple[Span, Span]:
        """Return the own speed at the end of the step, before it is read, and the own way; `after`: the acceleration then."""


@dataclass(frozen=True, eq=False)
class OwnCommand:
    """A car that knows its command and lag, and hears where its leader is and how fast (car following).

    The box holds the acceleration that the lag gives without a disturbance. The true one is off by at most `off`. This bounds every sum
    |E^(k-j) w_j + ... + E w_(k-1) + w_k|, E the lag's factor in a step, w the disturbance of the acceleration.
    """

    A: Array
    B: Array
    noise: Array  # (3,) bounds of the disturbance of x, v in a step, and 0
    off: float  # [m/s^2]
    lag: float  # [s]

    def told(self, received: Received, known_u: Array) -> Told:
        y, valid = received.y, received.valid
        heard, nothing = received.v2v is not None, num.zeros(y.shape[:2])
        x, w = (received.v2v[..., 0], received.v2v[..., 1]) if received.v2v is not None else (nothing, nothing)
        off = nothing != 0.0
        return Told(num.stack([x - y[..., 0], w, y[..., 1], nothing]), num.stack([valid[..., 0] & heard, ~off & heard, valid[..., 1], off]))

    def _next(self, box: Span, i: int, u: Array) -> Span:
        """Return state i at the end of the step, without the standstill; for the position, the way."""
        v, a, B, A = box.column(SPEED), box.column(ACCEL), self.B[i, 0], self.A[i]
        ends = (A[1] * v_ + A[2] * a_ + B * u for v_, a_ in zip(v, a, strict=True))
        return Span(*ends).padded(self.noise[i] if i == 2 else self.noise[i] + A[2] * self.off)

    def accel(self, box: Span, known_u: Array) -> Span:
        u = known_u[..., 0]
        (v_lo, v_hi), (lo, hi) = self._next(box, 1, u), self._next(box, 2, u)
        return Span(np.where(v_hi <= 0.0, np.maximum(lo, 0.0), lo), np.where(v_lo <= 0.0, np.maximum(hi, 0.0), hi))

    def travel(self, box: Span, after: Span, known_u: Array) -> tuple[Span, Span]:
        u = known_u[..., 0]
        speed, way = self._next(box, 1, u), self._next(box, 0, u)
        return speed, Span(way.lo, np.where(speed.lo <= 0.0, np.maximum(way.hi, 0.0), way.hi))


@dataclass(frozen=True, eq=False)
class OwnAccelerometer:
    """A car of a platoon: it measures gap, speed and acceleration, and its command is not known."""

    dt: float
    follows: Array  # (N,) bool
    limits: tuple[float, float]  # least and largest acceleration
    gust: Array  # (N,) bound of the disturbance of the speed in a step

    def told(self, received: Received, known_u: Array) -> Told:
        (d, v, a), (dv, vv, av) = (tuple(np.moveaxis(each, -1, 0)) for each in (received.y, received.valid))
        return Told(num.stack([d, num.zeros(d.shape), v, a]), num.stack([dv & self.follows, num.zeros(d.shape, bool), vv, av]))

    def accel(self, box: Span, known_u: Array) -> Span:
        shape = box.lo.shape[:2]
        return Span(num.full(shape, self.limits[0]), num.full(shape, self.limits[1]))

    def travel(self, box: Span, after: Span, known_u: Array) -> tuple[Span, Span]:
        """Return speed and way of a lag under a constant command: within the step the acceleration is monotone."""
        v, a = box.column(SPEED), box.column(ACCEL)
        lo, hi = np.minimum(a.lo, after.lo), np.maximum(a.hi, after.hi)
        speed, half = Span(v.lo + self.dt * lo, v.hi + self.dt * hi).padded(self.gust), 0.5 * self.dt * self.dt
        return speed, Span(v.lo * self.dt + half * lo, np.maximum(v.hi * self.dt + half * hi, 0.0))


@dataclass(frozen=True, eq=False)
class OwnOdometry:
    """A car with a radar: it measures gap and relative speed, and knows its own speed."""

    dt: float

    def told(self, received: Received, known_u: Array) -> Told:
        y, valid, v = received.y, received.valid, known_u[..., 0]
        nothing = num.zeros(v.shape)
        known = nothing == 0.0
        return Told(num.stack([y[..., 0], y[..., 1] + v, v, nothing]), num.stack([valid[..., 0], valid[..., 1], known, ~known]))

    def accel(self, box: Span, known_u: Array) -> Span:
        v, w = box.column(SPEED), known_u[..., 0]
        return Span((w - v.hi) / self.dt, (w - v.lo) / self.dt)

    def travel(self, box: Span, after: Span, known_u: Array) -> tuple[Span, Span]:
        v, w = box.column(SPEED), known_u[..., 0]
        return Span(w, w), Span(0.5 * self.dt * (v.lo + w), 0.5 * self.dt * (v.hi + w))


class SetPlan(NamedTuple):
    road: Road
    columns: Array  # (q,) column of each sensor
    accuracy: Array  # (N, 4) e
    loose: Array  # (N,) bound of the gap's disturbance in a step [m]
    gust: Array  # (N,) of the disturbance of the speed ahead [m/s]
    dt: float
    recover: int  # steps
    back: int  # steps of gaps that give the speed ahead; 0 where it is known
    least: Array  # (4,) physical limits
    most: Array


class SetState(NamedTuple):
    """Every leaf has B first."""

    lo: Array  # (B, N, 4)
    hi: Array
    left: Array  # (B, N, 4) int64: readings that have to pass before one is believed; 0: believed
    back_lo: Array  # (B, N, back) of h_1, h_2, ...
    back_hi: Array


class Finding(NamedTuple):
    """The result of a step."""

    box: Span  # (B, N, 4)
    worst: Span  # (B, N, 4) the box and the distrusted readings: where the two disagree, either may be wrong
    score: Array  # (B, N) the largest |y - mid P| / (e + half P); above 1 is an attack
    alarm: Array  # (B, N) bool
    trusted: Array  # (B, N, 4) bool: the column's readings are believed
    missing: Array  # (B, N) bool: a column that has a sensor has no believed reading in this step


@dataclass(frozen=True)
class SafeSet:
    """The box of each car. Bounds that no parameter gives are multiples of the standard deviations of the model's noise."""

    sigmas: Positive = param(4.0, "a sensor is accurate to so many standard deviations; of uniform noise 3^0.5 [-]")
    accuracy: tuple[Positive, ...] | None = param(None, "accuracy e of each sensor [its unit]; none: by sigmas")
    disturbance: NonNegative = param(3.0, "process noise in a step is at most so many sigmas [-]")
    adds_up: Literal["spread", "worst"] = param(
        "spread", "what a lag E makes of it is at most `disturbance` times its sigma in the long run, 1 / (1 - E^2)^0.5; worst: 1 / (1 - E)"
    )
    accel_limits: Limits = param((-9.0, 4.0), "least and largest acceleration of any car [m/s^2]")
    speed_max: Positive = param(60.0, "highest speed of any car [m/s]")
    recover: NonNegative = param(2.0, "time for which a distrusted sensor's readings have to pass before one is believed [s]")

    def __post_init__(self) -> None:
        if not self.accel_limits[0] < 0.0 < self.accel_limits[1]:
            raise InputError("accel_limits", self.accel_limits, "two accelerations, one below and one above 0")

    def limits_of(self, model: Model) -> SetPlan:
        """Return constants for a model. Raise NotApplicable where gap or own speed are neither measured nor known."""
        sd = np.sqrt(np.diagonal(model.R, axis1=1, axis2=2))
        if self.accuracy is not None and len(self.accuracy) != sd.shape[1]:
            raise InputError("accuracy", self.accuracy, f"{sd.shape[1]} bounds, of {', '.join(model.sensors)}")
        e = self.sigmas * sd if self.accuracy is None else np.broadcast_to(np.array(self.accuracy), sd.shape)
        assert model.gap is not None and model.speed is not None
        spread = np.sqrt(model.Q.diagonal()) * self.disturbance
        loose, gust = (num.matvec(np.abs(rows), spread) for rows in (model.gap, model.speed))
        road, columns = self._road(model, spread, gust)
        accuracy, still = np.full((model.agents, 4), np.inf), np.zeros(model.agents)
        accuracy[:, columns] = e
        told = not isinstance(road, OwnAccelerometer)
        if isinstance(road, OwnCommand):
            accuracy[:, LEAD], loose = EXACT, still
        if isinstance(road, OwnOdometry):
            accuracy[:, SPEED] = EXACT
        if not told:  # nobody drives ahead of the first car
            accuracy[~model.followers, GAP] = np.inf
        low, high = self.accel_limits
        least, most = np.array([-FAR, 0.0, 0.0, low]), np.array([FAR, self.speed_max, self.speed_max, high])
        steps, back = round(self.recover / model.dt), 0 if told else max(1, round(BACK / model.dt))
        return SetPlan(road, np.array(columns), accuracy, loose, still if told else gust, model.dt, steps, back, least, most)

    def _road(self, model: Model, spread: Array, gust: Array) -> tuple[Road, tuple[int, ...]]:
        if model.sensors == ("position", "velocity") and model.v2v == LEADER and model.actuators == ("acceleration",):
            tau = -model.dt / float(num.log(model.A[2, 2]))
            E = float(model.A[2, 2])
            off = float(spread[2]) / (1.0 - E if self.adds_up == "worst" else math.sqrt(1.0 - E * E))
            return OwnCommand(model.A, model.B, spread * np.array([1.0, 1.0, 0.0]), off, tau), (GAP, SPEED)
        if model.sensors == ("distance", "velocity", "acceleration") and model.v2v == V2V:
            return OwnAccelerometer(model.dt, model.followers, self.accel_limits, gust), (GAP, SPEED, ACCEL)
        if model.states == 4 and np.array_equal(model.B, kinematic(model.dt)[1]) and np.array_equal(model.C, np.eye(4)[None, :2]):
            return OwnOdometry(model.dt), (GAP, LEAD)
        wanted = "a car that measures a gap, or where it is, and knows or measures its own speed"
        raise NotApplicable("defence safe_state: sensors", list(model.sensors), wanted)

    def widest(self, plan: SetPlan, batch: int) -> SetState:
        """Return the box of physical limits: nothing is known before the first reading."""
        shape = (batch, len(plan.accuracy))
        back = num.full((*shape, plan.back), FAR)
        return SetState(num.full((*shape, 4), plan.least), num.full((*shape, 4), plan.most), num.zeros((*shape, 4), np.int64), -back, back)

    def enclose(self, plan: SetPlan, state: SetState, received: Received, known_u: Array) -> tuple[SetState, Finding]:
        """Move the box by one step, test the readings, and tighten the box by those that pass."""
        told, old, low, high = plan.road.told(received, known_u), Span(state.lo, state.hi), plan.least, plan.most
        left, ratio, box = state.left.copy(order="K"), num.zeros(told.y.shape), [old.column(i) for i in range(4)]

        def read(i: int, predicted: Span) -> None:
            """Test a reading against its prediction, and tighten the column where it is believed."""
            ratio[..., i], left[..., i] = self._tested(plan, told, left[..., i], i, predicted)
            box[i] = _met(predicted, told.y[..., i], plan.accuracy[:, i], told.valid[..., i] & (left[..., i] == 0))

        read(ACCEL, plan.road.accel(old, known_u))
        speed, way = plan.road.travel(old, box[ACCEL], known_u)
        read(SPEED, speed.within(0.0, high[SPEED]))
        w = old.column(LEAD)
        ahead = Span(w.lo + self.accel_limits[0] * plan.dt, w.hi + self.accel_limits[1] * plan.dt).padded(plan.gust)
        read(LEAD, ahead.within(0.0, high[LEAD]))
        d, half, end = old.column(GAP), 0.5 * plan.dt, ahead if plan.back else box[LEAD]  # a car that stops may do so within the step
        gap = Span(d.lo + np.maximum(half * (w.lo + end.lo), 0.0) - way.hi, d.hi + np.maximum(half * (w.hi + end.hi), 0.0) - way.lo)
        gap = gap.padded(plan.loose).within(low[GAP], high[GAP])
        read(GAP, gap)
        back = Span(state.back_lo, state.back_hi)
        if plan.back:
            back = self._looked_back(plan, old, back, way)
            fast = _told_by_gaps(plan, box[GAP], back, box[LEAD])
            lost = fast.lo > fast.hi  # no car moves like this
            if num.some(lost):
                sure = box[LEAD]
                fast, back = Span(np.where(lost, sure.lo, fast.lo), np.where(lost, sure.hi, fast.hi)), _reset(back, lost)
                box[GAP] = Span(np.where(lost, gap.lo, box[GAP].lo), np.where(lost, gap.hi, box[GAP].hi))
                ratio[..., GAP] = np.where(lost, np.maximum(ratio[..., GAP], 1.0 + 2 * ROUNDING), ratio[..., GAP])
                left[..., GAP] = np.where(lost, plan.recover + 1, left[..., GAP])
            box[LEAD] = fast
        out = Span(num.stack([each.lo for each in box]), num.stack([each.hi for each in box]))
        score = np.maximum(np.maximum(ratio[..., 0], ratio[..., 1]), np.maximum(ratio[..., 2], ratio[..., 3]))
        trusted, sensed = left == 0, np.isfinite(plan.accuracy)
        missing = np.asarray((sensed & ~(trusted & told.valid)).any(axis=-1))
        doubted, near = told.valid & ~trusted, Span(told.y, told.y).padded(plan.accuracy)
        worst = Span(np.where(doubted, np.minimum(out.lo, near.lo), out.lo), np.where(doubted, np.maximum(out.hi, near.hi), out.hi))
        return SetState(out.lo, out.hi, left, back.lo, back.hi), Finding(out, worst, score, score > 1.0 + ROUNDING, trusted, missing)

    def _tested(self, plan: SetPlan, told: Told, left: Array, i: int, predicted: Span) -> tuple[Array, Array]:
        """Return |y - mid| / (e + half) (B, N), 0 where nothing was read, and how many readings have still to pass."""
        valid, e = told.valid[..., i], plan.accuracy[:, i]
        half = np.where(np.isfinite(e), e, 0.0) + 0.5 * (predicted.hi - predicted.lo)
        off = np.abs(told.y[..., i] - 0.5 * (predicted.lo + predicted.hi))
        ratio = np.where(valid, off / np.maximum(half, ROUNDING), 0.0)
        waiting = np.where(valid, np.maximum(left - 1, 0), left)
        return ratio, np.where(ratio > 1.0 + ROUNDING, plan.recover + 1, waiting)

    def _looked_back(self, plan: SetPlan, old: Span, back: Span, way: Span) -> Span:
        """Return h_1, h_2, ... after the step: h_0 is the gap before it."""
        j, square = np.arange(plan.back), plan.dt * plan.dt
        lo, hi = np.empty_like(back.lo), np.empty_like(back.hi)
        lo[..., 0], hi[..., 0] = old.lo[..., GAP], old.hi[..., GAP]
        lo[..., 1:], hi[..., 1:] = back.lo[..., :-1], back.hi[..., :-1]
        loose = (plan.loose[:, None] + plan.gust[:, None] * (plan.dt * (j + 1.0)))
        lo = lo - way.hi[..., None] - self.accel_limits[1] * square * (j + 0.5) - loose
        hi = hi - way.lo[..., None] - self.accel_limits[0] * square * (j + 0.5) + loose
        return Span(lo, hi).within(-FAR, FAR)


def _met(predicted: Span, y: Array, e: Array, use: Array) -> Span:
    """Return the prediction, intersected with y +- e where `use` (B, N) holds."""
    lo, hi = np.where(use, np.maximum(predicted.lo, y - e), predicted.lo), np.where(use, np.minimum(predicted.hi, y + e), predicted.hi)
    return Span(np.minimum(lo, hi), np.maximum(lo, hi))  # two that touch may cross by rounding


def _told_by_gaps(plan: SetPlan, gap: Span, back: Span, ahead: Span) -> Span:
    """Return the speed of the car ahead, as far as the gaps give it."""
    j = plan.dt * np.arange(1, plan.back + 1)
    fastest, slowest = (gap.hi[..., None] - back.lo) / j, (gap.lo[..., None] - back.hi) / j
    return Span(np.maximum(ahead.lo, np.max(slowest, axis=-1)), np.minimum(ahead.hi, np.min(fastest, axis=-1)))


def _reset(back: Span, where: Array) -> Span:
    lost = where[..., None]
    return Span(np.where(lost, -FAR, back.lo), np.where(lost, FAR, back.hi))
