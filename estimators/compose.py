"""filter + detector + mitigation = defence: the only combinator.

Each step:  predict (A, u) -> innovation r, S -> detector: score, alarm, suspects -> mitigation: what to accept, which mode -> update.
A method that does not split this way implements `tailgate.core.Defence` itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Innovation, Mode, Model, Prior, Received, param
from tailgate.draws import Draws
from tailgate.registry import make_from, register
from tailgate.schema import fields_of


class Verdict(NamedTuple):
    """What a detector thinks of one step: score (B, N), alarm (B, N) bool, suspect (B, N, q) bool: the readings that it blames."""

    score: Array
    alarm: Array
    suspect: Array


class Decision(NamedTuple):
    """What a mitigation makes of it.

    accept (B, N, q) bool: the readings to use; mode (B, N) int8 for the controller; instead (B, N, q): readings to use in place of
    those received; forget (B, N) bool: where the filter shall first forget how sure it was.
    """

    accept: Array
    mode: Array
    instead: Array | None = None
    forget: Array | None = None


class Filter(Protocol):
    """A state estimator, split where a gate may cut in."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, prior: Prior) -> Any: ...

    def predict(self, plan: Any, state: Any, known_u: Array) -> Any: ...

    def innovation(self, plan: Any, state: Any, received: Received) -> Innovation:
        """r and S of a predicted state; r is 0 where nothing was received."""

    def update(self, plan: Any, state: Any, innovation: Innovation, accept: Array) -> Any:
        """Use the sensors that `accept` (B, N, q) names."""

    def forget(self, plan: Any, state: Any, where: Array) -> Any:
        """A predicted state that, in the rows of `where` (B, N), believes the next measurement almost entirely."""

    def gain(self, plan: Any, state: Any, innovation: Innovation) -> Array:
        """K (B, N, n, q) of an update with every sensor: what a white-box attacker computes."""

    def estimate(self, state: Any) -> Array:
        """x (B, N, n)."""


class Detector(Protocol):
    """An innovation monitor. One that alarms at a threshold names that parameter in `threshold_field`."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, batch: int) -> Any: ...

    def step(self, plan: Any, state: Any, innovation: Innovation) -> tuple[Any, Verdict]: ...

    def gate(self, plan: Any, state: Any) -> Array | float | None:
        """The largest r' S^-1 r (B, N) that raises no alarm in the next step; None where there is no such number."""


class Mitigation(Protocol):
    """What follows from a verdict."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, batch: int) -> Any: ...

    def step(self, plan: Any, state: Any, verdict: Verdict, received: Received) -> tuple[Any, Decision]: ...


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
    gate: Array | float | None  # threshold on r' S^-1 r; none when there is no gate


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
        detector, verdict = plan.detector.step(plan.detector_plan, state.detector, innovation)
        mitigation, decision = plan.mitigation.step(plan.mitigation_plan, state.mitigation, verdict, received)
        if decision.forget is not None and decision.forget.any():
            belief = plan.filter.forget(plan.filter_plan, belief, decision.forget)
        if decision.instead is not None or decision.forget is not None:
            y = received.y if decision.instead is None else decision.instead
            used = received._replace(y=y, valid=decision.accept | received.valid)
            innovation = plan.filter.innovation(plan.filter_plan, belief, used)
        belief = plan.filter.update(plan.filter_plan, belief, innovation, decision.accept)
        estimate = Estimate(
            plan.filter.estimate(belief), verdict.score, verdict.alarm, decision.mode, np.ones_like(verdict.alarm)
        )
        return ComposedState(belief, detector, mitigation), estimate

    def look(self, plan: ComposedPlan, state: ComposedState, received: Received, known_u: Array) -> Look:
        """The innovation, gain and gate that `received` would meet; changes nothing."""
        belief = plan.filter.predict(plan.filter_plan, state.filter, known_u)
        innovation = plan.filter.innovation(plan.filter_plan, belief, received)
        gain = plan.filter.gain(plan.filter_plan, belief, innovation)
        return Look(innovation, gain, plan.detector.gate(plan.detector_plan, state.detector))


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


@register("defence", "composed")
@dataclass(frozen=True)
class NamedParts(Composed):
    """A defence from three registered parts, each a name or a name with parameters: `composed:detector=cusum,detector.threshold=30`."""

    filter: Any = param("kf", "filter: a name, or a mapping with name and parameters")
    detector: Any = param("chi2", "detector: a name, or a mapping with name and parameters")
    mitigation: Any = param("gate_out", "mitigation: a name, or a mapping with name and parameters")

    def __post_init__(self) -> None:
        self.parts()  # a wrong name shall fail here

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return self._part("filter"), self._part("detector"), self._part("mitigation")

    def _part(self, family: Any) -> Any:
        data = getattr(self, family)
        if isinstance(data, dict):  # a mapping without a name changes the default part
            data = {"name": fields_of(type(self))[family].default, **data}
        return make_from(family, data, f"defence composed.{family}")


@dataclass(frozen=True)
class Stateless:
    """Base of detectors and mitigations without memory."""

    def prepare(self, model: Model) -> Any:
        return None

    def start(self, plan: Any, batch: int) -> Any:
        return None


def blame_all(score: Array, alarm: Array, innovation: Innovation) -> Verdict:
    """The verdict of a detector that cannot tell the sensors apart."""
    return Verdict(score, alarm, np.broadcast_to(alarm[..., None], innovation.r.shape))


@register("detector", "score")
@dataclass(frozen=True)
class Score(Stateless):
    """The normalised innovation squared r' S^-1 r as a score; never alarms."""

    def step(self, plan: Any, state: Any, innovation: Innovation) -> tuple[Any, Verdict]:
        score = num.quadratic(innovation.r, num.inverse(innovation.S))
        return None, blame_all(score, np.zeros_like(score, bool), innovation)

    def gate(self, plan: Any, state: Any) -> None:
        return None


@register("mitigation", "accept_all")
@dataclass(frozen=True)
class AcceptAll(Stateless):
    """Uses whatever was received."""

    def step(self, plan: Any, state: Any, verdict: Verdict, received: Received) -> tuple[Any, Decision]:
        return None, Decision(received.valid, np.full_like(verdict.alarm, Mode.NORMAL, np.int8))


@register("mitigation", "gate_out", reference="Dutta 2018, Algorithm 3")
@dataclass(frozen=True)
class GateOut(Stateless):
    """Ignores the suspected sensors: without any, the filter predicts open loop."""

    def step(self, plan: Any, state: Any, verdict: Verdict, received: Received) -> tuple[Any, Decision]:
        return None, Decision(received.valid & ~verdict.suspect, np.full_like(verdict.alarm, Mode.NORMAL, np.int8))
