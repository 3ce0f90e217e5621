"""What the defences of a platoon make of an innovation before the update: attacks priced, cut, or bounded, a car and an episode at a time.

lasso      sparse attacks are taken out of r (`tailgate.estimators.lasso`)
saturated  r is no longer than gamma standard deviations (`tailgate.estimators.saturated`)
norm       in place of r what a norm of it in place of its square allows, u (`tailgate.estimators.norm_resilient`)
"""

import numpy as np

from tailgate import linear
from tailgate.estimators.robust import LIMITS

from . import constants as of
from .compiled import formula, phase
from .platoon_filter import SETS, WORK, read_set
from .platoon_rows import ALARM, SCORE, SENSORS, R
from .rows import ALARM as ANY_ALARM
from .rows import LANES

pivot, ball = formula(linear.pivot.py_func), formula(linear.ball.py_func)
_R, _SCORE, _Q = int(R), int(SCORE), SENSORS
_tolerance, _rounding, _patience, _rounds = LIMITS
ROOM = 2 * LANES  # numbers to work with


@phase
def alarm(s, c, f, n):
    """Where the score is above the threshold, or always."""
    threshold, always = c[of.THRESHOLD], f[of.DETECTOR] == of.ALWAYS
    for i in range(n):
        s[ANY_ALARM + i] = 0.0
    for j in range(f[of.CARS]):
        work = s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            if always:
                work[SCORE + i] = 1.0
            work[ALARM + i] = 1.0 if (work[SCORE + i] > threshold) | always else 0.0
            s[ANY_ALARM + i] = max(s[ANY_ALARM + i], work[ALARM + i])


@formula
def _misses(table, f, j):
    """Whether a car may miss a reading."""
    whole, found = table.view(np.int64), False
    for h in range(f[of.MISSES]):
        found |= whole[f[of.IN_MISSES] + h] == j
    return found


@phase
def believe(s, table, c, f, n):
    """From the innovation to what the update corrects by, in its place."""
    kind = f[of.ESTIMATOR]
    if kind == of.LINEAR:
        return
    room = s[f[of.DEALT] : f[of.DEALT] + ROOM]
    for j in range(f[of.CARS]):
        work, misses = f[of.WORKS] + j * WORK, _misses(table, f, j)
        for i in range(int(n)):
            some = read_set(s, work, i) if misses else SETS - 1
            at = work + _R + i
            if kind == of.SATURATED:
                count = max((some & 1) + (some >> 1 & 1) + (some >> 2), 1)
                keep = c[of.PRICE] / max(np.sqrt(s[work + _SCORE + i] / count), c[of.PRICE])
                for q in range(_Q):
                    s[at + q * LANES] *= keep
            else:
                for q in range(_Q):
                    room[q] = s[at + q * LANES]
                w = f[of.IN_SHAPE] + (j * SETS + some) * f[of.SHAPE]
                if kind == of.LASSO:
                    _take_out(room, table[w : w + f[of.SHAPE]])
                else:
                    _bound(room, table[w : w + f[of.SHAPE]])
                for q in range(_Q):
                    s[at + q * LANES] = room[q]


@formula
def _take_out(room, shape):
    """r without sparse attacks, in its place; shape: S^-1, lam / 2 and the variances."""
    r, y, w, half, size = room[:_Q], room[8 : 8 + _Q], shape[: _Q * _Q], shape[_Q * _Q : _Q * _Q + _Q], shape[_Q * _Q + _Q :]
    beyond = False
    for q in range(_Q):
        beyond |= 2.0 * abs(w[_Q * q] * r[0] + w[_Q * q + 1] * r[1] + w[_Q * q + 2] * r[2]) > 2.0 * half[q]
    if not beyond:
        return
    left = pivot(
        _Q, r, w, half, size, (_tolerance, _rounding, _patience, _rounds), y, room[16 : 16 + _Q], room[24 : 24 + _Q], room[32 : 32 + _Q],
        room[40 : 40 + _Q], room[48 : 48 + _Q * _Q],
    )  # fmt: skip
    for q in range(_Q):
        r[q] = y[q] if left == 0 else np.nan


@formula
def _bound(room, shape):
    """The dual u in place of r; shape: the axes' turn and lam times half their lengths."""
    r, w, u = room[:_Q], room[8 : 8 + _Q], room[16 : 16 + _Q]
    for q in range(_Q):
        w[q] = 0.0 + shape[_Q * q] * r[0] + shape[_Q * q + 1] * r[1] + shape[_Q * q + 2] * r[2]
    ball(_Q, w, shape[_Q * _Q :], u)
    for q in range(_Q):
        r[q] = u[q]
