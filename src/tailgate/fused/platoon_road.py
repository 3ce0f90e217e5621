"""The road of a platoon as a lane: cars, messages, sensors and the law of cooperative cruise control (`tailgate.envs.platoon`, `.cacc`).

The state of the string is X = [c_0 v_0 a_0 | d_1 v_1 a_1 f_1 | ...]; a car's record holds position, speed, acceleration and f.
"""

import numpy as np

from tailgate.draws import Role
from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from . import road
from .compiled import phase
from .platoon_filter import WORK, total
from .platoon_rows import (
    AHEAD,
    APPLIED,
    ARRIVED,
    BELIEF,
    COMMAND,
    DRIVEN,
    GAP,
    LAW,
    LINKS,
    NEXT,
    SENSORS,
    SENT,
    TOLD,
    VALID,
    A,
    V,
    X,
)
from .rows import EGO, ENDED, EXO, HIT, LANES, LEAD_V, LEAD_X, LENGTH, OFF, REAR_HIT, TRUTH, WORLD_KEY
from .rows import X as FOOLED

_1, _2, _3, _4, _5 = (np.uint64(LANES * i) for i in range(1, 6))
_LINK = np.uint64(int(Role.LINK) << 16)
_PRIOR, _PROCESS, _SENSOR, _WAY = (np.uint64(int(role) << 16) for role in (Role.PRIOR, Role.PROCESS, Role.SENSOR, Role.MANOEUVRE))
_RANGE, _SPREAD = _PRIOR | np.uint64(1), _PRIOR | np.uint64(16)  # tags of what is drawn at the start
_BELIEF, _NEXT, _COMMAND = int(BELIEF), int(NEXT), int(COMMAND)


@phase
def dealt(s, g, stream, count, normal, f, n):
    """So many normals, or else uniforms, of an episode into the rows DEALT."""
    for pair in range((count + 1) // 2):
        out = np.uint64(f[of.DEALT] + 2 * pair * LANES)
        if normal:
            road.normals(s, g, WORLD_KEY, stream, np.uint64(pair), out, n)
        else:
            road.uniforms(s, g, WORLD_KEY, stream, np.uint64(pair), out, n)


@phase
def line_up(s, g, window, c, f, n):
    """The string at the start: all cars at one speed, at drawn gaps."""
    followers, deal = f[of.CARS] - 1, f[of.DEALT]
    mean, sd, wide, speed = c[of.GAPS], c[of.GAPS + 1], c[of.GAPS + 2], c[of.LEAD_START + 1]
    dealt(s, g, _PRIOR, followers, True, f, n)
    for j in range(followers):
        car = window[(j + 1) * f[of.CAR] :]
        z = s[deal + j * LANES : deal + (j + 1) * LANES]
        for i in range(n):
            car[X + i] = mean + sd * z[i]
    dealt(s, g, _RANGE, followers, False, f, n)
    for j in range(followers):
        car = window[(j + 1) * f[of.CAR] :]
        u = s[deal + j * LANES : deal + (j + 1) * LANES]
        for i in range(n):
            car[X + i] = car[X + i] + wide * (2.0 * u[i] - 1.0)
    for j in range(1, followers):  # from gaps to how far a car is behind the leader
        ahead, car = window[j * f[of.CAR] :], window[(j + 1) * f[of.CAR] :]
        for i in range(n):
            car[X + i] = ahead[X + i] + car[X + i]
    for j in range(followers + 1):
        car = window[j * f[of.CAR] : (j + 1) * f[of.CAR]]
        for i in range(n):
            car[X + i] = -car[X + i] if j > 0 else 0.0
            car[V + i], car[A + i], car[DRIVEN + i], car[LAW + i] = speed, 0.0, 0.0, 0.0


@phase
def told(s, g, window, c, f, n):
    """What each car is told of the state at the start."""
    cars, states, sd, deal = f[of.CARS], f[of.STATES], c[of.PRIOR_SD], f[of.DEALT]
    for j in range(cars):  # a car at a time, of which the first number may be the second of a pair
        first = j * states
        for pair in range(first // 2, (first + states + 1) // 2):
            out = np.uint64(deal + 2 * (pair - first // 2) * LANES)
            road.normals(s, g, WORLD_KEY, _SPREAD, np.uint64(pair), out, n)
        for e in range(states):
            z = s[deal + (e + first % 2) * LANES :]
            belief, truth = window[j * f[of.CAR] + _BELIEF + e * LANES :], s[f[of.TRUTHS] + e * LANES :]
            for i in range(n):
                belief[i] = truth[i] + sd * z[i]


@phase
def remember(s, window, f, n):
    """The truth X, before anything moves."""
    truth = s[f[of.TRUTHS] : f[of.TRUTHS] + f[of.STATES] * LANES]
    leader = window[: f[of.CAR]]
    for i in range(n):
        truth[i], truth[_1 + i], truth[_2 + i] = leader[X + i], leader[V + i], leader[A + i]
    for j in range(1, f[of.CARS]):
        ahead, car = window[(j - 1) * f[of.CAR] : j * f[of.CAR]], window[j * f[of.CAR] : (j + 1) * f[of.CAR]]
        row = truth[(4 * j - 1) * LANES :]
        for i in range(n):
            row[i], row[_1 + i], row[_2 + i], row[_3 + i] = ahead[X + i] - car[X + i], car[V + i], car[A + i], car[LAW + i]


@phase
def control(s, window, table, c, f, mode, n):
    """u = K X + k0 as the mode wants it, within its limits, and f later: keep f + (1 - keep) (G X + g0 + V v2v). A car knows its own f."""
    low, high, keep = c[of.ACCEL_MIN], c[of.ACCEL_MAX], c[of.FADES]
    for j in range(1, f[of.CARS]):
        first, to, bias, gain = j * f[of.CAR], f[of.WORKS] + j * WORK, f[of.IN_BIAS] + 2 * j, f[of.IN_V] + 3 * j
        total(table, f[of.IN_LAW], j, window, first, table[bias], window, first + _COMMAND)
        total(table, f[of.IN_FEED], j, window, first, table[bias + 1], s, to + _NEXT)
        car, work = window[first : first + f[of.CAR]], s[to : to + WORK]
        v0, v1, v2 = table[gain], table[gain + 1], table[gain + 2]
        if v0 != 0.0:
            for i in range(n):
                work[NEXT + i] += v0 * work[ARRIVED + _3 + i]
        if v1 != 0.0:
            for i in range(n):
                work[NEXT + i] += v1 * work[ARRIVED + _4 + i]
        if v2 != 0.0:
            for i in range(n):
                work[NEXT + i] += v2 * work[ARRIVED + _5 + i]
        for i in range(n):
            car[COMMAND + i] = np.minimum(np.maximum(road.obeyed(car[COMMAND + i], mode), low), high)
            car[LAW + i] = keep * car[LAW + i] + (1.0 - keep) * work[NEXT + i]


@phase
def hear(s, window, f):
    """What arrives of readings and messages where nothing is attacked."""
    for j in range(f[of.CARS]):
        sent, arrived = j * f[of.CAR] + int(SENT), f[of.WORKS] + j * WORK + int(ARRIVED)
        for at in range(0, LINKS * LANES, WIDTH):
            put(s, arrived + at, get(window, sent + at))
        for at in range(0, SENSORS * LANES, WIDTH):
            there = get(window, j * f[of.CAR] + f[of.THERE] + at) if f[of.THERE] != 0 else alike(1.0)
            put(s, f[of.WORKS] + j * WORK + int(VALID) + at, there)


@phase
def pass_on(s, window, f, n):
    """The commands reach the actuators as they are."""
    for j in range(f[of.CARS]):
        car, work = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            work[APPLIED + i] = car[COMMAND + i]


@phase
def move(s, g, window, c, f, table, n):
    """All cars one step later, and what they know of the leader's input."""
    load, shaken = c[of.LOAD], c[of.PROCESS_SD] != 0.0 or c[of.PROCESS_SD + 1] != 0.0 or c[of.PROCESS_SD + 2] != 0.0
    own = (
        (c[of.OWN_A], c[of.OWN_A + 1], c[of.OWN_A + 2]), (c[of.OWN_A + 3], c[of.OWN_A + 4], c[of.OWN_A + 5]),
        (c[of.OWN_A + 6], c[of.OWN_A + 7], c[of.OWN_A + 8]),
    )  # fmt: skip
    into = ((c[of.OWN_B],), (c[of.OWN_B + 1],), (c[of.OWN_B + 2],))
    sd0, sd1, sd2 = c[of.PROCESS_SD], c[of.PROCESS_SD + 1], c[of.PROCESS_SD + 2]
    leader = window[: f[of.CAR]]
    for i in range(n):
        s[LEAD_V + i] = leader[V + i]
    road.way(s, g, c, f, table[: f[of.PROFILED]], _WAY, n)
    if shaken:
        dealt(s, g, _PROCESS, 3 * f[of.CARS], True, f, n)
    for j in range(f[of.CARS]):
        car, work = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        knows = j == 0 or f[of.INPUT_KNOWN] != 0
        if j == 0:
            for i in range(n):
                car[DRIVEN + i] = s[EXO + i]
        else:
            for i in range(n):
                car[DRIVEN + i] = work[APPLIED + i] / load
        for i in range(n):
            car[TOLD + i] = s[EXO + i] if knows else 0.0
        deal = s[f[of.DEALT] + 3 * j * LANES : f[of.DEALT] + (3 * j + 3) * LANES]
        for i in range(n):
            noise = (sd0 * deal[i], sd1 * deal[_1 + i], sd2 * deal[_2 + i]) if shaken else (0.0, 0.0, 0.0)
            car[X + i], car[V + i], car[A + i] = road.drive(own, into, car[X + i], car[V + i], car[A + i], car[DRIVEN + i], noise)
    look_ahead(s, window, f, n)


@phase
def look_ahead(s, window, f, n):
    """Gap and speed ahead of each car, the leader alone on its road; the smallest gap in place of a single car's."""
    for i in range(n):
        s[LEAD_X + i], s[EGO + i], s[TRUTH + i] = np.inf, 0.0, 0.0
    for j in range(f[of.CARS]):
        ahead, car = window[max(j - 1, 0) * f[of.CAR] :], window[j * f[of.CAR] :]
        work = s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            gap = ahead[X + i] - car[X + i] if j > 0 else np.inf
            work[GAP + i], work[AHEAD + i] = gap, ahead[V + i]
            s[LEAD_X + i] = min(s[LEAD_X + i], gap)


@phase
def message(window, table, f, n):
    """What each car hears: its predecessor's and the leader's acceleration, and what drove its predecessor."""
    for j in range(1, f[of.CARS]):
        leader, ahead, car = window[: f[of.CAR]], window[(j - 1) * f[of.CAR] : j * f[of.CAR]], window[j * f[of.CAR] : (j + 1) * f[of.CAR]]
        heard = table[f[of.IN_LED] + j]
        for i in range(n):
            car[SENT + _3 + i], car[SENT + _4 + i], car[SENT + _5 + i] = ahead[A + i], heard * leader[A + i], ahead[DRIVEN + i]


@phase
def measure(s, g, window, c, f, table, n):
    """The readings of all cars at the step that g holds, and the messages."""
    sd0, sd1, sd2 = c[of.NOISE_SD], c[of.NOISE_SD + 1], c[of.NOISE_SD + 2]
    noisy = sd0 != 0.0 or sd1 != 0.0 or sd2 != 0.0
    if noisy:
        dealt(s, g, _SENSOR, 3 * f[of.CARS], True, f, n)
    for j in range(f[of.CARS]):
        car, work = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        deal = s[f[of.DEALT] + 3 * j * LANES : f[of.DEALT] + (3 * j + 3) * LANES]
        for i in range(n):
            car[SENT + i] = work[GAP + i] if j > 0 else car[X + i]
            car[SENT + _1 + i], car[SENT + _2 + i] = car[V + i], car[A + i]
        if noisy:
            for i in range(n):
                car[SENT + i] += sd0 * deal[i]
                car[SENT + _1 + i] += sd1 * deal[_1 + i]
                car[SENT + _2 + i] += sd2 * deal[_2 + i]
    message(window, table, f, n)


@phase
def lose(s, g, window, c, f, before, n):
    """Of what is sent at the step that g holds some is lost: its wire keeps the last that arrived, which is in the rows `before` of s."""
    dealt(s, g, _LINK, LINKS * f[of.CARS], False, f, n)
    for j in range(f[of.CARS]):
        car, there = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], window[j * f[of.CAR] + f[of.THERE] :]
        for w in range(LINKS):
            row, last, u = np.uint64(w * LANES), s[before + (j * LINKS + w) * LANES :], s[f[of.DEALT] + (j * LINKS + w) * LANES :]
            for i in range(n):
                car[SENT + row + i] = last[i] if u[i] < c[of.LOSS] else car[SENT + row + i]
            if w < SENSORS:
                for i in range(n):
                    there[row + i] = 0.0 if u[i] < c[of.LOSS] else 1.0


@phase
def keep(s, window, f, n):
    """What arrived last, into the rows SENDS."""
    for j in range(f[of.CARS]):
        for at in range(0, LINKS * LANES, WIDTH):
            put(s, f[of.SENDS] + j * LINKS * LANES + at, get(window, j * f[of.CAR] + int(SENT) + at))


@phase
def all_there(window, f, n):
    """The first readings arrive."""
    for j in range(f[of.CARS]):
        for at in range(SENSORS * LANES):
            window[j * f[of.CAR] + f[of.THERE] + at] = 1.0


@phase
def fooled(s, window, f, n):
    """By how much each car overestimates its gap; the most, and the largest error of a gap, in place of a single car's."""
    for i in range(n):
        s[FOOLED + i], s[OFF + i] = 0.0, 0.0
    for j in range(1, f[of.CARS]):
        column = (4 * j - 1) * LANES
        belief, truth = window[j * f[of.CAR] + _BELIEF + column :], s[f[of.TRUTHS] + column :]
        for i in range(n):
            off = 0.0 + (belief[i] - truth[i])
            s[FOOLED + i] = max(s[FOOLED + i], off)
            s[OFF + i] = max(s[OFF + i], abs(off))


@phase
def collide(s, f, n):
    """Collisions after the step, and whether they end the episode."""
    ends = f[of.ENDS] != 0
    for i in range(n):
        s[LENGTH + i] += 1.0 - s[ENDED + i]
        s[HIT + i], s[REAR_HIT + i] = s[LEAD_X + i] <= 0.0, 0.0
        s[ENDED + i] = 1.0 if (s[ENDED + i] != 0.0) | ((s[HIT + i] != 0.0) & ends) else 0.0
