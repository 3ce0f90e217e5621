"""The knobs of a defence, which are parameters that change while it runs, in each row separately; and the view of who turns them.

A knob is a parameter of an unchanged defence: the alarm threshold, the probability of a challenge, or the controller's mode while alarmed.
Turning a knob replaces the parameter by an array with one value per row. The parameter enters elementwise comparisons
only; a knob at the defence's own value changes no bit.

The player who turns the knobs sees only what the defence has: score, alarms, residuals, estimate, message and odometry.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Defence, Estimate, Mode, Model, Positive, PositiveCount, Prior, Probability, Received, param
from tailgate.core.draws import Draws
from tailgate.estimators.challenge.challenge_response import CHANCE, ChallengePlan, Challenger, ChallengeState
from tailgate.estimators.compose import Composed, ComposedPlan, ComposedState, ModeName, Reaction, threshold_field
from tailgate.estimators.detectors.chi_square import ChiSquare
from tailgate.estimators.detectors.sequential import Cusum, Mewma, WindowedChiSquare

TURNED = (ChiSquare, WindowedChiSquare, Cusum, Mewma)  # detectors whose threshold enters by comparison in `step`, and nowhere else
LEADER = ("leader_position", "leader_velocity")
LIMIT = 10.0  # observations are clipped to +-LIMIT
T = TypeVar("T")
HandPlan = ComposedPlan | ChallengePlan
HandState = ComposedState | ChallengeState
FADE = 0.95  # factor of the running means, per step
CALM = 50.0  # steps since an alarm are counted up to this


@dataclass(frozen=True)
class Menu:
    """The settings that a player may choose from: every combination for those knobs that the defence has."""

    thresholds: tuple[Positive, ...] = param((5.0, 8.0, 12.0, 20.0, 40.0), "alarm thresholds [unit of the detector's score]")
    challenges: tuple[Probability, ...] = param((0.02, 0.1, 0.3), "probabilities of a challenge a step, without an alarm [-]")
    modes: tuple[ModeName, ...] = param(("normal", "widen", "brake"), "what is asked of the controller while alarmed")
    interval: PositiveCount = param(10, "steps for which a setting holds")

    def __post_init__(self) -> None:
        for name in ("thresholds", "challenges", "modes"):
            held = getattr(self, name)
            if not held or len(set(held)) < len(held):
                raise InputError(f"menu.{name}", list(held), "at least one setting, and none twice")


class Knob(NamedTuple):
    """One knob: its settings in the menu, and the value that the defence itself has. Modes are numbers of `Mode`."""

    name: str
    levels: tuple[float, ...]
    own: float
    log: bool = False  # between its ends the settings are even in the logarithm

    def at(self, share: Array) -> Array:
        """Return the value at `share` (B,) in [-1, 1] of the way from the least to the largest setting; the nearest listed mode."""
        part = 0.5 + 0.5 * np.clip(share, -1.0, 1.0)
        if self.name == "mode":
            index = np.minimum((part * len(self.levels)).astype(np.int64), len(self.levels) - 1)
            return np.asarray(self.levels)[index]
        low, high = min(self.levels), max(self.levels)
        if self.log and low > 0.0:
            return np.asarray(np.clip(low * num.exp(part * float(num.log(high / low))), low, high))
        return np.asarray(low + part * (high - low))


def settings(knobs: tuple[Knob, ...]) -> Array:
    """Return (S, K): every combination of the knobs' settings, the last knob's running fastest."""
    return np.array(list(itertools.product(*(knob.levels for knob in knobs))))


def nearest(knobs: tuple[Knob, ...]) -> int:
    """Return the number of the combination that is nearest to the defence as it is; thresholds and probabilities compare by their ratio."""
    best = [min(range(len(k.levels)), key=lambda i, k=k: abs(_place(k, k.levels[i]) - _place(k, k.own))) for k in knobs]  # type: ignore[misc]
    out = 0
    for i, knob in zip(best, knobs, strict=True):
        out = out * len(knob.levels) + i
    return out


def _place(knob: Knob, value: float) -> float:
    return float(num.log(max(value, 1e-9))) if knob.log else value


@dataclass(frozen=True, eq=False)
class Hand:
    """A defence with its knobs: `step` plays it with the values of each row (B, K)."""

    defence: Composed | Challenger
    knobs: tuple[Knob, ...]

    @classmethod
    def on(cls, defence: Defence, menu: Menu) -> Hand:
        """Return a defence with its knobs. Raise NotApplicable for a defence without a knob."""
        mode = tuple(float(Mode[name.upper()]) for name in menu.modes)
        if isinstance(defence, Composed) and type(defence).step is Composed.step:
            _, detector, mitigation = defence.parts()
            knobs = []
            if isinstance(detector, TURNED):
                knobs.append(Knob("threshold", menu.thresholds, float(getattr(detector, detector.threshold_field)), True))
                if isinstance(mitigation, Reaction):
                    knobs.append(Knob("mode", mode, float(Mode[mitigation.mode.upper()])))
                return cls(defence, tuple(knobs))
        if isinstance(defence, Challenger) and type(defence).step is Challenger.step:
            knobs = [Knob("mode", mode, float(Mode[defence.mode.upper()]))]
            if defence.challenge == "random":
                chance = CHANCE if defence.probability is None else defence.probability
                knobs.insert(0, Knob("challenge", menu.challenges, chance, True))
            listening = dataclasses.replace(defence, mode="widen") if defence.mode == "normal" else defence  # a mode that can be replaced
            return cls(listening, tuple(knobs))
        named = ", ".join(cls.__name__ for cls in TURNED)
        wanted = f"a challenge-response defence, or a filter under one of the detectors {named}, made by `compose` or its subclasses"
        raise NotApplicable("steered defence", type(defence).__name__, wanted)

    def prepare(self, model: Model) -> HandPlan:
        plan: HandPlan = self.defence.prepare(model)
        if isinstance(plan, ComposedPlan) and isinstance(plan.mitigation, Reaction) and plan.mitigation.mode == "normal":
            plan = plan._replace(mitigation=_with(plan.mitigation, mode="widen"))
        return plan

    def start(self, plan: HandPlan, prior: Prior) -> HandState:
        defence: Defence = self.defence
        state: HandState = defence.start(plan, prior)
        return state

    @property
    def own(self) -> Array:
        """(K,) the defence's own values."""
        return np.array([knob.own for knob in self.knobs])

    def turned(self, plan: HandPlan, values: Array) -> tuple[Defence, HandPlan]:
        """Return the defence and its plan with the knobs at `values` (B, K)."""
        defence: Defence = self.defence
        for i, knob in enumerate(self.knobs):
            if knob.name == "threshold" and isinstance(plan, ComposedPlan):
                plan = plan._replace(detector=_with(plan.detector, **{threshold_field(plan.detector): values[:, i, None]}))
            elif knob.name == "challenge":
                defence = _with(defence, probability=values[:, i, None])
        return defence, plan

    def step(
        self, plan: HandPlan, state: HandState, values: Array, received: Received, known_u: Array, draws: Draws
    ) -> tuple[HandState, Estimate]:
        """Return the defence's step with the knobs at `values` (B, K)."""
        defence, plan = self.turned(plan, values)
        state, estimate = defence.step(plan, state, received, known_u, draws)
        for i, knob in enumerate(self.knobs):
            if knob.name == "mode":
                asked = np.where(estimate.mode != Mode.NORMAL, values[:, i, None], float(Mode.NORMAL)).astype(np.int64).astype(np.int8)
                estimate = estimate._replace(mode=asked)
        return state, estimate


def _with(part: T, **fields: object) -> T:
    """Return a frozen dataclass with other values. Its checks do not run: they know numbers, not one value per row."""
    out = copy.copy(part)
    for name, value in fields.items():
        object.__setattr__(out, name, value)
    return out


class Memory(NamedTuple):
    """The memory of the observation over an episode, (B,) each."""

    score: Array  # running mean of log(1 + score)
    alarm: Array  # running share of alarms
    calm: Array  # steps since the last alarm
    alarmed: Array  # steps with an alarm so far
    asked: Array  # steps in which something else than normal driving was asked for


@dataclass(frozen=True, eq=False)
class Sight:
    """The player's view of the defence: a vector (B, d) float32 scaled to about one; of many agents, the nearest to its leader."""

    model: Model
    knobs: tuple[Knob, ...]
    heard: bool  # the defence receives the messages of the car ahead

    @property
    def names(self) -> tuple[str, ...]:
        sensors = self.model.sensors if self.model.agents == 1 else ("largest",)
        road = ("gap", "speed", "headway") if self._road else ()
        closing = ("closing",) if self._closes else ()
        told = ("score", "score_mean", "alarm", "alarm_mean", "calm", "asked", "muted")
        return (*told, *(f"residual_{name}" for name in sensors), *road, *closing, *(f"knob_{knob.name}" for knob in self.knobs))

    @property
    def _leader(self) -> bool:
        return self.heard and self.model.v2v[:2] == LEADER

    @property
    def _road(self) -> bool:
        """True if the estimate, with the message where the state holds a position, gives the gap."""
        gap = self.model.gap
        assert gap is not None
        return bool(self.model.followers.any()) and (self._leader or not (gap < 0.0).any())

    @property
    def _closes(self) -> bool:
        return self._road and (self._leader or "relative_speed" in self.model.sensors)

    def begin(self, batch: int) -> Memory:
        zero = np.zeros(batch)
        return Memory(zero, zero.copy(), np.full(batch, CALM), zero.copy(), zero.copy())

    def blank(self, values: Array) -> Array:
        """Return the observation before the first measurement: nothing but the knobs (B, K)."""
        out = np.zeros((len(values), len(self.names)), np.float32)
        out[:, len(self.names) - len(self.knobs) :] = self._places(values)
        return out

    def look(self, memory: Memory, estimate: Estimate, received: Received, inner: HandState, values: Array) -> tuple[Memory, Array]:
        """Return the memory and the observation (B, d) after a step."""
        alarm = np.asarray(estimate.alarm.any(axis=1))
        score = num.log(1.0 + np.maximum(np.max(estimate.score, axis=1), 0.0))
        asked = np.max(estimate.mode, axis=1) != Mode.NORMAL
        memory = Memory(
            FADE * memory.score + (1.0 - FADE) * score, FADE * memory.alarm + (1.0 - FADE) * alarm,
            np.where(alarm, 0.0, np.minimum(memory.calm + 1.0, CALM)), memory.alarmed + alarm, memory.asked + asked,
        )  # fmt: skip
        muted = ~inner.probe.all(axis=1) if isinstance(inner, ChallengeState) else np.zeros(len(alarm), bool)
        columns = [score, memory.score, alarm, memory.alarm, memory.calm / CALM, asked, muted, *self._residuals(estimate, received)]
        if self._road:
            columns += self._driving(estimate, received)
        out = np.empty((len(alarm), len(self.names)), np.float32)
        for j, column in enumerate(columns):
            out[:, j] = np.clip(column, -LIMIT, LIMIT)
        out[:, len(columns) :] = self._places(values)
        return memory, out

    def _residuals(self, estimate: Estimate, received: Received) -> list[Array]:
        """Return readings less estimate, in standard deviations of the noise; 0 where nothing was received."""
        model = self.model
        off = received.y - num.apply(model.C, estimate.x)
        sd = np.sqrt(np.maximum(model.R.diagonal(axis1=1, axis2=2), 1e-12))
        off = np.where(received.valid, off / sd, 0.0)
        if model.agents == 1:
            return [off[:, 0, j] for j in range(off.shape[2])]
        return [np.max(np.abs(off), axis=(1, 2))]

    def _driving(self, estimate: Estimate, received: Received) -> list[Array]:
        """Return believed gap, own speed, time headway and, where it is known, the closing speed, of the follower with the least gap."""
        model, cars = self.model, np.flatnonzero(self.model.followers)
        assert model.gap is not None and model.speed is not None
        gaps, speeds, closing = [], [], []
        for i in cars.tolist():
            x = estimate.x[:, i]
            gap, speed = _row(model.gap[i], x), _row(model.speed[i], x)
            if self._leader:
                if received.v2v is None:  # a white-box attacker that looks ahead has no message: nothing is shown, as before the first one
                    return [np.zeros(len(x))] * 4
                gap = gap + np.where((model.gap[i] < 0.0).any(), received.v2v[:, i, 0], 0.0)
                closing.append(speed - received.v2v[:, i, 1])
            elif self._closes:
                closing.append(-_row(model.C[i, model.sensors.index("relative_speed")], x))
            gaps.append(gap)
            speeds.append(speed)
        near = np.argmin(np.stack(gaps, axis=1), axis=1)
        gap, speed = (num.pick(np.stack(part, axis=1), near) for part in (gaps, speeds))
        out = [gap / 50.0, speed / 15.0, gap / np.maximum(speed, 1.0) / 3.0]
        return [*out, num.pick(np.stack(closing, axis=1), near) / 5.0] if closing else out

    def _places(self, values: Array) -> Array:
        """Return the places (B, K) of the knobs, in [-1, 1] between the ends of the menu."""
        out = np.zeros(values.shape)
        for i, knob in enumerate(self.knobs):
            ends = [_place(knob, end) for end in (min(knob.levels), max(knob.levels))]
            at = num.log(np.maximum(values[:, i], 1e-9)) if knob.log else values[:, i]
            out[:, i] = np.clip(2.0 * (at - ends[0]) / (ends[1] - ends[0]) - 1.0, -1.0, 1.0) if ends[1] > ends[0] else 0.0
        return out


def _row(weights: Array, x: Array) -> Array:
    """Return weights (n,) times x (B, n), in fixed order."""
    out = np.zeros(len(x))
    for j in np.flatnonzero(weights).tolist():
        out += weights[j] * x[:, j]
    return out
