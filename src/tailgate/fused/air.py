"""The radar and what reaches it over the air, as a lane: `tailgate.envs.radar`, and that part of `tailgate.threat.Channel`.

A step measures twice where anybody radiates: before the attack, for the next step, and by the same draws under what is radiated then.
"""

import numpy as np

from tailgate.draws import Role
from tailgate.envs import fmcw
from tailgate.envs.radar import NEAREST, UNIFORM
from tailgate.jit import compilable
from tailgate.kernels import _exp, _log

from . import channel, road
from . import constants as of
from .channel import DROPOUT, ECHO_DELAY, JAM, NOISE_JAM
from .compiled import formula, phase
from .rows import (
    ARRIVED,
    BEAT,
    CLEAN,
    DEALT,
    DELAY,
    DRAW,
    EGO,
    ENERGY,
    FRESH,
    HEARD,
    HEARS,
    HELD,
    KIND,
    LANES,
    LEAD_V,
    LEAD_X,
    POWER,
    PROBE,
    REFUSED,
    SENSORS,
    SENT,
    SNR,
    TARGET,
    UNDER,
    UNDER_ENERGY,
    UNDER_HEARS,
    VALID,
    VALUE,
    WANT_KIND,
    WANT_TARGET,
    WANT_VALUE,
    WORLD_KEY,
)

compilable(fmcw.gamma)  # which mean_power calls
mean_power = formula(fmcw.mean_power)
beats, range_speed, passes = formula(fmcw.beats), formula(fmcw.range_speed), formula(fmcw.passes)
tone_variance, outlier_odds = formula(fmcw.tone_variance), formula(fmcw.outlier_odds)
_charge = channel.charging(aired=True)
_SENSOR = np.uint64(int(Role.SENSOR) << 16)
_UNIFORM = np.uint64(int(Role.SENSOR) << 16 | UNIFORM)
_0, _1, _2, _3, _4 = (np.uint64(LANES * i) for i in range(5))  # rows further down


@formula
def _received(gap, power, echo, jammed):
    """What a radar receives from a gap [m], over its noise: of a jammer, and of its own echo."""
    near = np.maximum(gap, NEAREST)
    square = near * near
    return jammed * power / square, echo / (square * square)


@phase
def measure(s, g, c, f, n):
    """The readings at the step that g holds under what is radiated, POWER and DELAY, into the rows UNDER."""
    echo, jammed, samples, high = c[of.ECHO], c[of.JAMMED], c[of.SAMPLES], c[of.HIGHEST]
    per_metre, per_speed, lowest, band = c[of.PER_METRE], c[of.PER_SPEED], c[of.LOWEST], c[of.IF_BAND]
    sd0, sd1, least, most = c[of.SENSOR_SD], c[of.SENSOR_SD + 1], c[of.REACH], c[of.REACH + 1]
    bound, widest = c[of.LEAST_BOUND], c[of.WIDEST]
    road.four_normals(s, g, WORLD_KEY, _SENSOR, np.uint64(0), DRAW, n)
    road.uniforms(s, g, WORLD_KEY, _UNIFORM, np.uint64(0), DEALT, n)
    road.uniforms(s, g, WORLD_KEY, _UNIFORM, np.uint64(1), DEALT + _2, n)
    for i in range(n):
        gap, speed = 0.0 + (s[LEAD_X + i] - s[EGO + i]), 0.0 + (s[LEAD_V + i] - s[EGO + _1 + i])
        jam, tone = _received(gap, s[POWER + i], echo, jammed)
        s[SNR + i] = samples * tone / (1.0 + jam)
        up, down = beats(gap + sd0 * s[DRAW + i] + s[DELAY + i], speed + sd1 * s[DRAW + _1 + i], per_metre, per_speed)
        s[BEAT + i], s[BEAT + _1 + i] = up, down
        s[UNDER_HEARS + i] = (s[PROBE + i] != 0.0) & passes(up, down, lowest, high)
    for i in range(n):
        s[UNDER + i] = _log(s[SNR + i])
    for i in range(n):
        s[UNDER + i] = _exp(outlier_odds(s[SNR + i], s[UNDER + i]))
    for i in range(n):
        lost, sd = 1.0 / (1.0 + s[UNDER + i]), band * np.sqrt(tone_variance(s[SNR + i], bound, widest))
        up, down = s[BEAT + i] + sd * s[DRAW + _2 + i], s[BEAT + _1 + i] + sd * s[DRAW + _3 + i]
        s[BEAT + i] = lowest + band * s[DEALT + _1 + i] if s[DEALT + i] < lost else up
        s[BEAT + _1 + i] = lowest + band * s[DEALT + _3 + i] if s[DEALT + _2 + i] < lost else down
    for i in range(n):
        d, dv = range_speed(s[BEAT + i], s[BEAT + _1 + i], per_metre, per_speed)
        there = (s[UNDER_HEARS + i] != 0.0) & (d >= least) & (d <= most)
        s[UNDER_HEARS + i] = there
        s[UNDER + i], s[UNDER + _1 + i] = d if there else 0.0, dv if there else 0.0
    silent = 0
    for i in range(n):
        s[UNDER_ENERGY + i] = 0.0
        silent += 1 if s[PROBE + i] == 0.0 else 0
    if silent > 0:
        _hear(s, g, c, n)


@phase
def _hear(s, g, c, n):
    """What a silent radar hears, into UNDER_ENERGY."""
    echo, jammed, samples, loud, share = c[of.ECHO], c[of.JAMMED], c[of.LISTENED], c[of.LOUD], c[of.LOUD_SHARE]
    road.four_normals(s, g, WORLD_KEY, _SENSOR, np.uint64(2), DRAW, n)
    for i in range(n):
        power, delay = s[POWER + i], s[DELAY + i]
        jam, tone = _received(0.0 + (s[LEAD_X + i] - s[EGO + i]), power, echo, jammed)
        attacked = (power > 0.0) | (delay > 0.0)
        heard, scale = loud if attacked else samples, share if attacked else 1.0
        tone = tone if delay > 0.0 else 0.0
        energy = mean_power(samples, heard, jam * scale, tone * scale, s[DRAW + i], s[DRAW + _1 + i], s[DRAW + _2 + i])
        s[UNDER_ENERGY + i] = energy if s[PROBE + i] == 0.0 else 0.0


@phase
def listen(s, g, c, f, n):
    """The readings at the step that g holds, before any attack."""
    for i in range(n):
        s[POWER + i] = s[DELAY + i] = 0.0
    measure(s, g, c, f, n)
    for i in range(n):
        s[SENT + i], s[SENT + _1 + i], s[HEARS + i] = s[UNDER + i], s[UNDER + _1 + i], s[UNDER_HEARS + i]
        s[ENERGY + i] = s[UNDER_ENERGY + i]


@phase
def rest(s, c, n):
    """What `decide` and `arrive` come to where no command is asked for."""
    channel.calm(s, c, n)
    for j in range(SENSORS):
        row = np.uint64(j * LANES)
        for i in range(n):
            sent, hears = s[SENT + row + i], s[HEARS + i] != 0.0
            s[CLEAN + row + i] = s[ARRIVED + row + i] = sent
            s[VALID + row + i] = hears
            s[FRESH + row + i] = sent if hears else s[FRESH + row + i]
    for i in range(n):
        s[HEARD + i] = s[ENERGY + i]


@phase
def _judge(s, c, n):
    """Counts in REFUSED what is sent over the air with a value that is not granted, or at the actuator."""
    strongest, latest = c[of.STRONGEST], c[of.LATEST]
    for i in range(n):
        kind = s[WANT_KIND + i]
        most = strongest if kind == NOISE_JAM else latest
        first, second, t0, t1 = s[WANT_VALUE + i], s[WANT_VALUE + _1 + i], s[WANT_TARGET + i] != 0.0, s[WANT_TARGET + _1 + i] != 0.0
        fits = ((not t0) | ((first > 0.0) & (first <= most))) & ((not t1) | ((second > 0.0) & (second <= most)))
        airs = (kind == NOISE_JAM) | (kind == ECHO_DELAY)
        s[REFUSED + i] += 1.0 if airs & ((not fits) | (s[WANT_TARGET + _4 + i] != 0.0)) else 0.0


@phase
def decide(s, c, n):
    """From the command that was asked for to the one in force, and what it costs."""
    channel.count(s, c, n)
    channel.judge(s, c, _0, n)
    channel.judge(s, c, _1, n)
    channel.judge(s, c, _4, n)
    _judge(s, c, n)
    firsts = _charge(s, c, n)
    channel.enforce(s, c, _4, n)
    granted0, granted1 = c[of.WIRE] != 0.0, c[of.WIRE + 1] != 0.0
    for i in range(n):  # who reaches the receiver over the air reaches all that it reads
        kind, value0, value1 = s[KIND + i], s[WANT_VALUE + i], s[WANT_VALUE + _1 + i]
        hit0, hit1 = granted0 & (s[WANT_TARGET + i] != 0.0) & (kind != 0.0), granted1 & (s[WANT_TARGET + _1 + i] != 0.0) & (kind != 0.0)
        airs, valued = kind >= NOISE_JAM, (kind == JAM) | (kind == channel.FDI)
        strength = np.maximum(value0 if hit0 else 0.0, value1 if hit1 else 0.0)
        s[TARGET + i], s[TARGET + _1 + i] = airs | hit0, airs | hit1
        s[VALUE + i] = strength if airs else value0 if hit0 & valued else 0.0
        s[VALUE + _1 + i] = strength if airs else value1 if hit1 & valued else 0.0
    if firsts > 0:
        channel.hold(s, n)


@phase
def _radiate(s, c, n):
    """Rows POWER and DELAY of the command in force. -> whether anybody radiates."""
    strongest, some = c[of.STRONGEST], 0
    for i in range(n):
        kind, hit = s[KIND + i], (s[TARGET + i] != 0.0) | (s[TARGET + _1 + i] != 0.0)
        power = s[VALUE + i] if kind == NOISE_JAM else strongest if kind == JAM else 0.0
        s[POWER + i], s[DELAY + i] = power if hit else 0.0, s[VALUE + i] if hit & (kind == ECHO_DELAY) else 0.0
        some += 1 if hit & ((kind == JAM) | (kind >= NOISE_JAM)) else 0
    return some > 0


@formula
def _deliver(s, row, n):
    """What arrives of a reading."""
    for i in range(n):
        sent, heard, fresh, kind = s[SENT + row + i], s[UNDER + row + i], s[FRESH + row + i], s[KIND + i]
        hit = s[TARGET + row + i] != 0.0
        changed = channel.altered(heard, kind, s[VALUE + row + i], s[HELD + row + i], fresh)
        s[CLEAN + row + i], s[ARRIVED + row + i] = sent, changed if hit & (kind < NOISE_JAM) else heard
        s[FRESH + row + i] = fresh if hit | (s[HEARS + i] == 0.0) else sent  # nothing is no sample
        there = s[HEARS + i] if kind == JAM else s[UNDER_HEARS + i]  # what a jammer leaves is read where anything is
        s[VALID + row + i] = 0.0 if hit & (kind == DROPOUT) else there


@phase
def arrive(s, g, c, f, n):
    """What arrives of the readings under the command in force."""
    if _radiate(s, c, n):
        measure(s, g, c, f, n)
    else:
        for i in range(n):
            s[UNDER + i], s[UNDER + _1 + i], s[UNDER_HEARS + i] = s[SENT + i], s[SENT + _1 + i], s[HEARS + i]
            s[UNDER_ENERGY + i] = s[ENERGY + i]
    for i in range(n):
        s[HEARD + i] = s[UNDER_ENERGY + i]
    _deliver(s, _0, n)
    _deliver(s, _1, n)
