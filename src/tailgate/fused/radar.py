"""A step of a car with a radar from its lanes, in the order of `tailgate.fused.step`: `tailgate.envs.radar_following` with `acc_radar`.

The state is x = [d, dv, a_L, v_F], of which the last is the model's known input: its row of A is zero. So its covariance with the others
is zero as well, and it is read by no sensor: the filter is that of three states (`kalman`) with a fourth that stands in a row of its own.
"""

import numpy as np

from tailgate.draws import Role
from tailgate.envs import radar_car, radar_following
from tailgate.kinds import Kind

from . import air, channel, imm, kalman, printed, regression, road, script, seat, step
from . import constants as of
from .compiled import formula, phase
from .rows import (
    APPLIED,
    DRAWN,
    EGO,
    EXO,
    FORGET,
    HEARS,
    KIND,
    LANES,
    LAST,
    LAST_DELAY,
    LAST_POWER,
    LEAD_A,
    LEAD_V,
    LEAD_X,
    MODE,
    NOISE,
    ON,
    OWN,
    OWN_VAR,
    PROBE,
    PROBED,
    REAR_V,
    REAR_X,
    SENT,
    SILENT,
    STEP,
    TRUTH,
    VALUE,
    ZERO,
    K,
    P,
    U,
    X,
)

lagged, wanted = formula(radar_following.lagged), formula(radar_car.wanted)
_1, _2, _3, _4 = (np.uint64(LANES * i) for i in range(1, 5))
_WAY = np.uint64(int(Role.MANOEUVRE) << 16)
_NOISE_JAM, _ECHO_DELAY = float(Kind.NOISE_JAM), float(Kind.ECHO_DELAY)


@phase
def _move_and_measure(s, g, intent, c, f, table, tick, n):
    """The rest of a step after the command is applied; leaves k one higher."""
    dt, load, keep, gain = c[of.DT], c[of.LOAD], c[of.KEEP], c[of.GAIN]
    road.way(s, g, c, f, table, _WAY, n)
    road.follow(s, intent, c, f, tick, n)
    for i in range(n):
        a = lagged(s[EGO + _2 + i], s[APPLIED + i] / load, keep, gain)
        x, v = road.roll(s[EGO + i], s[EGO + _1 + i], a, dt)
        s[EGO + i], s[EGO + _1 + i], s[EGO + _2 + i] = x, v, a
    for i in range(n):
        before = s[LEAD_V + i]
        s[LEAD_X + i], s[LEAD_V + i] = road.roll(s[LEAD_X + i], before, s[EXO + i], dt)
        s[LEAD_A + i] = (s[LEAD_V + i] - before) / dt
    road.next_step(s, g, n)
    air.listen(s, g, c, f, n)


@phase
def _control(s, c, n):
    """The command of the cruise control, on the estimate and on the trusted own speed."""
    headway, standstill, g, tau, gain = c[of.HEADWAY], c[of.STANDSTILL], c[of.GAMMA], c[of.LOWER_TAU], c[of.LOWER_GAIN]
    set_speed, sample, low, high = c[of.SET_SPEED], c[of.SAMPLE], c[of.ACCEL_MIN], c[of.ACCEL_MAX]
    for i in range(n):
        mode, v = s[MODE + i], s[EGO + _1 + i]
        speed = wanted(s[X + i], s[X + _1 + i], v, road.widened(headway, mode), standstill, g, tau, gain, set_speed)
        s[U + i] = np.minimum(np.maximum(road.obeyed((speed - v) / sample, mode), low), high)


@phase
def start(s, g, window, intent, c, f, table, tick, n):
    """Fresh episodes at k = 1, measured: keys and episode numbers stand in g."""
    step.clear(s, g, window, intent, c, n)
    x, v, a, behind, behind_v, var = c[of.START], c[of.START + 1], c[of.START + 2], c[of.REAR_START], c[of.REAR_START + 1], c[of.OWN_PRIOR]
    for i in range(n):
        s[EGO + i], s[EGO + _1 + i], s[EGO + _2 + i], s[LEAD_A + i] = x, v, a, 0.0
        s[REAR_X + i], s[REAR_V + i] = x - behind, behind_v
        s[OWN + i], s[OWN_VAR + i] = v, var
        s[PROBE + i] = s[PROBED + i] = 1.0
    for j in range(9):
        row, var = np.uint64(j * LANES), c[of.PRIOR + j]
        for i in range(n):
            s[P + row + i] = var
    _remember(s, n)
    for i in range(n):
        s[X + i], s[X + _1 + i], s[X + _2 + i] = s[TRUTH + i], s[TRUTH + _1 + i], s[TRUTH + _2 + i]
    if f[of.MODELED] != 0:
        imm.begin(s, window, c, f[of.MODELED], n)
    elif f[of.PRINTED] != 0:
        printed.begin(s, window, c, n)
    elif f[of.CHALLENGED] != 0:
        regression.begin(s, window, f, n)
    step.begin_way(s, g, c, f, n)
    for i in range(n):
        s[K + i] = 0.0
        g[STEP + i] = np.uint64(0)
        s[SENT + i], s[SENT + _1 + i], s[SENT + _2 + i], s[SENT + _3 + i] = 0.0 + s[X + i], 0.0 + s[X + _1 + i], 0.0, 0.0
    _control(s, c, n)
    step.take_hold(s, n)
    channel.pass_on(s, n)
    _move_and_measure(s, g, intent, c, f, table, tick, n)


@phase
def _remember(s, n):
    """The truth at k, before anything moves: all but the own speed, which the filter has."""
    for i in range(n):
        s[TRUTH + i], s[TRUTH + _1 + i], s[TRUTH + _2 + i] = s[LEAD_X + i] - s[EGO + i], s[LEAD_V + i] - s[EGO + _1 + i], s[LEAD_A + i]


@phase
def advance(s, g, window, intent, c, f, table, tick, asked, n):
    """A step under the command in the rows WANT_*, if any is `asked` for. What a Frame shows stands in the rows afterwards."""
    if asked:
        air.decide(s, c, n)
        air.arrive(s, g, c, f, n)
    else:
        air.rest(s, c, n)
    if f[of.RAW] != 0:
        kalman.read(s, n)
        for i in range(n):
            s[OWN + i] = 0.0 + s[EGO + _1 + i]
    elif f[of.MODELED] != 0:
        imm.step_known(s, window, c, f, n)
    elif f[of.PRINTED] != 0:
        printed.step(s, g, window, c, f, n)
    elif f[of.CHALLENGED] != 0:
        regression.step(s, g, window, c, f, n)
    else:
        kalman.predict_known(s, c, f, n)
        kalman.innovation(s, c, of.RNOISE, n)
        kalman.weigh(s, window, c, f, n)
        if f[of.MITIGATION] == of.REACQUIRE:
            broad = c[of.OWN_BROAD]
            for i in range(n):
                s[OWN_VAR + i] = broad if s[FORGET + i] != 0.0 else s[OWN_VAR + i]
        if f[of.ROBUST] != 0:
            kalman.take_out(s, c, f, n)
        kalman.update(s, f, n)
    _control(s, c, n)
    channel.actuate(s, f, n)
    _remember(s, n)
    _move_and_measure(s, g, intent, c, f, table, tick, n)
    road.collide(s, f, n)


@phase
def decide(s, g, window, c, f, table, p, n):
    """The command of a script into the rows WANT_*. -> whether there is any."""
    if not script.ready(s, c, p, n):
        return False
    if p[script.HOPS] != 0.0:
        for i in range(n):
            s[ON + i] = s[ON + i] if s[PROBED + i] != 0.0 else 0.0
    script.deal(s, g, p, n)
    for i in range(n):  # the actuator is the third of its wires
        s[DRAWN + _4 + i] = s[DRAWN + _2 + i]
    script.sample(s, c, p, n)
    if p[script.CHANCE] < 1.0:
        script.spare(s, g, p[script.CHANCE], n)
    return True


# What an observation shows of a radar on top of `seat.QUANTITIES`, and in place of some of them.
QUANTITIES = {
    "last_distance": (LAST, ZERO), "last_relative_speed": (LAST + _1, ZERO), "last_power": (LAST_POWER, ZERO),
    "last_delay": (LAST_DELAY, ZERO), "probed": (PROBED, ZERO), "noise_distance": (NOISE, ZERO),
    "noise_relative_speed": (NOISE + _1, ZERO), "silent": (SILENT, ZERO),
}  # fmt: skip


@phase
def look(s, window, c, f, table, paid, flags, count, mask, first, n):
    """What the information of a step shows of the state that it led to, and what the observation needs of it."""
    seat.look(s, window, c, f, table, paid, flags, count, mask, first, n)
    for i in range(n):
        kind, value = s[KIND + i], s[VALUE + i]
        s[LAST_POWER + i], s[LAST_DELAY + i] = value if kind == _NOISE_JAM else 0.0, value if kind == _ECHO_DELAY else 0.0
        s[LAST + i], s[LAST + _1 + i] = value if kind < _NOISE_JAM else 0.0, s[VALUE + _1 + i] if kind < _NOISE_JAM else 0.0
        gap, speed, hears = s[LEAD_X + i] - s[EGO + i], s[LEAD_V + i] - s[EGO + _1 + i], s[HEARS + i] != 0.0
        s[NOISE + i], s[NOISE + _1 + i] = s[SENT + i] - gap if hears else 0.0, s[SENT + _1 + i] - speed if hears else 0.0
        s[SILENT + i] = 0.0 if hears else 1.0
