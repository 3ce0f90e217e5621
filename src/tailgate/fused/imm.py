"""Several Kalman filters that trust the readings more or less, as a lane: `tailgate.estimators.imm`.

Each model in its turn is mixed from all of them into the rows of the filter, makes a step there, and is put aside; then they are weighed.
What is remembered stands in rows of its own, m: of each model the mean and the covariance, the same of its successor, its probability,
its share in the mixture at hand, and the logarithm of its weight.
"""

import numpy as np

from tailgate.estimators.imm import LEAST, LOG_2_PI
from tailgate.kernels import _exp, _log

from . import constants as of
from . import kalman
from .compiled import phase
from .rows import ACCEPT, ALARM, LANES, PIVOT, SCORE, SENSORS, VALID, P, R, S, X

WIDE = 12  # rows of a model: mean, covariance
EACH = 2 * WIDE + 3  # rows that are kept for each model
_1, _2, _3 = (np.uint64(LANES * i) for i in range(1, 4))
_BELIEF = WIDE * LANES


def rows(models: int) -> int:
    """How many are remembered; three more are for the weighing."""
    return EACH * models + 3


@phase
def begin(s, m, c, models, n):
    """Every model starts from the prior, which stands in the rows of the filter."""
    for j in range(models):
        keep(s, m, j, n)
        row, share = np.uint64((2 * WIDE * models + j) * LANES), c[of.SHARES + j]
        for i in range(n):
            m[row + i] = share


@phase
def keep(s, m, j, n):
    """The rows of the filter into place j of m."""
    place = np.uint64(j * _BELIEF)
    for k in range(3):
        row = np.uint64(k * LANES)
        for i in range(n):
            m[place + row + i] = s[X + row + i]
    for k in range(9):
        row = np.uint64(k * LANES)
        for i in range(n):
            m[place + _3 + row + i] = s[P + row + i]


@phase
def mix(s, m, c, models, j, n):
    """Model j before the step into the rows of the filter, and its probability c_j in place of its weight.

    w_ij = T_ij mu_i / c_j,   x0_j = sum_i w_ij x_i,   P0_j = sum_i w_ij (P_i + (x_i - x0_j)(x_i - x0_j)').
    """
    mu, share = np.uint64(2 * WIDE * models * LANES), np.uint64((2 * WIDE + 1) * models * LANES)
    own = np.uint64(((2 * WIDE + 2) * models + j) * LANES)
    for k in range(models):
        row, move, first = np.uint64(k * LANES), c[of.MOVES + of.MODELS * k + j], k == 0
        for i in range(n):
            part = move * m[mu + row + i]
            m[share + row + i] = part
            m[own + i] = part if first else m[own + i] + part
    for k in range(models):
        row, place, first = share + np.uint64(k * LANES), np.uint64(k * _BELIEF), k == 0
        for i in range(n):
            w = m[row + i] / m[own + i]
            m[row + i] = w
            x, v, a = w * m[place + i], w * m[place + _1 + i], w * m[place + _2 + i]
            s[X + i] = x if first else s[X + i] + x
            s[X + _1 + i] = v if first else s[X + _1 + i] + v
            s[X + _2 + i] = a if first else s[X + _2 + i] + a
    for k in range(models):
        row, place, first = share + np.uint64(k * LANES), np.uint64(k * _BELIEF), k == 0
        for p in range(3):
            down = np.uint64(p * LANES)
            for q in range(3):
                across, entry = np.uint64(q * LANES), np.uint64((3 * p + q) * LANES)
                for i in range(n):
                    off = (m[place + down + i] - s[X + down + i]) * (m[place + across + i] - s[X + across + i])
                    part = m[row + i] * (m[place + _3 + entry + i] + off)
                    s[P + entry + i] = part if first else s[P + entry + i] + part


@phase
def likelihood(s, m, models, j, n):
    """The logarithm of c_j N(r; 0, S), over the readings that were received; a missing one weighs the same in every model."""
    own = np.uint64(((2 * WIDE + 2) * models + j) * LANES)
    for i in range(n):
        a, d = s[S + i] if s[VALID + i] != 0.0 else 1.0, s[S + _3 + i] if s[VALID + _1 + i] != 0.0 else 1.0
        g = kalman.normalised(s[R + i], s[R + _1 + i], a, s[S + _1 + i], d)
        s[SCORE + i] = -0.5 * (g + (s[VALID + i] + s[VALID + _1 + i]) * LOG_2_PI)
        s[PIVOT + i], s[PIVOT + _1 + i] = a, d - s[S + _2 + i] / a * s[S + _1 + i]
    for i in range(n):
        s[SCORE + i] -= 0.5 * _log(s[PIVOT + i])
    for i in range(n):
        s[SCORE + i] -= 0.5 * _log(s[PIVOT + _1 + i])
    for i in range(n):
        m[own + i] = _log(m[own + i]) + s[SCORE + i]


@phase
def weigh(s, m, c, models, n):
    """Probabilities and score from the logarithms; the successors take the models' places, and their mixture is the estimate."""
    mu, log = np.uint64(2 * WIDE * models * LANES), np.uint64((2 * WIDE + 2) * models * LANES)
    most = np.uint64(EACH * models * LANES)
    total, rival = most + _1, most + _2
    for i in range(n):
        m[most + i], m[rival + i] = m[log + i], -np.inf
    for k in range(1, models):
        row = log + np.uint64(k * LANES)
        for i in range(n):
            m[most + i], m[rival + i] = np.maximum(m[most + i], m[row + i]), np.maximum(m[rival + i], m[row + i])
    for k in range(models):
        row, weight, first = log + np.uint64(k * LANES), mu + np.uint64(k * LANES), k == 0
        for i in range(n):
            w = np.maximum(_exp(m[row + i] - m[most + i]), LEAST)
            m[weight + i] = w
            m[total + i] = w if first else m[total + i] + w
    for k in range(models):
        weight = mu + np.uint64(k * LANES)
        for i in range(n):
            m[weight + i] /= m[total + i]
    for k in range(1, models):  # the log odds of all others
        row, first = log + np.uint64(k * LANES), k == 1
        for i in range(n):
            w = _exp(m[row + i] - m[rival + i])
            m[total + i] = w if first else m[total + i] + w
    threshold, alone = c[of.THRESHOLD], models == 1
    for i in range(n):
        odds = m[rival + i] + _log(m[total + i]) - m[log + i]
        s[SCORE + i] = 0.0 if alone else odds
        s[ALARM + i] = s[SCORE + i] > threshold
    for j in range(WIDE * models):
        row, after = np.uint64(j * LANES), np.uint64((j + WIDE * models) * LANES)
        for i in range(n):
            m[row + i] = m[after + i]
    for k in range(models):
        weight, place, first = mu + np.uint64(k * LANES), np.uint64(k * _BELIEF), k == 0
        for p in range(3):
            row = np.uint64(p * LANES)
            for i in range(n):
                part = m[weight + i] * m[place + row + i]
                s[X + row + i] = part if first else s[X + row + i] + part


@phase
def step(s, m, c, f, n):
    """Every model's own step, and what they say together."""
    models = f[of.MODELED]
    for j in range(SENSORS):
        row = np.uint64(j * LANES)
        for i in range(n):
            s[ACCEPT + row + i] = s[VALID + row + i]
    for j in range(models):
        mix(s, m, c, models, j, n)
        kalman.predict(s, c, f, n)
        kalman.innovation(s, c, of.NOISES + 4 * j, n)
        likelihood(s, m, models, j, n)
        kalman.update(s, f, n)
        keep(s, m, models + j, n)
    weigh(s, m, c, models, n)
