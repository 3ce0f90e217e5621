"""The distributed Kalman filter of a network as a lane: many sensors, each of which reads all states (`tailgate.estimators.distributed`).

    xb_i = Q_i^-1 / d_i sum_j L_j A xh_j        r_i = y_i - C_i xb_i        xh_i = xb_i + K_i r_i

Gains are constant, or those of the step (`tailgate.fused.platoon_steps`). With less than all readings they are the episode's own
(`network_defence`).
"""

from tailgate.vector import WIDTH, alike, get, put

from . import constants as of
from . import wires
from .compiled import formula, phase
from .platoon_filter import gather, product
from .platoon_steps import at_step, pull, together
from .rows import LANES
from .rows import SCORE as SOUND


@phase
def predict(s, window, table, f):
    """xb_i: what the agents send, L_j A xh_j, summed over those that are heard; or without fusion what each predicts."""
    states, size, line = f[of.STATES], f[of.STATES] * f[of.STATES], f[of.STATES] * LANES
    for j in range(f[of.CARS]):
        to = f[of.FUSED] + j * line if f[of.ALONE] != 0 else f[of.FORE]
        product(table, f[of.IN_A], states, states, window, f[of.BELIEFS] + j * line, 0.0, s, to)
        if f[of.ALONE] == 0:
            product(table, f[of.IN_L] + j * size, states, states, s, f[of.FORE], 0.0, s, f[of.SENDS] + j * line)
    for i in range(f[of.CARS] if f[of.ALONE] == 0 else 0):
        gather(s, table, f, i)
        product(table, f[of.IN_MERGE] + i * size, states, states, s, f[of.FORE], 0.0, s, f[of.FUSED] + i * line)


@phase
def innovation(s, f, table, n):
    """r_i, 0 where nothing is read, and how many readings each agent lacks."""
    states, q = f[of.STATES], f[of.SENSED]
    for j in range(f[of.CARS]):
        to = f[of.RESIDUES] + j * q * LANES
        product(table, f[of.IN_READS] + j * q * states, q, states, s, f[of.FUSED] + j * states * LANES, 0.0, s, to)
    for at in range(0, f[of.CARS] * q * LANES, WIDTH):
        put(s, f[of.RESIDUES] + at, get(s, f[of.ARRIVALS] + at) - get(s, f[of.RESIDUES] + at))
    if f[of.MISSES] != 0:
        for at in range(0, f[of.CARS] * LANES, WIDTH):
            put(s, f[of.ABSENT] + at, alike(0.0))
        for w in range(f[of.WIRED]):
            at = int(table[f[of.IN_WIRES] + w * wires.PER_WIRE + wires.VALID])
            r = f[of.RESIDUES] + at - f[of.VALIDS]
            absent = f[of.ABSENT] + int(table[f[of.IN_WIRES] + w * wires.PER_WIRE + wires.AGENT]) * LANES
            _leave_out(s[at : at + LANES], s[r : r + LANES], s[absent : absent + LANES], n)


@phase
def _leave_out(valid, r, absent, n):
    """A reading that does not arrive has no innovation."""
    for i in range(n):
        r[i] = r[i] if valid[i] != 0.0 else 0.0
        absent[i] += 1.0 - valid[i]


@phase
def update(s, window, table, c, f, n):
    """xh_i from the innovation that is TAKEN; of gains by step those of the step."""
    states, q, each = f[of.STATES], f[of.SENSED], f[of.STEP_WIDE] // f[of.CARS]
    stepped, line = f[of.STEPPED] != 0, f[of.STATES] * LANES
    alone = stepped and not together(s, n)
    first = at_step(s, f, 0) + q * q if stepped else f[of.IN_K]
    for j in range(0 if alone else f[of.CARS]):
        at = first + j * (each if stepped else states * q)
        product(table, at, states, q, s, f[of.TAKEN] + j * q * LANES, 0.0, s, f[of.FORE])
        add(s, f[of.FUSED] + j * line, c[of.FACTOR], f[of.FORE], window, f[of.BELIEFS] + j * line, states)
    for j in range(f[of.CARS] if alone else 0):
        for i in range(int(n)):
            _update_one(s, window, table, f, at_step(s, f, i) + j * each + q * q, j, i)
    for j in range(f[of.CARS] if f[of.PULLED] != 0 else 0):
        pull(s, table, f, j)
        if alone:
            for i in range(int(n)):
                _pull_one(s, window, table, f, at_step(s, f, i) + j * each + q * q + states * q, j, i)
        else:
            at = first + j * each + states * q
            product(table, at + 1, states, states, s, f[of.FORE], 0.0, s, f[of.SENDS])
            for e in range(0, line, WIDTH):
                belief = f[of.BELIEFS] + j * line + e
                put(window, belief, get(window, belief) + alike(table[at]) * get(s, f[of.SENDS] + e))


@phase
def add(s, base, factor, step, window, to, rows):
    """Rows of the window from `to` on = those of s at `base` + factor times those at `step`."""
    if factor == 1.0:
        for at in range(0, rows * LANES, WIDTH):
            put(window, to + at, get(s, base + at) + get(s, step + at))
    else:
        for at in range(0, rows * LANES, WIDTH):
            put(window, to + at, get(s, base + at) + alike(factor) * get(s, step + at))


@formula
def _update_one(s, window, table, f, k, j, i):
    """xh_j of one episode, with the gain at k."""
    q, r, at = f[of.SENSED], f[of.TAKEN] + j * f[of.SENSED] * LANES + i, j * f[of.STATES] * LANES + i
    for e in range(f[of.STATES]):
        correction = 0.0
        for m in range(q):
            correction += table[k + e * q + m] * s[r + m * LANES]
        window[f[of.BELIEFS] + at + e * LANES] = s[f[of.FUSED] + at + e * LANES] + correction


@formula
def _pull_one(s, window, table, f, at, j, i):
    """The same of the pull: its gain is the first number times the matrix behind it."""
    states = f[of.STATES]
    for e in range(states):
        moved = 0.0
        for k in range(states):
            moved += table[at + 1 + e * states + k] * s[f[of.FORE] + k * LANES + i]
        window[f[of.BELIEFS] + (j * states + e) * LANES + i] += table[at] * moved


@phase
def sound(s, window, f):
    """Row SCORE of the episode: a number that is not finite where an estimate or a score is not."""
    rows = f[of.CARS] * f[of.STATES]
    for lane in range(0, LANES, WIDTH):
        one = other = third = fourth = alike(0.0)  # sums that wait for themselves
        for j in range(f[of.CARS]):
            one = one + get(s, f[of.SCORES] + j * LANES + lane)
        at = f[of.BELIEFS] + lane
        for _ in range(rows // 4):
            one, other = one + get(window, at), other + get(window, at + LANES)
            third, fourth = third + get(window, at + 2 * LANES), fourth + get(window, at + 3 * LANES)
            at += 4 * LANES
        for _ in range(rows % 4):
            other, at = other + get(window, at), at + LANES
        put(s, int(SOUND) + lane, (one + other) + (third + fourth))
