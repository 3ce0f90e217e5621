"""The distributed Kalman filter with steady gains as a lane (`tailgate.estimators.distributed`), of eight episodes at a time.

    xb_i = Q_i^-1 / d_i sum_j L_j (A xh_j + B u_j + c)        r_i = y_i - C_i xb_i        xh_i = xb_i + K_i r_i

Sums have the order of `tailgate.lanes`. That one here also takes what is zero changes no bit of it: it begins with +0, and is never -0.
"""

import numpy as np

from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from .compiled import formula, phase
from .platoon_rows import ARRIVED, BELIEF, SCORE, SENSORS, TOLD, VALID, WORK_ROWS, R
from .rows import LANES
from .rows import SCORE as SOUND

WORK = WORK_ROWS * LANES
_SCORE, _VALID, _R, _BELIEF, _TOLD, _ARRIVED = (int(row) for row in (SCORE, VALID, R, BELIEF, TOLD, ARRIVED))
SETS = 1 << SENSORS  # of sensors that are read
_1, _2, _3, _4, _5, _6, _7 = (WIDTH * i for i in range(1, 8))  # a row is eight vectors


@formula
def write(y, v, a, b, c, d, e, f, g, h):
    """A row at v."""
    put(y, v, a)
    put(y, v + _1, b)
    put(y, v + _2, c)
    put(y, v + _3, d)
    put(y, v + _4, e)
    put(y, v + _5, f)
    put(y, v + _6, g)
    put(y, v + _7, h)


@formula
def total(table, entries, line, x, u, begin, y, v):
    """The row of y at v = begin + the sum over a line of entries (`platoon_build.Table.listed`) times rows of x, counted from u."""
    whole = table.view(np.int64)
    first, last, more = whole[entries + 1 + line], whole[entries + 2 + line], whole[entries]
    a = b = c = d = e = f = g = h = alike(begin)
    for k in range(first, last):
        w, o = alike(table[k]), u + whole[k + more]
        a, b, c, d = a + w * get(x, o), b + w * get(x, o + _1), c + w * get(x, o + _2), d + w * get(x, o + _3)
        e, f, g, h = e + w * get(x, o + _4), f + w * get(x, o + _5), g + w * get(x, o + _6), h + w * get(x, o + _7)
    write(y, v, a, b, c, d, e, f, g, h)


@phase
def product(table, at, rows, inner, x, u, begin, y, v):
    """y (rows) at v = the matrix (rows, inner) at a place of the table times x (inner) at u: two rows at a time, for half the way to x.

    Sums begin with `begin`, which is +0, or -0 where the plain loop's begin with their first product.
    """
    for pair in range(0, rows, 2):
        i = min(pair, rows - 2)
        one, two, o = at + i * inner, at + i * inner + inner, u
        a = b = c = d = e = f = g = h = alike(begin)
        A = B = C = D = E = F = G = H = alike(begin)
        for k in range(inner):
            w, z = alike(table[one + k]), alike(table[two + k])
            p, q, r, t = get(x, o), get(x, o + _1), get(x, o + _2), get(x, o + _3)
            a, b, c, d = a + w * p, b + w * q, c + w * r, d + w * t
            A, B, C, D = A + z * p, B + z * q, C + z * r, D + z * t
            p, q, r, t = get(x, o + _4), get(x, o + _5), get(x, o + _6), get(x, o + _7)
            e, f, g, h = e + w * p, f + w * q, g + w * r, h + w * t
            E, F, G, H = E + z * p, F + z * q, G + z * r, H + z * t
            o += LANES
        write(y, v + i * LANES, a, b, c, d, e, f, g, h)
        write(y, v + i * LANES + LANES, A, B, C, D, E, F, G, H)


@phase
def calm(window, f, n):
    """What lanes without an episode believe is zero: else it would die out until no number were normal, which is slow."""
    for j in range(f[of.CARS]):
        for e in range(f[of.STATES] if n < LANES else 0):
            at = j * f[of.CAR] + _BELIEF + e * LANES
            for i in range(int(n), LANES):
                window[at + i] = 0.0


@phase
def predict(s, window, table, f):
    """xb_i: what the cars send, L_j (A xh_j + B u_j + c), summed over those that are heard; or without fusion what each predicts."""
    cars, states, size = f[of.CARS], f[of.STATES], f[of.STATES] * f[of.STATES]
    if f[of.ALONE] != 0:
        for j in range(cars):
            forecast(s, window, table, f, j * f[of.CAR], f[of.FUSED] + j * states * LANES)
        return
    for j in range(cars):
        forecast(s, window, table, f, j * f[of.CAR], f[of.FORE])
        product(table, f[of.IN_L] + j * size, states, states, s, f[of.FORE], 0.0, s, f[of.SENDS] + j * states * LANES)
    for i in range(cars):
        gather(s, table, f, i)
        product(table, f[of.IN_MERGE] + i * size, states, states, s, f[of.FORE], 0.0, s, f[of.FUSED] + i * states * LANES)


@phase
def forecast(s, window, table, f, car, out):
    """A xh_j + B u_j + c into the rows from `out` on. To add a zero changes no bit of a sum that begins with +0."""
    for e in range(f[of.STATES]):
        total(table, f[of.IN_A], e, window, car + _BELIEF, 0.0, s, out + e * LANES)
        b, c = table[f[of.IN_B] + e], table[f[of.IN_C] + e]
        if b != 0.0 or c != 0.0:
            for lane in range(0, LANES, WIDTH):
                at = out + e * LANES + lane
                put(s, at, get(s, at) + (alike(0.0) + alike(b) * get(window, car + _TOLD + lane)) + alike(c))


@phase
def gather(s, table, f, i):
    """The sum of what car i hears into the rows FORE."""
    whole, states = table.view(np.int64), f[of.STATES]
    first, last = whole[f[of.IN_HEARD] + i], whole[f[of.IN_HEARD] + i + 1]
    for e in range(0, states * LANES, LANES):
        o = f[of.SENDS] + e
        a = b = c = d = p = q = g = h = alike(0.0)
        for k in range(first, last):
            z = o + whole[k] * states * LANES
            a, b, c, d = a + get(s, z), b + get(s, z + _1), c + get(s, z + _2), d + get(s, z + _3)
            p, q, g, h = p + get(s, z + _4), q + get(s, z + _5), g + get(s, z + _6), h + get(s, z + _7)
        write(s, f[of.FORE] + e, a, b, c, d, p, q, g, h)


@phase
def innovation(s, table, f, n):
    """r_i, 0 where nothing is read."""
    whole, states = table.view(np.int64), f[of.STATES]
    for i in range(f[of.CARS]):
        work, fused = f[of.WORKS] + i * WORK, f[of.FUSED] + i * states * LANES
        for q in range(SENSORS):
            column = fused + whole[f[of.IN_READS] + i * SENSORS + q] * LANES
            for lane in range(0, LANES, WIDTH):
                y = get(s, work + _ARRIVED + q * LANES + lane)
                put(s, work + _R + q * LANES + lane, y - (alike(0.0) + get(s, column + lane)))
    for h in range(f[of.MISSES]):
        work = f[of.WORKS] + whole[f[of.IN_MISSES] + h] * WORK
        for q in range(SENSORS):
            for i in range(int(n)):
                at = work + _R + q * LANES + i
                s[at] = s[at] if s[work + _VALID + q * LANES + i] != 0.0 else 0.0


@phase
def score(s, table, f, weight, apart):
    """g_i = r' S^-1 r; S^-1 of the first car stands at `weight` of the table, of the others so far apart."""
    for i in range(f[of.CARS]):
        work, w = f[of.WORKS] + i * WORK, weight + i * apart
        for lane in range(0, LANES, WIDTH):
            at = work + _R + lane
            r0, r1, r2 = get(s, at), get(s, at + LANES), get(s, at + 2 * LANES)
            t0 = alike(table[w]) * r0 + alike(table[w + 1]) * r1 + alike(table[w + 2]) * r2
            t1 = alike(table[w + 3]) * r0 + alike(table[w + 4]) * r1 + alike(table[w + 5]) * r2
            t2 = alike(table[w + 6]) * r0 + alike(table[w + 7]) * r1 + alike(table[w + 8]) * r2
            put(s, work + _SCORE + lane, r0 * t0 + r1 * t1 + r2 * t2)


@formula
def _correction(table, k, r0, r1, r2):
    """A row of the gain, at k, times r."""
    return alike(0.0) + alike(table[k]) * r0 + alike(table[k + 1]) * r1 + alike(table[k + 2]) * r2


@phase
def update(s, window, table, c, f, gain, apart):
    """xh_i; the gain of the first car stands at `gain` of the table, of the others so far apart."""
    states, factor = f[of.STATES], alike(c[of.FACTOR])
    plain = c[of.FACTOR] == 1.0
    for i in range(f[of.CARS]):
        r, fused, belief = f[of.WORKS] + i * WORK + _R, f[of.FUSED] + i * states * LANES, i * f[of.CAR] + _BELIEF
        for lane in range(0, LANES, WIDTH):
            r0, r1, r2 = get(s, r + lane), get(s, r + lane + LANES), get(s, r + lane + 2 * LANES)
            k, at = gain + i * apart, lane
            if plain:
                for _ in range(states):
                    put(window, belief + at, get(s, fused + at) + _correction(table, k, r0, r1, r2))
                    k, at = k + SENSORS, at + LANES
            else:
                for _ in range(states):
                    put(window, belief + at, get(s, fused + at) + factor * _correction(table, k, r0, r1, r2))
                    k, at = k + SENSORS, at + LANES


# -- a car and an episode at a time, where not all have the same gain


@formula
def score_one(s, table, w, work, i):
    """g of one car, whose record begins at `work`, in episode i, with the S^-1 at w."""
    r0, r1, r2 = s[work + _R + i], s[work + _R + LANES + i], s[work + _R + 2 * LANES + i]
    t0 = table[w] * r0 + table[w + 1] * r1 + table[w + 2] * r2
    t1 = table[w + 3] * r0 + table[w + 4] * r1 + table[w + 5] * r2
    t2 = table[w + 6] * r0 + table[w + 7] * r1 + table[w + 8] * r2
    s[work + _SCORE + i] = r0 * t0 + r1 * t1 + r2 * t2


@formula
def update_one(s, window, table, factor, f, k, car, i):
    """xh of a car likewise, with the gain at k."""
    work, fused, belief = f[of.WORKS] + car * WORK, f[of.FUSED] + car * f[of.STATES] * LANES + i, car * f[of.CAR] + _BELIEF + i
    r0, r1, r2 = s[work + _R + i], s[work + _R + LANES + i], s[work + _R + 2 * LANES + i]
    for e in range(f[of.STATES]):
        correction = table[k] * r0 + table[k + 1] * r1 + table[k + 2] * r2
        window[belief + e * LANES] = s[fused + e * LANES] + factor * correction
        k += SENSORS


@formula
def read_set(s, work, i):
    """Which sensors of a car are read, as the number of the set."""
    valid = work + _VALID + i
    return int(s[valid]) + 2 * int(s[valid + LANES]) + 4 * int(s[valid + 2 * LANES])


@formula
def _missing(s, f, h, work, i):
    """Where S^-1 and the gain stand with which the sensors that are read weigh alone; 0 where all are read."""
    some = read_set(s, work, i)
    return 0 if some == SETS - 1 else f[of.IN_SOME] + (h * SETS + some) * (SENSORS + f[of.STATES]) * SENSORS


@phase
def score_again(s, table, f, n):
    """g_i again in the episodes in which a car misses a reading."""
    whole = table.view(np.int64)
    for h in range(f[of.MISSES]):
        work = f[of.WORKS] + whole[f[of.IN_MISSES] + h] * WORK
        for i in range(int(n)):
            w = _missing(s, f, h, work, i)
            if w > 0:
                score_one(s, table, w, work, i)


@phase
def update_again(s, window, table, c, f, n):
    """xh_i likewise."""
    whole = table.view(np.int64)
    for h in range(f[of.MISSES]):
        car = whole[f[of.IN_MISSES] + h]
        for i in range(int(n)):
            w = _missing(s, f, h, f[of.WORKS] + car * WORK, i)
            if w > 0:
                update_one(s, window, table, c[of.FACTOR], f, w + SENSORS * SENSORS, car, i)


@phase
def sound(s, window, f):
    """Row SCORE of the episode: a number that is not finite where an estimate or a score is not."""
    for lane in range(0, LANES, WIDTH):
        one = other = third = fourth = alike(0.0)  # sums that wait for themselves
        for i in range(f[of.CARS]):
            at = i * f[of.CAR] + _BELIEF + lane
            one = one + get(s, f[of.WORKS] + i * WORK + _SCORE + lane)
            for _ in range(f[of.STATES] // 4):
                one, other = one + get(window, at), other + get(window, at + LANES)
                third, fourth = third + get(window, at + 2 * LANES), fourth + get(window, at + 3 * LANES)
                at += 4 * LANES
            for _ in range(f[of.STATES] % 4):
                other, at = other + get(window, at), at + LANES
        put(s, int(SOUND) + lane, (one + other) + (third + fourth))
