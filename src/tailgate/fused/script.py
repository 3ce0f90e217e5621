"""Scripted attacks as a lane: a trigger, a law of the values, and the wires that they reach (`tailgate.agents.scripted`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate.agents import radio, scripted
from tailgate.agents.model_based import Stealth
from tailgate.agents.triggers import Closing, Fast, LeaderBraking, Near, Slow, Trigger
from tailgate.agents.values import FAINTEST
from tailgate.core import AIRED, Array, Kind
from tailgate.draws import Role
from tailgate.elementwise import clip

from . import channel, road, stealth
from . import constants as of
from .compiled import formula, phase
from .rows import (
    ATTACK_KEY,
    DRAWN,
    EGO,
    ELAPSED,
    LANES,
    LEAD_V,
    LEAD_X,
    ON,
    OPENED,
    PASSES,
    SEEN,
    WANT_KIND,
    WANT_TARGET,
    WANT_VALUE,
    WIRES,
    K,
    wires_of,
)

# A script as numbers: what each place of the array holds.
WHEN, THRESHOLD, BEGIN, WINDOW, ON_FOR, OFF_FOR, CHANCE = range(7)
WHAT, LAW, FIRST, SECOND, LIMIT, HIT, TURN = range(7, 14)
AIM, SIGN = 14, 19  # five places each: the wires, and a factor for each
PUSHED, TOWARDS, GATE = 24, 25, 26  # of the white-box attack: a state, a sign, and a gate; NaN: the defence's own
MOST, HOPS = 27, 28  # over the air: the most that may be sent; whether only after a probe that was heard
PLACES = 29
TIME, NEAR, CLOSING, FAST, SLOW, LEADER_BRAKING = range(6)
NOTHING, CONSTANT, UNIFORM, GAUSSIAN, RAMP, STEALTH = range(6)

_WHEN = {Trigger: TIME, Near: NEAR, Closing: CLOSING, Fast: FAST, Slow: SLOW, LeaderBraking: LEADER_BRAKING}
ATTACK = np.uint64(int(Role.ATTACK) << 16)
CHANCES = np.uint64(int(Role.ATTACK) << 16 | scripted.CHANCE)
_1 = np.uint64(LANES)
_JAM, _FDI, _AIRED = float(Kind.DOS_JAM), float(Kind.FDI), float(min(AIRED))
_LANES = {
    scripted.NoAttack, scripted.Jam, scripted.Hold, scripted.Dropout, scripted.Inject, scripted.InjectGaussian, scripted.InjectBernoulli,
    scripted.InjectRamp, scripted.InjectThenJam, scripted.InjectUniform, Stealth, radio.NoiseJam, radio.EchoDelay, radio.EchoPullOff,
}  # fmt: skip


def known(attack: Any) -> bool:
    """Whether an attack is a script that has a lane."""
    return type(attack) in _LANES and type(getattr(attack, "when", Trigger())) in _WHEN


def numbers(attack: Any, plan: Any) -> Array | None:
    """A script as (PLACES,) numbers, None where it has no lane."""
    if not known(attack):
        return None
    p = law(attack, plan)
    p[SIGN : SIGN + WIRES] = 1.0
    if type(attack) is not scripted.NoAttack:
        mine = np.array(wires_of(plan.target.shape[1]))
        p[AIM + mine], p[SIGN + mine] = plan.target[0], signs(attack, plan)[0]
    return p


def signs(attack: Any, plan: Any) -> Array:
    """(N, w) the factor of what is injected at each wire."""
    out = np.ones(plan.target.shape)
    return np.asarray(plan.extra) if type(attack) is scripted.Inject and plan.extra is not None else out


def law(attack: Any, plan: Any) -> Array:
    """All of it but the wires that it reaches."""
    p = np.zeros(PLACES)
    p[[WINDOW, ON_FOR, CHANCE, HIT, TURN, LIMIT]] = np.inf, np.inf, 1.0, 2.0, np.inf, np.inf
    if type(attack) is scripted.NoAttack:
        p[BEGIN] = np.inf
        return p
    kind, threat = type(attack), plan.brief.threat
    if kind is scripted.Jam:
        p[WHAT], p[LAW], p[FIRST], p[SECOND] = Kind.DOS_JAM, UNIFORM, attack.low, attack.high
    elif kind is scripted.Hold:
        p[WHAT] = Kind.DOS_HOLD_FRESH if attack.fresh else Kind.DOS_HOLD
    elif kind is scripted.Dropout:
        p[WHAT], p[HIT] = Kind.DROPOUT, attack.probability
    elif kind is scripted.Inject:
        p[WHAT], p[LAW], p[FIRST] = Kind.FDI, CONSTANT, attack.value
    elif kind is scripted.InjectGaussian:
        p[WHAT], p[LAW], p[FIRST], p[SECOND] = Kind.FDI, GAUSSIAN, attack.mean, attack.sd
    elif kind is scripted.InjectBernoulli:
        p[WHAT], p[LAW], p[FIRST], p[HIT] = Kind.FDI, CONSTANT, attack.value, attack.probability
    elif kind is scripted.InjectRamp:
        p[WHAT], p[LAW], p[FIRST], p[SECOND], p[LIMIT] = Kind.FDI, RAMP, attack.base, attack.rate, attack.limit
    elif kind is scripted.InjectThenJam:
        p[WHAT], p[LAW], p[FIRST], p[TURN] = Kind.FDI, CONSTANT, attack.value, attack.inject
    elif kind is scripted.InjectUniform:
        p[WHAT], p[LAW], p[FIRST], p[SECOND] = Kind.FDI, UNIFORM, attack.low, attack.high
    elif kind is radio.NoiseJam:
        p[WHAT], p[LAW], p[FIRST], p[MOST] = Kind.NOISE_JAM, CONSTANT, attack.power, threat.jam_power
    elif kind is radio.EchoDelay:
        p[WHAT], p[LAW], p[FIRST], p[MOST] = Kind.ECHO_DELAY, CONSTANT, attack.delay, threat.delay_bound
    elif kind is radio.EchoPullOff:
        p[WHAT], p[LAW], p[FIRST], p[SECOND], p[LIMIT] = Kind.ECHO_DELAY, RAMP, attack.base, attack.rate, threat.delay_bound
        p[MOST] = threat.delay_bound
    else:
        p[WHAT], p[LAW], p[PUSHED], p[TOWARDS] = Kind.FDI, STEALTH, attack.state_index, attack.sign
        p[GATE] = np.nan if attack.gate is None else attack.gate
    when = attack.when
    p[WHEN], p[THRESHOLD], p[BEGIN] = _WHEN[type(when)], getattr(when, "threshold", 0.0), max(when.start, threat.onset)
    p[WINDOW] = np.inf if when.window is None else when.window
    p[ON_FOR], p[OFF_FOR] = (np.inf, 0.0) if attack.burst is None else (attack.burst, attack.pause)
    p[CHANCE] = attack.chance
    p[HOPS] = getattr(attack, "hop", False)
    return p


@phase
def _holds(s, c, p, n):
    """Row ON: whether the trigger's condition holds."""
    kind, threshold, dt = p[WHEN], p[THRESHOLD], c[of.DT]
    for i in range(n):
        gap, speed, lead = s[LEAD_X + i] - s[EGO + i], s[EGO + _1 + i], s[LEAD_V + i]
        holds = kind == TIME
        holds |= (kind == NEAR) & (gap < threshold)
        holds |= (kind == CLOSING) & (speed - lead > threshold)
        holds |= (kind == FAST) & (speed > threshold)
        holds |= (kind == SLOW) & (speed < threshold)
        holds |= (kind == LEADER_BRAKING) & ((s[SEEN + i] - lead) / dt > threshold)
        s[ON + i] = holds
        s[SEEN + i] = lead


@phase
def open_now(s, c, p, n):
    """From the condition in row ON to who is attacked now, with no kind so far in row WANT_KIND. -> whether anybody is."""
    begin, window, on_for, off_for = p[BEGIN], p[WINDOW], p[ON_FOR], p[OFF_FOR]
    for i in range(n):
        opened = (s[OPENED + i] != 0.0) | ((s[ON + i] != 0.0) & (s[K + i] >= begin))
        count = s[ELAPSED + i]
        s[ON + i] = opened & (count < window)
        s[OPENED + i] = opened
        s[ELAPSED + i] = count + s[OPENED + i]
    if on_for < np.inf:
        whole = on_for + off_for
        for i in range(n):
            count = s[ELAPSED + i] - s[OPENED + i]
            s[ON + i] = s[ON + i] if count - whole * np.floor(count / whole) < on_for else 0.0
    channel.open_within(s, c, 1.0, WANT_KIND, n)
    some = False
    for i in range(n):
        on = (s[ON + i] != 0.0) & (s[WANT_KIND + i] != 0.0)
        s[ON + i] = on
        s[WANT_KIND + i] = 0.0
        some |= on
    return some


@phase
def ready(s, c, p, n):
    """Row ON: who is attacked now, with no command so far in the rows WANT_*. -> whether anybody is."""
    _holds(s, c, p, n)
    if not open_now(s, c, p, n):
        return False
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        for i in range(n):
            s[WANT_TARGET + row + i] = s[WANT_VALUE + row + i] = 0.0
    return True


@phase
def decide(s, g, window, c, f, table, p, n):
    """The command of the script into the rows WANT_*. -> whether there is any."""
    if not ready(s, c, p, n):
        return False
    if p[LAW] == STEALTH:
        _push(s, window, c, f, p, n)
    else:
        deal(s, g, p, n)
        sample(s, c, p, n)
    if p[CHANCE] < 1.0:
        spare(s, g, p[CHANCE], n)
    return True


@phase
def _push(s, window, c, f, p, n):
    """The white-box attack's command."""
    sign, bound, aim0, aim1, own = p[TOWARDS], c[of.BOUND], p[AIM] != 0.0, p[AIM + 1] != 0.0, p[GATE]
    stealth.look(s, c, f, np.int64(p[PUSHED]), n)
    stealth.gate(s, window, c, f, own, n)
    stealth.push(s, sign, aim0, aim1, bound, n)
    for w in range(WIRES):
        row, aimed = np.uint64(w * LANES), p[AIM + w] != 0.0
        for i in range(n):
            on = (s[ON + i] != 0.0) & (s[PASSES + i] != 0.0) & aimed
            s[WANT_TARGET + row + i] = on
            s[WANT_VALUE + row + i] = s[WANT_VALUE + row + i] if on else 0.0
            s[WANT_KIND + i] = _FDI if on else s[WANT_KIND + i]


@phase
def deal(s, g, p, n):
    """The random numbers of the values and of who is hit."""
    law = p[LAW]
    if law == UNIFORM or p[HIT] < 2.0:
        for b in range(3):
            road.uniforms(s, g, ATTACK_KEY, ATTACK, np.uint64(b), DRAWN + np.uint64(2 * b * LANES), n)
    elif law == GAUSSIAN:
        for b in range(3):
            road.normals(s, g, ATTACK_KEY, ATTACK, np.uint64(b), DRAWN + np.uint64(2 * b * LANES), n)


@formula
def worth(law, first, second, limit, count, u):
    """What the law of the values says, so many steps after the window opened."""
    value = first
    value = first + (second - first) * u if law == UNIFORM else value
    value = first + second * u if law == GAUSSIAN else value
    return clip(first + second * (count + 1.0), -limit, limit) if law == RAMP else value


@phase
def sample(s, c, p, n):
    """What is sent."""
    kind, law, first, second, limit, turn = p[WHAT], p[LAW], p[FIRST], p[SECOND], p[LIMIT], p[TURN]
    hit, airs = p[HIT], p[WHAT] >= _AIRED
    spans = kind == _JAM or airs
    for w in range(WIRES):
        row, aim, sign = np.uint64(w * LANES), p[AIM + w], p[SIGN + w]
        bound, low, high = c[of.BOUND + w], FAINTEST if airs else c[of.LOW + w], p[MOST] if airs else c[of.HIGH + w]
        for i in range(n):
            count, u = s[ELAPSED + i] - 1.0, s[DRAWN + row + i]
            value = worth(law, first, second, limit, count, u)
            value = clip(value, low, high) if spans | (count >= turn) else clip(value, -bound, bound)
            on = (s[ON + i] != 0.0) & (aim != 0.0) & ((hit >= 2.0) | (u < hit))
            s[WANT_TARGET + row + i] = on
            s[WANT_VALUE + row + i] = value * sign if on & (law != NOTHING) else 0.0
            s[WANT_KIND + i] = (_JAM if (kind == _FDI) & (count >= turn) else kind) if on else s[WANT_KIND + i]


@phase
def spare(s, g, chance, n):
    """Without luck nothing is sent."""
    road.uniforms(s, g, ATTACK_KEY, CHANCES, np.uint64(0), DRAWN, n)
    for i in range(n):
        s[WANT_KIND + i] = s[WANT_KIND + i] if s[DRAWN + i] < chance else 0.0
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        for i in range(n):
            s[WANT_TARGET + row + i] = s[WANT_TARGET + row + i] if s[DRAWN + i] < chance else 0.0
            s[WANT_VALUE + row + i] = s[WANT_VALUE + row + i] if s[DRAWN + i] < chance else 0.0
