"""The distributed Kalman filter with steady gains as a lane (`tailgate.estimators.distributed`), of eight episodes at a time.

    xb_i = Q_i^-1 / d_i sum_j L_j (A xh_j + B u_j + c)        r_i = y_i - C_i xb_i        xh_i = xb_i + K_i r_i

Sums have the order of `tailgate.lanes`. That one here also takes what is zero changes no bit of it: it begins with +0, and is never -0.
"""

import numpy as np

from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from .compiled import formula, phase
from .platoon_rows import AIM_ROWS, ARRIVED, BELIEF, SCORE, SENSORS, TOLD, VALID, WORK_ROWS, R
from .rows import LANES
from .rows import SCORE as SOUND

GROUP = 4 * WIDTH  # episodes that a product takes at a time
WORK, AIM = WORK_ROWS * LANES, AIM_ROWS * LANES
_SCORE, _VALID, _R, _BELIEF, _TOLD, _ARRIVED = (int(row) for row in (SCORE, VALID, R, BELIEF, TOLD, ARRIVED))
_READINGS = 1 << SENSORS  # sets of sensors


@formula
def total(table, entries, line, x, u, begin, y, v, lanes):
    """Row v of y = begin + the sum over the entries of a line of a list (`platoon_build.listed`) times rows of x, which begin at u."""
    whole = table.view(np.int64)
    first, last = whole[entries + 1 + line], whole[entries + 2 + line]
    more = whole[entries]
    for lane in range(0, lanes, GROUP):
        a = b = c = d = alike(begin)
        for e in range(first, last):
            w, o = alike(table[e]), u + lane + whole[e + more]
            a, b = a + w * get(x, o), b + w * get(x, o + WIDTH)
            c, d = c + w * get(x, o + 2 * WIDTH), d + w * get(x, o + 3 * WIDTH)
        put(y, v + lane, a)
        put(y, v + lane + WIDTH, b)
        put(y, v + lane + 2 * WIDTH, c)
        put(y, v + lane + 3 * WIDTH, d)


@phase
def product(table, at, rows, inner, x, u, y, v, lanes):
    """y (rows) at v = the matrix (rows, inner) at `at` of the table times x (inner) at u. Two rows at a time: sums wait for themselves."""
    for pair in range(0, rows, 2):
        i = min(pair, rows - 2)
        one, two, to = at + i * inner, at + i * inner + inner, v + i * LANES
        for lane in range(0, lanes, GROUP):
            a = b = c = d = e = f = g = h = alike(0.0)
            o = u + lane
            for k in range(inner):
                w, z = alike(table[one + k]), alike(table[two + k])
                p, q, r, t = get(x, o), get(x, o + WIDTH), get(x, o + 2 * WIDTH), get(x, o + 3 * WIDTH)
                a, b, c, d = a + w * p, b + w * q, c + w * r, d + w * t
                e, f, g, h = e + z * p, f + z * q, g + z * r, h + z * t
                o += LANES
            put(y, to + lane, a)
            put(y, to + lane + WIDTH, b)
            put(y, to + lane + 2 * WIDTH, c)
            put(y, to + lane + 3 * WIDTH, d)
            put(y, to + lane + LANES, e)
            put(y, to + lane + LANES + WIDTH, f)
            put(y, to + lane + LANES + 2 * WIDTH, g)
            put(y, to + lane + LANES + 3 * WIDTH, h)


@phase
def calm(window, f, n, lanes):
    """What lanes without an episode believe is zero: else it would die out until no number were normal, which is slow."""
    for j in range(f[of.CARS]):
        for e in range(f[of.STATES]):
            at = j * f[of.CAR] + _BELIEF + e * LANES
            for i in range(int(n), lanes):
                window[at + i] = 0.0


@phase
def predict(s, window, table, f, lanes):
    """xb_i: what the cars send, L_j (A xh_j + B u_j + c), summed over those that are heard."""
    whole, cars, states = table.view(np.int64), f[of.CARS], f[of.STATES]
    fore, size = f[of.FORE], states * states
    for j in range(cars):
        car = j * f[of.CAR]
        for e in range(states):
            total(table, f[of.IN_A], e, window, car + _BELIEF, 0.0, s, fore + e * LANES, lanes)
            b, c = alike(table[f[of.IN_B] + e]), alike(table[f[of.IN_C] + e])
            for lane in range(0, lanes, WIDTH):
                at = fore + e * LANES + lane
                put(s, at, get(s, at) + (alike(0.0) + b * get(window, car + _TOLD + lane)) + c)
        product(table, f[of.IN_L] + j * size, states, states, s, fore, s, f[of.SENDS] + j * states * LANES, lanes)
    for i in range(cars):
        for e in range(states):
            for lane in range(0, lanes, WIDTH):
                at = e * LANES + lane
                sent = alike(0.0)
                for j in range(cars):
                    if whole[f[of.IN_HEARD] + i * cars + j] != 0:
                        sent = sent + get(s, f[of.SENDS] + j * states * LANES + at)
                put(s, fore + at, sent)
        product(table, f[of.IN_MERGE] + i * size, states, states, s, fore, s, f[of.FUSED] + i * states * LANES, lanes)


@phase
def innovation(s, table, f, n, lanes):
    """r_i, 0 where nothing is read."""
    whole, states = table.view(np.int64), f[of.STATES]
    for i in range(f[of.CARS]):
        work, fused = f[of.WORKS] + i * WORK, f[of.FUSED] + i * states * LANES
        for q in range(SENSORS):
            column = fused + whole[f[of.IN_READS] + i * SENSORS + q] * LANES
            for lane in range(0, lanes, WIDTH):
                y = get(s, work + _ARRIVED + q * LANES + lane)
                put(s, work + _R + q * LANES + lane, y - (alike(0.0) + get(s, column + lane)))
    for h in range(f[of.VICTIMS]):
        work, aim = f[of.WORKS] + whole[f[of.IN_VICTIMS] + h] * WORK, f[of.AIMS] + h * AIM
        for q in range(SENSORS):
            for i in range(int(n)):
                at = work + _R + q * LANES + i
                s[at] = s[at] if s[aim + _VALID + q * LANES + i] != 0.0 else 0.0


@phase
def score(s, table, f, lanes):
    """g_i = r' S^-1 r."""
    for i in range(f[of.CARS]):
        work, w = f[of.WORKS] + i * WORK, f[of.IN_W] + i * SENSORS * SENSORS
        for lane in range(0, lanes, WIDTH):
            at = work + _R + lane
            r0, r1, r2 = get(s, at), get(s, at + LANES), get(s, at + 2 * LANES)
            t0 = alike(table[w]) * r0 + alike(table[w + 1]) * r1 + alike(table[w + 2]) * r2
            t1 = alike(table[w + 3]) * r0 + alike(table[w + 4]) * r1 + alike(table[w + 5]) * r2
            t2 = alike(table[w + 6]) * r0 + alike(table[w + 7]) * r1 + alike(table[w + 8]) * r2
            put(s, work + _SCORE + lane, r0 * t0 + r1 * t1 + r2 * t2)


@phase
def update(s, window, table, f, lanes):
    """xh_i."""
    states = f[of.STATES]
    for i in range(f[of.CARS]):
        r, fused, belief = f[of.WORKS] + i * WORK + _R, f[of.FUSED] + i * states * LANES, i * f[of.CAR] + _BELIEF
        for e in range(states):
            k = f[of.IN_K] + (i * states + e) * SENSORS
            k0, k1, k2 = alike(table[k]), alike(table[k + 1]), alike(table[k + 2])
            for lane in range(0, lanes, WIDTH):
                r0, r1, r2 = get(s, r + lane), get(s, r + lane + LANES), get(s, r + lane + 2 * LANES)
                put(window, belief + e * LANES + lane, get(s, fused + e * LANES + lane) + (alike(0.0) + k0 * r0 + k1 * r1 + k2 * r2))


@phase
def lost(s, window, table, f, n):
    """Score and estimate again in the episodes in which a victim misses a reading: the others weigh as they do alone."""
    whole, states = table.view(np.int64), f[of.STATES]
    wide = (SENSORS + states) * SENSORS  # of S^-1 and of the gain for one set of sensors
    for h in range(f[of.VICTIMS]):
        victim, valid = whole[f[of.IN_VICTIMS] + h], f[of.AIMS] + h * AIM + _VALID
        work, fused, belief = f[of.WORKS] + victim * WORK, f[of.FUSED] + victim * states * LANES, victim * f[of.CAR] + _BELIEF
        for i in range(int(n)):
            some = int(s[valid + i]) + 2 * int(s[valid + LANES + i]) + 4 * int(s[valid + 2 * LANES + i])
            if some == _READINGS - 1:
                continue
            w = f[of.IN_SOME] + (h * _READINGS + some) * wide
            r0, r1, r2 = s[work + _R + i], s[work + _R + LANES + i], s[work + _R + 2 * LANES + i]
            t0 = table[w] * r0 + table[w + 1] * r1 + table[w + 2] * r2
            t1 = table[w + 3] * r0 + table[w + 4] * r1 + table[w + 5] * r2
            t2 = table[w + 6] * r0 + table[w + 7] * r1 + table[w + 8] * r2
            s[work + _SCORE + i] = r0 * t0 + r1 * t1 + r2 * t2
            for e in range(states):
                k = w + (SENSORS + e) * SENSORS
                corrected = table[k] * r0 + table[k + 1] * r1 + table[k + 2] * r2
                window[belief + e * LANES + i] = s[fused + e * LANES + i] + corrected


@phase
def sound(s, window, f, lanes):
    """Row SCORE of the episode: 0, or NaN where an estimate or a score is not finite."""
    for lane in range(0, lanes, WIDTH):
        bad = alike(0.0)
        for i in range(f[of.CARS]):
            bad = bad + alike(0.0) * get(s, f[of.WORKS] + i * WORK + _SCORE + lane)
            for e in range(f[of.STATES]):
                bad = bad + alike(0.0) * get(window, i * f[of.CAR] + _BELIEF + e * LANES + lane)
        put(s, int(SOUND) + lane, bad)
