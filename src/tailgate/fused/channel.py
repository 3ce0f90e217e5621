"""The channel as a lane: `tailgate.threat.Channel`, without delay and replay and without anything over the air."""

import numpy as np

from tailgate import threat
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
NOISE_JAM, ECHO_DELAY = float(Kind.NOISE_JAM), float(Kind.ECHO_DELAY)
accepts = formula(threat.accepts)
_0, _1, _2, _3, _4 = (np.uint64(LANES * i) for i in range(5))  # rows further down


@phase
def open_within(s, c, steps, out, n):
    """Whether a legal command would be accepted in one of so many steps from now on, into row `out`."""
    onset, last, budget, longest, pause = c[of.ONSET], c[of.LAST], c[of.BUDGET], c[of.LONGEST], c[of.PAUSE]
    for i in range(n):
        s[out + i] = accepts(s[K + i], steps, budget - s[USED + i], s[BURST + i], s[COOLDOWN + i], onset, last, longest, pause)


@phase
def calm(s, c, n):
    """What `decide` comes to where no command is asked for."""
    pause, attacked = c[of.PAUSE], 0
    for i in range(n):
        attacked += 1 if s[KIND + i] != 0.0 else 0
        s[KIND + i] = s[REFUSED + i] = 0.0
        s[COOLDOWN + i] = max(pause - 1.0, 0.0) if s[BURST + i] > 0.0 else max(s[COOLDOWN + i] - 1.0, 0.0)
        s[BURST + i] = 0.0
    for w in range(WIRES if attacked > 0 else 0):  # without a kind there is no target and no value
        row = np.uint64(w * LANES)
        for i in range(n):
            s[TARGET + row + i] = s[VALUE + row + i] = 0.0


@phase
def rest(s, c, n):
    """What `decide` and `arrive` come to where no command is asked for."""
    calm(s, c, n)
    for i in range(n):
        s[VALID + i] = s[VALID + _1 + i] = 1.0
    for w in range(LINKS):
        row = np.uint64(w * LANES)
        for i in range(n):
            s[CLEAN + row + i] = s[ARRIVED + row + i] = s[FRESH + row + i] = s[SENT + row + i]


@phase
def count(s, c, n):
    """How many wires are aimed at, into APPLIED for now, and how many of them without being granted, into REFUSED."""
    m0, m1, m2, m3, m4 = c[of.WIRE], c[of.WIRE + 1], c[of.WIRE + 2], c[of.WIRE + 3], c[of.WIRE + 4]
    for i in range(n):
        t0, t1, t2, t3, t4 = (
            s[WANT_TARGET + i], s[WANT_TARGET + _1 + i], s[WANT_TARGET + _2 + i], s[WANT_TARGET + _3 + i], s[WANT_TARGET + _4 + i],
        )  # fmt: skip
        s[APPLIED + i] = t0 + t1 + t2 + t3 + t4
        s[REFUSED + i] = t0 * (1.0 - m0) + t1 * (1.0 - m1) + t2 * (1.0 - m2) + t3 * (1.0 - m3) + t4 * (1.0 - m4)


@formula
def fits(kind, value, bound, low, high):
    """Whether a value is granted with that kind."""
    return ((kind != JAM) | ((value >= low) & (value <= high))) & ((kind != FDI) | (abs(value) <= bound))


@formula
def carried(kind, value):
    """The value of a command in force, where its kind has one."""
    return value if (kind == JAM) | (kind == FDI) else 0.0


@formula
def judge(s, c, row, n):
    """Counts in REFUSED a wire that is aimed at with a value that is not granted."""
    wire = np.int64(row) // LANES
    bound, low, high = c[of.BOUND + wire], c[of.LOW + wire], c[of.HIGH + wire]
    for i in range(n if c[of.WIRE + wire] != 0.0 else np.uint64(0)):
        kind, value, aimed = s[WANT_KIND + i], s[WANT_VALUE + row + i], s[WANT_TARGET + row + i] != 0.0
        s[REFUSED + i] += 1.0 if aimed & (not fits(kind, value, bound, low, high)) else 0.0


def charging(aired):
    """The phase `charge`: from the command that was asked for to the one in force, with kinds over the air or without."""

    @phase
    def charge(s, c, n):
        """Kind, refusal and costs of the command; -> of how many episodes it is the first."""
        onset, last, budget, longest, pause = c[of.ONSET], c[of.LAST], c[of.BUDGET], c[of.LONGEST], c[of.PAUSE]
        jam, hold, fresh, dropout, fdi = c[of.GRANTED + 1], c[of.GRANTED + 2], c[of.GRANTED + 3], c[of.GRANTED + 4], c[of.GRANTED + 5]
        noise, echo = c[of.GRANTED + 8], c[of.GRANTED + 9]
        firsts = 0
        for i in range(n):
            kind, used, burst, cooldown = s[WANT_KIND + i], s[USED + i], s[BURST + i], s[COOLDOWN + i]
            granted = jam if kind == JAM else 0.0
            granted = hold if kind == HOLD else granted
            granted = fresh if kind == HOLD_FRESH else granted
            granted = dropout if kind == DROPOUT else granted
            granted = fdi if kind == FDI else granted
            if aired:
                granted = noise if kind == NOISE_JAM else granted
                granted = echo if kind == ECHO_DELAY else granted
            open_now = (s[K + i] >= onset) & (s[K + i] <= last) & (cooldown == 0.0) & (used < budget) & (burst < longest)
            aimed = s[APPLIED + i] > 0.0
            charged = aimed & (granted != 0.0) & open_now & (s[REFUSED + i] == 0.0)
            first = charged & (used == 0.0)  # of the episode
            firsts += 1 if first else 0
            s[APPLIED + i] = 1.0 if first else 0.0
            s[REFUSED + i] = 1.0 if (aimed | (kind != 0.0)) & (not charged) else 0.0
            s[KIND + i] = kind if charged else 0.0
            s[COOLDOWN + i] = max(pause - 1.0, 0.0) if (burst > 0.0) & (not charged) else max(cooldown - 1.0, 0.0)
            s[USED + i] = used + 1.0 if charged else used
            s[BURST + i] = burst + 1.0 if charged else 0.0
        return firsts

    return charge


charge = charging(aired=False)


@phase
def decide(s, c, n):
    """From the command that was asked for to the one in force, and what it costs."""
    count(s, c, n)
    judge(s, c, _0, n)
    judge(s, c, _1, n)
    judge(s, c, _2, n)
    judge(s, c, _3, n)
    judge(s, c, _4, n)
    firsts = charge(s, c, n)
    enforce(s, c, _0, n)
    enforce(s, c, _1, n)
    enforce(s, c, _2, n)
    enforce(s, c, _3, n)
    enforce(s, c, _4, n)
    if firsts > 0:
        hold(s, n)


@phase
def hold(s, n):
    """What is held from the first attack of an episode on."""
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        for i in range(n):
            s[HELD + row + i] = s[FRESH + row + i] if s[APPLIED + i] != 0.0 else s[HELD + row + i]


@formula
def enforce(s, c, row, n):
    """What is in force at a wire; at one that is not granted there never is anything."""
    for i in range(n if c[of.WIRE + np.int64(row) // LANES] != 0.0 else np.uint64(0)):
        kind, value = s[KIND + i], s[WANT_VALUE + row + i]
        hit = (s[WANT_TARGET + row + i] != 0.0) & (kind != 0.0)
        s[TARGET + row + i] = 1.0 if hit else 0.0
        s[VALUE + row + i] = carried(kind, value) if hit else 0.0


@formula
def altered(sent, kind, value, held, fresh):
    """What an attacked wire carries in place of what was sent."""
    changed = held if kind == HOLD else fresh
    changed = sent + value if kind == FDI else changed
    return value if kind == JAM else changed


@formula
def _deliver(s, c, row, n):
    """What arrives at a link."""
    if c[of.WIRE + np.int64(row) // LANES] == 0.0:
        for i in range(n):
            s[CLEAN + row + i] = s[ARRIVED + row + i] = s[FRESH + row + i] = s[SENT + row + i]
        return
    for i in range(n):
        sent, fresh, hit = s[SENT + row + i], s[FRESH + row + i], s[TARGET + row + i] != 0.0
        changed = altered(sent, s[KIND + i], s[VALUE + row + i], s[HELD + row + i], fresh)
        s[CLEAN + row + i], s[ARRIVED + row + i] = sent, changed if hit else sent
        s[FRESH + row + i] = fresh if hit else sent


@phase
def arrive(s, c, n):
    """What arrives of the sensor readings and of the V2V message under the command in force."""
    _deliver(s, c, _0, n)
    _deliver(s, c, _1, n)
    _deliver(s, c, _2, n)
    _deliver(s, c, _3, n)
    for i in range(n):
        drops = s[KIND + i] == DROPOUT
        s[VALID + i] = 0.0 if (s[TARGET + i] != 0.0) & drops else 1.0
        s[VALID + _1 + i] = 0.0 if (s[TARGET + _1 + i] != 0.0) & drops else 1.0


@phase
def actuate(s, f, n):
    """What the actuator gets of the command of the controller."""
    if f[of.ACTUATED] == 0:
        pass_on(s, n)
        return
    for i in range(n):
        u, fresh, hit = s[U + i], s[FRESH + _4 + i], s[TARGET + _4 + i] != 0.0
        changed = altered(u, s[KIND + i], s[VALUE + _4 + i], s[HELD + _4 + i], fresh)
        s[APPLIED + i], s[FRESH + _4 + i] = changed if hit else u, fresh if hit else u


@phase
def pass_on(s, n):
    """The command reaches the actuator as it is: nobody attacks the step before the first."""
    for i in range(n):
        s[APPLIED + i] = s[U + i]
