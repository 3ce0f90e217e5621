"""Several Kalman filters that trust the readings more or less, as a lane: `tailgate.estimators.imm`.

Each model in its turn is mixed from all of them into the rows of the filter, makes a step there, and is put aside; then they are weighed.
What is remembered stands in rows of its own, m: of each model the mean and the covariance, the same of its successor, its probability,
and the logarithm of its weight. A loop reads or writes one place of m, so that the compiler sees that nothing overlaps.
"""

import numpy as np

from tailgate.estimators.imm import LEAST, LOG_2_PI
from tailgate.kernels import _exp, _log

from . import constants as of
from . import kalman
from .compiled import formula, phase
from .rows import (
    ACCEPT,
    ALARM,
    FORMER,
    FORMER_VAR,
    LANES,
    OWN,
    OWN_COV,
    OWN_VAR,
    PIVOT,
    RIVAL,
    SCORE,
    SENSORS,
    TOLD,
    TOP,
    TOTAL,
    VALID,
    WEIGHT,
    P,
    R,
    S,
    X,
)

WIDE = 12  # rows of a model: mean, covariance
EACH = 2 * WIDE + 2  # rows that are kept for each model
_1, _2, _3, _4, _5, _6, _7, _8 = (np.uint64(LANES * i) for i in range(1, 9))  # rows further down


def rows(models: int) -> int:
    """How many are remembered."""
    return EACH * models


@formula
def belief(j):
    """Where the mean of model j stands, its covariance below it; behind the last model its successors'."""
    return np.uint64(j * WIDE * LANES)


@formula
def probability(models, j):
    """Where its probability stands."""
    return np.uint64((2 * WIDE * models + j) * LANES)


@formula
def logarithm(models, j):
    """Where the logarithm of its weight stands."""
    return np.uint64(((2 * WIDE + 1) * models + j) * LANES)


@phase
def begin(s, m, c, models, n):
    """Every model starts from the prior, which stands in the rows of the filter."""
    for j in range(models):
        keep(s, m, j, n)
        mu, share = probability(models, j), c[of.SHARES + j]
        for i in range(n):
            m[mu + i] = share


@phase
def keep(s, m, j, n):
    """The rows of the filter into place j of m."""
    place = belief(j)
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
    """Model j before the step into the rows of the filter, and its probability c_j into row TOTAL.

    w_ij = T_ij mu_i / c_j,   x0_j = sum_i w_ij x_i,   P0_j = sum_i w_ij (P_i + (x_i - x0_j)(x_i - x0_j)').
    """
    for i in range(n):
        s[TOTAL + i] = s[X + i] = s[X + _1 + i] = s[X + _2 + i] = 0.0
    for k in range(9):
        row = np.uint64(k * LANES)
        for i in range(n):
            s[P + row + i] = 0.0
    for k in range(models):
        mu, move = probability(models, k), c[of.MOVES + of.MODELS * k + j]
        for i in range(n):
            s[TOTAL + i] += move * m[mu + i]
    for k in range(models):
        mu, place, move = probability(models, k), belief(k), c[of.MOVES + of.MODELS * k + j]
        for i in range(n):
            w = move * m[mu + i] / s[TOTAL + i]
            s[X + i] += w * m[place + i]
            s[X + _1 + i] += w * m[place + _1 + i]
            s[X + _2 + i] += w * m[place + _2 + i]
    for k in range(models):
        mu, place, P0, move = probability(models, k), belief(k), belief(k) + _3, c[of.MOVES + of.MODELS * k + j]
        for i in range(n):
            w = move * m[mu + i] / s[TOTAL + i]
            x, v, a = m[place + i] - s[X + i], m[place + _1 + i] - s[X + _1 + i], m[place + _2 + i] - s[X + _2 + i]
            s[P + i] += w * (m[P0 + i] + x * x)
            s[P + _1 + i] += w * (m[P0 + _1 + i] + x * v)
            s[P + _2 + i] += w * (m[P0 + _2 + i] + x * a)
            s[P + _3 + i] += w * (m[P0 + _3 + i] + v * x)
            s[P + _4 + i] += w * (m[P0 + _4 + i] + v * v)
            s[P + _5 + i] += w * (m[P0 + _5 + i] + v * a)
            s[P + _6 + i] += w * (m[P0 + _6 + i] + a * x)
            s[P + _7 + i] += w * (m[P0 + _7 + i] + a * v)
            s[P + _8 + i] += w * (m[P0 + _8 + i] + a * a)


@phase
def likelihood(s, m, models, j, n):
    """The logarithm of c_j N(r; 0, S), over the readings that were received; a missing one weighs the same in every model."""
    own = logarithm(models, j)
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
        s[SCORE + i] = _log(s[TOTAL + i]) + s[SCORE + i]
    for i in range(n):
        m[own + i] = s[SCORE + i]


@phase
def weigh(s, m, c, models, n):
    """Probabilities and score from the logarithms; the successors take the models' places, and their mixture is the estimate."""
    nominal = logarithm(models, 0)
    for i in range(n):
        s[TOP + i], s[RIVAL + i], s[TOTAL + i] = m[nominal + i], -np.inf, 0.0
    for k in range(1, models):
        log = logarithm(models, k)
        for i in range(n):
            s[RIVAL + i] = np.maximum(s[RIVAL + i], m[log + i])
    for i in range(n):
        s[TOP + i] = np.maximum(s[TOP + i], s[RIVAL + i])
    for k in range(models):
        log, mu = logarithm(models, k), probability(models, k)
        for i in range(n):
            s[WEIGHT + i] = np.maximum(_exp(m[log + i] - s[TOP + i]), LEAST)
        for i in range(n):
            s[TOTAL + i] += s[WEIGHT + i]
            m[mu + i] = s[WEIGHT + i]
    for k in range(models):
        mu = probability(models, k)
        for i in range(n):
            m[mu + i] /= s[TOTAL + i]
    _odds(s, m, c, models, n)
    for j in range(WIDE * models):
        row, after = np.uint64(j * LANES), np.uint64((j + WIDE * models) * LANES)
        for i in range(n):
            m[row + i] = m[after + i]
    for i in range(n):
        s[X + i] = s[X + _1 + i] = s[X + _2 + i] = 0.0
    for k in range(models):
        mu, place = probability(models, k), belief(k)
        for i in range(n):
            s[X + i] += m[mu + i] * m[place + i]
            s[X + _1 + i] += m[mu + i] * m[place + _1 + i]
            s[X + _2 + i] += m[mu + i] * m[place + _2 + i]


@phase
def _odds(s, m, c, models, n):
    """Score: the log odds of the others, of which RIVAL is the largest logarithm, against the nominal model."""
    nominal, threshold, alone = logarithm(models, 0), c[of.THRESHOLD], models == 1
    for i in range(n):
        s[TOTAL + i] = 0.0
    for k in range(1, models):
        log = logarithm(models, k)
        for i in range(n):
            s[TOTAL + i] += _exp(m[log + i] - s[RIVAL + i])
    for i in range(n):
        s[TOTAL + i] = _log(s[TOTAL + i])
    for i in range(n):
        s[SCORE + i] = 0.0 if alone else s[RIVAL + i] + s[TOTAL + i] - m[nominal + i]
        s[ALARM + i] = s[SCORE + i] > threshold


@phase
def _mix_known(s, m, c, models, j, n):
    """The fourth state likewise, the known input: each model has the same one, and with rounding their mixture is another."""
    for i in range(n):
        s[OWN + i] = s[OWN_VAR + i] = s[OWN_COV + i] = s[OWN_COV + _1 + i] = s[OWN_COV + _2 + i] = 0.0
    for k in range(models):
        mu, move = probability(models, k), c[of.MOVES + of.MODELS * k + j]
        for i in range(n):
            s[OWN + i] += move * m[mu + i] / s[TOTAL + i] * s[FORMER + i]
    for k in range(models):
        mu, place, move = probability(models, k), belief(k), c[of.MOVES + of.MODELS * k + j]
        for i in range(n):
            w, off = move * m[mu + i] / s[TOTAL + i], s[FORMER + i] - s[OWN + i]
            x, v, a = m[place + i] - s[X + i], m[place + _1 + i] - s[X + _1 + i], m[place + _2 + i] - s[X + _2 + i]
            s[OWN_COV + i] += w * (0.0 + x * off)
            s[OWN_COV + _1 + i] += w * (0.0 + v * off)
            s[OWN_COV + _2 + i] += w * (0.0 + a * off)
            s[OWN_VAR + i] += w * (s[FORMER_VAR + i] + off * off)


@phase
def _tell(s, m, models, n):
    """The fourth state of the estimate."""
    for i in range(n):
        s[TOLD + i] = 0.0
    for k in range(models):
        mu = probability(models, k)
        for i in range(n):
            s[TOLD + i] += m[mu + i] * s[OWN + i]


def stepping(rides):
    """The phase `step`, of models of three states or also of a fourth that is the known input."""
    predict = kalman.predict_tied if rides else kalman.predict

    @phase
    def step(s, m, c, f, n):
        """Every model's own step, and what they say together."""
        models = f[of.MODELED]
        for j in range(SENSORS):
            row = np.uint64(j * LANES)
            for i in range(n):
                s[ACCEPT + row + i] = s[VALID + row + i]
        if rides:
            for i in range(n):
                s[FORMER + i], s[FORMER_VAR + i] = s[OWN + i], s[OWN_VAR + i]
        for j in range(models):
            mix(s, m, c, models, j, n)
            if rides:
                _mix_known(s, m, c, models, j, n)
            predict(s, c, f, n)
            kalman.innovation(s, c, of.NOISES + 4 * j, n)
            likelihood(s, m, models, j, n)
            kalman.update(s, f, n)
            keep(s, m, models + j, n)
        weigh(s, m, c, models, n)
        if rides:
            _tell(s, m, models, n)

    return step


step, step_known = stepping(rides=False), stepping(rides=True)
