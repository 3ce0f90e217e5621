"""The joint regression under a challenge as a lane: `tailgate.estimators.kinematic` in `tailgate.estimators.challenge`.

Beside what every defence that challenges remembers stand two beliefs, the live one and the one at the last challenge that passed. A belief
is the mean and the covariance of the fit, its age, its CUSUMs, and of each step that is kept the two samples and whether they are there.
One at a time stands in the rows of the filter. Of four states the own speed is known exactly, and so has no covariance.
"""

import math

import numpy as np

from tailgate.estimators import kinematic

from . import challenge, kalman
from . import constants as of
from .compiled import formula, phase
from .rows import (
    ACCEPT,
    AGE,
    ARRIVED,
    ASIDE,
    AT_STOP,
    BACK,
    CALM,
    CHANGED,
    CROSS,
    CUSUM,
    FORESEEN,
    FORMER,
    HALTED,
    LANES,
    MOVED,
    OWN,
    OWN_VAR,
    VALID,
    P,
    R,
    S,
    X,
)

stop_time = formula(kinematic.stop_time)
_1, _2, _3, _4, _5, _6, _7, _8 = (np.uint64(LANES * i) for i in range(1, 9))  # rows further down
_FIT = 17  # rows of a belief before its samples: x, P, age, CUSUMs
LIVE, SAFE = 0, 1


def rows(window: int) -> int:
    """How many are remembered, with the samples of so many steps."""
    return challenge.REMEMBERED + 2 * (_FIT + 4 * window)


@formula
def _fit(window, belief):
    """Where a belief begins in m."""
    return np.uint64((challenge.REMEMBERED + belief * (_FIT + 4 * window)) * LANES)


@formula
def _samples(window, belief):
    """Where its samples begin: positions, speeds, and whether there are any of each, the newest first."""
    return np.uint64((challenge.REMEMBERED + belief * (_FIT + 4 * window) + _FIT) * LANES)


@formula
def _row(j):
    """Where the j-th number of a belief stands while it is in the rows of the filter."""
    first = X if j < 3 else P if j < 12 else AGE if j < 13 else CUSUM
    return first + np.uint64((j if j < 3 else j - 3 if j < 12 else j - 12 if j < 13 else j - 13) * LANES)


@phase
def begin(s, m, f, n):
    """Both beliefs are the prior, which stands in the rows of the filter; all else is zero."""
    window = f[of.SAMPLED]
    for i in range(n):
        s[AGE + i] = s[CUSUM + i] = s[CUSUM + _1 + i] = s[CUSUM + _2 + i] = s[CUSUM + _3 + i] = 0.0
    _put(s, m, _fit(window, LIVE), n)
    _put(s, m, _fit(window, SAFE), n)


@phase
def _put(s, m, place, n):
    """The rows of the filter into a belief."""
    for j in range(_FIT):
        row, goal = _row(j), place + np.uint64(j * LANES)
        for i in range(n):
            m[goal + i] = s[row + i]


@phase
def _take(s, m, place, n):
    """A belief into the rows of the filter."""
    for j in range(_FIT):
        row, source = _row(j), place + np.uint64(j * LANES)
        for i in range(n):
            s[row + i] = m[source + i]


@phase
def _shift(s, m, first, window, n):
    """The samples of a belief, seen from where the car is now; of this step there are none yet."""
    for j in range(4 * window - 1, -1, -1):
        row, starts, away = first + np.uint64(j * LANES), j % window == 0, j < window
        if starts:
            for i in range(n):
                m[row + i] = 0.0
        else:
            before = row - np.uint64(LANES)
            for i in range(n):
                s[ASIDE + i] = m[before + i]
            for i in range(n):
                m[row + i] = s[ASIDE + i]
        for i in range(n if away else np.uint64(0)):
            m[row + i] -= s[MOVED + i]


@phase
def _predict(s, m, c, f, belief, n):
    """A belief one step later, in the rows of the filter."""
    window, step = f[of.SAMPLED], c[of.DT]
    _take(s, m, _fit(window, belief), n)
    for i in range(n):
        s[OWN + i], s[OWN_VAR + i] = s[FORMER + i], 0.0
    kalman.predict_known(s, c, f, n)
    for i in range(n):
        s[AGE + i] += step
        s[MOVED + i] = 0.5 * step * (s[FORMER + i] + s[OWN + i])
    _shift(s, m, _samples(window, belief), window, n)


@phase
def _exchange(s, m, window, n):
    """A challenge that fails takes the live belief, in the rows of the filter, back to the safe one; one that passes makes it that."""
    safe = _fit(window, SAFE)
    for j in range(_FIT):
        row, place = _row(j), safe + np.uint64(j * LANES)
        for i in range(n):
            s[ASIDE + i] = m[place + i]
        for i in range(n):
            s[row + i] = s[ASIDE + i] if s[BACK + i] != 0.0 else s[row + i]
        for i in range(n):
            m[place + i] = s[row + i] if s[CALM + i] != 0.0 else s[ASIDE + i]
    for j in range(4 * window):
        one, other = _samples(window, LIVE) + np.uint64(j * LANES), _samples(window, SAFE) + np.uint64(j * LANES)
        for i in range(n):
            s[ASIDE + i] = m[one + i]
        for i in range(n):
            s[ASIDE + _1 + i] = m[other + i]
        for i in range(n):
            m[one + i] = s[ASIDE + _1 + i] if s[BACK + i] != 0.0 else s[ASIDE + i]
        for i in range(n):
            m[other + i] = s[ASIDE + i] if s[CALM + i] != 0.0 else s[ASIDE + _1 + i]


@formula
def _foresee(s, i):
    """The readings that the mean predicts, of a leader that has stopped as they were then; also when it did, and whether."""
    x0, x1, x2, own = s[X + i], s[X + _1 + i], s[X + _2 + i], s[OWN + i]
    speed = x1 + own
    t, moves, stops = stop_time(speed, x2, s[AGE + i]), 0.0 if speed < 0.0 else 1.0, -1.0 if speed < 0.0 else 0.0
    first = x0 + t * x1 + 0.5 * t * t * x2 + t * own
    return first, 0.0 * x0 + moves * x1 + 0.0 * x2 + stops * own, t, moves


@phase
def _innovate(s, c, n):
    """r, S, and C P- with the rows of the present step."""
    r00, r01, r10, r11 = c[of.RNOISE], c[of.RNOISE + 1], c[of.RNOISE + 2], c[of.RNOISE + 3]
    for i in range(n):
        first, second, t, moves = _foresee(s, i)
        s[FORESEEN + i], s[FORESEEN + _1 + i], s[AT_STOP + i], s[HALTED + i] = first, second, t, moves
    for i in range(n):
        t, moves, valid0, valid1 = s[AT_STOP + i], s[HALTED + i], s[VALID + i] != 0.0, s[VALID + _1 + i] != 0.0
        late = 0.5 * t * t
        c00, c01 = s[P + i] + t * s[P + _3 + i] + late * s[P + _6 + i], s[P + _1 + i] + t * s[P + _4 + i] + late * s[P + _7 + i]
        c02 = s[P + _2 + i] + t * s[P + _5 + i] + late * s[P + _8 + i]
        c10, c11, c12 = moves * s[P + _3 + i], moves * s[P + _4 + i], moves * s[P + _5 + i]
        both = valid0 & valid1
        S01, S10 = (c10 + t * c11 + late * c12) + r01, moves * c01 + r10
        s[S + i], s[S + _3 + i] = (c00 + t * c01 + late * c02) + r00, moves * c11 + r11
        s[S + _1 + i], s[S + _2 + i] = S01 if both else 0.0, S10 if both else 0.0
        s[CROSS + i], s[CROSS + _1 + i], s[CROSS + _2 + i] = c00, c01, c02
        s[CROSS + _3 + i], s[CROSS + _4 + i], s[CROSS + _5 + i] = c10, c11, c12
        s[R + i] = s[ARRIVED + i] - s[FORESEEN + i] if valid0 else 0.0
        s[R + _1 + i] = s[ARRIVED + _1 + i] - s[FORESEEN + _1 + i] if valid1 else 0.0


@formula
def _times(l0, l1, l2, a, b, d):
    """l0 a + l1 b + l2 d."""
    return l0 * a + l1 * b + l2 * d


@phase
def _update(s, c, n):
    """x and P in Joseph's form, with the readings in ACCEPT: K and I - K C as in `kinematic`, by entries."""
    r00, r11, fading = c[of.RNOISE], c[of.RNOISE + 3], c[of.FADING]
    for i in range(n):
        a0, a1, t, moves = s[ACCEPT + i] != 0.0, s[ACCEPT + _1 + i] != 0.0, s[AT_STOP + i], s[HALTED + i]
        c00, c01, c02 = s[CROSS + i] if a0 else 0.0, s[CROSS + _1 + i] if a0 else 0.0, s[CROSS + _2 + i] if a0 else 0.0
        c10, c11, c12 = s[CROSS + _3 + i] if a1 else 0.0, s[CROSS + _4 + i] if a1 else 0.0, s[CROSS + _5 + i] if a1 else 0.0
        r0, r1 = s[R + i] if a0 else 0.0, s[R + _1 + i] if a1 else 0.0
        w00, w01, w11 = kalman.inverse(s[S + i], s[S + _1 + i] if a0 & a1 else 0.0, s[S + _3 + i])
        k00, k10, k20 = w00 * c00 + w01 * c10, w00 * c01 + w01 * c11, w00 * c02 + w01 * c12
        k01, k11, k21 = w01 * c00 + w11 * c10, w01 * c01 + w11 * c11, w01 * c02 + w11 * c12
        s[X + i] += k00 * r0 + k01 * r1
        s[X + _1 + i] += k10 * r0 + k11 * r1
        s[X + _2 + i] += k20 * r0 + k21 * r1
        h0, h1, h2, g1 = 1.0 if a0 else 0.0, t if a0 else 0.0, 0.5 * t * t if a0 else 0.0, moves if a1 else 0.0
        l00, l01, l02 = 1.0 - k00 * h0, 0.0 - (k00 * h1 + k01 * g1), 0.0 - k00 * h2
        l10, l11, l12 = 0.0 - k10 * h0, 1.0 - (k10 * h1 + k11 * g1), 0.0 - k10 * h2
        l20, l21, l22 = 0.0 - k20 * h0, 0.0 - (k20 * h1 + k21 * g1), 1.0 - k20 * h2
        p00, p01, p02 = s[P + i], s[P + _1 + i], s[P + _2 + i]
        p10, p11, p12 = s[P + _3 + i], s[P + _4 + i], s[P + _5 + i]
        p20, p21, p22 = s[P + _6 + i], s[P + _7 + i], s[P + _8 + i]
        m00, m01, m02 = _times(l00, l01, l02, p00, p10, p20), _times(l00, l01, l02, p01, p11, p21), _times(l00, l01, l02, p02, p12, p22)
        m10, m11, m12 = _times(l10, l11, l12, p00, p10, p20), _times(l10, l11, l12, p01, p11, p21), _times(l10, l11, l12, p02, p12, p22)
        m20, m21, m22 = _times(l20, l21, l22, p00, p10, p20), _times(l20, l21, l22, p01, p11, p21), _times(l20, l21, l22, p02, p12, p22)
        e00, e01, e02, e10, e11, e12 = r00 * k00, r00 * k10, r00 * k20, r11 * k01, r11 * k11, r11 * k21  # R K'
        p00 = _times(l00, l01, l02, m00, m01, m02) + (k00 * e00 + k01 * e10)
        p01 = _times(l00, l01, l02, m10, m11, m12) + (k00 * e01 + k01 * e11)
        p02 = _times(l00, l01, l02, m20, m21, m22) + (k00 * e02 + k01 * e12)
        p10 = _times(l10, l11, l12, m00, m01, m02) + (k10 * e00 + k11 * e10)
        p11 = _times(l10, l11, l12, m10, m11, m12) + (k10 * e01 + k11 * e11)
        p12 = _times(l10, l11, l12, m20, m21, m22) + (k10 * e02 + k11 * e12)
        p20 = _times(l20, l21, l22, m00, m01, m02) + (k20 * e00 + k21 * e10)
        p21 = _times(l20, l21, l22, m10, m11, m12) + (k20 * e01 + k21 * e11)
        p22 = _times(l20, l21, l22, m20, m21, m22) + (k20 * e02 + k21 * e12)
        by = fading if a0 | a1 else 1.0
        p00, p01, p02, p10, p11 = p00 / by, p01 / by, p02 / by, p10 / by, p11 / by
        p12, p20, p21, p22 = p12 / by, p20 / by, p21 / by, p22 / by
        s[P + i], s[P + _4 + i], s[P + _8 + i] = 0.5 * (p00 + p00), 0.5 * (p11 + p11), 0.5 * (p22 + p22)
        s[P + _1 + i] = s[P + _3 + i] = 0.5 * (p01 + p10)
        s[P + _2 + i] = s[P + _6 + i] = 0.5 * (p02 + p20)
        s[P + _5 + i] = s[P + _7 + i] = 0.5 * (p12 + p21)


@phase
def _sample(s, m, first, window, n):
    """The samples of this step: what is read, or else predicted."""
    for j in range(2):
        row, down = first + np.uint64(j * window * LANES), np.uint64(j * LANES)
        for i in range(n):
            m[row + i] = (s[R + down + i] + s[FORESEEN + down + i]) + (s[OWN + i] if j == 1 else 0.0)
        there = first + np.uint64((2 + j) * window * LANES)
        for i in range(n):
            m[there + i] = s[ACCEPT + down + i]


@phase
def _sum_up(s, c, n):
    """The CUSUMs, and where one of them is too large. -> whether anywhere."""
    surprise, allowance, some = c[of.SURPRISE], c[of.ALLOWANCE], 0
    for i in range(n):
        a0, a1 = s[ACCEPT + i] != 0.0, s[ACCEPT + _1 + i] != 0.0
        z0, z1 = s[R + i] / math.sqrt(s[S + i]) if a0 else 0.0, s[R + _1 + i] / math.sqrt(s[S + _3 + i]) if a1 else 0.0
        up0, up1, down0, down1 = s[CUSUM + i], s[CUSUM + _1 + i], s[CUSUM + _2 + i], s[CUSUM + _3 + i]
        up0, down0 = np.maximum(0.0, up0 + z0 - allowance) if a0 else up0, np.maximum(0.0, down0 + -z0 - allowance) if a0 else down0
        up1, down1 = np.maximum(0.0, up1 + z1 - allowance) if a1 else up1, np.maximum(0.0, down1 + -z1 - allowance) if a1 else down1
        s[CUSUM + i], s[CUSUM + _1 + i], s[CUSUM + _2 + i], s[CUSUM + _3 + i] = up0, up1, down0, down1
        over = (up0 > surprise) | (up1 > surprise) | (down0 > surprise) | (down1 > surprise)
        s[CHANGED + i] = over
        some += 1 if over else 0
    return some > 0


@phase
def _restart(s, m, c, first, window, n):
    """Least squares on the samples kept, where the sums are too large: few episodes, one after the other."""
    dt, ridge, weight0, weight1 = c[of.DT], c[of.RIDGE], c[of.SAMPLE_WEIGHT], c[of.SAMPLE_WEIGHT + 1]
    for i in range(n):
        if s[CHANGED + i] == 0.0:
            continue
        own = s[OWN + i]
        t0, t1, t2 = s[X + i], s[X + _1 + i] + own, s[X + _2 + i]
        m00, m01, m02, m11, m12, m22, b0, b1, b2 = ridge, 0.0, 0.0, ridge, 0.0, ridge, 0.0, 0.0, 0.0
        for j in range(window):
            ago = -dt * j
            h2 = 0.5 * ago * ago
            row = first + np.uint64(j * LANES) + i
            w = weight0 * m[row + np.uint64(2 * window * LANES)]
            off = w * (m[row] - (t0 * 1.0 + t1 * ago + t2 * h2))
            m00, m01, m02 = m00 + w * 1.0, m01 + w * ago, m02 + w * h2
            m11, m12, m22 = m11 + w * (ago * ago), m12 + w * (ago * h2), m22 + w * (h2 * h2)
            b0, b1, b2 = b0 + off, b1 + off * ago, b2 + off * h2
            w = weight1 * m[row + np.uint64(3 * window * LANES)]
            off = w * (m[row + np.uint64(window * LANES)] - (t0 * 0.0 + t1 * 1.0 + t2 * ago))
            m11, m12, m22 = m11 + w * 1.0, m12 + w * ago, m22 + w * (ago * ago)
            b1, b2 = b1 + off, b2 + off * ago
        v00, v01, v02, v10, v11, v12, v20, v21, v22 = _inverse(m00, m01, m02, m11, m12, m22)
        s[X + i] = t0 + (v00 * b0 + v01 * b1 + v02 * b2)
        s[X + _1 + i] = t1 + (v10 * b0 + v11 * b1 + v12 * b2) - own
        s[X + _2 + i] = t2 + (v20 * b0 + v21 * b1 + v22 * b2)
        s[P + i], s[P + _1 + i], s[P + _2 + i] = v00, v01, v02
        s[P + _3 + i], s[P + _4 + i], s[P + _5 + i] = v10, v11, v12
        s[P + _6 + i], s[P + _7 + i], s[P + _8 + i] = v20, v21, v22
        s[AGE + i] = np.minimum(s[AGE + i], dt * (window - 1))
        s[CUSUM + i] = s[CUSUM + _1 + i] = s[CUSUM + _2 + i] = s[CUSUM + _3 + i] = 0.0


@formula
def _inverse(a00, a01, a02, a11, a12, a22):
    """Of a symmetric matrix of three, row by row: `tailgate.linear.invert_each`, step by step."""
    a10, a20, a21 = a01, a02, a12
    scale = 1.0 / a00
    a01, a02, v00 = a01 * scale, a02 * scale, 1.0 * scale
    a11, a12, v10 = a11 - a10 * a01, a12 - a10 * a02, 0.0 - a10 * v00
    a21, a22, v20 = a21 - a20 * a01, a22 - a20 * a02, 0.0 - a20 * v00
    scale = 1.0 / a11
    a12, v10, v11 = a12 * scale, v10 * scale, 1.0 * scale
    a02, v00, v01 = a02 - a01 * a12, v00 - a01 * v10, 0.0 - a01 * v11
    a22, v20, v21 = a22 - a21 * a12, v20 - a21 * v10, 0.0 - a21 * v11
    scale = 1.0 / a22
    v20, v21, v22 = v20 * scale, v21 * scale, 1.0 * scale
    v00, v01, v02 = v00 - a02 * v20, v01 - a02 * v21, 0.0 - a02 * v22
    v10, v11, v12 = v10 - a12 * v20, v11 - a12 * v21, 0.0 - a12 * v22
    return v00, v01, v02, v10, v11, v12, v20, v21, v22


@phase
def _show(s, n):
    """The estimate in place of the belief: a leader that has stopped stands."""
    for i in range(n):
        first, second, _, moves = _foresee(s, i)
        s[X + i], s[X + _1 + i], s[X + _2 + i] = first, second, 0.0 if moves == 0.0 else s[X + _2 + i]


@phase
def step(s, g, m, c, f, n):
    """One step of the defence."""
    window = f[of.SAMPLED]
    for i in range(n):
        s[FORMER + i] = s[OWN + i]
    if f[of.ROLLS_BACK] != 0:
        _predict(s, m, c, f, SAFE, n)
        _put(s, m, _fit(window, SAFE), n)
    _predict(s, m, c, f, LIVE, n)
    if challenge.listen(s, m, c, n) and f[of.ROLLS_BACK] != 0:
        _exchange(s, m, window, n)
    challenge.use(s, f, n)
    _innovate(s, c, n)
    _update(s, c, n)
    _sample(s, m, _samples(window, LIVE), window, n)
    if _sum_up(s, c, n):
        _restart(s, m, c, _samples(window, LIVE), window, n)
    _put(s, m, _fit(window, LIVE), n)
    _show(s, n)
    challenge.finish(s, g, c, f, n)
