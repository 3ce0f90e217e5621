"""Gains of filters whose covariance is the same in all episodes at the same step, computed once by the plain filter."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from tailgate import num
from tailgate.core import Array, Model, Prior, Received
from tailgate.estimators.consensus import ConsensusFilter
from tailgate.estimators.sentinels import AcceptFirst

MOST = 4_000_000  # numbers of all steps: more do not stay in a cache, and are not worth their making


def numbers(model: Model, pulled: bool) -> int:
    """How many numbers a step has."""
    q, n = len(model.sensors), model.states
    return model.agents * (q * q + n * q + (1 + n * n if pulled else 0))


def by_step(part: Any, mitigation: Any, model: Model, prior_var: float, steps: int) -> Array:
    """(steps, N, .) of each car S^-1, K, and of a consensus filter its gain and M. The filters are frozen, and so are keys."""
    read = mitigation.steps if type(mitigation) is AcceptFirst else steps
    return _by_step(part, read, _Shown(model), prior_var, steps)


class _Shown:
    """A model by what a filter reads of it."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.key = b"".join(part.tobytes() for part in (model.A, model.B, model.c, model.C, model.Q, model.R, model.graph))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Shown) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@lru_cache(maxsize=4)
def _by_step(part: Any, read: int, shown: _Shown, prior_var: float, steps: int) -> Array:
    model = shown.model
    plan, (cars, q, n) = part.prepare(model), model.C.shape
    cov = np.broadcast_to(prior_var * np.eye(n), (1, cars, n, n))
    state, out = part.start(plan, Prior(np.zeros((1, cars, n)), cov)), []
    received = Received(np.zeros((1, cars, q)), np.ones((1, cars, q), bool), np.zeros((1, cars)), None)
    for k in range(steps):
        state = part.predict(plan, state, np.zeros((1, cars, model.inputs)))
        innovation, M = part.innovation(plan, state, received), np.array(state.P)
        weight, keep = num.inverse(np.array(innovation.S)), float(k < read)
        gain = num.transpose(num.matmul(weight, num.matmul(model.C, M))) * keep
        parts = [weight.reshape(cars, -1), np.ascontiguousarray(gain).reshape(cars, -1)]
        if type(part) is ConsensusFilter:
            rows = num.dot(M, M)
            pull = part.consensus / (1.0 + np.sqrt(num.dot(rows, np.ones(n))))
            parts += [pull.reshape(cars, 1), M.reshape(cars, -1)]
        out.append(np.concatenate(parts, axis=1))
        state = part.update(plan, state, innovation, np.full((1, cars, q), k < read))
    held = np.stack(out)
    held.flags.writeable = False
    return held
