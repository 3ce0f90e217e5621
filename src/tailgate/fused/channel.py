"""The channel as a lane: `tailgate.threat.Channel`, without delay and replay and without anything over the air."""

import numpy as np

from tailgate.kinds import Kind

from . import constants as of
from .compiled import formula, phase
from .rows import (
    APPLIED,
    ARRIVED,
    BURST,
    CLEAN,
    COOLDOWN,
    FRESH,
    HELD,
    KIND,
    LANES,
    LINKS,
    REFUSED,
    SENSORS,
    SENT,
    TARGET,
    USED,
    VALID,
    VALUE,
    WANT_KIND,
    WANT_TARGET,
    WANT_VALUE,
    WIRES,
    K,
    U,
)

JAM, HOLD, HOLD_FRESH, DROPOUT, FDI = (float(kind) for kind in (Kind.DOS_JAM, Kind.DOS_HOLD, Kind.DOS_HOLD_FRESH, Kind.DROPOUT, Kind.FDI))
_1, _2, _3, _4 = (np.uint64(LANES * i) for i in range(1, 5))  # rows further down


@phase
def allowed(s, c, out, n):
    """Whether a legal command would be accepted now, into row `out`."""
    onset, last, budget, longest = c[of.ONSET], c[of.LAST], c[of.BUDGET], c[of.LONGEST]
    for i in range(n):
        s[out + i] = (s[K + i] >= onset) & (s[K + i] <= last) & (s[COOLDOWN + i] == 0.0) & (s[USED + i] < budget) & (s[BURST + i] < longest)


@phase
def rest(s, c, n):
    """What `decide` and `arrive` come to where no command is asked for."""
    pause, attacked = c[of.PAUSE], False
    for i in range(n):
        attacked |= s[KIND + i] != 0.0
        s[KIND + i] = s[REFUSED + i] = 0.0
        s[COOLDOWN + i] = max(pause - 1.0, 0.0) if s[BURST + i] > 0.0 else max(s[COOLDOWN + i] - 1.0, 0.0)
        s[BURST + i] = 0.0
        s[VALID + i] = s[VALID + np.uint64(LANES) + i] = 1.0
    for w in range(WIRES if attacked else 0):  # without a kind there is no target and no value
        row = np.uint64(w * LANES)
        for i in range(n):
            s[TARGET + row + i] = s[VALUE + row + i] = 0.0
    for w in range(LINKS):
        row = np.uint64(w * LANES)
        for i in range(n):
            s[CLEAN + row + i] = s[ARRIVED + row + i] = s[FRESH + row + i] = s[SENT + row + i]


@formula
def _wrong(kind, aimed, value, mine, bound, low, high):
    """Whether a wire is aimed at that is not granted, or with a value that is not."""
    fits = ((kind != JAM) | ((value >= low) & (value <= high))) & ((kind != FDI) | (abs(value) <= bound))
    return aimed & ((not mine) | (not fits))


@phase
def decide(s, c, n):
    """From the command that was asked for to the one in force, and what it costs."""
    onset, last, budget, longest, pause = c[of.ONSET], c[of.LAST], c[of.BUDGET], c[of.LONGEST], c[of.PAUSE]
    jam, hold, fresh, dropout, fdi = (
        c[of.GRANTED + 1] != 0.0, c[of.GRANTED + 2] != 0.0, c[of.GRANTED + 3] != 0.0, c[of.GRANTED + 4] != 0.0, c[of.GRANTED + 5] != 0.0,
    )  # fmt: skip
    m0, m1, m2, m3, m4 = c[of.WIRE] != 0.0, c[of.WIRE + 1] != 0.0, c[of.WIRE + 2] != 0.0, c[of.WIRE + 3] != 0.0, c[of.WIRE + 4] != 0.0
    b0, b1, b2, b3, b4 = c[of.BOUND], c[of.BOUND + 1], c[of.BOUND + 2], c[of.BOUND + 3], c[of.BOUND + 4]
    l0, l1, l2, l3, l4 = c[of.LOW], c[of.LOW + 1], c[of.LOW + 2], c[of.LOW + 3], c[of.LOW + 4]
    h0, h1, h2, h3, h4 = c[of.HIGH], c[of.HIGH + 1], c[of.HIGH + 2], c[of.HIGH + 3], c[of.HIGH + 4]
    for i in range(n):
        kind = s[WANT_KIND + i]
        t0, t1, t2 = s[WANT_TARGET + i] != 0.0, s[WANT_TARGET + _1 + i] != 0.0, s[WANT_TARGET + _2 + i] != 0.0
        t3, t4 = s[WANT_TARGET + _3 + i] != 0.0, s[WANT_TARGET + _4 + i] != 0.0
        wrong = _wrong(kind, t0, s[WANT_VALUE + i], m0, b0, l0, h0) | _wrong(kind, t1, s[WANT_VALUE + _1 + i], m1, b1, l1, h1)
        wrong |= _wrong(kind, t2, s[WANT_VALUE + _2 + i], m2, b2, l2, h2) | _wrong(kind, t3, s[WANT_VALUE + _3 + i], m3, b3, l3, h3)
        wrong |= _wrong(kind, t4, s[WANT_VALUE + _4 + i], m4, b4, l4, h4)
        granted = (
            ((kind == JAM) & jam) | ((kind == HOLD) & hold) | ((kind == HOLD_FRESH) & fresh) | ((kind == DROPOUT) & dropout)
            | ((kind == FDI) & fdi)
        )  # fmt: skip
        open_now = (s[K + i] >= onset) & (s[K + i] <= last) & (s[COOLDOWN + i] == 0.0) & (s[USED + i] < budget) & (s[BURST + i] < longest)
        aimed = t0 | t1 | t2 | t3 | t4
        charged = aimed & granted & open_now & (not wrong)
        s[REFUSED + i] = 1.0 if (aimed | (kind != 0.0)) & (not charged) else 0.0
        s[KIND + i] = kind if charged else 0.0
        s[APPLIED + i] = 1.0 if charged & (s[USED + i] == 0.0) else 0.0  # the first attack of the episode, for now
        over = (s[BURST + i] > 0.0) & (not charged)
        s[COOLDOWN + i] = max(pause - 1.0, 0.0) if over else max(s[COOLDOWN + i] - 1.0, 0.0)
        s[USED + i] += 1.0 if charged else 0.0
        s[BURST + i] = s[BURST + i] + 1.0 if charged else 0.0
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        for i in range(n):
            kind = s[KIND + i]
            hit = (s[WANT_TARGET + row + i] != 0.0) & (kind != 0.0)
            s[TARGET + row + i] = 1.0 if hit else 0.0
            s[VALUE + row + i] = s[WANT_VALUE + row + i] if hit & ((kind == JAM) | (kind == FDI)) else 0.0
            s[HELD + row + i] = s[FRESH + row + i] if s[APPLIED + i] != 0.0 else s[HELD + row + i]


@phase
def arrive(s, n):
    """What arrives of the sensor readings and of the V2V message under the command in force."""
    for w in range(LINKS):
        row = np.uint64(w * LANES)
        for i in range(n):
            sent, kind, hit = s[SENT + row + i], s[KIND + i], s[TARGET + row + i] != 0.0
            changed = s[FRESH + row + i]
            changed = s[HELD + row + i] if kind == HOLD else changed
            changed = sent + s[VALUE + row + i] if kind == FDI else changed
            changed = s[VALUE + row + i] if kind == JAM else changed
            s[CLEAN + row + i] = sent
            s[ARRIVED + row + i] = changed if hit else sent
            s[FRESH + row + i] = s[FRESH + row + i] if hit else sent
    for w in range(SENSORS):
        row = np.uint64(w * LANES)
        for i in range(n):
            s[VALID + row + i] = 0.0 if (s[TARGET + row + i] != 0.0) & (s[KIND + i] == DROPOUT) else 1.0


@phase
def actuate(s, f, n):
    """What the actuator gets of the command of the controller."""
    row = np.uint64(LANES * LINKS)
    if f[of.ACTUATED] == 0:
        pass_on(s, n)
        return
    for i in range(n):
        u, kind, hit = s[U + i], s[KIND + i], s[TARGET + row + i] != 0.0
        changed = s[FRESH + row + i]
        changed = s[HELD + row + i] if kind == HOLD else changed
        changed = u + s[VALUE + row + i] if kind == FDI else changed
        changed = s[VALUE + row + i] if kind == JAM else changed
        s[APPLIED + i] = changed if hit else u
        s[FRESH + row + i] = s[FRESH + row + i] if hit else u


@phase
def pass_on(s, n):
    """The command reaches the actuator as it is: nobody attacks the step before the first."""
    for i in range(n):
        s[APPLIED + i] = s[U + i]
