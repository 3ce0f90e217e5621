"""A lossy link between a sensor and its readers: readings are lost, or come late. Nobody knows of it in advance.

Nobody attacks here. The receiver knows of a lost reading (`valid`), and its wire keeps the last value that arrived, as in an attack of kind
dropout. It does not know that a reading is late.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Probability, Received, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Latency


class LinkState(NamedTuple):
    """Every leaf has B first."""

    way: Array  # (B, N, wires, latency) what is under way, the oldest first
    last: Array  # (B, N, wires) what arrived last


@dataclass(frozen=True)
class Link:
    """Loses each reading with a probability, independently, and delivers the others some steps late."""

    loss: Probability = param(0.0, "probability that a reading is lost [-]")
    latency: Latency = param(0, "steps by which readings and messages are late; the first one fills in for those that are not there yet")

    @property
    def perfect(self) -> bool:
        """True if readings arrive at once."""
        return self.loss == 0.0 and self.latency == 0

    def start(self, sent: Array) -> LinkState:
        """Return the state at the first readings and messages `sent` (B, N, wires), which arrive."""
        way = num.zeros((*sent.shape, self.latency))
        way[...] = sent[..., None]
        return LinkState(way, sent)

    def step(self, state: LinkState, sent: Array, received: Received, draws: Draws) -> tuple[LinkState, Array, Received]:
        """Return the next state, and what arrives of `sent` (B, N, wires) and of the readings in it."""
        way, q = state.way, received.y.shape[-1]
        if self.latency:
            whole = num.zeros((*sent.shape, self.latency + 1))
            whole[..., :-1], whole[..., -1] = way, sent
            sent, way = whole[..., 0], num.batch_last(whole[..., 1:])
        valid = received.valid
        if self.loss:
            gone = draws.uniform(sent.shape[1:]) < self.loss
            sent, valid = np.where(gone, state.last, sent), valid & ~gone[..., :q]
        sent = num.batch_last(sent)
        return LinkState(way, sent), sent, received._replace(y=sent[..., :q], valid=valid)
