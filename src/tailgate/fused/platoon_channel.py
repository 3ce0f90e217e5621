"""The channel of a platoon as a lane, and the scripts that decide in it: `tailgate.threat.Channel` on the wires of the victims alone.

Victims are the cars with a wire that may be attacked; all other wires carry what is sent. What a command costs is one for all
(`channel.charge`).
"""

import numpy as np

from tailgate.elementwise import clip
from tailgate.vector import WIDTH, alike, get, put

from . import channel, road, script
from . import constants as of
from .compiled import phase
from .platoon_filter import AIM, WORK
from .platoon_rows import (
    AHEAD,
    APPLIED,
    ARRIVED,
    CLEAN,
    COMMAND,
    FRESH,
    GAP,
    HELD,
    LINKS,
    SEEN,
    SENSORS,
    SENT,
    TARGET,
    VALID,
    VALUE,
    VICTIM_ROWS,
    WANT_TARGET,
    WANT_VALUE,
    WIRES,
    V,
)
from .rows import APPLIED as AIMED
from .rows import ATTACK_KEY, DRAWN, ELAPSED, KIND, LANES, ON, REFUSED, WANT_KIND
from .rows import WANT_TARGET as STRAY  # wires that are aimed at and belong to nobody that may be attacked

VICTIM = VICTIM_ROWS * LANES
_COMMAND = np.uint64(LINKS * LANES)  # the last wire
GRANTED, BOUND, LOW, HIGH, PLACE = (WIRES * i for i in range(5))  # of each wire of a victim, in the table; its place in an action
PER_VICTIM = 5 * WIRES


@phase
def obey(s, asked, f, first, n):
    """The command of asked, (2 + 2 V WIRES, B): kind, strays, each victim's targets and values, into the rows WANT_*. -> whether any."""
    some = 0.0
    for i in range(n):
        s[WANT_KIND + i], s[STRAY + i] = asked[0, first + i], asked[1, first + i]
        some += abs(s[WANT_KIND + i]) + s[STRAY + i]
    for h in range(f[of.VICTIMS]):
        aim = s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM]
        for w in range(WIRES):
            row, at = np.uint64(w * LANES), 2 + 2 * WIRES * h + w
            for i in range(n):
                aim[WANT_TARGET + row + i], aim[WANT_VALUE + row + i] = asked[at, first + i], asked[at + WIRES, first + i]
                some += aim[WANT_TARGET + row + i]
    return some > 0.0


@phase
def decide(s, window, c, f, table, asked, n):
    """From the command in the rows WANT_*, if any is `asked` for, to the one in force, and what it costs."""
    if asked:
        for i in range(n):
            s[AIMED + i] = s[REFUSED + i] = s[STRAY + i]
        for h in range(f[of.VICTIMS]):
            judge(s, s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM], table[f[of.IN_WIRES] + h * PER_VICTIM :], n)
        firsts = channel.charge(s, c, n)
    else:
        channel.calm(s, c, n)
        firsts = 0
    for h in range(f[of.VICTIMS]):
        victim = window[f[of.HUNTED] + h * VICTIM : f[of.HUNTED] + (h + 1) * VICTIM]
        aim = s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM]
        enforce(s, victim, aim, table[f[of.IN_WIRES] + h * PER_VICTIM :], asked, n)
        if firsts > 0:
            hold(s, victim, n)


@phase
def judge(s, aim, granted, n):
    """Counts the wires of a victim that are aimed at, and in REFUSED those that are not granted with that value. Others are STRAY."""
    for w in range(WIRES):
        row, bound, low, high = np.uint64(w * LANES), granted[BOUND + w], granted[LOW + w], granted[HIGH + w]
        for i in range(n if granted[GRANTED + w] != 0.0 else np.uint64(0)):
            aimed = aim[WANT_TARGET + row + i] != 0.0
            fits = channel.fits(s[WANT_KIND + i], aim[WANT_VALUE + row + i], bound, low, high)
            s[AIMED + i] += 1.0 if aimed else 0.0
            s[REFUSED + i] += 1.0 if aimed & (not fits) else 0.0


@phase
def enforce(s, victim, aim, granted, asked, n):
    """What is in force at the wires of a victim; at those that are not granted there never is anything."""
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        if granted[GRANTED + w] == 0.0:
            continue
        if asked:
            for i in range(n):
                kind, value = s[KIND + i], aim[WANT_VALUE + row + i]
                hit = (aim[WANT_TARGET + row + i] != 0.0) & (kind != 0.0)
                victim[TARGET + row + i] = 1.0 if hit else 0.0
                victim[VALUE + row + i] = channel.carried(kind, value) if hit else 0.0
        else:
            for i in range(n):
                victim[TARGET + row + i] = victim[VALUE + row + i] = 0.0


@phase
def hold(s, victim, n):
    """What is held from the first attack of an episode on."""
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        for i in range(n):
            victim[HELD + row + i] = victim[FRESH + row + i] if s[AIMED + i] != 0.0 else victim[HELD + row + i]


@phase
def arrive(s, window, table, f, n):
    """What arrives of readings and messages under the command in force."""
    whole = table.view(np.int64)
    for j in range(f[of.CARS]):
        sent, arrived = j * f[of.CAR] + int(SENT), f[of.WORKS] + j * WORK + int(ARRIVED)
        for at in range(0, LINKS * LANES, WIDTH):
            put(s, arrived + at, get(window, sent + at))
        for at in range(0, SENSORS * LANES, WIDTH):
            there = get(window, j * f[of.CAR] + f[of.THERE] + at) if f[of.THERE] != 0 else alike(1.0)
            put(s, f[of.WORKS] + j * WORK + int(VALID) + at, there)
    for h in range(f[of.VICTIMS]):
        at = f[of.WORKS] + whole[f[of.IN_VICTIMS] + h] * WORK
        victim = window[f[of.HUNTED] + h * VICTIM : f[of.HUNTED] + (h + 1) * VICTIM]
        aim, granted = s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM], table[f[of.IN_WIRES] + h * PER_VICTIM :]
        reach(s, victim, s[at : at + WORK], aim, granted, n)


@phase
def reach(s, victim, work, aim, granted, n):
    """What arrives at a victim in place of what was sent."""
    for w in range(LINKS):
        row = np.uint64(w * LANES)
        there = np.uint64(min(w, SENSORS - 1) * LANES)
        if granted[GRANTED + w] == 0.0:
            for i in range(n):
                aim[CLEAN + row + i] = work[ARRIVED + row + i]
            continue
        for i in range(n):
            sent, fresh, hit = work[ARRIVED + row + i], victim[FRESH + row + i], victim[TARGET + row + i] != 0.0
            changed = channel.altered(sent, s[KIND + i], victim[VALUE + row + i], victim[HELD + row + i], fresh)
            aim[CLEAN + row + i], work[ARRIVED + row + i] = sent, changed if hit else sent
            victim[FRESH + row + i] = fresh if hit | ((w < SENSORS) & (work[VALID + there + i] == 0.0)) else sent  # a lost one is no sample
    for q in range(SENSORS):
        row = np.uint64(q * LANES)
        for i in range(n):
            drops = (victim[TARGET + row + i] != 0.0) & (s[KIND + i] == channel.DROPOUT)
            work[VALID + row + i] = 0.0 if drops else work[VALID + row + i]


@phase
def actuate(s, window, table, f, n):
    """What the actuators get of the commands."""
    whole = table.view(np.int64)
    for j in range(f[of.CARS]):
        car, work = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            work[APPLIED + i] = car[COMMAND + i]
    for h in range(f[of.VICTIMS]):
        at = f[of.WORKS] + whole[f[of.IN_VICTIMS] + h] * WORK
        work, victim = s[at : at + WORK], window[f[of.HUNTED] + h * VICTIM : f[of.HUNTED] + (h + 1) * VICTIM]
        for i in range(n):
            u, fresh, hit = work[APPLIED + i], victim[FRESH + _COMMAND + i], victim[TARGET + _COMMAND + i] != 0.0
            changed = channel.altered(u, s[KIND + i], victim[VALUE + _COMMAND + i], victim[HELD + _COMMAND + i], fresh)
            work[APPLIED + i], victim[FRESH + _COMMAND + i] = changed if hit else u, fresh if hit else u


@phase
def take_hold(s, window, table, f, n):
    """What the channel keeps of what is expected and of the first commands."""
    whole = table.view(np.int64)
    for h in range(f[of.VICTIMS]):
        car = window[whole[f[of.IN_VICTIMS] + h] * f[of.CAR] :]
        victim = window[f[of.HUNTED] + h * VICTIM : f[of.HUNTED] + (h + 1) * VICTIM]
        for w in range(WIRES):
            row = np.uint64(w * LANES)
            for i in range(n):
                victim[HELD + row + i] = victim[FRESH + row + i] = car[SENT + row + i] if w < LINKS else car[COMMAND + i]


# -- scripts


@phase
def _holds(s, window, c, f, p, n):
    """Row ON: whether the trigger's condition holds for any car."""
    kind, threshold, dt = p[script.WHEN], p[script.THRESHOLD], c[of.DT]
    for i in range(n):
        s[ON + i] = kind == script.TIME
    for j in range(f[of.CARS] if kind != script.TIME else 0):
        car, work = window[j * f[of.CAR] : (j + 1) * f[of.CAR]], s[f[of.WORKS] + j * WORK : f[of.WORKS] + (j + 1) * WORK]
        for i in range(n):
            speed, ahead = car[V + i], work[AHEAD + i]
            holds = (kind == script.NEAR) & (work[GAP + i] < threshold)
            holds |= (kind == script.CLOSING) & (speed - ahead > threshold)
            holds |= (kind == script.FAST) & (speed > threshold)
            holds |= (kind == script.SLOW) & (speed < threshold)
            holds |= (kind == script.LEADER_BRAKING) & ((car[SEEN + i] - ahead) / dt > threshold)
            s[ON + i] = 1.0 if holds | (s[ON + i] != 0.0) else 0.0
            car[SEEN + i] = ahead


@phase
def scripted(s, g, window, c, f, table, p, n):
    """The command of the script into the rows WANT_*. -> whether there is any."""
    _holds(s, window, c, f, p, n)
    if not script.open_now(s, c, p, n):
        return False
    whole = table.view(np.int64)
    for i in range(n):
        s[STRAY + i] = 0.0
    for h in range(f[of.VICTIMS]):
        agent, aim = whole[f[of.IN_VICTIMS] + h], s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM]
        for w in range(WIRES):
            aims, sign = p[script.PLACES + 2 * WIRES * h + w], p[script.PLACES + 2 * WIRES * h + WIRES + w]
            if aims != 0.0:
                sample(s, g, aim, table[f[of.IN_WIRES] + h * PER_VICTIM :], p, agent * WIRES + w, w, sign, n)
            else:
                row = np.uint64(w * LANES)
                for i in range(n):
                    aim[WANT_TARGET + row + i] = aim[WANT_VALUE + row + i] = 0.0
    if p[script.CHANCE] < 1.0:
        for i in range(n):  # the kind, where anything is left
            s[DRAWN + i], s[WANT_KIND + i] = s[WANT_KIND + i], 0.0
        for h in range(f[of.VICTIMS]):
            agent, aim = whole[f[of.IN_VICTIMS] + h], s[f[of.AIMS] + h * AIM : f[of.AIMS] + (h + 1) * AIM]
            spare(s, g, aim, p[script.CHANCE], agent, n)
    return True


@phase
def sample(s, g, aim, granted, p, element, w, sign, n):
    """What is sent on a wire, which has an element of the draws of its own."""
    kind, law, first, second, limit, turn, hit = (
        p[script.WHAT], p[script.LAW], p[script.FIRST], p[script.SECOND], p[script.LIMIT], p[script.TURN], p[script.HIT],
    )  # fmt: skip
    row, bound, low, high = np.uint64(w * LANES), granted[BOUND + w], granted[LOW + w], granted[HIGH + w]
    if law == script.UNIFORM or hit < 2.0:
        road.uniforms(s, g, ATTACK_KEY, script.ATTACK, np.uint64(element // 2), DRAWN, n)
    elif law == script.GAUSSIAN:
        road.normals(s, g, ATTACK_KEY, script.ATTACK, np.uint64(element // 2), DRAWN, n)
    drawn = s[DRAWN + np.uint64(element % 2 * LANES) :]
    for i in range(n):
        count, u = s[ELAPSED + i] - 1.0, drawn[i]
        value, jams = script.worth(law, first, second, limit, count, u), (kind == channel.JAM) | (count >= turn)
        value = clip(value, low, high) if jams else clip(value, -bound, bound)
        on = (s[ON + i] != 0.0) & ((hit >= 2.0) | (u < hit))
        aim[WANT_TARGET + row + i] = on
        aim[WANT_VALUE + row + i] = value * sign if on & (law != script.NOTHING) else 0.0
        s[WANT_KIND + i] = (channel.JAM if (kind == channel.FDI) & (count >= turn) else kind) if on else s[WANT_KIND + i]


@phase
def spare(s, g, aim, chance, agent, n):
    """Without luck nothing is sent to a car; the kind stands in row DRAWN."""
    drawn = DRAWN + np.uint64(2 * LANES)
    road.uniforms(s, g, ATTACK_KEY, script.CHANCES, np.uint64(agent // 2), drawn, n)
    luck = s[drawn + np.uint64(agent % 2 * LANES) :]
    for w in range(WIRES):
        row = np.uint64(w * LANES)
        for i in range(n):
            keeps = (luck[i] < chance) & (aim[WANT_TARGET + row + i] != 0.0)
            aim[WANT_TARGET + row + i] = keeps
            aim[WANT_VALUE + row + i] = aim[WANT_VALUE + row + i] if keeps else 0.0
            s[WANT_KIND + i] = s[DRAWN + i] if keeps else s[WANT_KIND + i]
