"""A step of a platoon from its lanes: the same order as `tailgate.loop.Loop`, for blocks of LANES episodes.

start     the string, what each car is told, the first commands, the first move, the first measurement
advance   channel -> distributed filter -> law -> channel -> cars -> measurement

The records of cars (`platoon_rows`) and of wires that may be attacked (`wires`) stand in the `window`; the constants of filter and law in
the `table` (`platoon_build`).
"""

import numpy as np

from . import constants as of
from . import platoon_defence as defence
from . import platoon_filter as filter
from . import platoon_road as road
from . import platoon_steps as steps
from . import road as single
from . import script, step, wires
from .compiled import phase
from .platoon_filter import WORK
from .platoon_rows import AHEAD, BELIEF, GAP, SEEN, SENSORS, SENT, V
from .rows import LANES, ON, STEP, K


@phase
def _move_and_measure(s, g, window, c, f, table, n):
    """The rest of a step after the commands are applied; leaves k one higher."""
    road.move(s, g, window, c, f, table, n)
    single.next_step(s, g, n)
    road.measure(s, g, window, c, f, table, n)


@phase
def _expect(window, table, f, n):
    """What the channel would hold of an attack in the first step: the readings that each car expects, and the messages."""
    whole = table.view(np.int64)
    for j in range(f[of.CARS]):
        car = window[j * f[of.CAR] : (j + 1) * f[of.CAR]]
        for q in range(SENSORS):
            row, column = SENT + np.uint64(q * LANES), BELIEF + np.uint64(whole[f[of.IN_READS] + j * SENSORS + q] * LANES)
            for i in range(n):
                car[row + i] = 0.0 + car[column + i]
        for i in range(n):
            car[SEEN + i] = -np.inf
    road.message(window, table, f, n)


@phase
def start(s, g, window, intent, c, f, table, tick, n):
    """Fresh episodes at k = 1, measured: keys and episode numbers stand in g."""
    step.clear(s, g, window, intent, c, n)
    road.line_up(s, g, window, c, f, n)
    road.remember(s, window, f, n)
    road.told(s, g, window, c, f, n)
    step.begin_way(s, g, c, f, n)
    for i in range(n):
        s[K + i] = 0.0
        g[STEP + i] = np.uint64(0)
    _expect(window, table, f, n)
    if f[of.THERE] != 0:
        road.all_there(window, f, n)
    road.hear(s, window, f)
    road.control(s, window, table, c, f, 0.0, n)
    wires.take_hold(window, f, table, n)
    road.pass_on(s, window, f, n)
    _move_and_measure(s, g, window, c, f, table, n)


@phase
def advance(s, g, window, intent, c, f, table, tick, asked, n):
    """A step under the command in the rows WANT_*, if any is `asked` for. What a Frame shows stands in the rows afterwards."""
    attacked = wires.decide(s, window, c, f, table, asked, n)
    road.hear(s, window, f)
    wires.arrive(s, window, f, table, False, attacked, n)
    if f[of.ESTIMATOR] == of.READ:
        steps.read(s, window, table, f, n)
    else:
        filter.calm(window, f, n)
        filter.predict(s, window, table, f)
        filter.innovation(s, table, f, n)
        if f[of.STEPPED] != 0:
            steps.weigh(s, table, f, n)
            steps.correct(s, window, table, c, f, n)
        else:
            filter.score(s, table, f, f[of.IN_W], SENSORS * SENSORS)
            filter.score_again(s, table, f, n)
            defence.believe(s, table, c, f, n)
            filter.update(s, window, table, c, f, f[of.IN_K], f[of.STATES] * SENSORS)
            filter.update_again(s, window, table, c, f, n)
    defence.alarm(s, c, f, n)
    filter.sound(s, window, f)
    road.remember(s, window, f, n)
    road.fooled(s, window, f, n)
    road.control(s, window, table, c, f, c[of.ASKED], n)
    road.pass_on(s, window, f, n)
    wires.arrive(s, window, f, table, True, attacked, n)
    if f[of.THERE] != 0:
        road.keep(s, window, f, n)
    _move_and_measure(s, g, window, c, f, table, n)
    if f[of.THERE] != 0:
        road.lose(s, g, window, c, f, f[of.SENDS], n)
    road.collide(s, f, n)


@phase
def scripted(s, g, window, c, f, table, p, n):
    """The command of the script into the rows WANT_*. -> whether there is any."""
    _holds(s, window, c, f, p, n)
    return wires.scripted(s, g, c, f, table, p, n)


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
