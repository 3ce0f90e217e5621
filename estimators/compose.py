"""filter + detector + mitigation = defence: the only combinator.

Each step:  predict (A, u) -> innovation r, S -> detector: score, alarm -> mitigation: which sensors to accept, which mode -> update.
A method that does not split this way implements `tailgate.core.Defence` itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Innovation, Mode, Model, Prior, Received
from tailgate.draws import Draws


class Filter(Protocol):
    """A state estimator, split where a gate may cut in."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, prior: Prior) -> Any: ...

    def predict(self, plan: Any, state: Any, known_u: Array) -> Any: ...

    def innovation(self, plan: Any, state: Any, received: Received) -> Innovation:
        """r and S of a predicted state; r is 0 where nothing was received."""

    def update(self, plan: Any, state: Any, innovation: Innovation, accept: Array) -> Any:
        """Use the sensors that `accept` (B, N, q) names."""

    def gain(self, plan: Any, state: Any, innovation: Innovation) -> Array:
        """K (B, N, n, q) of an update with every sensor: what a white-box attacker computes."""

    def estimate(self, state: Any) -> Array:
        """x (B, N, n)."""


class Detector(Protocol):
    """An innovation monitor."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, batch: int) -> Any: ...

    def step(self, plan: Any, state: Any, innovation: Innovation) -> tuple[Any, Array, Array]:
        """-> state, score (B, N), alarm (B, N) bool."""


class Mitigation(Protocol):
    """What follows from an alarm."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, batch: int) -> Any: ...

    def step(self, plan: Any, state: Any, alarm: Array, received: Received) -> tuple[Any, Array, Array]:
        """-> state, accept (B, N, q) bool, mode (B, N) int8."""


class ComposedPlan(NamedTuple):
    filter: Filter
    detector: Detector
    mitigation: Mitigation
    filter_plan: Any
    detector_plan: Any
    mitigation_plan: Any


class ComposedState(NamedTuple):
    filter: Any
    detector: Any
    mitigation: Any


class Look(NamedTuple):
    """What the defence would see of a measurement: the white-box attacker's look ahead."""

    innovation: Innovation
    gain: Array  # (B, N, n, q)
    gate: float | None  # threshold on r' S^-1 r; none when there is no gate


class Composed:
    """A defence made of three parts. A named one subclasses it as a dataclass and returns its parts."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        """The filter, detector and mitigation, made from this defence's parameters."""
        raise TypeError(f"{type(self).__name__} must define parts()")

    def prepare(self, model: Model) -> ComposedPlan:
        f, d, m = self.parts()
        return ComposedPlan(f, d, m, f.prepare(model), d.prepare(model), m.prepare(model))

    def start(self, plan: ComposedPlan, prior: Prior) -> ComposedState:
        batch = len(prior.mean)
        return ComposedState(
            plan.filter.start(plan.filter_plan, prior),
            plan.detector.start(plan.detector_plan, batch),
            plan.mitigation.start(plan.mitigation_plan, batch),
        )

    def step(
        self, plan: ComposedPlan, state: ComposedState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[ComposedState, Estimate]:
        belief = plan.filter.predict(plan.filter_plan, state.filter, known_u)
        innovation = plan.filter.innovation(plan.filter_plan, belief, received)
        detector, score, alarm = plan.detector.step(plan.detector_plan, state.detector, innovation)
        mitigation, accept, mode = plan.mitigation.step(plan.mitigation_plan, state.mitigation, alarm, received)
        belief = plan.filter.update(plan.filter_plan, belief, innovation, accept)
        estimate = Estimate(plan.filter.estimate(belief), score, alarm, mode, np.ones_like(alarm))
        return ComposedState(belief, detector, mitigation), estimate

    def look(self, plan: ComposedPlan, state: ComposedState, received: Received, known_u: Array) -> Look:
        """The innovation, gain and gate that `received` would meet; changes nothing."""
        belief = plan.filter.predict(plan.filter_plan, state.filter, known_u)
        innovation = plan.filter.innovation(plan.filter_plan, belief, received)
        gain = plan.filter.gain(plan.filter_plan, belief, innovation)
        return Look(innovation, gain, getattr(plan.detector, "eta", None))


@dataclass(frozen=True)
class _Parts(Composed):
    filter: Filter
    detector: Detector
    mitigation: Mitigation

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return self.filter, self.detector, self.mitigation


def compose(filter: Filter, detector: Detector, mitigation: Mitigation) -> Composed:
    """A defence from three parts."""
    return _Parts(filter, detector, mitigation)


@dataclass(frozen=True)
class Stateless:
    """Base of detectors and mitigations without memory."""

    def prepare(self, model: Model) -> Any:
        return None

    def start(self, plan: Any, batch: int) -> Any:
        return None


@dataclass(frozen=True)
class Score(Stateless):
    """The normalised innovation squared r' S^-1 r as a score; never alarms."""

    def step(self, plan: Any, state: Any, innovation: Innovation) -> tuple[Any, Array, Array]:
        score = num.quadratic(innovation.r, num.inverse(innovation.S))
        return None, score, np.zeros_like(score, bool)


@dataclass(frozen=True)
class AcceptAll(Stateless):
    """Uses whatever was received."""

    def step(self, plan: Any, state: Any, alarm: Array, received: Received) -> tuple[Any, Array, Array]:
        return None, received.valid, np.full_like(alarm, Mode.NORMAL, np.int8)


@dataclass(frozen=True)
class GateOut(Stateless):
    """Ignores every sensor in a step that alarms: the filter predicts open loop."""

    def step(self, plan: Any, state: Any, alarm: Array, received: Received) -> tuple[Any, Array, Array]:
        return None, received.valid & ~alarm[..., None], np.full_like(alarm, Mode.NORMAL, np.int8)
