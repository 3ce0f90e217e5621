"""A bank of steady Kalman filters: one for each subset of sensors. The banks of `kf_bank` and `observer_bank`.

    x-_K = A x_K + B u + c          z_K = y - C x-_K          x_K = x-_K + G_K z_K

G_K is the steady gain of the sensors in K, with zeros for the others. The bank is the last axis: x (B, N, n, K), z (B, N, q, K).

A reading that is missing gets the z_M that the others let expect, z_M = -(W_MM)^-1 W_MO z_O with W = S^-1. Then G_K z_K is the
correction that the others make alone at the same P-, and z_K' W z_K is their own z_O' (S_OO)^-1 z_O. As in the steady filter, P- and S do
not widen. In a bank of more than LARGEST numbers in W a missing reading has z = 0: its loop would take minutes to compile.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Model, Received
from tailgate.estimators.filters.kalman import gain_of, steady_state

LARGEST = 20_000  # numbers in the weights of an agent's bank


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
    z = expected(plan, z, received.valid)
    return x + summed(plan.gain, z), z


def expected(plan: BankPlan, z: Array, arrived: Array) -> Array:
    """Return z (B, N, q, K) with what the readings that arrived (B, N, q) let expect of the others; by conjugate gradients."""
    missing = ~arrived[..., None]
    if plan.weight[0].size > LARGEST:
        return z

    def step(z: Array, r: Array, p: Array, left: Array) -> tuple[Array, list[Array]]:
        first = left < 0.0
        pull = np.where(missing, summed(plan.weight, np.where(first[..., None, :], z, p)), 0.0)
        curve = _dot(p, pull)
        move = np.where(curve > 0.0, left / np.where(curve > 0.0, curve, 1.0), 0.0)[..., None, :]
        r = np.where(first[..., None, :], -pull, r - move * pull)
        square = _dot(r, r)
        turn = np.where(left > 0.0, square / np.where(left > 0.0, left, 1.0), 0.0)[..., None, :]
        return np.asarray((square > 0.0).any(axis=-1)), [z + move * p, r, r + turn * p, square]

    state = [z, np.zeros_like(z), np.zeros_like(z), np.full_like(z[..., 0, :], -1.0)]
    return num.until(step, state, np.asarray(missing.any(axis=(-2, -1))), 2 * z.shape[-2])[0]


def _dot(a: Array, b: Array) -> Array:
    """Return sum_i a_i b_i (B, N, K) for a, b (B, N, q, K), in ascending order."""
    out = a[..., 0, :] * b[..., 0, :]
    for i in range(1, a.shape[-2]):
        out = out + a[..., i, :] * b[..., i, :]
    return np.asarray(out)


def summed(M: Array, z: Array) -> Array:
    """Return sum_i M[:, :, i] z_i (B, N, m, K) for M (N, m, q, K) and z (B, N, q, K), in ascending order."""
    out = M[:, :, 0] * z[..., None, 0, :]
    for i in range(1, M.shape[2]):
        out = out + M[:, :, i] * z[..., None, i, :]
    return np.asarray(out)


def statistic(plan: BankPlan, z: Array) -> Array:
    """Return z_K' S_K^-1 z_K (B, N, K)."""
    return _dot(summed(plan.weight, z), z)
