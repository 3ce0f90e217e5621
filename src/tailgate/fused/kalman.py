"""The Kalman filter, its detectors and its mitigations as lanes, for three states and the readings of the first two.

    x- = A x + B u + c      P- = A P A' + Q      r = y - C x-      S = C P- C' + R      K = P- C' S^-1
    x = x- + K r            P = P- - K C P-

The same sums in the same order as `tailgate.estimators.kalman` with `tailgate.num.matmul`, which leaves out structural zeros: an entry of
A below is written where A has one. The outlier problem of the robust filter is `tailgate.estimators.robust`.
"""

import math

import numpy as np

from . import constants as of
from .compiled import formula, phase
from .rows import (
    ACCEPT,
    ALARM,
    ARRIVED,
    EGO,
    FORGET,
    LANES,
    LEFT,
    MODE,
    OWN,
    OWN_COV,
    OWN_VAR,
    REJECTED,
    SCORE,
    SENSORS,
    SHUT,
    SUM,
    SUSPECT,
    TARGET,
    VALID,
    P,
    R,
    S,
    U,
    X,
)

_1, _2, _3, _4, _5, _6, _7, _8 = (np.uint64(LANES * i) for i in range(1, 9))  # rows further down


def predicting(rides, tied=False):
    """The phase `predict`: of three states, or also of a fourth that is the known input itself and `rides` in rows of its own.

    Before the step the fourth may be `tied` to the others by a covariance, as in a mixture; after it, it is not.
    """

    @phase
    def predict(s, c, f, n):
        """x- and P-. Entries of A: 1, a01, a02, 1, a12, a22; of the fourth state into0, into1."""
        a01, a02, a12, a22 = c[of.A + 1], c[of.A + 2], c[of.A + 5], c[of.A + 8]
        b0, b1, b2, c0, c1, c2 = c[of.B], c[of.B + 1], c[of.B + 2], c[of.C0], c[of.C0 + 1], c[of.C0 + 2]
        into0, into1 = c[of.OWN_INTO], c[of.OWN_INTO + 1]
        for i in range(n):
            x, v, a = s[X + i], s[X + _1 + i], s[X + _2 + i]
            u = s[EGO + _1 + i] if rides else s[U + i]
            moved, faster = 0.0 + x + a01 * v + a02 * a, 0.0 + v + a12 * a
            if rides:
                moved, faster = moved + into0 * s[OWN + i], faster + into1 * s[OWN + i]
                s[OWN + i] = 0.0 + u
            s[X + i] = moved + (0.0 + b0 * u) + c0
            s[X + _1 + i] = faster + (0.0 + b1 * u) + c1
            s[X + _2 + i] = (0.0 + a22 * a) + (0.0 + b2 * u) + c2
        if f[of.STEADY] != 0:
            return
        q0, q1, q2, q3, q4, q5, q6, q7, q8 = (
            c[of.Q], c[of.Q + 1], c[of.Q + 2], c[of.Q + 3], c[of.Q + 4], c[of.Q + 5], c[of.Q + 6], c[of.Q + 7], c[of.Q + 8],
        )  # fmt: skip
        own_q = c[of.OWN_Q]
        for i in range(n):
            p20, p21, p22 = s[P + _6 + i], s[P + _7 + i], s[P + _8 + i]
            p10, p11, p12 = s[P + _3 + i], s[P + _4 + i], s[P + _5 + i]
            h00, h01, h02 = (
                0.0 + s[P + i] + a01 * p10 + a02 * p20, 0.0 + s[P + _1 + i] + a01 * p11 + a02 * p21,
                0.0 + s[P + _2 + i] + a01 * p12 + a02 * p22,
            )  # A P  # fmt: skip
            h10, h11, h12 = 0.0 + p10 + a12 * p20, 0.0 + p11 + a12 * p21, 0.0 + p12 + a12 * p22
            h20, h21, h22 = 0.0 + a22 * p20, 0.0 + a22 * p21, 0.0 + a22 * p22
            if tied:
                t0, t1, t2 = s[OWN_COV + i], s[OWN_COV + _1 + i], s[OWN_COV + _2 + i]
                h00, h01, h02 = h00 + into0 * t0, h01 + into0 * t1, h02 + into0 * t2
                h10, h11, h12 = h10 + into1 * t0, h11 + into1 * t1, h12 + into1 * t2
            p00, p01 = 0.0 + h00 + a01 * h01 + a02 * h02, 0.0 + h10 + a01 * h11 + a02 * h12  # A (A P)'
            p02, p12 = 0.0 + h20 + a01 * h21 + a02 * h22, 0.0 + h21 + a12 * h22
            p10, p11 = 0.0 + h01 + a12 * h02, 0.0 + h11 + a12 * h12
            if rides:
                h03, h13 = into0 * s[OWN_VAR + i], into1 * s[OWN_VAR + i]
                if tied:
                    h03, h13, h23 = t0 + a01 * t1 + a02 * t2 + h03, t1 + a12 * t2 + h13, a22 * t2
                    p02, p12 = p02 + into0 * h23, p12 + into1 * h23
                p00, p01, p10, p11 = p00 + into0 * h03, p01 + into0 * h13, p10 + into1 * h03, p11 + into1 * h13
                s[OWN_VAR + i] = own_q
            s[P + i], s[P + _1 + i], s[P + _2 + i] = p00 + q0, p01 + q1, p02 + q2
            s[P + _3 + i], s[P + _4 + i], s[P + _5 + i] = p10 + q3, p11 + q4, p12 + q5
            s[P + _6 + i] = (0.0 + a22 * h02) + q6
            s[P + _7 + i] = (0.0 + a22 * h12) + q7
            s[P + _8 + i] = (0.0 + a22 * h22) + q8

    return predict


predict, predict_known, predict_tied = predicting(rides=False), predicting(rides=True), predicting(rides=True, tied=True)


@phase
def innovation(s, c, noise, n):
    """r and S. A reading that is missing has r = 0 and no covariance with the other.

    `noise`: where in c the covariance of the readings begins.
    """
    r00, r01, r10, r11 = c[noise], c[noise + 1], c[noise + 2], c[noise + 3]
    for i in range(n):
        first, second = s[VALID + i] != 0.0, s[VALID + _1 + i] != 0.0
        r0, r1 = s[ARRIVED + i] - (0.0 + s[X + i]), s[ARRIVED + _1 + i] - (0.0 + s[X + _1 + i])
        S01, S10 = (0.0 + s[P + _3 + i]) + r01, (0.0 + s[P + _1 + i]) + r10
        both = first & second
        s[R + i], s[R + _1 + i] = r0 if first else 0.0, r1 if second else 0.0
        s[S + i] = (0.0 + s[P + i]) + r00
        s[S + _1 + i], s[S + _2 + i] = S01 if both else 0.0, S10 if both else 0.0
        s[S + _3 + i] = (0.0 + s[P + _4 + i]) + r11


@formula
def inverse(a, b, d):
    """Entries 00, 01, 11 of the inverse of [[a, b], [., d]]."""
    scale = 1.0 / (a * d - b * b)
    return d * scale, -b * scale, a * scale


@formula
def normalised(r0, r1, a, b, d):
    """g = r' S^-1 r."""
    w00, w01, w11 = inverse(a, b, d)
    return r0 * (w00 * r0 + w01 * r1) + r1 * (w01 * r0 + w11 * r1)


@phase
def detect(s, ring, c, f, n):
    """Score and alarm: `tailgate.estimators.detectors`. The rows of `ring` hold the older sums of a window."""
    detector, threshold = f[of.DETECTOR], c[of.THRESHOLD]
    if detector == of.ALWAYS:
        for i in range(n):
            s[SCORE + i] = 1.0
            s[ALARM + i] = 1.0
        return
    if detector == of.MEWMA:
        weight, limit, exact, again = c[of.WEIGHT], c[of.LIMIT], f[of.EXACT] != 0, f[of.RESET] != 0
        for i in range(n):
            l00 = math.sqrt(s[S + i])
            l10 = s[S + _2 + i] / l00
            l11 = math.sqrt(s[S + _3 + i] - l10 * l10)
            first = s[R + i] / l00
            second = (s[R + _1 + i] - l10 * first) / l11
            z0 = weight * first + (1.0 - weight) * s[SUM + i]
            z1 = weight * second + (1.0 - weight) * s[SUM + _1 + i]
            faded = s[SUM + _2 + i] * ((1.0 - weight) * (1.0 - weight))
            score = (z0 * z0 + z1 * z1) / (limit * (1.0 - faded) if exact else limit)
            clear = (score > threshold) & again
            s[SCORE + i] = score
            s[ALARM + i] = score > threshold
            s[SUM + i], s[SUM + _1 + i], s[SUM + _2 + i] = 0.0 if clear else z0, 0.0 if clear else z1, 1.0 if clear else faded
        return
    for i in range(n):
        s[SCORE + i] = normalised(s[R + i], s[R + _1 + i], s[S + i], s[S + _1 + i], s[S + _3 + i])
    if detector == of.WINDOWED:
        older = f[of.WINDOW] - 1
        for i in range(n):
            g = s[SCORE + i]
            s[SUM + i] = g
            s[SCORE + i] = (ring[np.uint64((older - 1) * LANES) + i] if older > 0 else 0.0) + g
        for j in range(older - 1, 0, -1):
            row, before = np.uint64(j * LANES), np.uint64((j - 1) * LANES)
            for i in range(n):
                ring[row + i] = s[SUM + i] + ring[before + i]
        for i in range(n if older > 0 else np.uint64(0)):
            ring[i] = s[SUM + i]
    elif detector == of.CUSUM:
        drift, again = c[of.DRIFT], f[of.RESET] != 0
        for i in range(n):
            score = np.maximum(0.0, (s[SUM + i] - drift) + s[SCORE + i])
            s[SCORE + i] = score
            s[SUM + i] = 0.0 if (score > threshold) & again else score
    alarms = detector != of.SCORE_ONLY
    for i in range(n):
        s[ALARM + i] = (s[SCORE + i] > threshold) & alarms


@phase
def suspect(s, c, f, n):
    """The sensors that an alarm blames: all, or with the sparse gate the fewest that explain it (`tailgate.estimators.sparse`)."""
    if f[of.DETECTOR] != of.SPARSE:
        for i in range(n):
            s[SUSPECT + i] = s[SUSPECT + _1 + i] = s[ALARM + i]
        return
    fewer = c[of.FEWER]
    for i in range(n):
        r0, r1, a, d = s[R + i], s[R + _1 + i], s[S + i], s[S + _3 + i]
        w00, w01, w11 = inverse(a, s[S + _1 + i], d)
        pull0, pull1 = w00 * r0 + w01 * r1, w01 * r0 + w11 * r1
        first = pull0 * pull0 / w00 >= pull1 * pull1 / w11  # by dropping it g falls more
        left0, left1 = 0.0 if first else r0, r1 if first else 0.0
        both = normalised(left0, left1, a, 0.0, d) > fewer  # nor does the other fit alone
        alarm = s[ALARM + i] != 0.0
        s[SUSPECT + i] = alarm & (first | both)
        s[SUSPECT + _1 + i] = alarm & ((not first) | both)


@phase
def mitigate(s, c, f, n):
    """Which readings to use, whether to forget, and the mode: `tailgate.estimators.mitigations`."""
    kind, latch, after = f[of.MITIGATION], c[of.LATCH], c[of.AFTER]
    for i in range(n):
        s[FORGET + i] = 0.0
    for j in range(SENSORS):
        row = np.uint64(j * LANES)
        if kind == of.ACCEPT_ALL or kind == of.ALWAYS_MODE:
            for i in range(n):
                s[ACCEPT + row + i] = s[VALID + row + i]
        elif kind == of.ACCEPT_HONEST:
            for i in range(n):
                s[ACCEPT + row + i] = (s[VALID + row + i] != 0.0) & (s[TARGET + row + i] == 0.0)
        elif kind == of.ACCEPT_FIRST:
            for i in range(n):
                s[ACCEPT + row + i] = s[VALID + row + i] if s[SHUT + row + i] < after else 0.0
                s[SHUT + row + i] += 1.0
        elif kind == of.GATE_OUT:
            for i in range(n):
                left = latch + 1.0 if s[SUSPECT + row + i] != 0.0 else max(s[SHUT + row + i] - 1.0, 0.0)
                s[SHUT + row + i] = left
                s[ACCEPT + row + i] = (s[VALID + row + i] != 0.0) & (not left > 0.0)
        else:  # REACQUIRE
            for i in range(n):
                valid = s[VALID + row + i] != 0.0
                left = latch + 1.0 if s[SUSPECT + row + i] != 0.0 else max(s[SHUT + row + i] - 1.0, 0.0)
                rejected = s[REJECTED + row + i]
                rejected = (rejected + 1.0 if left > 0.0 else 0.0) if valid else rejected
                due = valid & (rejected > after)
                s[REJECTED + row + i] = 0.0 if due else rejected
                s[ACCEPT + row + i] = valid & ((not left > 0.0) | due)
                s[SHUT + row + i] = 0.0 if due else left
                s[FORGET + i] = 1.0 if due else s[FORGET + i]
    asked, linger = c[of.ASKED], c[of.LINGER]
    if kind == of.ALWAYS_MODE:
        for i in range(n):
            s[MODE + i] = asked
    elif f[of.MODED] != 0:
        for i in range(n):
            left = linger + 1.0 if s[ALARM + i] != 0.0 else max(s[LEFT + i] - 1.0, 0.0)
            s[LEFT + i] = left
            s[MODE + i] = asked if left > 0.0 else 0.0


@phase
def forget(s, c, n):
    """Where it is due the filter believes the next measurement almost entirely. -> whether it is due anywhere."""
    due = 0.0
    for i in range(n):
        due = max(due, s[FORGET + i])
    if due == 0.0:
        return False
    b0, b1, b2 = c[of.BROAD], c[of.BROAD + 1], c[of.BROAD + 2]
    for i in range(n):
        clear = s[FORGET + i] != 0.0
        s[P + i] = b0 if clear else s[P + i]
        s[P + _4 + i] = b1 if clear else s[P + _4 + i]
        s[P + _8 + i] = b2 if clear else s[P + _8 + i]
        s[P + _1 + i] = 0.0 if clear else s[P + _1 + i]
        s[P + _2 + i] = 0.0 if clear else s[P + _2 + i]
        s[P + _3 + i] = 0.0 if clear else s[P + _3 + i]
        s[P + _5 + i] = 0.0 if clear else s[P + _5 + i]
        s[P + _6 + i] = 0.0 if clear else s[P + _6 + i]
        s[P + _7 + i] = 0.0 if clear else s[P + _7 + i]
    return True


@phase
def weigh(s, ring, c, f, n):
    """What is made of the innovation: score, alarm, mode, and which readings the update may use."""
    detect(s, ring, c, f, n)
    suspect(s, c, f, n)
    mitigate(s, c, f, n)
    if f[of.MITIGATION] == of.REACQUIRE and forget(s, c, n):
        innovation(s, c, of.RNOISE, n)


@formula
def _both(r0, r1, s0, s1, h0, h1, S00, S01, S10, S11, w00, w01, w11, best, y0, y1):
    """The candidate of `_pair` with outliers of signs s0, s1 at both sensors, if it is better than the best so far."""
    t0, t1 = s0 * h0, s1 * h1
    b0, b1 = S00 * t0 + S01 * t1, S10 * t0 + S11 * t1
    d0, d1 = t0 - (w00 * b0 + w01 * b1), t1 - (w01 * b0 + w11 * b1)
    b0, b1 = b0 + (S00 * d0 + S01 * d1), b1 + (S10 * d0 + S11 * d1)  # mends the rounding
    least = np.minimum(s0 * (r0 - b0), s1 * (r1 - b1))  # negative where a sign is wrong
    better = least > best
    return np.maximum(least, best), b0 if better else y0, b1 if better else y1


@formula
def believed(r0, r1, S00, S01, S10, S11, lam0, lam1):
    """The part y of the innovation that is believed: `tailgate.estimators.robust.believed`, its candidates tried in its order."""
    w00, w01, w11 = inverse(S00, S01, S11)
    near = (2.0 * abs(w00 * r0 + w01 * r1) <= lam0) & (2.0 * abs(w01 * r0 + w11 * r1) <= lam1)
    h0, h1 = 0.5 * lam0, 0.5 * lam1
    best, y0, y1 = _both(r0, r1, 1.0, 1.0, h0, h1, S00, S01, S10, S11, w00, w01, w11, -np.inf, r0, r1)
    best, y0, y1 = _both(r0, r1, 1.0, -1.0, h0, h1, S00, S01, S10, S11, w00, w01, w11, best, y0, y1)
    best, y0, y1 = _both(r0, r1, -1.0, 1.0, h0, h1, S00, S01, S10, S11, w00, w01, w11, best, y0, y1)
    best, y0, y1 = _both(r0, r1, -1.0, -1.0, h0, h1, S00, S01, S10, S11, w00, w01, w11, best, y0, y1)
    b = w01 * r1
    one = np.minimum(np.maximum(r0, (-h0 - b) / w00), (h0 - b) / w00)
    inside = abs(w01 * one + w11 * r1) <= h1
    y0, y1 = one if inside else y0, r1 if inside else y1
    b = w01 * r0
    one = np.minimum(np.maximum(r1, (-h1 - b) / w11), (h1 - b) / w11)
    inside = abs(w00 * r0 + w01 * one) <= h0
    y0, y1 = r0 if inside else y0, one if inside else y1
    return r0 if near else y0, r1 if near else y1


@phase
def take_out(s, c, f, n):
    """The robust filter's step before the update: sparse outliers leave the innovation."""
    price, per_sigma = c[of.PRICE], f[of.PER_SIGMA] != 0
    for i in range(n):
        a0, a1 = s[ACCEPT + i], s[ACCEPT + _1 + i]
        S00, S01, S10, S11 = s[S + i], s[S + _1 + i] * (a0 * a1), s[S + _2 + i] * (a0 * a1), s[S + _3 + i]
        lam0, lam1 = price / math.sqrt(S00) if per_sigma else price, price / math.sqrt(S11) if per_sigma else price
        y0, y1 = believed(s[R + i] * a0, s[R + _1 + i] * a1, S00, S01, S10, S11, lam0, lam1)
        s[R + i], s[R + _1 + i] = y0, y1


@formula
def _correct(s, i):
    """x, with the accepted readings: the others have no row in C and no covariance in S. -> rows of C P-, columns of K."""
    a0, a1 = s[ACCEPT + i], s[ACCEPT + _1 + i]
    c00, c01, c02 = (0.0 + s[P + i]) * a0, (0.0 + s[P + _1 + i]) * a0, (0.0 + s[P + _2 + i]) * a0
    c10, c11, c12 = (0.0 + s[P + _3 + i]) * a1, (0.0 + s[P + _4 + i]) * a1, (0.0 + s[P + _5 + i]) * a1
    r0, r1 = s[R + i] * a0, s[R + _1 + i] * a1
    w00, w01, w11 = inverse(s[S + i], s[S + _1 + i] * (a0 * a1), s[S + _3 + i])
    k00, k01 = w00 * c00 + w01 * c10, w01 * c00 + w11 * c10
    k10, k11 = w00 * c01 + w01 * c11, w01 * c01 + w11 * c11
    k20, k21 = w00 * c02 + w01 * c12, w01 * c02 + w11 * c12
    s[X + i] += k00 * r0 + k01 * r1
    s[X + _1 + i] += k10 * r0 + k11 * r1
    s[X + _2 + i] += k20 * r0 + k21 * r1
    return (c00, c01, c02), (c10, c11, c12), (k00, k10, k20), (k01, k11, k21)


@phase
def update(s, f, n):
    """x and P."""
    if f[of.STEADY] != 0:
        for i in range(n):
            _correct(s, i)
        return
    for i in range(n):
        (c00, c01, c02), (c10, c11, c12), (k00, k10, k20), (k01, k11, k21) = _correct(s, i)
        p00, p11, p22 = (
            s[P + i] - (k00 * c00 + k01 * c10), s[P + _4 + i] - (k10 * c01 + k11 * c11), s[P + _8 + i] - (k20 * c02 + k21 * c12),
        )  # fmt: skip
        p01, p10 = s[P + _1 + i] - (k00 * c01 + k01 * c11), s[P + _3 + i] - (k10 * c00 + k11 * c10)
        p02, p20 = s[P + _2 + i] - (k00 * c02 + k01 * c12), s[P + _6 + i] - (k20 * c00 + k21 * c10)
        p12, p21 = s[P + _5 + i] - (k10 * c02 + k11 * c12), s[P + _7 + i] - (k20 * c01 + k21 * c11)
        s[P + i], s[P + _4 + i], s[P + _8 + i] = 0.5 * (p00 + p00), 0.5 * (p11 + p11), 0.5 * (p22 + p22)
        s[P + _1 + i] = s[P + _3 + i] = 0.5 * (p01 + p10)
        s[P + _2 + i] = s[P + _6 + i] = 0.5 * (p02 + p20)
        s[P + _5 + i] = s[P + _7 + i] = 0.5 * (p12 + p21)


@phase
def read(s, n):
    """No filter: what arrives is the estimate of the states that it reads, the others keep their prior (`tailgate.estimators.raw`)."""
    for i in range(n):
        s[X + i] = s[ARRIVED + i] if s[VALID + i] != 0.0 else s[X + i]
        s[X + _1 + i] = s[ARRIVED + _1 + i] if s[VALID + _1 + i] != 0.0 else s[X + _1 + i]
