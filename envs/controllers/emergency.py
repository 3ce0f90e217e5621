"""Automatic emergency braking: the last layer, which brakes where nothing else avoids a collision any more.

It brakes when the gap is at most what stopping the approach takes, for some cycles in a row:

    gap <= margin + reaction c + c^2 / (2 decel),      c = closing speed

It stops braking when the approach is over and the gap is that of `release` at the own speed again. An earlier end would let a deceived
car approach at once.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array

DECEL = 6.0  # [m/s^2]; UN Regulation 152 asks for 5.0 at least
REACTION = 0.9  # time until the brakes act: cycles that confirm, and the actuator's lag out of an acceleration [s]
MARGIN = 1.0  # gap that is left [m]
RELEASE = (3.0, 0.3)  # gap [m], and for each m/s of the own speed [s]
CYCLES = 3  # in a row that ask for it: one wrong reading brakes nobody
SLOWEST = 10.0 / 3.6  # least own speed [m/s]; UN Regulation 152 asks for it from 10 km/h on


class BrakeState(NamedTuple):
    asked: Array  # (B, N) float: cycles in a row, up to CYCLES
    on: Array  # (B, N) bool: it brakes


@dataclass(frozen=True)
class EmergencyBrake:
    """The rule and its memory."""

    def start(self, shape: tuple[int, ...]) -> BrakeState:
        """Return the state of (B, N) cars that do not brake."""
        return BrakeState(num.zeros(shape), num.zeros(shape, bool))

    def step(self, state: BrakeState, gap: Array, closing: Array, speed: Array) -> BrakeState:
        """Return the next state for gap [m], closing speed and own speed [m/s], each (B, N)."""
        near = gap <= MARGIN + REACTION * closing + closing * closing / (2.0 * DECEL)
        late = near & (closing > 0.0) & (speed >= SLOWEST)
        asked = np.where(late, np.minimum(state.asked + 1.0, float(CYCLES)), 0.0)
        still = (closing > 0.0) | (gap < RELEASE[0] + RELEASE[1] * speed)
        return BrakeState(asked, (state.on & still & (speed > 0.0)) | (asked >= CYCLES))

    def limited(self, state: BrakeState, u: Array) -> Array:
        """Return the command [m/s^2], (B, N)."""
        out: Array = np.where(state.on, np.minimum(u, -DECEL), u)
        return out
