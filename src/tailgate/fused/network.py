"""A step of a network from its lanes: the same order as `tailgate.loop.Loop`, for blocks of LANES episodes.

start     the system, what each agent believes, the first move, the first measurement
advance   channel -> distributed filter -> system -> measurement

The window holds the system's state, what each agent sends and believes, and a record for each wire that may be attacked
(`tailgate.fused.wires`); s the rest; the matrices stand in the `table` (`network_build`). As nobody drives, the largest error of an
agent stands in place of a gap.
"""

import numpy as np

from tailgate.draws import Role
from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from . import network_defence as defence
from . import network_filter as filter
from . import road, step, wires
from .compiled import phase
from .platoon_filter import product
from .platoon_road import dealt
from .rows import EGO, ENDED, HIT, LANES, LEAD_X, LENGTH, LIVE, OFF, ON, REAR_HIT, SEEN, STEP, TRUTH, K, X
from .script import SLOW, THRESHOLD, TIME, WHEN

_PRIOR, _PROCESS, _SENSOR = (np.uint64(int(role) << 16) for role in (Role.PRIOR, Role.PROCESS, Role.SENSOR))


@phase
def start(s, g, window, intent, c, f, table, tick, n):
    """Fresh episodes at k = 1, measured: keys and episode numbers stand in g."""
    step.clear(s, g, window, intent, c, n)
    dealt(s, g, _PRIOR, f[of.STATES], True, f, n)
    for e in range(0, f[of.STATES] * LANES, LANES):
        state, z = window[e : e + LANES], s[f[of.DEALT] + e : f[of.DEALT] + e + LANES]
        for i in range(n):
            state[i] = c[of.STATE_SD] * z[i]
        for i in range(int(n), LANES):  # lanes without an episode: what was there would grow, or die out
            state[i] = 0.0
    for i in range(n):
        s[K + i] = 0.0
        g[STEP + i] = np.uint64(0)
    still(s, n)
    wires.take_hold(window, f, table, n)  # of the readings that a guess of zero foresees
    _move_and_measure(s, g, window, c, f, table, n)


@phase
def advance(s, g, window, intent, c, f, table, tick, asked, n):
    """A step under the command in the rows WANT_*, if any is `asked` for. What a Frame shows stands in the rows afterwards."""
    attacked = wires.decide(s, window, c, f, table, asked, n)
    size = f[of.CARS] * f[of.SENSED] * LANES
    for at in range(0, size, WIDTH):
        put(s, f[of.ARRIVALS] + at, get(window, f[of.SENTS] + at))
        put(s, f[of.VALIDS] + at, alike(1.0))
    wires.arrive(s, window, f, table, False, attacked, n)
    filter.predict(s, window, table, f)
    filter.innovation(s, f, table, n)
    defence.weigh(s, table, c, f, n)
    filter.update(s, window, table, c, f, n)
    if f[of.MISSES] != 0:
        defence.again(s, window, table, c, f, n)
    defence.alarm(s, c, f, n)
    filter.sound(s, window, f)
    for at in range(0, f[of.STATES] * LANES, WIDTH):
        put(s, f[of.TRUTHS] + at, get(window, at))
    still(s, n)
    if f[of.ACTIONS] != 0:
        _fooled(s, window, f, n)
    _move_and_measure(s, g, window, c, f, table, n)
    ends(s, n)


@phase
def _move_and_measure(s, g, window, c, f, table, n):
    """The system one step later, and what is read of it; leaves k one higher."""
    states, q = f[of.STATES], f[of.SENSED]
    product(table, f[of.IN_OWN], states, states, window, 0, 0.0, s, f[of.FORE])
    for at in range(0, states * LANES, WIDTH):
        put(window, at, get(s, f[of.FORE] + at))
    if c[of.WALK_SD] != 0.0:
        dealt(s, g, _PROCESS, states, True, f, n)
        _shake(window, 0, s, f[of.DEALT], states, c[of.WALK_SD], n)
    road.next_step(s, g, n)
    for j in range(f[of.CARS]):
        product(table, f[of.IN_MEASURE] + j * q * states, q, states, window, 0, 0.0, window, f[of.SENTS] + j * q * LANES)
    if c[of.READ_SD] != 0.0:
        dealt(s, g, _SENSOR, f[of.CARS] * q, True, f, n)
        _shake(window, f[of.SENTS], s, f[of.DEALT], f[of.CARS] * q, c[of.READ_SD], n)


@phase
def _shake(window, first, s, deal, rows, sd, n):
    """So many rows of the window with noise."""
    for e in range(0, rows * LANES, LANES):
        row, z = window[first + e : first + e + LANES], s[deal + e : deal + e + LANES]
        for i in range(n):
            row[i] += sd * z[i]


@phase
def still(s, n):
    """What a car would have: no gap that it misjudges."""
    for i in range(n):
        s[EGO + i] = s[TRUTH + i] = s[X + i] = 0.0


@phase
def _fooled(s, window, f, n):
    """Row OFF: the largest error of an agent's estimate, its 2-norm."""
    for i in range(n):
        s[OFF + i] = 0.0
    for j in range(f[of.CARS]):
        total = s[f[of.ASIDE] : f[of.ASIDE] + LANES]
        for i in range(n):
            total[i] = 0.0
        for e in range(0, f[of.STATES] * LANES, LANES):
            at = f[of.BELIEFS] + j * f[of.STATES] * LANES + e
            belief, truth = window[at : at + LANES], s[f[of.TRUTHS] + e : f[of.TRUTHS] + e + LANES]
            for i in range(n):
                off = belief[i] - truth[i]
                total[i] += off * off
        for i in range(n):
            s[OFF + i] = max(s[OFF + i], np.sqrt(total[i]))


@phase
def ends(s, n):
    """Nothing collides, and no episode ends before its time."""
    for i in range(n):
        s[LENGTH + i] += 1.0 - s[ENDED + i]
        s[HIT + i] = s[REAR_HIT + i] = 0.0


@phase
def damage(s, n):
    """The largest error of an agent after a step that counts, in place of a gap."""
    for i in range(n):
        s[LEAD_X + i] = s[OFF + i] if s[LIVE + i] != 0.0 else s[LEAD_X + i]


@phase
def scripted(s, g, window, c, f, table, p, n):
    """The command of the script into the rows WANT_*. -> whether there is any. Of the road's triggers one holds where nobody drives."""
    holds = (p[WHEN] == TIME) | ((p[WHEN] == SLOW) & (p[THRESHOLD] > 0.0))
    for i in range(n):
        s[ON + i], s[SEEN + i] = 1.0 if holds else 0.0, 0.0
    return wires.scripted(s, g, c, f, table, p, n)
