"""Algorithms 1 and 2 of the thesis as they are printed: they detect the attack, and do not survive it.

    g = h' P        gamma = lambda + g h        j = g' / gamma        e = y' - w' h        w = w + j e        P = (P - j g) / lambda

for d and dv apart, h = [1, t/100], lambda = 0.95, w = 0 and P = delta I at first, delta = 1. From the detection on the controller drives on
w' h; but the attacker sends y', to which w is still adapted. The list of challenges is fixed, and known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Innovation, Positive, PositiveCount, Probability, param
from tailgate.core.registry import register
from tailgate.estimators.challenge.challenge_response import QUIET, WATCH, Challenger, Response
from tailgate.estimators.filters.predictors import Predictor, PredictorPlan, PredictorState
from tailgate.estimators.parts import Filter

Factor = Annotated[float, Field(ge=0.01, lt=1)]
UNIT = 100.0  # unit of time in h [steps]


class Weights(NamedTuple):
    w: Array  # (B, N, q, 2)
    P: Array  # (B, N, q, 2, 2)
    h: Array  # (B, N, q, 2)


@dataclass(frozen=True)
class PrintedRegression(Predictor[Weights]):
    """Algorithm 1: recursive least squares of each reading on [1, t/100]."""

    forgetting: float
    delta: float

    def begin(self, plan: PredictorPlan, y: Array) -> Weights:
        h = num.full((*y.shape, 2), np.array([1.0, 0.0]))
        return Weights(num.zeros(h.shape), num.full((*h.shape, 2), self.delta * np.eye(2)), h)

    def ahead(self, plan: PredictorPlan, past: Weights) -> tuple[Weights, Array, Array]:
        past = past._replace(h=past.h + np.array([0.0, 1.0 / UNIT]))
        return past, num.dot(past.w, past.h), plan.R * (1.0 + num.quadratic(past.h, past.P) / self.forgetting)

    def learn(self, plan: PredictorPlan, past: Weights, y: Array, accept: Array) -> Weights:
        w, P, h = past
        g = num.matvec(P, h)
        j = g / (self.forgetting + num.dot(g, h))[..., None]
        e = y - num.dot(w, h)
        w = np.where(accept[..., None], w + j * e[..., None], w)
        P = np.where(accept[..., None, None], (P - j[..., :, None] * g[..., None, :]) / self.forgetting, P)
        return Weights(w, P, h)

    def update(
        self, plan: PredictorPlan, state: PredictorState[Weights], innovation: Innovation, accept: Array
    ) -> PredictorState[Weights]:
        state = super().update(plan, state, innovation, accept)
        x = state.x.copy(order="K")
        x[:, plan.agent, plan.state] = num.dot(state.past.w, state.past.h)
        return state._replace(x=x)


@register("defence", "algorithm2", uses=("measurements", "odometry", "probe"), reference="Dutta 2018, Algorithms 1 and 2, as printed")
@dataclass(frozen=True, kw_only=True)
class AsPrinted(Challenger):
    """The thesis's Algorithms 1 and 2 as printed: after detection it drives on a fit to what the attacker sends, and fails."""

    label = "algorithm2"

    challenge: Literal["random", "fixed"] = param("fixed", "random: each step with a probability; fixed: at the steps of a list")
    watch: Probability | None = param(None, WATCH)
    quiet: PositiveCount = param(1, QUIET)
    forgetting: Factor = param(0.95, "forgetting factor lambda of both fits [-]")
    delta: Positive = param(1.0, "P at first, over the unit matrix [-]")

    def predictor(self) -> Filter:
        return PrintedRegression(self.forgetting, self.delta)

    def response(self) -> Response:
        return Response(passes=True, stops=True, freezes=False, rolls_back=False)
