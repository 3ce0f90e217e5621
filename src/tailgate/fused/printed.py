"""Algorithms 1 and 2 of the thesis as they are printed, as a lane: `tailgate.estimators.algorithm2`.

Beside what every defence that challenges remembers (`challenge`), of each reading the weights w, the matrix P and the time in h = [1, t].
While a reading is worked at they stand in the rows of the filter's covariance.
"""

import numpy as np

from tailgate.elementwise import clip
from tailgate.estimators.algorithm2 import UNIT
from tailgate.estimators.predictors import LARGEST

from . import challenge
from . import constants as of
from .compiled import formula, phase
from .rows import ACCEPT, ARRIVED, EGO, FORESEEN, LANES, OWN, SENSORS, VALID, P, R, S, X

_1, _2, _3 = (np.uint64(LANES * i) for i in range(1, 4))
_WIDE = 7  # rows of a reading
_P, _W, _T = P, P + np.uint64(4 * LANES), P + np.uint64(6 * LANES)
ROWS = challenge.REMEMBERED + SENSORS * _WIDE


@formula
def _place(j):
    """Where reading j stands in m."""
    return np.uint64((challenge.REMEMBERED + j * _WIDE) * LANES)


@phase
def _put(s, m, j, n):
    for k in range(_WIDE):
        row, goal = np.uint64(k * LANES), _place(j) + np.uint64(k * LANES)
        for i in range(n):
            m[goal + i] = s[_P + row + i]


@phase
def _take(s, m, j, n):
    for k in range(_WIDE):
        row, source = np.uint64(k * LANES), _place(j) + np.uint64(k * LANES)
        for i in range(n):
            s[_P + row + i] = m[source + i]


@phase
def begin(s, m, c, n):
    """No weights, and P = delta I."""
    delta = c[of.RIDGE]
    for i in range(n):
        s[_P + i], s[_P + _1 + i], s[_P + _2 + i], s[_P + _3 + i] = delta, 0.0, 0.0, delta
        s[_W + i], s[_W + _1 + i], s[_T + i] = 0.0, 0.0, 0.0
    for j in range(SENSORS):
        _put(s, m, j, n)


@formula
def _gain(s, i):
    """g = P h."""
    t = s[_T + i]
    return s[_P + i] * 1.0 + s[_P + _1 + i] * t, s[_P + _2 + i] * 1.0 + s[_P + _3 + i] * t


@phase
def _regress(s, c, j, n):
    """One step of reading j: what it is foreseen to be, r and S, and what is learned of it."""
    down, variance, fading = np.uint64(j * LANES), c[of.RNOISE + 3 * j], c[of.FADING]
    for i in range(n):
        s[_T + i] += 1.0 / UNIT
        g0, g1 = _gain(s, i)
        spread = variance * (1.0 + (1.0 * g0 + s[_T + i] * g1) / fading)
        y = clip(s[_W + i] * 1.0 + s[_W + _1 + i] * s[_T + i], -LARGEST, LARGEST)
        s[FORESEEN + i], s[FORESEEN + _1 + i] = y, spread
    for i in range(n):
        s[R + down + i] = s[ARRIVED + down + i] - (0.0 + s[FORESEEN + i]) if s[VALID + down + i] != 0.0 else 0.0
        s[S + down + down + down + i] = s[FORESEEN + _1 + i]
    for i in range(n):
        accept, t, w0, w1, (g0, g1) = s[ACCEPT + down + i] != 0.0, s[_T + i], s[_W + i], s[_W + _1 + i], _gain(s, i)
        y = (0.0 + s[FORESEEN + i]) + (s[R + down + i] if accept else 0.0)
        by = fading + (g0 * 1.0 + g1 * t)
        j0, j1, e = g0 / by, g1 / by, y - (w0 * 1.0 + w1 * t)
        p00, p01, p10, p11 = s[_P + i], s[_P + _1 + i], s[_P + _2 + i], s[_P + _3 + i]
        w0, w1 = w0 + j0 * e if accept else w0, w1 + j1 * e if accept else w1
        s[_P + i], s[_P + _1 + i] = (p00 - j0 * g0) / fading if accept else p00, (p01 - j0 * g1) / fading if accept else p01
        s[_P + _2 + i], s[_P + _3 + i] = (p10 - j1 * g0) / fading if accept else p10, (p11 - j1 * g1) / fading if accept else p11
        s[_W + i], s[_W + _1 + i] = w0, w1
        s[FORESEEN + i] = w0 * 1.0 + w1 * t
    for i in range(n):
        s[X + down + i] = s[FORESEEN + i]


@phase
def step(s, g, m, c, f, n):
    """One step of the defence."""
    for i in range(n):
        s[OWN + i] = 0.0 + s[EGO + _1 + i]
        s[S + _1 + i] = s[S + _2 + i] = 0.0
    challenge.listen(s, m, c, n)
    challenge.use(s, f, n)
    for j in range(SENSORS):
        _take(s, m, j, n)
        _regress(s, c, j, n)
        _put(s, m, j, n)
    challenge.finish(s, g, c, f, n)
