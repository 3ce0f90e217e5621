"""Minimax estimation under integrity attacks (Mo and Sinopoli 2015; thesis, [14]), applied to each step's innovations.

An attacker replaces any l of m readings and knows everything. With 2l >= m nothing that is measured helps: the estimate is the prediction.
Else each set I of m - 2l sensors has its own correction d_I = K_I r, with the gain of these sensors alone. Their middle is taken:

    f(r) = max_{|J| = m - l} min_{I in J} d_I        (for each state; halfway to min max, which is the same for equal sensors)

One J has honest sensors only, and every J has an honest I: f lies between the least and the largest honest d_I, whatever is sent. For equal
sensors of a scalar, f is the mean without the l smallest and l largest readings, times the gain. With m = 2l + 1 it is the median.

The paper's optimal estimators have this form. Its gains, though, depend on the prior: each set has the gain here that is best without an
attack. Where the prediction is much better than a reading, a smaller gain, or none, has a smaller worst-case error (figures: the tests).
"""

from dataclasses import dataclass
from math import comb
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Count, Innovation, Model, Prior, Received, param
from tailgate.core.registry import register
from tailgate.estimators.compose import AcceptAll, Composed, Score
from tailgate.estimators.filters.kalman import KalmanFilter, KalmanPlan, KalmanState
from tailgate.estimators.parts import Detector, Filter, Mitigation
from tailgate.estimators.sparse_attacks.bank import BankPlan, bank_plan, expected, summed
from tailgate.estimators.sparse_attacks.subsets import MOST, require, without

PAPER = "Y. Mo, B. Sinopoli, Secure Estimation in the Presence of Integrity Attacks, 2015"
ATTACKED = "readings of an agent that the attacker may replace, of those that arrive"


class MinimaxPlan(NamedTuple):
    kalman: KalmanPlan
    bank: BankPlan | None  # of the sets I; none: nothing that is measured helps
    inside: Array | None  # (J, M) indices of the sets I in each J


@register("filter", "minimax", reference=PAPER)
@dataclass(frozen=True)
class MinimaxFilter:
    """Predicts, and corrects by the middle of what small sets of sensors ask for; with half of the sensors attacked, by nothing."""

    attacked: Count = param(1, ATTACKED)

    def prepare(self, model: Model) -> MinimaxPlan:
        q, l = len(model.sensors), self.attacked
        kalman = KalmanFilter().prepare(model)
        if 2 * l >= q:
            return MinimaxPlan(kalman, None, None)
        require(model, l, "filter minimax")
        if comb(q, 2 * l) > MOST or comb(q, l) > MOST:
            raise InputError("filter minimax.attacked", l, f"fewer subsets than {max(comb(q, 2 * l), comb(q, l))}: at most {MOST}")
        I, J = without(q, 2 * l), without(q, l)
        bank = bank_plan(model, I)
        inside = np.array([np.flatnonzero((~I | some).all(axis=1)) for some in J])
        return MinimaxPlan(kalman._replace(held=self._steady(bank)), bank, inside)

    def _steady(self, bank: BankPlan) -> Array:
        """Return P- (N, n, n) of the least informative set: with any other's, it would correct too little when it decides."""
        worst = np.argmax(bank.before.trace(axis1=-2, axis2=-1), axis=1)
        return np.stack([before[k] for before, k in zip(bank.before, worst.tolist(), strict=True)])

    def start(self, plan: MinimaxPlan, prior: Prior) -> KalmanState:
        return KalmanState(prior.mean, prior.cov if plan.bank is None else None)

    def predict(self, plan: MinimaxPlan, state: KalmanState, known_u: Array) -> KalmanState:
        return KalmanFilter().predict(plan.kalman, state, known_u)

    def innovation(self, plan: MinimaxPlan, state: KalmanState, received: Received) -> Innovation:
        return KalmanFilter().innovation(plan.kalman, state, received)

    def update(self, plan: MinimaxPlan, state: KalmanState, innovation: Innovation, accept: Array) -> KalmanState:
        if plan.bank is None or plan.inside is None:
            return state
        z = num.full((*innovation.r.shape, len(plan.bank.keep)), np.where(accept, innovation.r, 0.0)[..., None])
        d = summed(plan.bank.gain, expected(plan.bank, z, accept))  # (B, N, n, I)
        by_set = d[..., plan.inside.ravel()].reshape(*d.shape[:3], *plan.inside.shape)
        low, high = np.max(np.min(by_set, axis=-1), axis=-1), np.min(np.max(by_set, axis=-1), axis=-1)
        return KalmanState(state.x + 0.5 * (low + high), None)

    def forget(self, plan: MinimaxPlan, state: KalmanState, where: Array) -> KalmanState:
        return state if plan.bank is not None else KalmanFilter().forget(plan.kalman, state, where)

    def gain(self, plan: MinimaxPlan, state: KalmanState, innovation: Innovation) -> Array:
        """Return the gain (B, N, n, q) of an update with every sensor at the same P-; nothing where no reading helps."""
        if plan.bank is None:
            return num.zeros((*innovation.r.shape[:2], state.x.shape[-1], innovation.r.shape[-1]))
        return KalmanFilter().gain(plan.kalman, state, innovation)

    def estimate(self, state: KalmanState) -> Array:
        return state.x


@register("defence", "minimax", reference=PAPER)
@dataclass(frozen=True)
class Minimax(Composed):
    """The middle of what small sets of sensors ask for: honest readings bound it, whatever some others say; never alarms."""

    attacked: Count = param(MinimaxFilter.attacked, ATTACKED)

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return MinimaxFilter(self.attacked), Score(), AcceptAll()
