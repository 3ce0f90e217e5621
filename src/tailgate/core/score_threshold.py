"""A threshold on the score of a defence that has no threshold. It is reported only; the defence behaves as before.

The score of a filter without a test is r' S^-1 r: the threshold makes it the standard chi-square test. The score of a challenge is the
energy heard while the probe was muted. The score of a safe set is the distance of a reading from its prediction; 1 is the edge.
`tailgate.estimators.watched` adds the threshold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import numpy as np

from tailgate.core import Array, Defence, Estimate, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.core.nouns import P, S


@dataclass(frozen=True)
class Watched(Generic[P, S]):
    """A defence whose reported alarm is `score > threshold`; its own alarm still acts as before."""

    defence: Defence[P, S]
    threshold: float

    @property
    def opaque(self) -> str:
        """Why no white box looks into the defence; empty where one may."""
        return str(getattr(self.defence, "opaque", ""))

    @property
    def untraced(self) -> str:
        """Why the defence cannot be traced."""
        return str(getattr(self.defence, "untraced", ""))

    def prepare(self, model: Model) -> P:
        return self.defence.prepare(model)

    def start(self, plan: P, prior: Prior) -> S:
        return self.defence.start(plan, prior)

    def step(self, plan: P, state: S, received: Received, known_u: Array, draws: Draws) -> tuple[S, Estimate]:
        state, told = self.defence.step(plan, state, received, known_u, draws)
        return state, told._replace(alarm=self.alarms(told.score))

    def alarms(self, score: Array) -> Array:
        """Return the alarms, bool, in the shape of the scores."""
        return np.asarray(score > self.threshold)
