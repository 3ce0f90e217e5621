"""Losses of messages in bursts: the two-state channel of Gilbert and Elliott.

E. N. Gilbert, Capacity of a Burst-Noise Channel, Bell System Technical Journal 39 (1960) 1253-1265; E. O. Elliott, Estimates of Error Rates
for Codes on Burst-Noise Channels, Bell System Technical Journal 42 (1963) 1977-1997.

Lost are the fields that a controller hears; the predictions that estimators exchange are trusted and never lost (docs/distributed.md).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.scripted import ScriptPlan, Timed
from tailgate.agents.scripts.triggers import TriggerState, idle
from tailgate.base.errors import InputError
from tailgate.core import Array, Command, Kind, Probability, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief

MOVE, LOSE = 0x100, 0x101  # tags of the draws


class BurstState(NamedTuple):
    """Every leaf has B first."""

    trigger: TriggerState
    bad: Array  # (B, N, groups) bool: the channel is in its bad state


def groups(brief: Brief) -> Array:
    """Return the channel (w,) that each wire comes over: V2V fields of one sender share one, every other wire has its own.

    The sender is the first word of a field: predecessor_acceleration and predecessor_command come in one message.
    """
    model = brief.model
    names = [*model.sensors, *(f"v2v {field.split('_')[0]}" for field in model.v2v), *(f"actuator {name}" for name in model.actuators)]
    known = list(dict.fromkeys(names))
    return np.array([known.index(name) for name in names])


@register("attack", "burst_loss", reference="E. N. Gilbert, Capacity of a Burst-Noise Channel, 1960; E. O. Elliott, 1963")
@dataclass(frozen=True)
class BurstLoss(Timed):
    """Denial of service: messages are lost in bursts, and the receiver keeps their last values.

    Each car's channel from each sender is good or bad by a Markov chain. It starts in its steady state, and runs in and out of the window.
    A bad spell lasts 1 / recover steps in the mean, and recover / (fail + recover) of all steps are good.
    """

    fail: Probability = param(0.02, "probability a step that a good channel turns bad [-]")
    recover: Probability = param(0.1, "probability a step that a bad channel turns good [-]")
    loss_good: Probability = param(0.0, "probability that a message is lost in the good state; 0 is Gilbert's channel [-]")
    loss_bad: Probability = param(1.0, "probability that a message is lost in the bad state [-]")

    def __post_init__(self) -> None:
        if self.fail + self.recover <= 0.0:
            raise InputError("attack burst_loss.recover", self.recover, "fail or recover above 0")

    def prepare(self, brief: Brief) -> ScriptPlan:
        """Return the plan. Without `targets` it aims at the V2V fields that are granted, or where none is, at the sensors."""
        q, p = len(brief.model.sensors), len(brief.model.v2v)
        wire = np.arange(len(brief.model.wires))
        messages = brief.granted & ((wire >= q) & (wire < q + p))
        target = chosen(brief, self.targets, messages if messages.any() else brief.granted & ~brief.is_actuator, self.agents)
        require(brief, "attack burst_loss", ["dropout"], target)
        return ScriptPlan(brief, target, groups(brief))

    def start(self, plan: ScriptPlan, batch: int, draws: Draws) -> BurstState:
        share = self.fail / (self.fail + self.recover)
        return BurstState(idle(batch, plan.brief.model.agents), draws.uniform(self._channels(plan), MOVE) < share)

    def decide(self, plan: ScriptPlan, state: BurstState, view: View, draws: Draws) -> tuple[BurstState, Command]:
        u = draws.uniform(self._channels(plan), MOVE)
        bad = np.where(state.bad, u >= self.recover, u < self.fail)
        lost = draws.uniform(self._channels(plan), LOSE) < np.where(bad, self.loss_bad, self.loss_good)
        trigger, command = self.timed(plan._replace(extra=lost[..., plan.extra]), state.trigger, view, draws)
        return BurstState(trigger, bad), command

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        target = plan.target & plan.extra
        return plan.brief.command(on & target.any(axis=(1, 2)), Kind.DROPOUT, target, 0.0)

    def _channels(self, plan: ScriptPlan) -> tuple[int, int]:
        return plan.brief.model.agents, int(np.max(plan.extra)) + 1
