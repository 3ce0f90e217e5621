"""Filters of a platoon whose gains follow a covariance that is the same in all episodes at the same step: each car alone, and consensus.

    K_i = M_i C_i' (Sv_i + C_i M_i C_i')^-1          xh_i = xb_i + K_i r_i + Cons_i mean_{j ~ i} (xb_j - xb_i)

Where nothing is missed, covariances depend on the step alone: S^-1, K and Cons of each are computed once, by the plain filter
(`tailgate.fused.platoon_gains`), and stand in the table. Episodes of a block are mostly at the same step, and share them.
"""

import numpy as np

from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from .compiled import formula, phase
from .platoon_filter import WORK, product, score, score_one, update, update_one
from .platoon_rows import ARRIVED, BELIEF, SCORE, SENSORS, VALID
from .rows import LANES, K

_BELIEF, _W = int(BELIEF), SENSORS * SENSORS


@formula
def at_step(s, f, i):
    """Where the constants of an episode's step stand."""
    return f[of.IN_W] + min(int(s[K + np.uint64(i)]) - 1, f[of.STEPPED] - 1) * f[of.STEP_WIDE]


@formula
def together(s, n):
    """Whether all episodes of a block are at the same step."""
    apart = 0
    for i in range(n):
        apart += 1 if s[K + i] != s[K] else 0
    return apart == 0


@phase
def weigh(s, table, f, n):
    """g_i."""
    each = f[of.STEP_WIDE] // f[of.CARS]
    if together(s, n):
        score(s, table, f, at_step(s, f, 0), each)
        return
    for j in range(f[of.CARS]):
        for i in range(int(n)):
            score_one(s, table, at_step(s, f, i) + j * each, f[of.WORKS] + j * WORK, i)


@phase
def correct(s, window, table, c, f, n):
    """xh_i."""
    each, as_one = f[of.STEP_WIDE] // f[of.CARS], together(s, n)
    if as_one:
        update(s, window, table, c, f, at_step(s, f, 0) + _W, each)
    for j in range(f[of.CARS]):
        for i in range(0 if as_one else int(n)):
            update_one(s, window, table, 1.0, f, at_step(s, f, i) + j * each + _W, j, i)
        if f[of.PULLED] != 0:
            pull(s, table, f, j)
            if as_one:
                _pull_all(s, window, table, f, j, at_step(s, f, 0) + j * each + _W + f[of.STATES] * SENSORS)
            else:
                _pull_each(s, window, table, f, j, n)


@phase
def pull(s, table, f, i):
    """The mean of (xb_j - xb_i) over the others that car i hears, into the rows FORE."""
    whole, line = table.view(np.int64), f[of.STATES] * LANES
    first, last, mine = whole[f[of.IN_HEARD] + i], whole[f[of.IN_HEARD] + i + 1], f[of.FUSED] + i * line
    count = alike(float(max(last - first - 1, 1)))
    for e in range(0, line, WIDTH):
        pulled = alike(0.0)
        for k in range(first, last):
            if whole[k] != i:
                pulled = pulled + (get(s, f[of.FUSED] + whole[k] * line + e) - get(s, mine + e))
        put(s, f[of.FORE] + e, pulled / count)


@phase
def _pull_all(s, window, table, f, j, at):
    """xh_j moved by Cons_j times the rows FORE; Cons is the first number times the matrix behind it."""
    states, gain = f[of.STATES], alike(table[at])
    product(table, at + 1, states, states, s, f[of.FORE], 0.0, s, f[of.SENDS])
    for e in range(0, states * LANES, WIDTH):
        belief = j * f[of.CAR] + _BELIEF + e
        put(window, belief, get(window, belief) + gain * get(s, f[of.SENDS] + e))


@phase
def _pull_each(s, window, table, f, j, n):
    """The same where the episodes are at steps of their own."""
    states, each = f[of.STATES], f[of.STEP_WIDE] // f[of.CARS]
    for i in range(int(n)):
        at = at_step(s, f, i) + j * each + _W + states * SENSORS
        for e in range(states):
            moved, row = 0.0, at + 1 + e * states
            for k in range(states):
                moved += table[row + k] * s[f[of.FORE] + k * LANES + i]
            window[j * f[of.CAR] + _BELIEF + e * LANES + i] += table[at] * moved


@phase
def read(s, window, table, f, n):
    """No filter: what a car reads, and hears that others read, is the state (`tailgate.estimators.raw`); the score is 0."""
    whole = table.view(np.int64)
    for j in range(f[of.CARS]):
        work = s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            work[SCORE + i] = 0.0
    for at in range(f[of.IN_HEARS] + 1, f[of.IN_HEARS] + 1 + 4 * whole[f[of.IN_HEARS]], 4):
        to, column, teller, sensor = whole[at], whole[at + 1], whole[at + 2], whole[at + 3]
        belief = window[to * f[of.CAR] + _BELIEF + column * LANES :]
        told = s[f[of.WORKS] + teller * WORK + sensor * LANES :]
        for i in range(n):
            belief[i] = told[ARRIVED + i] if told[VALID + i] != 0.0 else belief[i]
