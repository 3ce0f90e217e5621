"""A bank of steady Kalman filters: one for each subset of sensors. The banks of `kf_bank` and `observer_bank`.

    x-_K = A x_K + B u + c          z_K = y - C x-_K          x_K = x-_K + G_K z_K

G_K is the steady gain of the sensors in K, with zeros for the others. The bank is the last axis: x (B, N, n, K), z (B, N, q, K). A reading
that is missing has z = 0: the others keep their gains.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Model, Received
from tailgate.estimators.filters.kalman import gain_of, steady_state


class BankPlan(NamedTuple):
    A: Array
    B: Array
    c: Array
    C: Array  # (N, q, n)
    keep: Array  # (K, q) bool: the subsets
    gain: Array  # (N, n, q, K)
    before: Array  # (N, K, n, n) P- of each filter
    after: Array  # (N, K, n, n) P
    weight: Array  # (N, q, q, K) S^-1 of the sensors in K, zero elsewhere


def bank_plan(model: Model, keep: Array) -> BankPlan:
    """Return the filters of the subsets `keep` (K, q) bool, which all have the same size."""
    agents, q, n, count = model.agents, len(model.sensors), model.states, len(keep)
    gain, weight = np.zeros((agents, n, q, count)), np.zeros((agents, q, q, count))
    before, after = (np.zeros((agents, count, n, n)) for _ in range(2))
    rows = [np.flatnonzero(some) for some in keep]
    for i in range(agents):
        C = np.stack([model.C[i][some] for some in rows])
        R = np.stack([model.R[i][np.ix_(some, some)] for some in rows])
        told = dataclasses.replace(
            model, C=C, R=R, sensors=model.sensors[: C.shape[1]], graph=np.eye(count, dtype=bool), gap=None, speed=None
        )
        before[i] = steady_state(told)
        for k, some in enumerate(rows):
            cross = num.matmul(C[k], before[i, k])
            S = num.matmul(C[k], num.transpose(cross)) + R[k]
            gain[i][:, some, k] = gain_of(S, cross)
            weight[i][(*np.ix_(some, some), k)] = num.inverse(S)
            after[i, k] = before[i, k] - num.matmul(num.transpose(cross), num.matmul(num.inverse(S), cross))
    return BankPlan(model.A, model.B, model.c, model.C, keep, gain, before, after, weight)


def bank_start(plan: BankPlan, mean: Array) -> Array:
    """Return x (B, N, n, K) at the prior's mean (B, N, n)."""
    return num.full((*mean.shape, len(plan.keep)), mean[..., None])


def bank_step(plan: BankPlan, x: Array, received: Received, known_u: Array) -> tuple[Array, Array]:
    """Return x (B, N, n, K) and z (B, N, q, K) after a step of every filter."""
    x = num.matmul(plan.A, x) + num.matvec(plan.B, known_u)[..., None] + plan.c[:, None]
    z = np.where(received.valid[..., None], received.y[..., None] - num.matmul(plan.C, x), 0.0)
    return x + summed(plan.gain, z), z


def summed(M: Array, z: Array) -> Array:
    """Return sum_i M[:, :, i] z_i (B, N, m, K) for M (N, m, q, K) and z (B, N, q, K), in ascending order."""
    out = M[:, :, 0] * z[..., None, 0, :]
    for i in range(1, M.shape[2]):
        out = out + M[:, :, i] * z[..., None, i, :]
    return np.asarray(out)


def statistic(plan: BankPlan, z: Array) -> Array:
    """Return z_K' S_K^-1 z_K (B, N, K)."""
    pull = summed(plan.weight, z)
    out = pull[..., 0, :] * z[..., 0, :]
    for i in range(1, z.shape[-2]):
        out = out + pull[..., i, :] * z[..., i, :]
    return np.asarray(out)
