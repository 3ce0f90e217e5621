"""Gaussian mixtures of a fixed size J: components without a weight fill the places that are not used.

Reduced after Vo and Ma (2006): the heaviest component takes in all whose mean is near its own,

    (x_i - x_j)' P_i^-1 (x_i - x_j) <= merge

so that mean and covariance stay; then the heaviest of those that are left, J times. Lighter ones than `prune` are left out.
"""

from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Received
from tailgate.estimators.filters.imm import LEAST, log_likelihood, merged, summed
from tailgate.estimators.filters.kalman import KalmanFilter, KalmanPlan, KalmanState


class Mixture(NamedTuple):
    """Components in K places; every leaf has B first."""

    w: Array  # (B, N, K), sums to 1
    x: Array  # (B, N, K, n)
    P: Array  # (B, N, K, n, n)


def alone(held: KalmanState, places: int) -> Mixture:
    """Return one component (B, N, n) in the first of `places` places."""
    assert held.P is not None
    batch, agents, n = held.x.shape
    w = num.zeros((batch, agents, places))
    w[..., 0] = 1.0
    x = np.broadcast_to(held.x[:, :, None], (batch, agents, places, n))
    return Mixture(w, x.copy(), np.broadcast_to(held.P[:, :, None], (batch, agents, places, n, n)).copy())


def component(held: Mixture, k: int) -> KalmanState:
    """Return component k (B, N, n)."""
    return KalmanState(held.x[:, :, k], held.P[:, :, k])


def weights(held: Mixture) -> list[Array]:
    """Return the weight (B, N) of each component."""
    return [held.w[..., k] for k in range(held.w.shape[-1])]


def joined(one: Mixture, other: Mixture, share: Array, rest: Array) -> Mixture:
    """Return `one` and `other` with their weights times share and rest (B, N), scaled to 1; `one` alone where both are 0."""
    parts = [share * w for w in weights(one)] + [rest * w for w in weights(other)]
    whole = summed(parts)
    some = whole > 0.0
    kept = weights(one) + [num.zeros(whole.shape)] * len(weights(other))
    w = [np.where(some, part / np.where(some, whole, 1.0), old) for part, old in zip(parts, kept, strict=True)]
    return Mixture(num.stack(w), np.concatenate([one.x, other.x], axis=2), np.concatenate([one.P, other.P], axis=2))


def spread_out(plan: KalmanPlan, places: int) -> KalmanPlan:
    """Return the plan of a filter that has `places` components for each agent, one after the other."""
    return plan._replace(C=np.repeat(plan.C, places, axis=0), R=np.repeat(plan.R, places, axis=0))


def measured(plan: KalmanPlan, held: Mixture, received: Received, known_u: Array) -> tuple[Mixture, Array]:
    """Return the mixture one step later, and log of its likelihood (B, N) of the readings. `plan` is that of `spread_out`."""
    batch, agents, K, n = held.x.shape

    def each(leaf: Array) -> Array:
        wide = np.broadcast_to(leaf[:, :, None], (*leaf.shape[:2], K, leaf.shape[-1]))
        return wide.reshape(batch, agents * K, leaf.shape[-1])

    kf = KalmanFilter()
    heard = received._replace(y=each(received.y), valid=each(received.valid))
    belief = KalmanState(held.x.reshape(batch, agents * K, n), held.P.reshape(batch, agents * K, n, n))
    belief = kf.predict(plan, belief, each(known_u))
    innovation = kf.innovation(plan, belief, heard)
    logs = log_likelihood(innovation, heard.valid).reshape(batch, agents, K)
    belief = kf.update(plan, belief, innovation, heard.valid)
    assert belief.P is not None
    terms = [np.where(w > 0.0, num.log(np.maximum(w, LEAST)) + logs[..., k], -np.inf) for k, w in enumerate(weights(held))]
    largest = terms[0]
    for term in terms[1:]:
        largest = np.maximum(largest, term)
    parts = [num.exp(term - largest) for term in terms]
    whole = summed(parts)
    out = Mixture(
        num.stack([part / whole for part in parts]), belief.x.reshape(batch, agents, K, n), belief.P.reshape(batch, agents, K, n, n)
    )
    return out, largest + num.log(whole)


def reduced(held: Mixture, places: int, merge: float, prune: float) -> Mixture:
    """Return the mixture in `places` places."""
    K = held.w.shape[-1]
    parts = [component(held, k) for k in range(K)]
    inverses = [num.inverse(held.P[:, :, k]) for k in range(K)]
    left = [np.where(w >= prune, w, 0.0) for w in weights(held)]
    found, shares = [], []
    for _ in range(places):
        best = np.argmax(num.stack(left), axis=-1)  # the first of equals
        centre = summed([np.where((best == k)[..., None], part.x, 0.0) for k, part in enumerate(parts)])
        taken = []
        for k, part in enumerate(parts):
            near = (num.quadratic(part.x - centre, inverses[k]) <= merge) | (best == k)
            taken.append(np.where(near, left[k], 0.0))
            left[k] = np.where(near, 0.0, left[k])
        found.append(merged(parts, taken))
        shares.append(summed(taken))
    whole = summed(shares)
    w = num.stack([share / whole for share in shares])
    stacked = [np.concatenate([leaf[:, :, None] for leaf in leaves], axis=2) for leaves in zip(*((s.x, s.P) for s in found), strict=True)]
    return Mixture(w, stacked[0], stacked[1])


def mean(held: Mixture) -> Array:
    """Return the mean (B, N, n)."""
    return summed([w[..., None] * held.x[:, :, k] for k, w in enumerate(weights(held))])
