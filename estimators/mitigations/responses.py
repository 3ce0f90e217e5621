"""Mitigations: the readings to use after a verdict, and the mode asked of the controller (docs/detectors.md).

Two independent choices: the readings (`gate_out`, `latch`, `hold`, `reacquire`, `accept_all`), and the mode (`mode`, `linger`), which
every one of them takes. `widen` and `brake` are `gate_out` with a mode.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Count, PositiveCount, Received, param
from tailgate.core.registry import register
from tailgate.estimators.compose import Gate, GateOut, ModeName, ReactionPlan, quiet
from tailgate.estimators.parts import Decision, Verdict


@register("mitigation", "latch")
@dataclass(frozen=True)
class Latch(GateOut):
    """Ignores the suspected sensors, and goes on ignoring them for a number of steps."""

    latch: Count = param(10, "steps that the gate stays shut after the last suspicion")


class HoldState(NamedTuple):
    shut: Array | None  # (B, N, q) steps that the gate stays shut
    held: Array  # (B, N, q) the last accepted readings
    known: Array  # (B, N, q) bool: there is one


@register("mitigation", "hold", reference="Dutta 2018, (6.18): Y_tau, the last good measurement")
@dataclass(frozen=True)
class Hold(Gate[HoldState]):
    """Uses the last accepted reading in place of one that is suspected or missing, as a receiver with a zero-order hold does.

    The filter takes the old reading for a new one: on a moving car the estimate falls behind. Before the first accepted reading the
    sensor is ignored.
    """

    def begin(self, plan: ReactionPlan, batch: int) -> HoldState:
        shape = (batch, plan.agents, plan.sensors)
        return HoldState(self.gates(plan, batch), num.zeros(shape), num.zeros(shape, bool))

    def choose(
        self, plan: ReactionPlan, state: HoldState | None, verdict: Verdict, received: Received
    ) -> tuple[HoldState, Decision]:
        assert state is not None
        left, shut = self.shut(state.shut, verdict)
        good = received.valid & ~shut
        held, known = np.where(good, received.y, state.held), good | state.known
        return HoldState(left, held, known), Decision(known, quiet(verdict), instead=held)


class ReacquireState(NamedTuple):
    shut: Array | None  # (B, N, q) steps that the gate stays shut
    rejected: Array  # (B, N, q) int64: readings of each sensor that were rejected in a row


@register("mitigation", "reacquire")
@dataclass(frozen=True)
class Reacquire(Gate[ReacquireState]):
    """Ignores the suspected sensors, but after a number of rejections in a row starts again from what they say.

    It ends the lock-out, in which a wrong estimate shuts out the honest readings. An attacker who keeps lying for as long is believed as
    well: `after` is the price. The filter also forgets states that no sensor reads. So its gate is wide for all sensors in the next step,
    and a false value of another sensor gets in then. Readings that are missing neither count nor break the row.
    """

    after: PositiveCount = param(20, "readings of a sensor rejected in a row before the next one is believed")

    def begin(self, plan: ReactionPlan, batch: int) -> ReacquireState:
        return ReacquireState(self.gates(plan, batch), num.zeros((batch, plan.agents, plan.sensors), np.int64))

    def choose(
        self, plan: ReactionPlan, state: ReacquireState | None, verdict: Verdict, received: Received
    ) -> tuple[ReacquireState, Decision]:
        assert state is not None
        left, shut = self.shut(state.shut, verdict)
        rejected = np.where(received.valid, np.where(shut, state.rejected + 1, 0), state.rejected)
        due = received.valid & (rejected > self.after)
        if num.some(due):
            rejected = np.where(due, 0, rejected)
            left = None if left is None else np.where(due, 0, left)
        forget = np.asarray(due.any(axis=-1)) if num.some(due) else None
        return ReacquireState(left, rejected), Decision(received.valid & (~shut | due), quiet(verdict), forget=forget)


@register("mitigation", "widen")
@dataclass(frozen=True, kw_only=True)
class Widen(GateOut):
    """Ignores the suspected sensors, and asks for a longer time headway while alarmed and for some time after."""

    mode: ModeName = param("widen", "what is asked of the controller while alarmed: normal, widen, brake, stop or acc")


@register("mitigation", "brake")
@dataclass(frozen=True, kw_only=True)
class Brake(GateOut):
    """Ignores the suspected sensors, and asks for gentle braking while alarmed and for some time after."""

    mode: ModeName = param("brake", "what is asked of the controller while alarmed: normal, widen, brake, stop or acc")
