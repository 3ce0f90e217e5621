"""A safe set as a lane: intervals that hold gap, speed ahead, own speed and acceleration, and the brake that acts on them.

`tailgate.estimators.safe_state` and `reactive_brake`, for a car that knows its command and hears where its leader is. What is remembered
stands in rows of its own, m: the ends of the four intervals, how many readings of the first three have still to pass, and for how many
steps the brake stays armed.
"""

import numpy as np

from tailgate.estimators import reactive_brake
from tailgate.estimators.reactive_brake import ROUNDS
from tailgate.estimators.safe_state import FAR, ROUNDING
from tailgate.kernels import _exp

from . import constants as of
from .compiled import formula, phase
from .rows import (
    ACCEL,
    ACCEPT,
    AHEAD,
    ALARM,
    ARRIVED,
    FASTEST,
    HEARD,
    LANES,
    MISSING,
    MOST,
    PASSED,
    READ,
    SCORE,
    SLOWEST,
    SPAN,
    STOP,
    VALID,
    WAIT,
    WORST,
    U,
    X,
)

sooner, way_until = formula(reactive_brake.sooner), formula(reactive_brake.way_until)
_1, _2, _3 = (np.uint64(LANES * i) for i in range(1, 4))  # rows further down
GAP, LEAD, SPEED = (np.uint64(LANES * i) for i in range(3))  # and of the acceleration, the last
LO, HI, LEFT, ARMED = (np.uint64(LANES * i) for i in (0, 4, 8, 11))
ROWS = 12  # of m


@phase
def begin(m, c, n):
    """Physical limits: nothing is known before the first reading."""
    for j in range(4):
        row, low, high = np.uint64(j * LANES), c[of.BOX_LO + j], c[of.BOX_HI + j]
        for i in range(n):
            m[LO + row + i], m[HI + row + i] = low, high


@phase
def drive(s, m, c, n):
    """The own car one step later: acceleration, way, and speed, before it is read. A car that stands does not reverse."""
    a01, a02, a11, a12, a21, a22 = c[of.A + 1], c[of.A + 2], c[of.A + 4], c[of.A + 5], c[of.A + 7], c[of.A + 8]
    b0, b1, b2, own_way, own_speed = c[of.B], c[of.B + 1], c[of.B + 2], c[of.OWN_WAY], c[of.OWN_SPEED]
    fastest = c[of.BOX_HI + 2]
    for i in range(n):
        u, v0, v1, a0, a1 = s[U + i], m[LO + SPEED + i], m[HI + SPEED + i], m[LO + _3 + i], m[HI + _3 + i]
        speed0, speed1 = (a11 * v0 + a12 * a0 + b1 * u) - own_speed, (a11 * v1 + a12 * a1 + b1 * u) + own_speed
        way0, way1 = (a01 * v0 + a02 * a0 + b0 * u) - own_way, (a01 * v1 + a02 * a1 + b0 * u) + own_way
        accel0, accel1 = a21 * v0 + a22 * a0 + b2 * u, a21 * v1 + a22 * a1 + b2 * u
        accel0 = np.maximum(accel0, 0.0) if speed1 <= 0.0 else accel0
        accel1 = np.maximum(accel1, 0.0) if speed0 <= 0.0 else accel1
        s[PASSED + i], s[PASSED + _1 + i] = way0, np.maximum(way1, 0.0) if speed0 <= 0.0 else way1
        s[ACCEL + i], s[ACCEL + _1 + i] = np.minimum(accel0, accel1), np.maximum(accel0, accel1)
        s[SPAN + i] = np.minimum(np.maximum(speed0, 0.0), fastest)
        s[SPAN + _1 + i] = np.minimum(np.maximum(speed1, 0.0), fastest)
    for i in range(n):
        m[LO + _3 + i], m[HI + _3 + i] = s[ACCEL + i], s[ACCEL + _1 + i]


@phase
def lead(s, m, c, n):
    """The speed of the car ahead one step later, before it is told."""
    low, high, fastest = c[of.AHEAD_LO], c[of.AHEAD_HI], c[of.BOX_HI + 1]
    for i in range(n):
        w0, w1 = m[LO + LEAD + i], m[HI + LEAD + i]
        s[AHEAD + i], s[AHEAD + _1 + i] = w0, w1
        s[SPAN + i] = np.minimum(np.maximum(w0 + low, 0.0), fastest)
        s[SPAN + _1 + i] = np.minimum(np.maximum(w1 + high, 0.0), fastest)


@phase
def close_in(s, m, c, n):
    """The gap one step later, before it is read: a car that stops may do so within the step."""
    half = 0.5 * c[of.DT]
    for i in range(n):
        ahead0, ahead1 = s[AHEAD + i] + m[LO + LEAD + i], s[AHEAD + _1 + i] + m[HI + LEAD + i]
        gap0 = m[LO + GAP + i] + np.maximum(half * ahead0, 0.0) - s[PASSED + _1 + i]
        gap1 = m[HI + GAP + i] + np.maximum(half * ahead1, 0.0) - s[PASSED + i]
        s[SPAN + i] = np.minimum(np.maximum(gap0, -FAR), FAR)
        s[SPAN + _1 + i] = np.minimum(np.maximum(gap1, -FAR), FAR)


@phase
def test(s, m, column, e, recover, n):
    """The reading READ, exact to e, against what is predicted of a column: where it is believed it tightens the interval."""
    for i in range(n):
        lo, hi, y, heard = s[SPAN + i], s[SPAN + _1 + i], s[READ + i], s[HEARD + i] != 0.0
        half = e + 0.5 * (hi - lo)
        ratio = abs(y - 0.5 * (lo + hi)) / np.maximum(half, ROUNDING) if heard else 0.0
        left = m[LEFT + column + i]
        left = np.maximum(left - 1.0, 0.0) if heard else left
        left = recover + 1.0 if ratio > 1.0 + ROUNDING else left
        use = heard & (left == 0.0)
        near0, near1 = np.maximum(lo, y - e) if use else lo, np.minimum(hi, y + e) if use else hi
        lo, hi = np.minimum(near0, near1), np.maximum(near0, near1)  # two that touch may cross by rounding
        doubted = heard & (left != 0.0)
        s[WAIT + i], s[SPAN + i], s[SPAN + _1 + i] = left, lo, hi
        s[WORST + i], s[WORST + _1 + i] = np.minimum(lo, y - e) if doubted else lo, np.maximum(hi, y + e) if doubted else hi
        s[SCORE + i] = np.maximum(s[SCORE + i], ratio)
        s[MISSING + i] = s[MISSING + i] if use else 1.0
    for i in range(n):  # each place by itself, so that the compiler sees that they do not overlap
        m[LEFT + column + i] = s[WAIT + i]
    for i in range(n):
        m[LO + column + i] = s[SPAN + i]
    for i in range(n):
        m[HI + column + i] = s[SPAN + _1 + i]


@phase
def enclose(s, m, c, n):
    """One step of the box, moved, tested and tightened: score, alarm, and the readings that the filter may use."""
    recover = c[of.RECOVER]
    for i in range(n):
        s[SCORE + i] = s[MISSING + i] = 0.0
    drive(s, m, c, n)
    for j in range(3):  # own speed, speed ahead, gap: the gap needs both
        column = SPEED if j == 0 else LEAD if j == 1 else GAP
        if j == 0:
            for i in range(n):
                s[READ + i], s[HEARD + i] = s[ARRIVED + _1 + i], s[VALID + _1 + i]
        elif j == 1:
            lead(s, m, c, n)
            for i in range(n):
                s[READ + i], s[HEARD + i] = s[ARRIVED + _3 + i], 1.0
        else:
            close_in(s, m, c, n)
            for i in range(n):
                s[READ + i], s[HEARD + i] = s[ARRIVED + _2 + i] - s[ARRIVED + i], s[VALID + i]
        test(s, m, column, c[of.ACCURATE + 2 - j], recover, n)
        for i in range(n):  # what the brake goes by: the highest speed, the lowest of the car ahead, the smallest gap
            s[FASTEST + i] = s[WORST + _1 + i] if j == 0 else s[FASTEST + i]
            s[SLOWEST + i] = s[WORST + i] if j == 1 else s[SLOWEST + i]
    for i in range(n):
        s[ALARM + i] = s[SCORE + i] > 1.0 + ROUNDING
        s[ACCEPT + i] = (s[VALID + i] != 0.0) & (m[LEFT + GAP + i] == 0.0)
        s[ACCEPT + _1 + i] = (s[VALID + _1 + i] != 0.0) & (m[LEFT + SPEED + i] == 0.0)


@phase
def inside(s, m, n):
    """The estimated speed within the box: a linear filter that knows of a hard brake would reverse a car that stands."""
    for i in range(n):
        s[X + _1 + i] = np.minimum(np.maximum(s[X + _1 + i], m[LO + SPEED + i]), m[HI + SPEED + i])


@phase
def needed(s, c, n):
    """The smallest safe gap for the worst of the box, into row READ."""
    brake, harder, lag, rho, eased = c[of.HARD], c[of.HARDER], c[of.LAG], c[of.RHO], c[of.EASED]
    off, response, clearance = c[of.OWN_OFF], c[of.RESPONSE], c[of.CLEARANCE]
    speed, above, time, fallen = STOP, STOP + _1, STOP + _2, STOP + _3
    for i in range(n):
        v, a, w = s[FASTEST + i], s[ACCEL + _1 + i] + off, np.maximum(s[SLOWEST + i], 0.0)
        a = a + eased * np.maximum(response - a, 0.0)
        fast = np.maximum(v + np.maximum(a, 0.0) * rho, 0.0)
        s[SPAN + i], s[SPAN + _1 + i] = clearance + 0.5 * rho * (v + fast), w * w / harder
        s[speed + i], s[above + i] = fast, np.maximum(a + brake, 0.0)
        s[time + i] = (fast + s[above + i] * lag) / brake
    for _ in range(ROUNDS):
        for i in range(n):
            s[fallen + i] = _exp(-s[time + i] / lag)
        for i in range(n):
            s[time + i] = sooner(s[time + i], s[fallen + i], s[speed + i], s[above + i], brake, lag)
    for i in range(n):
        s[fallen + i] = _exp(-s[time + i] / lag)
    for i in range(n):
        way = way_until(s[time + i], s[fallen + i], s[speed + i], s[above + i], brake, lag)
        s[READ + i] = s[SPAN + i] + way - s[SPAN + _1 + i]


@phase
def watch(s, m, c, f, n):
    """The largest command: the brake's where the worst of the box is unsafe while a reading is distrusted or missing, or was of late."""
    always, brake, distance, long = f[of.ALWAYS_ARMED] != 0, c[of.HARD], c[of.DISTANCE], c[of.WATCH]
    anyone = 0.0
    for i in range(n):
        s[MOST + i] = np.inf
        anyone = max(anyone, max(s[MISSING + i], m[ARMED + i]))
    if anyone == 0.0 and not always:
        return
    needed(s, c, n)
    for i in range(n):
        gap, missing, armed = s[WORST + i], s[MISSING + i] != 0.0, m[ARMED + i]
        some = always | missing | (armed > 0.0)
        unsafe = (some & (gap < s[READ + i])) | (missing & (gap < distance))
        s[MOST + i] = -brake if unsafe else np.inf
        m[ARMED + i] = long if (s[ALARM + i] != 0.0) | (unsafe & missing) else np.maximum(armed - 1.0, 0.0)


@phase
def hold_back(s, n):
    """The controller's command below that."""
    for i in range(n):
        s[U + i] = np.minimum(s[U + i], s[MOST + i])
