"""Played readings for the defences against sparse attacks, and what a radar reads."""

import numpy as np

from tailgate.core import Air, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.envs import RadarCruise, RadarFollowing


def play_readings(defence, model, y, mean=None, valid=None, u=None):
    """States and estimates of a defence over readings y (K, B, q) of one agent, from a prior of unit covariance; inputs u (K, m)."""
    batch, n = y.shape[1], model.states
    plan = defence.prepare(model)
    mean = np.zeros((batch, 1, n)) if mean is None else mean
    state = defence.start(plan, Prior(mean.copy(), np.broadcast_to(np.eye(n), (batch, 1, n, n)).copy()))
    held, out = keys("train", range(batch)), []
    for k, row in enumerate(y):
        there = np.ones(row.shape, bool) if valid is None else valid[k]
        received = Received(row[:, None].copy(), there[:, None].copy(), np.zeros((batch, 1)))
        known = np.zeros((batch, 1, model.inputs)) if u is None else np.tile(u[k], (batch, 1, 1))
        state, estimate = defence.step(plan, state, received, known, held.at(Role.DEFENCE, np.full(batch, k)))
        out.append((state, estimate))
    return plan, out


def simulated(model, steps, batch, rng):
    """True states (K, B, n) and readings (K, B, q) of a linear model without input."""
    x, xs, ys = np.zeros((batch, model.states)), [], []
    noise, spread = np.linalg.cholesky(model.R[0]), np.linalg.cholesky(model.Q + 1e-18 * np.eye(model.states))
    for _ in range(steps):
        x = x @ model.A.T + rng.normal(size=x.shape) @ spread.T
        xs.append(x)
        ys.append(x @ model.C[0].T + rng.normal(size=(batch, len(model.sensors))) @ noise.T)
    return np.array(xs), np.array(ys)


def dense(linear_model, rng, n=3, q=7, Q=1e-6, R=1.0):
    """A random dense model on the edge of stability."""
    A = rng.normal(size=(n, n))
    A /= np.max(np.abs(np.linalg.eigvals(A)))
    return linear_model(A, rng.normal(size=(q, n)), Q * np.eye(n), R * np.eye(q))


def sense(radar, d, rows, dv=-5.0, power=0.0, delay=0.0, seed=0, probe=True, reaction=np.inf, step=7):
    """Return the radar's readings of a gap d [m] that changes by dv [m/s], in each of `rows` episodes."""
    model = RadarFollowing().model(radar, RadarCruise())
    truth, one = np.zeros((rows, 1, 4)), np.ones((rows, 1))
    truth[..., 0], truth[..., 1] = d, dv
    draws = keys("train", range(seed, seed + rows)).at(Role.SENSOR, np.full(rows, step))
    return radar.disturbed(radar.prepare(model), truth, np.full((rows, 1), probe), draws, Air(power * one, delay * one, reaction))
