"""The road as a lane: manoeuvre, vehicles, driver behind, sensors and cruise control. Every formula is the one that the plain loop uses."""

import numpy as np

from tailgate.envs import controllers, idm, manoeuvres, vehicle
from tailgate.jit import compilable
from tailgate.kernels import _log_normal, _sincos_turn, _uniform_pair

from . import constants as of
from .compiled import formula, phase
from .rows import (
    APPLIED,
    DRAW,
    EGO,
    ENDED,
    EPISODE,
    EXO,
    HIT,
    LANES,
    LEAD_V,
    LEAD_X,
    LENGTH,
    MODE,
    REAR_HIT,
    REAR_V,
    REAR_X,
    SENT,
    STEP,
    TRUTH,
    WAY,
    WORLD_KEY,
    K,
    U,
    X,
)

_1, _2, _3 = (np.uint64(LANES * i) for i in range(1, 4))

drive, roll = formula(vehicle.drive), formula(vehicle.roll)
compilable(idm.idm)  # which idm_accel calls
idm_accel = formula(idm.idm_accel)
spaced, widened, obeyed = formula(controllers.spaced), formula(controllers.widened), formula(controllers.obeyed)
between, halt, drawn_back = formula(manoeuvres.between), formula(manoeuvres.halt), formula(manoeuvres.drawn_back)
phase_over, stop_and_go = formula(manoeuvres.phase_over), formula(manoeuvres.stop_and_go)


@phase
def uniforms(s, g, key, stream, block, out, n):
    """Two uniforms on (0, 1) for each episode, elements 2 block and 2 block + 1 of its draw, into the row `out` and the next."""
    for i in range(n):
        s[out + i], s[out + _1 + i] = _uniform_pair(g[key + i], g[EPISODE + i], g[STEP + i], stream, block)


@formula
def _radius(u):
    """How far two standard normals lie from 0: Box and Muller's."""
    return np.sqrt(-2.0 * _log_normal(u, 0.0))


@formula
def _turn(s, out, i):
    """Two standard normals from their radius in row `out` and the direction in the next, in turns."""
    radius = s[out + i]
    sine, cosine = _sincos_turn(s[out + _1 + i])
    s[out + i], s[out + _1 + i] = radius * cosine, radius * sine


@phase
def normals(s, g, key, stream, block, out, n):
    """Two standard normals likewise. Three short loops: the steps of a long sum wait for each other, those of several episodes do not."""
    uniforms(s, g, key, stream, block, out, n)
    for i in range(n):
        s[out + i] = _radius(s[out + i])
    for i in range(n):
        _turn(s, out, i)


@phase
def four_normals(s, g, key, stream, block, out, n):
    """Four: those of this block and of the next one, which share what depends on the key alone."""
    for i in range(n):
        world, episode, step = g[key + i], g[EPISODE + i], g[STEP + i]
        first, second = _uniform_pair(world, episode, step, stream, block)
        third, fourth = _uniform_pair(world, episode, step, stream, block + np.uint64(1))
        s[out + i], s[out + _1 + i], s[out + _2 + i], s[out + _3 + i] = first, second, third, fourth
    for i in range(n):
        s[out + i], s[out + _2 + i] = _radius(s[out + i]), _radius(s[out + _2 + i])
    for i in range(n):
        _turn(s, out, i)
        _turn(s, out + _2, i)


@phase
def way(s, g, c, f, table, stream, n):
    """The leader's acceleration at k, from the manoeuvre and what it remembers."""
    kind, p = f[of.WAY], of.WAY_PARAM
    a, b, d, e, h = c[p], c[p + 1], c[p + 2], c[p + 3], c[p + 4]
    dt = c[of.DT]
    if kind == of.CONSTANT:
        for i in range(n):
            s[EXO + i] = a
    elif kind == of.PULSE:
        for i in range(n):
            s[EXO + i] = between(s[K + i] * dt, b, d, a, 0.0)
    elif kind == of.SWITCHED:
        for i in range(n):
            s[EXO + i] = between(s[K + i] * dt, 0.0, d, a, b)
    elif kind == of.SINE:
        for i in range(n):
            cosine, sine = s[WAY + i], s[WAY + _1 + i]
            s[EXO + i] = a * cosine
            s[WAY + i], s[WAY + _1 + i] = b * cosine - d * sine, d * cosine + b * sine
    elif kind == of.BRAKING:
        for i in range(n):
            s[EXO + i] = halt(s[K + i] * dt, s[WAY + i], a, s[LEAD_V + i], dt)
    elif kind == of.STOP_AND_GO:
        some = 0
        for i in range(n):
            s[WAY + _1 + i] -= dt
            over = phase_over(s[WAY + i], s[WAY + _1 + i], s[LEAD_V + i], a, b)
            s[EXO + i] = 1.0 if over else 0.0
            some += 1 if over else 0
        if some > 0:  # few: a list of them, so that not everybody draws
            listed = np.uint64(0)
            for i in range(n):
                s[DRAW + listed] = i
                listed += np.uint64(s[EXO + i] > 0.0)
            for j in range(listed):
                lane = np.uint64(np.int64(s[DRAW + j]))
                u, _ = _uniform_pair(g[WORLD_KEY + lane], g[EPISODE + lane], g[STEP + lane], stream, np.uint64(0))
                after = s[WAY + lane] + 1.0
                after = after if after < 4.0 else 0.0
                low = p + 4 if after == manoeuvres.CRUISE else p + 6
                s[WAY + lane], s[WAY + _1 + lane] = after, c[low] + (c[low + 1] - c[low]) * u
        for i in range(n):
            s[EXO + i] = stop_and_go(s[WAY + i], s[LEAD_V + i], a, b, d, e, dt)
    elif kind == of.RANDOM:
        normals(s, g, WORLD_KEY, stream, np.uint64(0), DRAW, n)
        for i in range(n):
            s[WAY + i] = a * s[WAY + i] + b * s[DRAW + i]
            s[EXO + i] = drawn_back(s[WAY + i], s[LEAD_V + i], d, e, h)
    else:  # PROFILE
        for i in range(n):
            s[EXO + i] = (table[min(np.int64(s[K + i]) + 1, len(table) - 1)] - s[LEAD_V + i]) / dt


@phase
def follow(s, intent, c, f, tick, n):
    """The driver behind, if there is one, one step later; `tick` counts the steps of the block, by which the ring of intents turns."""
    dt = c[of.DT]
    if f[of.REAR] != 0:
        reaction = f[of.REACTION]
        if reaction > 0:
            slot = np.uint64((tick % reaction) * LANES)
            for i in range(n):
                decided = idm_accel(s[EGO + i] - s[REAR_X + i], s[REAR_V + i], s[EGO + _1 + i])
                made = intent[slot + i]
                intent[slot + i] = decided
                s[REAR_X + i], s[REAR_V + i] = roll(s[REAR_X + i], s[REAR_V + i], made, dt)
        else:
            for i in range(n):
                decided = idm_accel(s[EGO + i] - s[REAR_X + i], s[REAR_V + i], s[EGO + _1 + i])
                s[REAR_X + i], s[REAR_V + i] = roll(s[REAR_X + i], s[REAR_V + i], decided, dt)


@phase
def move(s, g, intent, c, f, stream, tick, n):
    """Leader, follower and the driver behind, one step later."""
    dt, load = c[of.DT], c[of.LOAD]
    A = (
        (c[of.OWN_A], c[of.OWN_A + 1], c[of.OWN_A + 2]), (c[of.OWN_A + 3], c[of.OWN_A + 4], c[of.OWN_A + 5]),
        (c[of.OWN_A + 6], c[of.OWN_A + 7], c[of.OWN_A + 8]),
    )  # fmt: skip
    B = ((c[of.OWN_B],), (c[of.OWN_B + 1],), (c[of.OWN_B + 2],))
    sd0, sd1, sd2 = c[of.PROCESS_SD], c[of.PROCESS_SD + 1], c[of.PROCESS_SD + 2]
    follow(s, intent, c, f, tick, n)
    four_normals(s, g, WORLD_KEY, stream, np.uint64(0), DRAW, n)
    for i in range(n):
        noise = (sd0 * s[DRAW + i], sd1 * s[DRAW + _1 + i], sd2 * s[DRAW + _2 + i])
        x, v, a = drive(A, B, s[EGO + i], s[EGO + _1 + i], s[EGO + _2 + i], s[APPLIED + i] / load, noise)
        s[EGO + i], s[EGO + _1 + i], s[EGO + _2 + i] = x, v, a
        s[LEAD_X + i], s[LEAD_V + i] = roll(s[LEAD_X + i], s[LEAD_V + i], s[EXO + i], dt)


@phase
def control(s, lead, c, n):
    """The command of the cruise control, on the estimate and on the leader's message in row `lead` and the next."""
    headway, standstill, gamma = c[of.HEADWAY], c[of.STANDSTILL], c[of.GAMMA]
    set_speed, low, high = c[of.SET_SPEED], c[of.ACCEL_MIN], c[of.ACCEL_MAX]
    for i in range(n):
        mode, x, v = s[MODE + i], s[X + i], s[X + _1 + i]
        wide = widened(headway, mode)
        a = spaced(x, v, s[lead + i], s[lead + _1 + i], wide, standstill, gamma)
        a = np.minimum(a, (set_speed - v) / wide)
        s[U + i] = np.minimum(np.maximum(obeyed(a, mode), low), high)


@phase
def measure(s, g, c, f, stream, n):
    """The readings at the step that g holds, and the leader's message."""
    sd0, sd1 = c[of.SENSOR_SD], c[of.SENSOR_SD + 1]
    if f[of.UNIFORM_NOISE] != 0:
        uniforms(s, g, WORLD_KEY, stream, np.uint64(0), DRAW, n)
        wide = 3.0**0.5
        for i in range(n):
            s[DRAW + i], s[DRAW + _1 + i] = wide * (2.0 * s[DRAW + i] - 1.0), wide * (2.0 * s[DRAW + _1 + i] - 1.0)
    else:
        normals(s, g, WORLD_KEY, stream, np.uint64(0), DRAW, n)
    for i in range(n):
        s[SENT + i] = (0.0 + s[EGO + i]) + sd0 * s[DRAW + i]
        s[SENT + _1 + i] = (0.0 + s[EGO + _1 + i]) + sd1 * s[DRAW + _1 + i]
        s[SENT + _2 + i], s[SENT + _3 + i] = s[LEAD_X + i], s[LEAD_V + i]


@phase
def remember(s, n):
    """The truth at k, before anything moves."""
    for i in range(n):
        s[TRUTH + i], s[TRUTH + _1 + i], s[TRUTH + _2 + i] = s[EGO + i], s[EGO + _1 + i], s[EGO + _2 + i]


@phase
def collide(s, f, n):
    """Collisions after the step, and whether they end the episode."""
    ends, rear = f[of.ENDS] != 0, f[of.REAR] != 0
    for i in range(n):
        s[LENGTH + i] += 1.0 - s[ENDED + i]
        s[HIT + i] = s[LEAD_X + i] - s[EGO + i] <= 0.0
        s[REAR_HIT + i] = (s[EGO + i] - s[REAR_X + i] <= 0.0) & rear
        s[ENDED + i] = 1.0 if (s[ENDED + i] != 0.0) | (((s[HIT + i] != 0.0) | (s[REAR_HIT + i] != 0.0)) & ends) else 0.0


@phase
def next_step(s, g, n):
    """k + 1, for what is counted and for what is drawn."""
    for i in range(n):
        s[K + i] += 1.0
        g[STEP + i] += np.uint64(1)
