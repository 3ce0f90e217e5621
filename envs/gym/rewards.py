"""Payments of the learner. Scores never use them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Discount, Frame, Kind, Model, NonNegative, Positive, param
from tailgate.core.registry import find, register
from tailgate.num import clip

NEAR = 20.0  # min_gap: a smaller gap than this counts [m]


def closeness(gap: Array) -> Array:
    """Return how near the car ahead is, elementwise: 0 from 100 m on, 1 at a gap of 0."""
    out: Array = 1.0 - clip(gap, 0.0, 100.0) / 100.0
    return out


def fooled(belief: Array) -> Array:
    """Return the believed gap less the true one [m], elementwise: in units of 10 m, 2 at most."""
    out: Array = clip(belief, 0.0, 20.0) / 10.0
    return out


def small(gap: Array) -> Array:
    """Return the gap [m] within the range that `min_gap` pays for, elementwise."""
    out: Array = clip(gap, 0.0, NEAR)
    return out


@dataclass(frozen=True)
class Step:
    """One step of the loop, as a reward sees it."""

    model: Model
    frame: Frame
    fall: Array  # (B,) by how much the smallest gap of the episode fell [m], within [0, NEAR]
    rise: Array | float  # (B,) by how much the largest error of the episode rose; 0 unless the payment asks for it
    last: Array  # (B,) bool: the last step of the horizon

    @property
    def crashed(self) -> Array:
        """(B,) bool: a collision in front or behind, the first of the episode."""
        return self.frame.collided | self.frame.rear_collided

    @property
    def error(self) -> Array:
        """(B,) largest error of an agent (`Model.error`)."""
        return np.asarray(np.max(self.model.error(self.frame.estimate.x, self.frame.truth), axis=1))


@dataclass(frozen=True)
class Payment:
    """Base class of the payment of a step. An instance is given as `reward=`, or by a name (`register`, entry points)."""

    road: ClassVar[bool] = False  # only collisions earn something
    peak: ClassVar[bool] = False  # asks for `Step.rise`

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        """Return the terms (B,) of the payment of one step, which are added in this order; scale: `Reward.error_scale`."""
        raise NotImplementedError


@register("reward", "collision")
class Collision(Payment):
    """1 at the first collision in front or behind."""

    road = True

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        return (step.crashed,)


@register("reward", "min_gap")
class MinGap(Collision):
    """1 at the first collision, and the metres by which the smallest gap of the episode falls below 20 m, over 20 m.

    A burst at the right moment earns something long before it makes a collision.
    """

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        return step.crashed, step.fall / NEAR


@register("reward", "error")
class Error(Payment):
    """The largest error of an agent over `error_scale`, capped at 1, per second."""

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        return (step.model.dt * np.minimum(step.error / scale, 1.0),)


@register("reward", "stealth")
class Stealth(Error):
    """The reward `error`, less one per second of alarm."""

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        return *super().terms(step, scale), np.asarray(-step.model.dt * step.frame.estimate.alarm.any(axis=1))


@register("reward", "peak")
class Peak(Payment):
    """The rise of the largest error of the episode, over `error_scale`: in all, the metric `max_error`."""

    peak = True

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        return (np.asarray(step.rise / scale),)


@register("reward", "final")
class Final(Payment):
    """The error over `error_scale`, squared, at the last step of the horizon: its mean is the trace of the error's covariance."""

    def terms(self, step: Step, scale: float) -> tuple[Array, ...]:
        error = step.error / scale
        return (np.where(step.last, error * error, 0.0),)


@dataclass(frozen=True)
class Reward:
    """Reward presets. Scores never use them: they use raw outcomes.

    The field `reward` names the payment of a step (the subclasses of `Payment`). The shaping terms are potential-based (Ng, Harada,
    Russell 1999): they leave the best policy unchanged when `gamma` is the learner's. They may use the truth, which the policy does not
    see. Without a road nothing collides, and the potentials are 0. The potential behind an end is 0: that of a horizon that truncates
    stays, as the learner estimates what lies behind it (Grzes 2017).
    """

    reward: str = param("min_gap", "payment of a step: collision, min_gap, error, peak, stealth or final")
    error_scale: Positive = param(10.0, "error, peak, stealth, final: the error that earns 1: of the gap [m], or of the state [its unit]")
    gap_shaping: NonNegative = param(0.5, "weight of the closeness of the car ahead as a potential [-]")
    error_shaping: NonNegative = param(1.0, "weight of the believed extra gap, per 10 m and capped at 20 m, as a potential [-]")
    gamma: Discount = param(0.995, "discount in the potential's difference [-]")
    horizon_ends: bool = param(
        False, "the horizon terminates an episode, with a potential of 0 behind it; else it truncates", if_any=True
    )
    illegal_penalty: NonNegative = param(0.0, "cost of a decision whose command is refused in every step [-]")
    attack_cost: NonNegative = param(0.0, "cost of a step under attack: what makes waiting for the right moment pay [-]")

    def __post_init__(self) -> None:
        _ = self.payment  # an unknown name shall fail here

    @cached_property
    def payment(self) -> Payment:
        """The payment of a step that `reward` names."""
        return find("reward", self.reward).cls()  # type: ignore[no-any-return]

    def potential(self, gap: Array, belief: Array | float = 0.0) -> Array:
        """Return the potential (B,) of a gap (B, N) [m], infinite where nobody is ahead, and of its believed excess (B, N) [m]."""
        most = np.max(fooled(np.asarray(belief)) + np.zeros_like(gap), axis=1)
        return np.asarray(self.gap_shaping * closeness(np.min(gap, axis=1)) + self.error_shaping * most)

    def least(self, gap: Array, before: Array | float = NEAR) -> Array:
        """Return the smallest gap so far (B,), within [0, NEAR], from a gap (B, N) and the smallest one before [m]."""
        return np.asarray(np.minimum(small(np.min(gap, axis=1)), before))

    def check(self, model: Model) -> None:
        """Raise InputError for a reward that nothing can earn under this model."""
        if self.payment.road and not model.followers.any():
            raise InputError("reward", self.reward, "error, peak, stealth or final: nobody drives in this scenario, so nobody collides")

    def __call__(self, model: Model, frame: Frame, fall: Array, last: Array, rise: Array | float = 0.0) -> Array:
        """Return the reward (B,) of one step of the loop; last (B,) bool: the horizon's last step.

        The frame has the first collision of the episode alone. fall (B,) of the smallest gap [m]; rise (B,) of the largest error, which
        only `peak` asks for.
        """
        out = -self.attack_cost * (frame.command.kind != Kind.NONE)
        for term in self.payment.terms(Step(model, frame, fall, rise, last), self.error_scale):
            out = out + term
        return np.asarray(out)

    def decided(self, raw: Array, illegal: Array, before: Array, after: Array, terminated: Array) -> Array:
        """Return the reward (B,) of a decision.

        raw (B,): of its steps. illegal (B,) bool. before, after (B,): the potentials. terminated (B,) bool: it ended the episode for good.
        """
        return np.asarray(raw - self.illegal_penalty * illegal + self.gamma * np.where(terminated, 0.0, after) - before)


@dataclass(frozen=True)
class Paying(Reward):
    """A reward whose payment is an object of somebody's class."""

    reward: str = "own"
    paid: Payment = field(default_factory=Payment)

    @cached_property
    def payment(self) -> Payment:
        """The payment of a step."""
        return self.paid
