"""What the defences of a network make of an innovation before the update, and the update of those who lack readings.

lasso      sparse attacks are taken out of r (`tailgate.estimators.lasso`)
saturated  r is no longer than gamma standard deviations (`tailgate.estimators.saturated`)
norm       in place of r what a norm of it in place of its square allows, u (`tailgate.estimators.norm_resilient`)

Who lacks readings weighs those that are left by gains of its own, which are computed for eight episodes at a time, as the plain loop does.
"""

import numpy as np

from tailgate import lanes, linear
from tailgate.estimators.robust import LIMITS
from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from .compiled import formula, phase
from .platoon_filter import product
from .platoon_steps import at_step, together
from .rows import ALARM as ANY_ALARM
from .rows import LANES

pivot, pair, ball, turn = (formula(part.py_func) for part in (linear.pivot, linear.pair, linear.ball, linear.turn))
invert, times = phase(lanes._invert.py_func), phase(lanes._times.py_func)
_tolerance, _rounding, _patience, _rounds = LIMITS
_NOTHING = -0.0  # a sum that begins so begins with its first number


def room(q: int, n: int) -> int:
    """Rows that are worked in: S^-1 times r, and behind it matrices of eight episodes, or what a single one is solved in."""
    return q + max(5, -(-(q * q + 2 * q * n) // (LANES // WIDTH)) + -(-(2 * q * (n + q) + 8 * q) // LANES) + 1)


@phase
def weigh(s, table, c, f, n):
    """g_i = r' S^-1 r, and the innovation that is TAKEN."""
    q, stepped = f[of.SENSED], f[of.STEPPED] != 0
    each, apart = f[of.STEP_WIDE] // f[of.CARS], stepped and not together(s, n)
    for j in range(f[of.CARS]):
        r, score = f[of.RESIDUES] + j * q * LANES, f[of.SCORES] + j * LANES
        w = at_step(s, f, 0) + j * each if stepped else f[of.IN_W] + j * q * q
        if apart:
            for i in range(int(n)):
                s[score + i] = _score_one(s, table, at_step(s, f, i) + j * each, r + i, q)
            continue
        product(table, w, q, q, s, r, _NOTHING, s, f[of.ASIDE])
        for lane in range(0, LANES, WIDTH):
            total = alike(_NOTHING)
            for m in range(lane, lane + q * LANES, LANES):
                total = total + get(s, r + m) * get(s, f[of.ASIDE] + m)
            put(s, score + lane, total)
        if f[of.ESTIMATOR] == of.SATURATED:
            _cut(s, c, f, j, n)
        elif f[of.ESTIMATOR] == of.LASSO:
            _price(s, table, f, j, n)
        elif f[of.ESTIMATOR] == of.NORM:
            _bound(s, table, f, j, n)


@formula
def _score_one(s, table, w, r, q):
    """g of one agent in one episode, with the S^-1 at w."""
    total = _NOTHING
    for m in range(q):
        weighed = _NOTHING
        for k in range(q):
            weighed += table[w + m * q + k] * s[r + k * LANES]
        total += s[r + m * LANES] * weighed
    return total


@phase
def _cut(s, c, f, j, n):
    """The innovation of an agent at its length, in units of sqrt(q) standard deviations of what is read."""
    q, gamma = f[of.SENSED], c[of.PRICE]
    score, keep = s[f[of.SCORES] + j * LANES : f[of.SCORES] + (j + 1) * LANES], s[f[of.ASIDE] : f[of.ASIDE] + LANES]
    absent = s[f[of.ABSENT] + j * LANES : f[of.ABSENT] + (j + 1) * LANES]
    for i in range(n):
        count = max(float(q) - (absent[i] if f[of.MISSES] != 0 else 0.0), 1.0)
        keep[i] = gamma / max(np.sqrt(score[i] / count), gamma)
    for m in range(0, q * LANES, LANES):
        at = j * q * LANES + m
        r, taken = s[f[of.RESIDUES] + at : f[of.RESIDUES] + at + LANES], s[f[of.TAKEN] + at : f[of.TAKEN] + at + LANES]
        for i in range(n):
            taken[i] = r[i] * keep[i]


@phase
def _price(s, table, f, j, n):
    """Of an agent, without sparse attacks where there are any; S^-1 r stands ASIDE."""
    q, first, shape = f[of.SENSED], j * f[of.SENSED] * LANES, f[of.IN_SHAPE] + 2 * j * f[of.SENSED]
    for at in range(0, q * LANES, WIDTH):
        put(s, f[of.TAKEN] + first + at, get(s, f[of.RESIDUES] + first + at))
    beyond = s[f[of.ASIDE] + q * LANES : f[of.ASIDE] + (q + 1) * LANES]
    for i in range(n):
        beyond[i] = 0.0
    for m in range(q):
        half, weighed = table[shape + m], s[f[of.ASIDE] + m * LANES : f[of.ASIDE] + (m + 1) * LANES]
        for i in range(n):
            beyond[i] = 1.0 if 2.0 * abs(weighed[i]) > 2.0 * half else beyond[i]
    some = s[f[of.ASIDE] + (q + 1) * LANES :]
    for i in range(int(n)):
        if beyond[i] != 0.0 and (f[of.MISSES] == 0 or s[f[of.ABSENT] + j * LANES + i] == 0.0):
            w = f[of.IN_W] + j * q * q
            _take_out(s, some, table[w : w + q * q], table[f[of.IN_SOME] + j * f[of.IN_SOME_WIDE] :], table[shape : shape + 2 * q], f, j, i)


@formula
def _take_out(s, some, w, S, shape, f, j, i):
    """The innovation of an agent in one episode without sparse attacks, by S^-1; shape: lam / 2 and the variances."""
    q, at = f[of.SENSED], j * f[of.SENSED] * LANES + i
    r, y, half, size = some[:q], some[q : 2 * q], shape[:q], shape[q : 2 * q]
    for m in range(q):
        r[m] = s[f[of.RESIDUES] + at + m * LANES]
    if q == 2:
        both = s[f[of.VALIDS] + at] * s[f[of.VALIDS] + at + LANES]
        y[0], y[1] = pair(r[0], r[1], half[0], half[1], S[0], S[1] * both, S[2] * both, S[3], w[0], w[1], w[2], w[3])
        left = 0
    else:
        left = pivot(
            q, r, w, half, size, (_tolerance, _rounding, _patience, _rounds), y, some[2 * q : 3 * q], some[3 * q : 4 * q],
            some[4 * q : 5 * q], some[5 * q : 6 * q], some[6 * q : 6 * q + q * q],
        )  # fmt: skip
    for m in range(q):
        s[f[of.TAKEN] + at + m * LANES] = y[m] if left == 0 else np.nan


@phase
def _bound(s, table, f, j, n):
    """Of an agent, the dual u; of its shape there are the axes' turn and lam times half their lengths."""
    q, first, shape = f[of.SENSED], j * f[of.SENSED] * LANES, f[of.IN_SHAPE] + j * (f[of.SENSED] + 1) * f[of.SENSED]
    product(table, shape, q, q, s, f[of.RESIDUES] + first, 0.0, s, f[of.ASIDE])
    w, half, at = s[f[of.ASIDE] : f[of.ASIDE] + q * LANES], table[shape + q * q : shape + q * q + q], f[of.ASIDE] + q * LANES
    mu, size, on = s[at : at + LANES], s[at + LANES : at + 2 * LANES], s[at + 2 * LANES : at + 3 * LANES]
    _into_ball(w, half, mu, size, on, s[at + 3 * LANES : at + 4 * LANES], s[at + 4 * LANES : at + 5 * LANES], n)
    for m in range(q):
        x, c, u = w[m * LANES : (m + 1) * LANES], half[m], s[f[of.TAKEN] + first + m * LANES : f[of.TAKEN] + first + (m + 1) * LANES]
        for i in range(n):
            u[i] = x[i] / (c + mu[i]) / size[i] if x[i] != 0.0 else 0.0


@phase
def _into_ball(w, half, mu, size, on, one, other, n):
    """`linear.ball` of rows w, of all episodes at once: mu and the length; each takes as many rounds as it does alone."""
    beyond, rounds, largest = 0, 0, 0.0
    for i in range(n):
        mu[i] = one[i] = other[i] = 0.0
    for m in range(len(half)):
        x, c = w[m * LANES : (m + 1) * LANES], half[m]
        largest = max(largest, c)
        for i in range(n):
            share = x[i] / c if x[i] != 0.0 else 0.0
            mu[i], one[i], other[i] = max(mu[i], abs(x[i]) - c), one[i] + x[i] * x[i], other[i] + share * share
    for i in range(n):
        outside, least = other[i] > 1.0, max(mu[i], np.sqrt(one[i]) - largest)
        mu[i], size[i], on[i] = least if outside else 0.0, 1.0, 1.0 if outside else 0.0
        beyond += 1 if outside else 0
    while beyond > 0 and rounds < 100:
        for i in range(n):
            one[i] = other[i] = 0.0
        for m in range(len(half)):
            x, c = w[m * LANES : (m + 1) * LANES], half[m]
            for i in range(n):
                z = x[i] / (c + mu[i]) if x[i] != 0.0 else 0.0
                one[i], other[i] = one[i] + z * z, other[i] + (z * z / (c + mu[i]) if z != 0.0 else 0.0)
        beyond, rounds = 0, rounds + 1
        for i in range(n):
            length, searches = np.sqrt(one[i]), on[i] != 0.0
            step = one[i] * (length - 1.0) / other[i]
            goes = searches & (step > 1e-15 * mu[i])
            size[i], mu[i], on[i] = length if searches else size[i], mu[i] + step if goes else mu[i], 1.0 if goes else 0.0
            beyond += 1 if goes else 0


# -- who lacks readings


@phase
def again(s, window, table, c, f, n):
    """Score and estimate again of eight episodes at a time in which an agent lacks a reading."""
    whole = table.view(np.int64)
    for h in range(f[of.MISSES]):
        j = whole[f[of.IN_MISSES] + h]
        for lane in range(0, LANES, WIDTH):
            absent = 0.0
            for i in range(lane, lane + WIDTH):
                absent += s[f[of.ABSENT] + j * LANES + i]
            if absent > 0.0:
                _weigh_again(s, table, f, j, lane)
                if f[of.ESTIMATOR] == of.NORM:
                    _bound_again(s, window, table, c, f, j, lane, n)
                else:
                    _take_again(s, table, c, f, j, lane, n)
                    _update_again(s, window, table, f, j, lane)


@phase
def _weigh_again(s, table, f, j, lane):
    """S^-1 of the readings that are left, behind the rows ASIDE that S^-1 r takes, and the score."""
    q, S, r = f[of.SENSED], f[of.IN_SOME] + j * f[of.IN_SOME_WIDE], f[of.RESIDUES] + j * f[of.SENSED] * LANES + lane
    valid, w = f[of.VALIDS] + j * q * LANES + lane, f[of.ASIDE] + q * LANES
    for m in range(q):
        for k in range(q):
            both = get(s, valid + m * LANES) * get(s, valid + k * LANES)
            put(s, w + (m * q + k) * WIDTH, alike(table[S + m * q + k]) * both if m != k else alike(table[S + m * q + m]))
    invert(s, w, q)
    total = alike(_NOTHING)
    for m in range(q):
        weighed = alike(_NOTHING)
        for k in range(q):
            weighed = weighed + get(s, w + (m * q + k) * WIDTH) * get(s, r + k * LANES)
        put(s, f[of.ASIDE] + m * LANES + lane, weighed)
        total = total + get(s, r + m * LANES) * weighed
    put(s, f[of.SCORES] + j * LANES + lane, total)


@phase
def _take_again(s, table, c, f, j, lane, n):
    """The innovation that is TAKEN of the readings that are left."""
    q, shape = f[of.SENSED], f[of.IN_SHAPE] + 2 * j * f[of.SENSED]
    some = s[f[of.ASIDE] + q * LANES + (q * q + 2 * q * f[of.STATES]) * WIDTH :]
    for i in range(lane, min(lane + WIDTH, int(n)) if f[of.ESTIMATOR] != of.LINEAR else lane):
        if s[f[of.ABSENT] + j * LANES + i] > 0.0:
            at = j * q * LANES + i
            beyond, count = False, max(float(q) - s[f[of.ABSENT] + j * LANES + i], 1.0)
            keep = c[of.PRICE] / max(np.sqrt(s[f[of.SCORES] + j * LANES + i] / count), c[of.PRICE])
            for m in range(q):
                r = s[f[of.RESIDUES] + at + m * LANES]
                s[f[of.TAKEN] + at + m * LANES] = r * keep if f[of.ESTIMATOR] == of.SATURATED else r
                beyond |= 2.0 * abs(s[f[of.ASIDE] + m * LANES + i]) > 2.0 * table[shape + m] if f[of.ESTIMATOR] == of.LASSO else False
            if beyond:
                w = some[6 * q + q * q : 6 * q + 2 * q * q]
                for m in range(q * q):
                    w[m] = s[f[of.ASIDE] + q * LANES + m * WIDTH + i - lane]
                _take_out(s, some, w, table[f[of.IN_SOME] + j * f[of.IN_SOME_WIDE] :], table[shape : shape + 2 * q], f, j, i)


@phase
def _update_again(s, window, table, f, j, lane):
    """xh_j by the gain of the readings that are left."""
    q, states, w = f[of.SENSED], f[of.STATES], f[of.ASIDE] + f[of.SENSED] * LANES
    cross, gain = w + q * q * WIDTH, w + (q * q + q * states) * WIDTH
    known, valid = f[of.IN_SOME] + j * f[of.IN_SOME_WIDE] + q * q, f[of.VALIDS] + j * q * LANES + lane
    for m in range(q):
        keep = get(s, valid + m * LANES)
        for e in range(states):
            put(s, cross + (m * states + e) * WIDTH, alike(table[known + m * states + e]) * keep)
    times(s, w, s, cross, q, q, states, s, gain)
    for e in range(states):
        correction = alike(_NOTHING)
        for m in range(q):
            correction = correction + get(s, gain + (m * states + e) * WIDTH) * get(s, f[of.TAKEN] + (j * q + m) * LANES + lane)
        at = (j * states + e) * LANES + lane
        put(window, f[of.BELIEFS] + at, get(s, f[of.FUSED] + at) + correction)


@phase
def _bound_again(s, window, table, c, f, j, lane, n):
    """xh_j of the norm's problem with the readings that are left, whose axes are found anew."""
    q, states = f[of.SENSED], f[of.STATES]
    wide, known = q + states, f[of.IN_SOME] + j * f[of.IN_SOME_WIDE] + q * q + q * states
    white, spread = known + q * states, known + q * states + q
    some = s[f[of.ASIDE] + q * LANES + (q * q + 2 * q * states) * WIDTH :]
    both, r, w, half, u = some[: q * wide], some[q * wide :], some[q * wide + q :], some[q * wide + 2 * q :], some[q * wide + 3 * q :]
    for i in range(lane, min(lane + WIDTH, int(n))):
        if s[f[of.ABSENT] + j * LANES + i] == 0.0:
            continue
        left = 0  # those that are missing neither turn nor push
        for m in range(q):
            r[m] = s[f[of.RESIDUES] + (j * q + m) * LANES + i]
            if s[f[of.VALIDS] + (j * q + m) * LANES + i] != 0.0:
                for e in range(states):
                    both[left * wide + e] = table[known + m * states + e]
                for k in range(q):
                    both[left * wide + states + k] = table[white + m] if k == m else 0.0
                left += 1
        turn(both, left, wide, states)
        for m in range(left):
            w[m] = half[m] = 0.0
            for k in range(q):
                w[m] += both[m * wide + states + k] * r[k]
            for e in range(states):
                half[m] += both[m * wide + e] * both[m * wide + e]
            half[m] = c[of.FACTOR] * (0.5 * half[m])
        ball(left, w, half, u)
        for e in range(states):
            moved = 0.0
            for m in range(left):
                push = _NOTHING
                for k in range(states):
                    push += both[m * wide + k] * table[spread + k * states + e]
                moved += 0.5 * push * u[m]
            at = (j * states + e) * LANES + i
            window[f[of.BELIEFS] + at] = s[f[of.FUSED] + at] + c[of.FACTOR] * moved


@phase
def alarm(s, c, f, n):
    """Where the score is above the threshold, or always."""
    threshold, always = c[of.THRESHOLD], f[of.DETECTOR] == of.ALWAYS
    for i in range(n):
        s[ANY_ALARM + i] = 0.0
    for j in range(f[of.CARS]):
        score = s[f[of.SCORES] + j * LANES : f[of.SCORES] + (j + 1) * LANES]
        alarms = s[f[of.ALARMS] + j * LANES : f[of.ALARMS] + (j + 1) * LANES]
        for i in range(n):
            score[i] = 1.0 if always else score[i]
            alarms[i] = 1.0 if (score[i] > threshold) | always else 0.0
            s[ANY_ALARM + i] = max(s[ANY_ALARM + i], alarms[i])
