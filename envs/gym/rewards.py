"""What the learner is paid for. Scores never use it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Discount, Frame, Kind, Model, NonNegative, Positive, param
from tailgate.num import clip

RewardName = Literal["collision", "min_gap", "error", "peak", "stealth", "final"]
NEAR = 20.0  # min_gap: a smaller gap than this counts [m]


def closeness(gap: Array) -> Array:
    """How near the car ahead is, elementwise: 0 from 100 m on, 1 at a gap of 0."""
    out: Array = 1.0 - clip(gap, 0.0, 100.0) / 100.0
    return out


def fooled(belief: Array) -> Array:
    """What a car believes that it has on top of its gap [m], elementwise: in units of 10 m, 2 at most."""
    out: Array = clip(belief, 0.0, 20.0) / 10.0
    return out


def small(gap: Array) -> Array:
    """The gap [m] within what `min_gap` pays for, elementwise."""
    out: Array = clip(gap, 0.0, NEAR)
    return out


@dataclass(frozen=True)
class Reward:
    """Reward presets. Scores never use them: they use raw outcomes.

    collision: 1 at a collision in front or behind. min_gap: the same, and the metres by which the smallest gap of the episode falls
    below 20 m, over 20 m: a burst at the right moment earns something long before it makes a collision. error: the largest error of an
    agent (`Model.error`) over `error_scale`, capped at 1, per second. peak: by how much the largest error of the episode so far rises, over
    `error_scale`: in all, the metric `max_error`. stealth: error, less one per second of alarm. final: that error over
    `error_scale`, squared, at the last step of the horizon alone: its mean is the trace of the error's covariance. The shaping terms are
    potential-based (Ng, Harada, Russell 1999): they leave the best policy unchanged when `gamma` is the learner's, and may use the truth,
    which the policy does not see. Without a road nothing collides, and the potentials are 0.
    """

    reward: RewardName = param("min_gap", "collision, min_gap, error, peak, stealth or final")
    error_scale: Positive = param(10.0, "error, peak, stealth, final: the error that earns 1: of the gap [m], or of the state [its unit]")
    gap_shaping: NonNegative = param(0.5, "weight of the closeness of the car ahead as a potential [-]")
    error_shaping: NonNegative = param(1.0, "weight of the believed extra gap, per 10 m and capped at 20 m, as a potential [-]")
    gamma: Discount = param(0.995, "discount in the potential's difference [-]")
    illegal_penalty: NonNegative = param(0.0, "cost of a decision whose command is refused in every step [-]")
    attack_cost: NonNegative = param(0.0, "cost of a step under attack: what makes waiting for the right moment pay [-]")

    def potential(self, gap: Array, belief: Array | float = 0.0) -> Array:
        """(B,) potential of a gap (B, N) [m], infinite where nobody is ahead, and of what a car believes it has on top of it (B, N) [m]."""
        most = np.max(fooled(np.asarray(belief)) + np.zeros_like(gap), axis=1)
        return np.asarray(self.gap_shaping * closeness(np.min(gap, axis=1)) + self.error_shaping * most)

    def least(self, gap: Array, before: Array | float = NEAR) -> Array:
        """(B,) smallest gap so far, within [0, NEAR], from a gap (B, N) and the smallest one before [m]."""
        return np.asarray(np.minimum(small(np.min(gap, axis=1)), before))

    def check(self, model: Model) -> None:
        """Raise InputError for a reward that nothing can earn under this model."""
        if self.reward in ("collision", "min_gap") and not model.followers.any():
            raise InputError("reward", self.reward, "error, peak, stealth or final: nobody drives in this scenario, so nobody collides")

    def __call__(self, model: Model, frame: Frame, fall: Array, last: Array, rise: Array | float = 0.0) -> Array:
        """(B,) reward of one step of the loop; last (B,) bool: the horizon's last step.

        fall (B,) of the smallest gap [m]; rise (B,) of the largest error, which only `peak` asks for.
        """
        crashed = frame.collided | frame.rear_collided
        out = -self.attack_cost * (frame.command.kind != Kind.NONE)
        if self.reward in ("collision", "min_gap"):
            out = out + crashed
            if self.reward == "min_gap":
                out = out + fall / NEAR
        elif self.reward == "peak":
            out = out + rise / self.error_scale
        else:
            error = np.max(model.error(frame.estimate.x, frame.truth), axis=1) / self.error_scale
            out = out + (np.where(last, error * error, 0.0) if self.reward == "final" else model.dt * np.minimum(error, 1.0))
            if self.reward == "stealth":
                out = out - model.dt * frame.estimate.alarm.any(axis=1)
        return np.asarray(out)

    def decided(self, raw: Array, illegal: Array, before: Array, after: Array, terminated: Array) -> Array:
        """(B,) reward of a decision from that of its steps, whether it was illegal, and the potentials (B,) before and after it."""
        return np.asarray(raw - self.illegal_penalty * illegal + self.gamma * np.where(terminated, 0.0, after) - before)
