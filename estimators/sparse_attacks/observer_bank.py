"""Observer banks (Chong, Wakaiki and Hespanha 2015; thesis, [15]): the subset of sensors whose estimates agree best.

For each set J of q - s sensors and each S in J with q - 2s an estimate. With 2s sensors fewer than q, some J has no attacked sensor, and
every J has an S without:

    pi_J = max_{S in J} |x_J - x_S|,      J* = argmin pi_J,      xh = x_J*

An honest J bounds pi_J*, and an honest S in J* bounds the rest: |error| <= |error of x_J| + 2 max_{S honest} |error of x_S|. The paper has
three times a bound that all honest sets share. A single Kalman filter on J may err more than every one on its subsets.

`observer`: steady Kalman filters (bank.py). `gramian`: least squares on the last T readings, weighed by the noise.
A lost reading counts as one that agrees: with the others of its subset, or for `gramian` with the last estimate. The alarm compares
|x_J - x_S| with its own spread: for these filters cov(x_J - x_S) = P_S - P_J.
"""

from dataclasses import dataclass
from math import comb
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Count, Estimate, Mode, Model, Positive, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.sparse_attacks.bank import BankPlan, bank_plan, bank_start, bank_step
from tailgate.estimators.sparse_attacks.kf_bank import ATTACKED
from tailgate.estimators.sparse_attacks.subsets import MOST, require, without
from tailgate.estimators.sparse_attacks.window import (
    WINDOW,
    Length,
    WindowPlan,
    WindowState,
    centred,
    window_plan,
    window_start,
    window_step,
)


class WindowBank(NamedTuple):
    """Least squares of each subset on a window: x = gain Y, and its covariance at the window's end."""

    gain: Array  # (N, n, q T, K) from readings over sd to x at the end
    after: Array  # (N, K, n, n)


class ObserverPlan(NamedTuple):
    most: BankPlan | WindowBank  # of the sets J
    fewer: BankPlan | WindowBank  # of the sets S
    inside: Array  # (J, M) indices of the sets S in each J
    spread: Array  # (N, J, M) standard deviation of |x_J - x_S|
    window: WindowPlan | None


class ObserverState(NamedTuple):
    most: Array | None  # (B, N, n, J)
    fewer: Array | None  # (B, N, n, S)
    window: WindowState | None
    x: Array | None  # (B, N, n) the last estimate; with a window only


def window_bank(plan: WindowPlan, keep: Array) -> WindowBank:
    """Return the least squares of the subsets `keep` (K, q) bool, as gains on the readings of a window."""
    agents, q, T, n = plan.O.shape
    gain, after = np.zeros((agents, n, q * T, len(keep))), np.zeros((agents, len(keep), n, n))
    for i in range(agents):
        for k, some in enumerate(keep):
            rows = plan.O[i] * some[:, None, None]
            flat = rows.reshape(q * T, n)
            G = num.product(flat.T, flat)
            inverse = num.solve(G, np.eye(n))
            at_end = num.product(plan.last, inverse)
            gain[i, :, :, k] = num.product(at_end, flat.T)
            after[i, k] = num.product(at_end, plan.last.T)
    return WindowBank(gain, after)


def agreement(most: Array, fewer: Array, inside: Array) -> Array:
    """Return |x_J - x_S| (B, N, J, M) for x_J (B, N, n, J), x_S (B, N, n, S) and indices of the sets S in each J (J, M)."""
    total = None
    for j in range(most.shape[2]):
        off = most[:, :, j, :, None] - fewer[:, :, j][..., inside.ravel()].reshape(*most.shape[:2], *inside.shape)
        total = off * off if total is None else total + off * off
    assert total is not None
    return np.asarray(np.sqrt(total))


@register(
    "defence", "observer_bank",
    reference="M. S. Chong, M. Wakaiki, J. P. Hespanha, Observability of Linear Systems Under Adversarial Attacks, 2015",
)  # fmt: skip
@dataclass(frozen=True)
class ObserverBank:
    """Estimates from all large and all small subsets of the sensors; it believes the large one that agrees best with its small ones."""

    threshold_field: ClassVar[str] = "threshold"
    s: Count = param(1, ATTACKED)
    kind: Literal["observer", "gramian"] = param("observer", "observer: a steady Kalman filter each; gramian: least squares on a window")
    window: Length = param(0, WINDOW)
    threshold: Positive = param(6.0, "alarm where the believed set is farther from one of its subsets [standard deviations]")

    def prepare(self, model: Model) -> ObserverPlan:
        require(model, self.s, "defence observer_bank")
        q = len(model.sensors)
        if (count := comb(q, self.s) + comb(q, 2 * self.s)) > MOST:
            raise InputError("defence observer_bank.s", self.s, f"fewer estimates than {count}: at most {MOST}")
        J, S = without(q, self.s), without(q, 2 * self.s)
        inside = np.array([np.flatnonzero((~S | some).all(axis=1)) for some in J])
        window = window_plan(model, self.window) if self.kind == "gramian" else None
        most: BankPlan | WindowBank
        fewer: BankPlan | WindowBank
        if window is None:
            most, fewer = bank_plan(model, J), bank_plan(model, S)
        else:
            most, fewer = window_bank(window, J), window_bank(window, S)
        traces = [bank.after.trace(axis1=-2, axis2=-1) for bank in (most, fewer)]
        spread = np.sqrt(np.maximum(traces[1][:, inside] - traces[0][:, :, None], 0.0))
        return ObserverPlan(most, fewer, inside, spread, window)

    def start(self, plan: ObserverPlan, prior: Prior) -> ObserverState:
        if plan.window is not None:
            return ObserverState(None, None, window_start(plan.window, prior), prior.mean)
        assert isinstance(plan.most, BankPlan) and isinstance(plan.fewer, BankPlan)
        return ObserverState(bank_start(plan.most, prior.mean), bank_start(plan.fewer, prior.mean), None, None)

    def step(
        self, plan: ObserverPlan, state: ObserverState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[ObserverState, Estimate]:
        full = first = None
        if plan.window is not None:
            assert state.window is not None and isinstance(plan.most, WindowBank) and isinstance(plan.fewer, WindowBank)
            assert state.x is not None
            here = plan.window
            ahead = num.apply(here.A[None], state.x) + num.matvec(here.B, known_u) + here.c
            y = np.where(received.valid, received.y, num.apply(here.C, ahead))
            window = window_step(here, state.window, received._replace(y=y, valid=np.ones_like(received.valid)), known_u)
            held = centred(plan.window, window)
            flat = held.Y.reshape(*held.Y.shape[:2], held.Y.shape[2] * held.Y.shape[3])[..., None]
            most, fewer = (_applied(bank.gain, flat) + held.xi[..., None] for bank in (plan.most, plan.fewer))
            full, first = held.full, window.kalman.x
        else:
            assert isinstance(plan.most, BankPlan) and isinstance(plan.fewer, BankPlan)
            assert state.most is not None and state.fewer is not None
            most, _ = bank_step(plan.most, state.most, received, known_u)
            fewer, _ = bank_step(plan.fewer, state.fewer, received, known_u)
            state = ObserverState(most, fewer, None, None)
        away = agreement(most, fewer, plan.inside)
        chosen = np.argmin(np.max(away, axis=-1), axis=-1)
        x = num.pick(most, chosen[..., None])
        over = np.where(plan.spread > 0.0, away / np.where(plan.spread > 0.0, plan.spread, 1.0), 0.0)
        score = num.pick(np.max(over, axis=-1), chosen)
        if full is not None and first is not None:
            x, score = np.where(full[..., None], x, first), np.where(full, score, 0.0)
            state = ObserverState(None, None, window, x)
        alarm = score > self.threshold
        return state, Estimate(x, score, alarm, num.full(score.shape, Mode.NORMAL, np.int8), np.ones_like(alarm))


def _applied(gain: Array, flat: Array) -> Array:
    """Return sum_r gain[:, :, r] flat_r (B, N, n, K) for gain (N, n, q T, K) and flat (B, N, q T, 1), in ascending order."""
    out = gain[:, :, 0] * flat[..., 0, None, :]
    for r in range(1, gain.shape[2]):
        out = out + gain[:, :, r] * flat[..., r, None, :]
    return np.asarray(out)
