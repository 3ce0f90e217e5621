"""The channel of several agents as a lane, and the scripts and actions that decide in it, wire by wire: `tailgate.threat.Channel`.

Only wires that may be attacked are here, in the order of their agents: all others carry what is sent. Each has a record in the `window`,
one in `s`, and constants in the `table`. What a command costs is one for all (`channel.charge`).
"""

import numpy as np

from tailgate.elementwise import clip

from . import channel, road, script, seat
from . import constants as of
from .compiled import phase
from .rows import APPLIED as AIMED
from .rows import ATTACK_KEY, DRAWN, ELAPSED, KIND, LANES, ON, REFUSED, WANT_KIND
from .rows import WANT_TARGET as STRAY  # wires that are aimed at and may not be attacked

HELD, FRESH, TARGET, VALUE = (np.uint64(LANES * i) for i in range(4))  # in the window
WANT_TARGET, WANT_VALUE, CLEAN, SHOWN = (np.uint64(LANES * i) for i in range(4))  # in s; what an observation shows: the value sent last
WIRE = AIM = 4 * LANES
# In the table: what may be sent; its place in a vector of values; its element among the draws; its agent; where in `window` what is sent
# stands, and in `s` what arrives, and whether it does (of a reading, else -1); whether it is an actuator's; of its agent's wires the first.
BOUND, LOW, HIGH, PLACE, ELEMENT, AGENT, SENT, ARRIVED, VALID, ACTS, FIRST = range(11)
PER_WIRE = 11


@phase
def obey(s, asked, f, first, n):
    """The command of asked, (2 + 2 wires, B): kind, strays, targets and values, into the rows WANT_*. -> whether there is any."""
    some = 0.0
    for i in range(n):
        s[WANT_KIND + i], s[STRAY + i] = asked[0, first + i], asked[1, first + i]
        some += abs(s[WANT_KIND + i]) + s[STRAY + i]
    for w in range(f[of.WIRED]):
        aim = s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM]
        for i in range(n):
            aim[WANT_TARGET + i], aim[WANT_VALUE + i] = asked[2 + w, first + i], asked[2 + f[of.WIRED] + w, first + i]
            some += aim[WANT_TARGET + i]
    return some > 0.0


@phase
def decide(s, window, c, f, table, asked, n):
    """From the command in the rows WANT_*, if any is `asked` for, to the one in force, and what it costs. -> whether one was, or is."""
    before = _attacked(s, n)
    if not asked:
        channel.calm(s, c, n)
        for w in range(f[of.WIRED] if before else 0):
            wire = window[f[of.HUNTED] + w * WIRE : f[of.HUNTED] + (w + 1) * WIRE]
            for i in range(n):
                wire[TARGET + i] = wire[VALUE + i] = 0.0
        return False
    for i in range(n):
        s[AIMED + i] = s[REFUSED + i] = s[STRAY + i]
    for w in range(f[of.WIRED]):
        at = f[of.IN_WIRES] + w * PER_WIRE
        _judge(s, s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM], table[at + BOUND], table[at + LOW], table[at + HIGH], n)
    firsts = channel.charge(s, c, n)
    if not before and not _attacked(s, n):
        return False
    for w in range(f[of.WIRED]):
        wire = window[f[of.HUNTED] + w * WIRE : f[of.HUNTED] + (w + 1) * WIRE]
        _enforce(s, wire, s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM], n)
        if firsts > 0:
            for i in range(n):
                wire[HELD + i] = wire[FRESH + i] if s[AIMED + i] != 0.0 else wire[HELD + i]
    return True


@phase
def _attacked(s, n):
    """Whether a command is in force in any episode."""
    some = 0
    for i in range(n):
        some += 1 if s[KIND + i] != 0.0 else 0
    return some > 0


@phase
def _judge(s, aim, bound, low, high, n):
    """Counts a wire that is aimed at, and in REFUSED one whose value is not granted."""
    for i in range(n):
        aimed = aim[WANT_TARGET + i] != 0.0
        fits = channel.fits(s[WANT_KIND + i], aim[WANT_VALUE + i], bound, low, high)
        s[AIMED + i] += 1.0 if aimed else 0.0
        s[REFUSED + i] += 1.0 if aimed & (not fits) else 0.0


@phase
def _enforce(s, wire, aim, n):
    """What is in force at a wire."""
    for i in range(n):
        kind, value = s[KIND + i], aim[WANT_VALUE + i]
        hit = (aim[WANT_TARGET + i] != 0.0) & (kind != 0.0)
        wire[TARGET + i] = 1.0 if hit else 0.0
        wire[VALUE + i] = channel.carried(kind, value) if hit else 0.0


@phase
def arrive(s, window, f, table, acts, attacked, n):
    """What arrives under the command in force, in place of what was sent: at the actuators, or else at everybody else."""
    for w in range(f[of.WIRED]):
        at = f[of.IN_WIRES] + w * PER_WIRE
        if (table[at + ACTS] != 0.0) == acts:
            wire = window[f[of.HUNTED] + w * WIRE : f[of.HUNTED] + (w + 1) * WIRE]
            aim = s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM]
            to, valid = int(table[at + ARRIVED]), int(table[at + VALID])
            if not attacked and valid < 0:
                for i in range(n):
                    aim[CLEAN + i] = wire[FRESH + i] = s[to + i]
            elif not attacked:
                _sample(wire, aim, s[to : to + LANES], s[valid : valid + LANES], n)
            else:
                _reach(s, wire, aim, s[to : to + LANES], s[max(valid, 0) : max(valid, 0) + LANES], valid >= 0, n)


@phase
def _sample(wire, aim, arrived, valid, n):
    """A reading that arrives as it was sent, if it was not lost."""
    for i in range(n):
        aim[CLEAN + i], fresh = arrived[i], wire[FRESH + i]
        wire[FRESH + i] = arrived[i] if valid[i] != 0.0 else fresh


@phase
def _reach(s, wire, aim, arrived, valid, reads, n):
    """Any wire; what was lost on the way is no sample."""
    for i in range(n):
        sent, fresh, hit, lost = arrived[i], wire[FRESH + i], wire[TARGET + i] != 0.0, reads & (valid[i] == 0.0)
        changed = channel.altered(sent, s[KIND + i], wire[VALUE + i], wire[HELD + i], fresh)
        aim[CLEAN + i], arrived[i] = sent, changed if hit else sent
        wire[FRESH + i] = fresh if hit | lost else sent
    for i in range(n if reads else np.uint64(0)):
        drops = (wire[TARGET + i] != 0.0) & (s[KIND + i] == channel.DROPOUT)
        valid[i] = 0.0 if drops else valid[i]


@phase
def take_hold(window, f, table, n):
    """What the channel keeps of what is expected, which stands where it is sent."""
    for w in range(f[of.WIRED]):
        wire, sent = window[f[of.HUNTED] + w * WIRE : f[of.HUNTED] + (w + 1) * WIRE], int(table[f[of.IN_WIRES] + w * PER_WIRE + SENT])
        for i in range(n):
            wire[HELD + i] = wire[FRESH + i] = window[sent + i]


# -- scripts


@phase
def scripted(s, g, c, f, table, p, n):
    """The command of a script, whose trigger's condition stands in row ON, into the rows WANT_*. -> whether there is any."""
    if not script.open_now(s, c, p, n):
        return False
    for i in range(n):
        s[STRAY + i] = 0.0
    drawn, count = -1, f[of.WIRED]
    for w in range(count):
        aim, at = s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM], f[of.IN_WIRES] + w * PER_WIRE
        if p[script.PLACES + w] != 0.0:
            pair = int(table[at + ELEMENT]) // 2
            if pair != drawn:
                _deal(s, g, p, pair, n)
            drawn = pair
            odd = int(table[at + ELEMENT]) % 2
            u = s[np.int64(DRAWN) + odd * LANES : np.int64(DRAWN) + (odd + 1) * LANES]
            _value(s, aim, u, p, table[at + BOUND], table[at + LOW], table[at + HIGH], p[script.PLACES + count + w], n)
        else:
            for i in range(n):
                aim[WANT_TARGET + i] = aim[WANT_VALUE + i] = 0.0
    if p[script.CHANCE] < 1.0:
        for i in range(n):  # the kind, where anything is left
            s[DRAWN + i], s[WANT_KIND + i] = s[WANT_KIND + i], 0.0
        for w in range(count):
            aim, at = s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM], f[of.IN_WIRES] + w * PER_WIRE
            _spare(s, g, aim, p[script.CHANCE], int(table[at + AGENT]), table[at + FIRST] != 0.0, n)
    return True


@phase
def _deal(s, g, p, pair, n):
    """The random numbers of two wires that follow each other, if the script wants any, into the rows DRAWN."""
    if p[script.LAW] == script.UNIFORM or p[script.HIT] < 2.0:
        road.uniforms(s, g, ATTACK_KEY, script.ATTACK, np.uint64(pair), DRAWN, n)
    elif p[script.LAW] == script.GAUSSIAN:
        road.normals(s, g, ATTACK_KEY, script.ATTACK, np.uint64(pair), DRAWN, n)


@phase
def _value(s, aim, drawn, p, bound, low, high, sign, n):
    """What is sent on a wire."""
    kind, law, first, second, limit, turn, hit = (
        p[script.WHAT], p[script.LAW], p[script.FIRST], p[script.SECOND], p[script.LIMIT], p[script.TURN], p[script.HIT],
    )  # fmt: skip
    for i in range(n):
        count, u = s[ELAPSED + i] - 1.0, drawn[i]
        value, jams = script.worth(law, first, second, limit, count, u), (kind == channel.JAM) | (count >= turn)
        value = clip(value, low, high) if jams else clip(value, -bound, bound)
        on = (s[ON + i] != 0.0) & ((hit >= 2.0) | (u < hit))
        aim[WANT_TARGET + i] = on
        aim[WANT_VALUE + i] = value * sign if on & (law != script.NOTHING) else 0.0
        s[WANT_KIND + i] = (channel.JAM if (kind == channel.FDI) & (count >= turn) else kind) if on else s[WANT_KIND + i]


@phase
def _spare(s, g, aim, chance, agent, first, n):
    """Without luck, which is drawn at the `first` wire of an agent, nothing is sent to it; the kind stands in row DRAWN."""
    drawn = DRAWN + np.uint64(2 * LANES)
    if first:
        road.uniforms(s, g, ATTACK_KEY, script.CHANCES, np.uint64(agent // 2), drawn, n)
    luck = s[drawn + np.uint64(agent % 2 * LANES) :]
    for i in range(n):
        keeps = (luck[i] < chance) & (aim[WANT_TARGET + i] != 0.0)
        aim[WANT_TARGET + i] = keeps
        aim[WANT_VALUE + i] = aim[WANT_VALUE + i] if keeps else 0.0
        s[WANT_KIND + i] = s[DRAWN + i] if keeps else s[WANT_KIND + i]


# -- actions


@phase
def decode(s, window, c, f, table, action, first, n):
    """Actions (B, ACTIONS), of this block from `first` on, into the rows WANT_*. -> whether there is any command."""
    kind, some, wide = f[of.ACTION], 0, 2 + 2 * f[of.WIRED]
    discrete = kind == of.DISCRETE or kind == of.RAMPING
    for i in range(n):
        s[WANT_KIND + i] = s[STRAY + i] = 0.0
        some += 1 if action[first + i, 0] > 0.0 else 0  # the trigger, or the number of the action: 0 is none
    if some == 0:
        return False
    for i in range(n):
        if discrete:
            s[WANT_KIND + i] = table[f[of.IN_MODES] + np.int64(action[first + i, 0]) * wide]
        else:
            s[ON + i] = clip(action[first + i, 0], -1.0, 1.0) > 0.0
            s[WANT_KIND + i] = seat.FDI if s[ON + i] != 0.0 else 0.0
    for w in range(f[of.WIRED]):
        wire, aim = window[f[of.HUNTED] + w * WIRE : f[of.HUNTED] + (w + 1) * WIRE], s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM]
        at = f[of.IN_WIRES] + w * PER_WIRE
        if discrete:
            _choose(s, wire, aim, table[at + BOUND], c, f, table, action, w, first, n)
        else:
            _fill(s, wire, aim, table[at + BOUND], c, f, action, int(table[at + PLACE]), first, n)
    return True


@phase
def _choose(s, wire, aim, bound, c, f, table, action, w, first, n):
    """What a discrete action asks of a wire."""
    ramping, rate, wide = f[of.ACTION] == of.RAMPING, c[of.RATE], 2 + 2 * f[of.WIRED]
    for i in range(n):
        row = f[of.IN_MODES] + np.int64(action[first + i, 0]) * wide
        ramps = ramping & (table[row] == seat.FDI) & (s[KIND + i] == seat.FDI)
        aimed, value = table[row + 2 + w], table[row + 2 + f[of.WIRED] + w]
        value = clip(wire[VALUE + i] + rate * table[row + 1], -bound, bound) if ramps else value
        aim[WANT_TARGET + i] = aimed
        aim[WANT_VALUE + i] = value if aimed != 0.0 else 0.0


@phase
def _fill(s, wire, aim, bound, c, f, action, place, first, n):
    """What a vector of values asks of a wire."""
    rate, grows = c[of.RATE], f[of.ACTION] == of.INCREMENT
    for i in range(n):
        share = clip(action[first + i, place], -1.0, 1.0)
        before = wire[VALUE + i] if s[KIND + i] == seat.FDI else 0.0
        value = clip(before + rate * share, -bound, bound) if grows else bound * share
        on = s[ON + i] != 0.0
        aim[WANT_TARGET + i] = on
        aim[WANT_VALUE + i] = value if on else 0.0


@phase
def look(s, window, f, table, n):
    """What an observation needs: the values sent last, and behind them of each agent whether it is attacked."""
    attacked = f[of.AIMS] + f[of.WIRED] * AIM - LANES
    for w in range(f[of.WIRED]):
        wire, aim = window[f[of.HUNTED] + w * WIRE : f[of.HUNTED] + (w + 1) * WIRE], s[f[of.AIMS] + w * AIM : f[of.AIMS] + (w + 1) * AIM]
        if table[f[of.IN_WIRES] + w * PER_WIRE + FIRST] != 0.0:
            attacked += LANES
            for i in range(n):
                s[attacked + i] = 0.0
        for i in range(n):
            aim[SHOWN + i] = wire[VALUE + i]
            s[attacked + i] = max(s[attacked + i], wire[TARGET + i])
