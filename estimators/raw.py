"""No defence: the measurement itself is the estimate."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Mode, Model, Prior, Received
from tailgate.draws import Draws
from tailgate.errors import InputError
from tailgate.registry import register


class RawPlan(NamedTuple):
    wiring: Array  # (q,) the state that each sensor reads


class RawState(NamedTuple):
    x: Array  # (B, N, n) the last values


@register("defence", "none")
@dataclass(frozen=True)
class Raw:
    """Believes the sensors: each measured state is its reading, a state that no sensor reads keeps its prior."""

    def prepare(self, model: Model) -> RawPlan:
        C = model.C[0]
        one_each = np.isin(C, (0.0, 1.0)).all() and (np.count_nonzero(C, axis=1) == 1).all()
        if not (one_each and (model.C == C).all()):
            raise InputError("defence none", "this sensor matrix", "sensors that each read one state directly")
        return RawPlan(np.argmax(C, axis=1))

    def start(self, plan: RawPlan, prior: Prior) -> RawState:
        return RawState(prior.mean)

    def step(
        self, plan: RawPlan, state: RawState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[RawState, Estimate]:
        x = state.x.copy(order="K")
        for sensor, column in enumerate(plan.wiring):
            x[..., column] = np.where(received.valid[..., sensor], received.y[..., sensor], x[..., column])
        score = np.zeros(x.shape[:2])
        quiet = np.zeros(x.shape[:2], bool)
        return RawState(x), Estimate(x, score, quiet, num.full(score.shape, Mode.NORMAL, np.int8), ~quiet)
