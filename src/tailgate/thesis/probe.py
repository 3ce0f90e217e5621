"""A gated filter fed by hand: with chosen innovations, or with a plant that only it observes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Model, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.estimators.compose import Composed

DRAWS = keys("report", [0]).at(Role.DEFENCE, np.zeros(1, np.int64))  # a composed filter draws nothing


class Fed(NamedTuple):
    """B runs of K steps: estimates (K, B, n), covariances (K, B, n, n), alarms (K, B), scores (K, B)."""

    x: Array
    P: Array
    alarm: Array
    score: Array


def start(defence: Composed, model: Model, x: Array, P: Array) -> tuple[Any, Any]:
    """Return plan and state of B runs from means x (B, n) and one covariance P (n, n)."""
    plan = defence.prepare(model)
    cov = num.full((len(x), 1, *P.shape), P)
    return plan, defence.start(plan, Prior(num.batch_last(x[:, None]), cov))


def feed(
    defence: Composed, model: Model, P: Array, *, innovations: Array | None = None, readings: Array | None = None, x: Array | None = None
) -> Fed:
    """Return runs of one agent without input, from covariance P (n, n) and means x (B, n), zero if not given.

    Either innovations (K, B, q): what each reading adds to the filter's own prediction; or readings (K, B, q) themselves.
    """
    given = innovations if innovations is not None else readings
    if given is None or (innovations is not None and readings is not None):
        raise TypeError("feed() takes innovations or readings")
    steps, batch, q = given.shape
    x = np.zeros((batch, model.states)) if x is None else x
    plan, state = start(defence, model, x, P)
    u = np.zeros((batch, 1, model.inputs))
    xs, covs = np.empty((steps, batch, model.states)), np.empty((steps, batch, model.states, model.states))
    alarms, scores = np.empty((steps, batch), bool), np.empty((steps, batch))
    for k in range(steps):
        y = given[k][:, None]
        if innovations is not None:
            y = y + num.matvec(model.C, plan.filter.predict(plan.filter_plan, state.filter, u).x)
        received = Received(y, np.ones((batch, 1, q), bool), np.zeros((batch, 1)))
        state, estimate = defence.step(plan, state, received, u, DRAWS)
        xs[k], covs[k] = state.filter.x[:, 0], state.filter.P[:, 0]
        alarms[k], scores[k] = estimate.alarm[:, 0], estimate.score[:, 0]
    return Fed(xs, covs, alarms, scores)
