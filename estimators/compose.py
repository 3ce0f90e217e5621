"""filter + detector + mitigation = defence: the only combinator.

Each step:  predict (A, u) -> innovation r, S -> detector: score, alarm, suspects -> mitigation: what to accept, which mode -> update.
A method that does not split this way implements `tailgate.core.Defence` itself.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Generic, Literal, NamedTuple

import numpy as np
from typing_extensions import TypeVar

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Count, Estimate, Innovation, Mode, Model, NonNegative, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import PARTS, Family, imported, make_from, register
from tailgate.core.schema import build, fields_of
from tailgate.estimators.parts import Decision, Detector, Filter, Mitigation, Stateless, Verdict, blame_all, normalised

FP = TypeVar("FP", default=Any)  # the filter's plan
FS = TypeVar("FS", default=Any)  # and state
DP = TypeVar("DP", default=Any)  # the detector's
DS = TypeVar("DS", default=Any)
MP = TypeVar("MP", default=Any)  # the mitigation's
MS = TypeVar("MS", default=Any)


class ComposedPlan(NamedTuple, Generic[FP, FS, DP, DS, MP, MS]):
    filter: Filter[FP, FS]
    detector: Detector[DP, DS]
    mitigation: Mitigation[MP, MS]
    filter_plan: FP
    detector_plan: DP
    mitigation_plan: MP


class ComposedState(NamedTuple, Generic[FS, DS, MS]):
    filter: FS
    detector: DS
    mitigation: MS


class Look(NamedTuple):
    """The defence's view of a measurement, which a white-box attacker computes in advance."""

    innovation: Innovation
    gain: Array  # (B, N, n, q)
    gate: Array | float | None  # threshold on r' S^-1 r; none when there is no gate


class Composed:
    """A defence made of three parts. A named one subclasses it as a dataclass and returns its parts."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        """Return the filter, detector and mitigation, made from this defence's parameters."""
        raise TypeError(f"{type(self).__name__} must define parts()")

    def with_threshold(self, value: float) -> Composed:
        """Return this defence with its alarm threshold, or its detector's, at `value`. Raise NotApplicable where neither has one."""
        own = getattr(self, "threshold_field", None)
        if own is not None:
            changed: Composed = dataclasses.replace(self, **{own: value})  # type: ignore[type-var]
            return changed
        f, d, m = self.parts()
        return compose(f, dataclasses.replace(d, **{threshold_field(d): value}), m)  # type: ignore[type-var]

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
        detector, verdict = self.judge(plan, state, innovation, received, known_u)
        mitigation, decision = plan.mitigation.step(plan.mitigation_plan, state.mitigation, verdict, received)
        if decision.forget is not None and num.some(decision.forget):
            belief = plan.filter.forget(plan.filter_plan, belief, decision.forget)
        if decision.instead is not None or decision.forget is not None:
            y = received.y if decision.instead is None else decision.instead
            used = received._replace(y=y, valid=decision.accept | received.valid)
            innovation = plan.filter.innovation(plan.filter_plan, belief, used)
        belief = plan.filter.update(plan.filter_plan, belief, innovation, decision.accept)
        estimate = Estimate(
            plan.filter.estimate(belief), verdict.score, verdict.alarm, decision.mode, np.ones_like(verdict.alarm), decision.limits
        )
        return ComposedState(belief, detector, mitigation), estimate

    def judge(
        self, plan: ComposedPlan, state: ComposedState, innovation: Innovation, received: Received, known_u: Array
    ) -> tuple[Any, Verdict]:
        """Return the detector's next state and its verdict."""
        verdict: tuple[Any, Verdict] = plan.detector.step(plan.detector_plan, state.detector, innovation)
        return verdict

    def look(self, plan: ComposedPlan, state: ComposedState, received: Received, known_u: Array) -> Look:
        """Return the innovation, gain and gate that `received` would meet; change nothing."""
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
    """Return a defence from three parts."""
    return _Parts(filter, detector, mitigation)


@register("defence", "composed")
@dataclass(frozen=True)
class NamedParts(Composed):
    """A defence from three registered parts, each a name or a name with parameters: `composed:detector=cusum,detector.threshold=30`."""

    filter: object = param("kf", "filter: a name, or a mapping with name and parameters")
    detector: object = param("chi2", "detector: a name, or a mapping with name and parameters")
    mitigation: object = param("gate_out", "mitigation: a name, or a mapping with name and parameters")

    def __post_init__(self) -> None:
        self.parts()  # a wrong name shall fail here

    def with_threshold(self, value: float) -> NamedParts:
        name = threshold_field(self.parts()[1])
        held = self.detector if isinstance(self.detector, dict) else {"name": self.detector}
        return dataclasses.replace(self, detector=held | {name: value})

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        held = {"filter": self.filter, "detector": self.detector, "mitigation": self.mitigation}
        f, d, m = (part_from(family, held[family], fields_of(type(self))[family].default, f"defence composed.{family}") for family in PARTS)
        return f, d, m


def part_from(family: Family, data: object, default: str, where: str) -> Any:
    """Return a part of a defence from its name, or a mapping with name and parameters; a name module:Class is imported.

    A mapping without a name changes parameters of the part `default`.
    """
    if isinstance(data, dict):
        data = {"name": default, **data}
    name = data["name"] if isinstance(data, dict) else data
    if isinstance(name, str) and ":" in name:  # Spec.imports lets readers of files and rows refuse it
        params = {key: value for key, value in data.items() if key != "name"} if isinstance(data, dict) else {}
        return build(imported(family, name).cls, params, where)
    return make_from(family, data, where)


def threshold_field(detector: Detector) -> str:
    """Return the name of a detector's threshold. Raise NotApplicable where it has none."""
    name = getattr(detector, "threshold_field", None)
    if name is None:
        raise NotApplicable("threshold", type(detector).__name__, "a detector that alarms at a threshold")
    return str(name)


@register("detector", "score")
@dataclass(frozen=True)
class Score(Stateless):
    """The normalised innovation squared r' S^-1 r as a score; never alarms."""

    def step(self, plan: None, state: None, innovation: Innovation) -> tuple[None, Verdict]:
        score = normalised(innovation)
        return None, blame_all(score, np.zeros_like(score, bool), innovation)

    def gate(self, plan: None, state: None) -> None:
        return None


ModeName = Literal["normal", "widen", "brake", "stop", "acc"]


M = TypeVar("M", default=None)  # memory by which a mitigation chooses the readings
X = TypeVar("X", default=None)  # its constants besides those of every mitigation


class ReactionPlan(NamedTuple, Generic[X]):
    agents: int
    sensors: int
    linger: int  # steps that a mode outlasts its alarm
    own: X | None = None


class ReactionState(NamedTuple, Generic[M]):
    left: Array | None  # (B, N) int64: steps that the mode still lasts; none where no mode is ever asked for
    readings: M | None


@dataclass(frozen=True, kw_only=True)
class Reaction(Generic[M, X]):
    """Base of mitigations: a subclass's `choose` says which readings to use; the mode asked of the controller is the same for all."""

    mode: ModeName = param("normal", "what is asked of the controller while alarmed: normal, widen, brake, stop or acc")
    linger: NonNegative = param(2.0, "time that the mode outlasts the last alarm [s]")

    def prepare(self, model: Model) -> ReactionPlan[X]:
        return ReactionPlan(model.agents, len(model.sensors), round(self.linger / model.dt), self.constants(model))

    def constants(self, model: Model) -> X | None:
        """Return what `choose` reads in `plan.own`."""
        return None

    def start(self, plan: ReactionPlan[X], batch: int) -> ReactionState[M]:
        left = None if self.mode == "normal" else num.zeros((batch, plan.agents), np.int64)
        return ReactionState(left, self.begin(plan, batch))

    def begin(self, plan: ReactionPlan[X], batch: int) -> M | None:
        """Return the memory of `choose` at the start, every leaf with B first; None where it keeps nothing."""
        return None

    def choose(self, plan: ReactionPlan[X], state: M | None, verdict: Verdict, received: Received) -> tuple[M | None, Decision]:
        """Return the next memory and the readings to use."""
        raise TypeError(f"{type(self).__name__} must define choose()")

    def step(
        self, plan: ReactionPlan[X], state: ReactionState[M], verdict: Verdict, received: Received
    ) -> tuple[ReactionState[M], Decision]:
        readings, decision = self.choose(plan, state.readings, verdict, received)
        if state.left is None:
            return ReactionState(None, readings), decision
        left = np.where(verdict.alarm, plan.linger + 1, np.maximum(state.left - 1, 0))
        mode = np.where(left > 0, Mode[self.mode.upper()], Mode.NORMAL).astype(np.int8)
        return ReactionState(left, readings), decision._replace(mode=mode)


def quiet(verdict: Verdict) -> Array:
    """Return Mode.NORMAL for everybody."""
    return np.full_like(verdict.alarm, Mode.NORMAL, np.int8)


@register("mitigation", "accept_all")
@dataclass(frozen=True)
class AcceptAll(Reaction[None, X]):
    """Uses whatever was received."""

    def choose(self, plan: ReactionPlan[X], state: None, verdict: Verdict, received: Received) -> tuple[None, Decision]:
        return None, Decision(received.valid, quiet(verdict))


@dataclass(frozen=True)
class Gate(Reaction[M, X]):
    """Base of mitigations that shut out the suspected sensors, and keep them out for `latch` steps."""

    latch: Count = param(0, "steps that the gate stays shut after the last suspicion")

    def gates(self, plan: ReactionPlan[X], batch: int) -> Array | None:
        """Return the steps (B, N, q) int64 that the gate of each sensor stays shut; None without a latch."""
        return num.zeros((batch, plan.agents, plan.sensors), np.int64) if self.latch else None

    def shut(self, state: Array | None, verdict: Verdict) -> tuple[Array | None, Array]:
        """Return the next steps of the gates, and (B, N, q) bool: the sensors whose readings are not to be used."""
        if state is None:
            return None, verdict.suspect
        state = np.where(verdict.suspect, self.latch + 1, np.maximum(state - 1, 0))
        return state, state > 0

    def gated(self, state: Array | None, verdict: Verdict, received: Received) -> tuple[Array | None, Decision]:
        """Return the next steps of the gates, and the decision to use what was received and is not shut out."""
        state, shut = self.shut(state, verdict)
        return state, Decision(received.valid & ~shut, quiet(verdict))


@register("mitigation", "gate_out", reference="Dutta 2018, Algorithm 3")
@dataclass(frozen=True)
class GateOut(Gate[Array]):
    """Ignores the suspected sensors: without any, the filter predicts open loop."""

    def begin(self, plan: ReactionPlan, batch: int) -> Array | None:
        return self.gates(plan, batch)

    def choose(self, plan: ReactionPlan, state: Array | None, verdict: Verdict, received: Received) -> tuple[Array | None, Decision]:
        return self.gated(state, verdict, received)
