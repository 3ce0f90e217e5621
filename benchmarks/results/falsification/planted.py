"""A defence with a planted fault: a Kalman filter with a sign error in a narrow range of the gap.

Where it believes the gap between 100 and 104 m, farther than the car ahead ever is, it takes its own position with the wrong sign.
"""

from dataclasses import dataclass

import numpy as np

from tailgate.estimators.filters.kalman import Kalman

SOUND = Kalman()


@dataclass(frozen=True)
class SignError:
    """The planted fault. It hears the leader's message, to know its gap."""

    low: float = 100.0  # [m] the range of the fault
    high: float = 104.0

    uses = ("measurements", "v2v")

    def prepare(self, model):
        return SOUND.prepare(model)

    def start(self, plan, prior):
        return SOUND.start(plan, prior)

    def step(self, plan, state, received, known_u, draws):
        state, estimate = SOUND.step(plan, state, received, known_u, draws)
        position = estimate.x[..., 0]
        gap = received.v2v[..., 0] - position
        wrong = (gap > self.low) & (gap < self.high)
        x = np.concatenate([np.where(wrong, -position, position)[..., None], estimate.x[..., 1:]], axis=-1)
        return state, estimate._replace(x=x)
