"""The white-box attack as a lane: one step ahead with the filter's own step, to the edge of the gate (`tailgate.agents.model_based`)."""

import math

import numpy as np

from tailgate.estimators.detectors import INSIDE

from . import constants as of
from . import kalman
from .compiled import phase
from .rows import (
    ARRIVED,
    COVARIANCE,
    GATE,
    INTO,
    LANES,
    MEAN,
    PASSES,
    SENSORS,
    SENT,
    SUM,
    VALID,
    WANT_VALUE,
    P,
    R,
    S,
    X,
)

NO_GATE = 20.0  # the gate where a defence has none
WITHIN = 1.0 - 1e-9  # of the gate that is aimed at
_1, _2, _3, _4, _5 = (np.uint64(LANES * i) for i in range(1, 6))  # rows further down


@phase
def look(s, c, f, state, n):
    """The innovation r and S that the readings would meet now, and row `state` of the gain K, into INTO; changes no state."""
    for j in range(3):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[MEAN + row + i] = s[X + row + i]
    for j in range(9):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[COVARIANCE + row + i] = s[P + row + i]
    for j in range(SENSORS):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[ARRIVED + row + i], s[VALID + row + i] = s[SENT + row + i], 1.0
    kalman.predict(s, c, f, n)
    kalman.innovation(s, c, of.RNOISE, n)
    down = np.uint64(state * LANES)
    for i in range(n):
        w00, w01, w11 = kalman.inverse(s[S + i], s[S + _1 + i], s[S + _3 + i])
        c0, c1 = 0.0 + s[P + down + i], 0.0 + s[P + _3 + down + i]  # C P-
        s[INTO + i], s[INTO + _1 + i] = c0 * w00 + c1 * w01, c0 * w01 + c1 * w11
    for j in range(3):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[X + row + i] = s[MEAN + row + i]
    for j in range(9):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[P + row + i] = s[COVARIANCE + row + i]


@phase
def gate(s, ring, c, f, given, n):
    """The largest r' S^-1 r that raises no alarm in this step: each detector's own `gate`, unless one is `given`."""
    detector, threshold = f[of.DETECTOR], c[of.THRESHOLD]
    if given >= 0.0:
        for i in range(n):
            s[GATE + i] = given
    elif detector == of.CHI2 or detector == of.SPARSE:
        for i in range(n):
            s[GATE + i] = threshold
    elif detector == of.WINDOWED:
        older = f[of.WINDOW] - 1
        for i in range(n):
            s[GATE + i] = threshold - (ring[np.uint64((older - 1) * LANES) + i] if older > 0 else 0.0)
    elif detector == of.CUSUM:
        drift = c[of.DRIFT]
        for i in range(n):
            s[GATE + i] = threshold - (s[SUM + i] - drift)
    elif detector == of.MEWMA:
        weight, limit, exact = c[of.WEIGHT], c[of.LIMIT], f[of.EXACT] != 0
        for i in range(n):
            faded = s[SUM + _2 + i] * ((1.0 - weight) * (1.0 - weight))
            longest = math.sqrt(threshold * (limit * (1.0 - faded) if exact else limit)) * INSIDE
            room = (longest - (1.0 - weight) * math.sqrt(s[SUM + i] * s[SUM + i] + s[SUM + _1 + i] * s[SUM + _1 + i])) / weight
            s[GATE + i] = room * abs(room)
    else:
        for i in range(n):
            s[GATE + i] = NO_GATE


@phase
def push(s, sign, first, second, bound, n):
    """What moves the state farthest without leaving the gate, on the readings that are aimed at, into WANT_VALUE.

    (r + a)' W (r + a) over the attacked readings is least at -centre, and there leaves `spent` of the gate. Row PASSES tells whether what
    is then received stays inside.
    """
    for i in range(n):
        r0, r1, g = s[R + i], s[R + _1 + i], s[GATE + i]
        w00, w01, w11 = kalman.inverse(s[S + i], s[S + _1 + i], s[S + _3 + i])
        all0, all1 = w00 * r0 + w01 * r1, w01 * r0 + w11 * r1
        v00, v01, v11 = kalman.inverse(w00, w01, w11)
        v00, v01, v11 = v00 if second else 1.0 / w00, v01 if first & second else 0.0, v11 if first else 1.0 / w11
        pull0, pull1 = all0 if first else 0.0, all1 if second else 0.0
        row0, row1 = s[INTO + i] if first else 0.0, s[INTO + _1 + i] if second else 0.0
        centre0, centre1 = v00 * pull0 + v01 * pull1, v01 * pull0 + v11 * pull1
        spent = (r0 * all0 + r1 * all1) - (pull0 * centre0 + pull1 * centre1)
        push0, push1 = v00 * row0 + v01 * row1, v01 * row0 + v11 * row1
        strength = row0 * push0 + row1 * push1
        reach = math.sqrt(np.maximum(WITHIN * g - spent, 0.0) / (strength if strength > 0.0 else np.inf))
        wanted0, wanted1 = sign * reach * push0 - centre0, sign * reach * push1 - centre1
        # on the line from no injection to the wanted one the score stays convex: shrinking to the bound stays inside
        share = np.minimum(1.0, bound / np.maximum(np.maximum(abs(wanted0), abs(wanted1)), 1e-300))
        a0, a1 = wanted0 * share if first else 0.0, wanted1 * share if second else 0.0
        x0, x1 = r0 + a0, r1 + a1
        s[WANT_VALUE + i], s[WANT_VALUE + _1 + i] = a0, a1
        s[PASSES + i] = x0 * (w00 * x0 + w01 * x1) + x1 * (w01 * x0 + w11 * x1) <= g

