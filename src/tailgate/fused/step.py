"""A step of car following from its lanes: the same order as `tailgate.loop.Loop`, one compiled function for blocks of LANES episodes.

start     the prior, the first command, the first move, the first measurement
advance   channel -> defence -> controller -> channel -> plant -> measurement
"""

import numpy as np

from tailgate.draws import Role

from . import channel, imm, kalman, monitor, road
from . import constants as of
from .compiled import phase
from .rows import (
    ALARM,
    ARRIVED,
    BURST,
    COOLDOWN,
    DRAW,
    EGO,
    ELAPSED,
    ENDED,
    FRESH,
    HELD,
    KIND,
    LANES,
    LEAD_V,
    LEAD_X,
    LEFT,
    LENGTH,
    LINKS,
    MODE,
    OPENED,
    REAR_V,
    REAR_X,
    REJECTED,
    SCORE,
    SEEN,
    SENSORS,
    SENT,
    SHUT,
    STEP,
    SUM,
    TARGET,
    USED,
    VALUE,
    WAY,
    WIRES,
    WORLD_KEY,
    K,
    P,
    U,
    X,
)

_1, _2 = np.uint64(LANES), np.uint64(2 * LANES)
_PRIOR, _PROCESS, _SENSOR, _WAY = (np.uint64(int(role) << 16) for role in (Role.PRIOR, Role.PROCESS, Role.SENSOR, Role.MANOEUVRE))
_PRIOR_STEP = np.uint64(0xFFFFFFFF)  # the step under which an episode's start draws
_MESSAGE = ARRIVED + _2  # the leader's, as it arrived


@phase
def move_and_measure(s, g, intent, c, f, table, tick, n):
    """The rest of a step after the command is applied; leaves k one higher."""
    road.way(s, g, c, f, table, _WAY, n)
    road.move(s, g, intent, c, f, _PROCESS, tick, n)
    road.next_step(s, g, n)
    road.measure(s, g, c, f, _SENSOR, n)


@phase
def clear(s, g, window, intent, c, n):
    """What is zero before the first step, and the leader."""
    for i in range(n):
        g[STEP + i] = _PRIOR_STEP
        s[K + i] = s[ENDED + i] = s[LEFT + i] = s[SCORE + i] = s[ALARM + i] = s[MODE + i] = 0.0
        s[USED + i] = s[BURST + i] = s[COOLDOWN + i] = s[KIND + i] = 0.0
        s[LENGTH + i] = s[OPENED + i] = s[ELAPSED + i] = 0.0
        s[SEEN + i] = -np.inf
        s[LEAD_X + i], s[LEAD_V + i] = c[of.LEAD_START], c[of.LEAD_START + 1]
        s[SUM + i], s[SUM + _1 + i], s[SUM + _2 + i] = 0.0, 0.0, 1.0
    for j in range(SENSORS):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[SHUT + row + i] = s[REJECTED + row + i] = 0.0
    for j in range(len(window) // LANES):
        row = np.uint64(j * LANES)
        for i in range(n):
            window[row + i] = 0.0
    for j in range(len(intent) // LANES):
        row = np.uint64(j * LANES)
        for i in range(n):
            intent[row + i] = 0.0


@phase
def start(s, g, window, intent, c, f, table, tick, n):
    """Fresh episodes at k = 1, measured: keys and episode numbers stand in g."""
    clear(s, g, window, intent, c, n)
    road.four_normals(s, g, WORLD_KEY, _PRIOR, np.uint64(0), DRAW, n)
    for j in range(3):
        row, at, sd, mean = np.uint64(j * LANES), c[of.START + j], c[of.START_SD + j], c[of.MEAN + j]
        for i in range(n):
            s[EGO + row + i] = at + sd * s[DRAW + row + i]
            s[X + row + i] = mean
    for j in range(9):
        row, var = np.uint64(j * LANES), c[of.PRIOR + j]
        for i in range(n):
            s[P + row + i] = var
    if f[of.MODELED] != 0:
        imm.begin(s, window, c, f[of.MODELED], n)
    elif f[of.BOXED] != 0:
        monitor.begin(window, c, n)
    for i in range(n):
        s[REAR_X + i], s[REAR_V + i] = s[EGO + i] - c[of.REAR_START], c[of.REAR_START + 1]
    begin_way(s, g, c, f, n)
    for i in range(n):
        s[K + i] = 0.0
        g[STEP + i] = np.uint64(0)
        s[SENT + i], s[SENT + _1 + i], s[SENT + _2 + i] = 0.0 + s[X + i], 0.0 + s[X + _1 + i], s[LEAD_X + i]
        s[SENT + _2 + _1 + i] = s[LEAD_V + i]
    road.control(s, SENT + _2, c, n)
    take_hold(s, n)
    channel.pass_on(s, n)
    move_and_measure(s, g, intent, c, f, table, tick, n)


@phase
def take_hold(s, n):
    """What the channel keeps of the readings that are expected and of the first command, and that nothing is attacked."""
    for j in range(WIRES):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[TARGET + row + i] = s[VALUE + row + i] = 0.0
            s[HELD + row + i] = s[FRESH + row + i] = s[SENT + row + i] if j < LINKS else s[U + i]


@phase
def begin_way(s, g, c, f, n):
    """What the manoeuvre remembers at first."""
    kind, p = f[of.WAY], of.WAY_PARAM
    if kind == of.SINE:
        for i in range(n):
            s[WAY + i], s[WAY + _1 + i] = 1.0, 0.0
    elif kind == of.RANDOM:
        road.normals(s, g, WORLD_KEY, _WAY, np.uint64(0), DRAW, n)
        for i in range(n):
            s[WAY + i], s[WAY + _1 + i] = c[p + 5] * s[DRAW + i], 0.0
    else:
        road.uniforms(s, g, WORLD_KEY, _WAY, np.uint64(0), DRAW, n)
        for i in range(n):
            span = c[p + 4] + (c[p + 5] - c[p + 4]) * s[DRAW + i]
            s[WAY + i], s[WAY + _1 + i] = span if kind == of.BRAKING else 0.0, span


@phase
def advance(s, g, window, intent, c, f, table, tick, asked, n):
    """A step under the command in the rows WANT_*, if any is `asked` for. What a Frame shows stands in the rows afterwards."""
    if asked:
        channel.decide(s, c, n)
        channel.arrive(s, c, n)
    else:
        channel.rest(s, c, n)
    if f[of.RAW] != 0:
        kalman.read(s, n)
    elif f[of.MODELED] != 0:
        imm.step(s, window, c, f, n)
    else:
        kalman.predict(s, c, f, n)
        kalman.innovation(s, c, of.RNOISE, n)
        if f[of.BOXED] != 0:
            monitor.enclose(s, window, c, n)
        else:
            kalman.weigh(s, window, c, f, n)
        if f[of.ROBUST] != 0:
            kalman.take_out(s, c, f, n)
        kalman.update(s, f, n)
        if f[of.BOXED] != 0:
            monitor.inside(s, window, n)
    road.control(s, _MESSAGE, c, n)
    if f[of.BRAKES] != 0:
        monitor.watch(s, window, c, f, n)
        monitor.hold_back(s, n)
    channel.actuate(s, f, n)
    road.remember(s, n)
    move_and_measure(s, g, intent, c, f, table, tick, n)
    road.collide(s, f, n)
