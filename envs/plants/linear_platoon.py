"""The thesis's platoon: the linear closed loop on the true state, X+ = Ad X + cd + Bd u_r (thesis 6.2, figures 6.3 to 6.5)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Model, Prior, Scene
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.envs.controllers.cacc import PER_CAR, Column
from tailgate.envs.plants.platoon import String


class LinearPlan(NamedTuple):
    A: Array  # (1, n, n)
    B: Array  # (n,)
    c: Array  # (n,)
    leader_heard: Array  # (N,) 1 where the leader's messages arrive, else 0


class LinearState(NamedTuple):
    """Every leaf has B first."""

    X: Array  # (B, n)


@register("plant", "platoon_linear", reference="Dutta 2018, (6.14)")
@dataclass(frozen=True)
class LinearPlatoon(String):
    """The string as its own linear model has it: controllers on the true state and in continuous time, no limits. Estimates only watch."""

    def prepare(self, model: Model) -> LinearPlan:
        return LinearPlan(model.A[None], model.B[:, 0], model.c, model.graph[:, 0].astype(np.float64))

    def start(self, plan: LinearPlan, draws: Draws) -> LinearState:
        gaps = self.initial_gaps(draws)
        X = num.zeros((len(gaps), self.size[1]))
        X[:, 1] = self.speed
        X[:, Column.gap(1) :: PER_CAR] = gaps
        X[:, Column.speed(1) :: PER_CAR] = self.speed
        return LinearState(X)

    def prior(self, plan: LinearPlan, state: LinearState, held: Array, draws: Draws) -> Prior:
        return self.told(self.truth(plan, state, held), draws)

    def step(self, plan: LinearPlan, state: LinearState, u: Array, exo: Array, draws: Draws) -> LinearState:
        return LinearState(num.apply(plan.A, state.X[:, None])[:, 0] + plan.c + exo[:, None] * plan.B)

    def truth(self, plan: LinearPlan, state: LinearState, held: Array) -> Array:
        return np.broadcast_to(state.X[:, None], (len(state.X), *self.size))

    def lead_speed_of(self, state: LinearState) -> Array:
        return state.X[:, 1]

    def _cars(self, state: LinearState) -> tuple[Array, Array, Array]:
        """Return positions, speeds and accelerations (B, N)."""
        cars = range(self.size[0])
        v, a = (state.X[:, [place(i) for i in cars]] for place in (Column.speed, Column.accel))
        x = np.repeat(state.X[:, :1], self.size[0], axis=1)
        x[:, 1:] -= np.add.accumulate(state.X[:, Column.gap(1) :: PER_CAR], axis=1)
        return x, v, a

    def scene(self, plan: LinearPlan, state: LinearState) -> Scene:
        x, v, a = self._cars(state)
        gap, ahead = num.full(x.shape, np.inf), v.copy()
        gap[:, 1:], ahead[:, 1:] = state.X[:, Column.gap(1) :: PER_CAR], v[:, :-1]
        return Scene(gap, v, a, ahead, num.full(x.shape, np.inf), num.zeros(x.shape), x)

    def v2v(self, plan: LinearPlan, state: LinearState) -> Array:
        """Return accelerations (B, N, 3), for the record: the controllers are in the model. It has no commands."""
        _, _, a = self._cars(state)
        out = num.zeros((*a.shape, 3))
        out[:, 1:, 0], out[:, 1:, 1] = a[:, :-1], plan.leader_heard[1:] * a[:, :1]
        return out
