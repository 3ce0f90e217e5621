"""A threshold of the scorer's on the score of a defence that has none of its own: it tells, and changes nothing of what is done.

Of a filter without a test the score is r' S^-1 r, so that a watch is the standard chi-square test on its innovation; of challenges the
energy that was heard while the probe was muted; of a safe set how far a reading lies from what was predicted, 1 being the edge.
`tailgate.estimators.watched` makes one.
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
    """A defence with an alarm where its score is above a threshold [of the score], in place of its own alarm, which acts as before."""

    defence: Defence[P, S]
    threshold: float

    @property
    def opaque(self) -> str:
        """Why no white box looks into the defence; of the watch it sees nothing."""
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
        """Of the same shape, bool."""
        return np.asarray(score > self.threshold)
