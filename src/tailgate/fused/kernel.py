"""What is compiled: a function that plays a batch block by block, so that a block's rows stay in the processor's cache.

Each kind of plant has its own, of which here is that of car following.
"""

import numpy as np

from . import constants as of
from . import memory as at
from . import script, seat, step
from .compiled import Kernel, array_at, fetch, phase, written_in
from .rows import EGO, ENDED, EPISODE, LANES, LEAD_X, LENGTH, OVER, RADAR_STATE, REAR_X, SCORE, WANT_KIND, WIRES, WORDS, K, X

_1, _2 = np.uint64(LANES), np.uint64(2 * LANES)
LINE = 8  # numbers of a line of the cache


@phase
def obey(s, asked, f, first, n):
    """The command of asked (ASKED, B) into the rows WANT_*. -> whether there is any."""
    some = 0.0
    for j in range(at.ASKED):
        row, counts = WANT_KIND + np.uint64(j * LANES), j <= WIRES  # kind and targets
        for i in range(n):
            s[row + i] = asked[j, first + i]
            some += abs(s[row + i]) if counts else 0.0
    return some > 0.0


@phase
def sound(s, n):
    """Whether estimate and score are finite."""
    not_finite = 0
    for i in range(n):
        not_finite += 1 if 0.0 * (s[X + i] + s[X + _1 + i] + s[X + _2 + i] + s[SCORE + i]) != 0.0 else 0
    return not_finite == 0


@phase
def keep(s, window, columns, record, t, first, n):
    """The rows `columns` of a block into record (K, columns, B) at step t; -1 - row of one that stands in the window."""
    for j in range(len(columns)):
        if columns[j] >= 0:
            row = np.uint64(columns[j])
            for i in range(n):
                record[t, j, first + i] = s[row + i]
        else:
            row = np.uint64(-1 - columns[j])
            for i in range(n):
                record[t, j, first + i] = window[row + i]


@phase
def nearest(s, f, record, first, n):
    """The smallest gaps of a block so far, in front and behind, into record (1, 2, B): of the steps that belong to the episodes."""
    rear = f[of.REAR] != 0
    for i in range(n):
        live = s[LENGTH + i] == s[K + i] - 1.0
        gap, behind = s[LEAD_X + i] - s[EGO + i], s[EGO + i] - s[REAR_X + i] if rear else np.inf
        record[0, 0, first + i] = min(record[0, 0, first + i], gap if live else np.inf)
        record[0, 1, first + i] = min(record[0, 1, first + i], behind if live else np.inf)


@phase
def living(s, n):
    """Whether any episode of a block goes on."""
    left = 0
    for i in range(n):
        left += 1 if s[ENDED + i] == 0.0 else 0
    return left > 0


@phase
def ending(s, n):
    """Whether any episode of a block is over."""
    over = 0
    for i in range(n):
        over += 1 if s[OVER + i] != 0.0 else 0
    return over > 0


@phase
def carry(source, goal):
    """The state of a block from one place to another."""
    for i in range(np.uint64(min(len(source), len(goal)))):
        goal[i] = source[i]


@phase
def foresee(source, t, steps):
    """Asks for a part of a block that is played next: in each of so many steps one, until the cache has it all."""
    lines = len(source) // LINE
    for i in range(lines * t // steps, lines * (t + 1) // steps):
        fetch(source, i * LINE)


@phase
def everyone(s, g, n):
    """All rows are over, and so begin: under the episode number that they have."""
    for i in range(n):
        s[OVER + i] = 1.0
        g[EPISODE + i] -= np.uint64(1)


@phase
def begin_again(start, s, g, window, intent, c, f, table, tick, fresh, words, new_window, new_intent, n):
    """The next episode in every row that is over: played apart in a block of its own, then put in its place."""
    count = np.uint64(0)
    for i in range(n):
        if s[OVER + i] != 0.0:
            for j in range(WORDS):
                words[np.uint64(j * LANES) + count] = g[np.uint64(j * LANES) + i]
            words[EPISODE + count] += np.uint64(1)
            count += np.uint64(1)
    if count == np.uint64(0):
        return
    start(fresh, words, new_window, new_intent, c, f, table, tick, count)
    seat.begin(fresh, c, count)
    k = np.uint64(0)
    for i in range(n):
        if s[OVER + i] != 0.0:
            for j in range(RADAR_STATE):
                s[np.uint64(j * LANES) + i] = fresh[np.uint64(j * LANES) + k]
            for j in range(WORDS):
                g[np.uint64(j * LANES) + i] = words[np.uint64(j * LANES) + k]
            for j in range(len(window) // LANES):
                window[np.uint64(j * LANES) + i] = new_window[np.uint64(j * LANES) + k]
            for j in range(len(intent) // LANES):
                intent[np.uint64(j * LANES) + i] = new_intent[np.uint64(j * LANES) + k]
            k += np.uint64(1)


@written_in
def play(start, advance, obey, decide, decode, pay, look, places, first_block, last_block, part):
    """What the orders ask for (`memory`), in blocks from the first to before the last, at the desk of a `part` of the threads.

    How a step begins and goes on, what a command, a script and an action decide, what is paid for and seen, are phases of the plant.

    Recorded in record (K, columns, B), or in (1, 2, B) the smallest gaps. What a seat is shown in the end goes into its sheet
    (`cockpit.SHEET`).

    -> steps played, or -1 where an estimate is not finite.
    """
    asks = array_at(places[at.AT_ORDERS], at.ORDERS + of.CHOICES, np.int64)
    o, f = asks[: at.ORDERS], asks[at.ORDERS :]
    batch, how, steps, tick = o[at.BATCH], o[at.HOW], o[at.STEPS], o[at.TICK]
    blocks, wide, long, deep = (batch + LANES - 1) // LANES, o[at.WINDOW] * LANES, o[at.INTENT] * LANES, o[at.DEEP] * LANES
    whole = o[at.WHOLE] * LANES
    c = array_at(places[at.AT_C], of.NUMBERS, np.float64)
    table = array_at(places[at.AT_TABLE], o[at.TABLE], np.float64)
    p = array_at(places[at.AT_SCRIPT], o[at.SCRIPT], np.float64)
    rows = array_at(places[at.AT_ROWS], blocks * deep, np.float64)
    windows, intents = array_at(places[at.AT_WINDOW], blocks * wide, np.float64), array_at(places[at.AT_INTENT], blocks * long, np.float64)
    words = array_at(places[at.AT_WORDS], blocks * WORDS * LANES, np.uint64)
    asked = array_at(places[at.AT_ASKED], (o[at.ASKING], batch), np.float64)
    action = array_at(places[at.AT_ACTION], (batch, f[of.ACTIONS]), np.float64)
    paid, flags = array_at(places[at.AT_PAID], (at.PAID, batch), np.float64), array_at(places[at.AT_FLAGS], (at.FLAGS, batch), np.bool_)
    count, mask = array_at(places[at.AT_COUNT], batch, np.int64), array_at(places[at.AT_MASK], (batch, o[at.MASKED]), np.int8)
    seen = array_at(places[at.AT_SEEN], (batch, f[of.FEATURES]), np.float32)
    columns = array_at(places[at.AT_COLUMNS], o[at.COLUMNS], np.int64)
    record = array_at(places[at.AT_RECORD], (o[at.KEPT], o[at.COLUMNS], batch), np.float64)
    room = at.DESKS * whole + wide + long
    desk = array_at(places[at.AT_DESK], (part + 1) * room, np.float64)[part * room :]
    spare, spare_window, spare_intent = desk[whole : 2 * whole], desk[2 * whole : room - long], desk[room - long :]
    spare_words = array_at(places[at.AT_DESK_WORDS], (part + 1) * WORDS * LANES, np.uint64)[part * WORDS * LANES :]
    seated, fresh, longest = how == at.SEATED, o[at.FRESH] != 0, 0
    restart, alone = fresh or o[at.RESTART] != 0, deep == whole  # `at.SHOW`: and every block is shown
    for b in range(first_block, last_block):
        n, first = np.uint64(min(LANES, batch - b * LANES)), np.uint64(b * LANES)
        held, coming = rows[b * deep : (b + 1) * deep], rows[(b + 1) * deep : (b + 2) * deep]
        if steps == 0 and not fresh and o[at.RESTART] != at.SHOW and not ending(held, n):
            continue  # nothing is decided and nothing begins
        s = held if alone else desk
        if not alone:
            carry(held, desk)
        g = words[b * WORDS * LANES : (b + 1) * WORDS * LANES]
        window = windows[b * wide : (b + 1) * wide]
        intent, coming_intent = intents[b * long : (b + 1) * long], intents[(b + 1) * long : (b + 2) * long]
        now, wanted = tick, False
        if fresh:
            everyone(s, g, n)
            now += 1
        if seated and steps > 0:
            seat.before(s, n)
        for t in range(steps):
            if o[at.TERMINATE] != 0 and not living(s, n):
                break
            if not alone and steps > 1:  # within one there is no time for it
                foresee(coming, t, steps)
                foresee(coming_intent, t, steps)
            if seated:
                seat.alive(s, c, n)
                if t == 0 or f[of.ACTION] == of.RAMPING or f[of.ACTION] == of.INCREMENT:  # which depend on the last command
                    wanted = decode(s, window, c, f, table, action, first, n)
            elif how == at.SCRIPTED:
                wanted = decide(s, g, window, c, f, table, p, n)
            else:
                wanted = obey(s, asked, f, first, n)
            advance(s, g, window, intent, c, f, table, now, wanted, n)
            now += 1
            if not sound(s, n):
                return -1
            if seated:
                pay(s, c, f, n)
            if o[at.LEAST] != 0:
                nearest(s, f, record, first, n)
            else:
                keep(s, window, columns, record, o[at.FIRST_STEP] + t, first, n)
            longest = max(longest, t + 1)
        if seated and steps > 0:
            seat.settle(s, c, paid, flags, first, n)
        if restart:
            begin_again(start, s, g, window, intent, c, f, table, now - 1, spare, spare_words, spare_window, spare_intent, n)
        if seated:
            if steps > 0:
                seat.close(s, flags, first, n)
            look(s, window, c, f, table, paid, flags, count, mask, first, n)
            seat.observe(s, c, f, seen, first, n)
        if not alone:
            carry(desk, held)
    if last_block - first_block == blocks:  # nobody else reads it
        o[at.TICK] += o[at.FRESH] + steps
    return longest


@Kernel
def run(places, first_block, last_block, part):
    """`play`, of car following."""
    return play(
        step.start, step.advance, obey, script.decide, seat.decode, seat.pay, seat.look, places, first_block, last_block, part
    )  # fmt: skip
