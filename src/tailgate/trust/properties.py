"""Properties of a run as formulas: the built-in ones of a scenario, and a user's own.

    no_collision   G (gap > 0 and rear_gap > 0)
    brakes         whenever a gap is unsafe once an attack has begun, that car begins to brake within 0.6 s, strictly later, and
                   brakes on for 0.5 s, or stops, or is safe again
    detects        an alarm within ten steps of the first step of an attack; it counts under a limit of false alarms (false_alarms.py)
    error          G (error <= bound), where nobody drives

A property that has no meaning in a scenario has a reason in place of a formula. One with an antecedent, the trigger, also holds of a run
without it; reports say how often the trigger came about.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Model, Positive, PositiveCount, param
from tailgate.core.scenario import Scenario
from tailgate.envs.controllers.adaptive_cruise import BRAKE_ACCEL
from tailgate.evaluation.attack_free import HOURS
from tailgate.play.metrics import DETECTION_DEADLINE

from .formula import parse
from .logic import Always, And, Atom, Eventually, Formula, Interval, Not, Or, implies, response
from .signals import FLAGS, check_names


@dataclass(frozen=True)
class Demands:
    """The numbers in the built-in properties."""

    deadline: Positive = param(0.6, "time to brake after a threat [s]; thesis 7.4")
    hold: Positive = param(0.5, "time that the braking has to last [s]; thesis 7.4: the actuator's limit")
    steps: PositiveCount = param(4, "steps that the deadline spans at least: with fewer a step is too coarse to time it")
    braking: Positive = param(-BRAKE_ACCEL, "deceleration from which an applied command counts as braking [m/s^2]; that of the mode BRAKE")
    stands: Positive = param(0.1, "speed below which a car counts as standing, and need not brake [m/s]")
    detection: PositiveCount = param(DETECTION_DEADLINE, "steps from the first one attacked to an alarm")
    false_alarms: Positive = param(HOURS, "shortest mean time between false alarms with which detection counts [h]")


@dataclass(frozen=True)
class Property:
    """A formula and its antecedent; without a formula the reason why it has no meaning here."""

    name: str
    about: str
    formula: Formula | None
    trigger: Formula | None = None
    reason: str = ""
    until: float = math.inf  # the trigger is asked about up to here [s]

    @property
    def signals(self) -> set[str]:
        """Names of the signals that are needed to decide it."""
        return set().union(*(f.signals for f in (self.formula, self.trigger) if f is not None))


CONJUNCTIONS: dict[str, tuple[str, ...]] = {  # of what is defined among these one boolean a run is made
    "trust": ("no_collision", "brakes", "detects", "error"),
    "safety": ("no_collision", "brakes", "error"),
}


def _over(signal: str, factor: float, bound: float, strict: bool = True) -> Atom:
    """Return factor x signal > bound."""
    return Atom(((signal, factor),), -bound, strict)


def _none(name: str, about: str, reason: str) -> Property:
    return Property(name, about, None, reason=reason)


def _no_collision(model: Model) -> Property:
    about = "no collision, in front or behind, until the horizon"
    if not model.followers.any():
        return _none("no_collision", about, "nobody drives behind another")
    return Property("no_collision", about, Always(And((_over("gap", 1.0, 0.0), _over("rear_gap", 1.0, 0.0)))))


def _brakes(model: Model, horizon: int, asked: Demands) -> Property:
    about = f"brakes within {1000 * asked.deadline:g} ms, and on, whenever it is too close to stop after an attack began"
    last = (horizon - 1) * model.dt - asked.deadline - asked.hold
    if model.lane:
        return _none("brakes", about, "a car that keeps its lane at constant speed does not brake")
    if not model.followers.any():
        return _none("brakes", about, "nobody drives behind another")
    if model.dt * asked.steps > asked.deadline * (1.0 + 1e-9):
        return _none("brakes", about, f"a step of {model.dt:g} s is too coarse for a deadline of {asked.deadline:g} s")
    if last < 0.0:
        return _none("brakes", about, "the episode is shorter than the deadline")
    each, threats = [], []
    for i in np.flatnonzero(model.followers):
        threat = And((_over("attacked", 1.0, 0.5), _over(f"margin@{i}", -1.0, 0.0)))
        safe = _over(f"margin@{i}", 1.0, 0.0, False)
        answer = Or((_over(f"applied@{i}", -1.0, asked.braking, False), _over(f"speed@{i}", -1.0, -asked.stands, False), safe))
        lasting = Always(answer, Interval(0.0, asked.hold))
        # the command of the step that led into the threat is no answer to it: the next step's is the first
        soon = Interval(model.dt, asked.deadline)
        over = Not(Eventually(And(()), soon))  # the episode ended with the threat: what became of it, `no_collision` says
        each.append(Always(implies(threat, Or((Eventually(lasting, soon), over))), Interval(0.0, last)))
        threats.append(threat)
    return Property("brakes", about, And(tuple(each)) if len(each) > 1 else each[0], Or(tuple(threats)), until=last)


def _detects(model: Model, horizon: int, asked: Demands) -> Property:
    about = f"an alarm within {asked.detection} steps of the first attack step"
    deadline = asked.detection * model.dt
    last = (horizon - 1) * model.dt - deadline
    if last < 0.0:
        return _none("detects", about, "the episode is shorter than the deadline")
    onset = _over("onset", 1.0, 0.5)
    return Property("detects", about, response(onset, _over("alarm", 1.0, 0.5), deadline, last), onset, until=last)


def _error(model: Model, bound: float | None) -> Property:
    if model.followers.any():
        return _none("error", "the estimate's error stays within the suite's bound", "cars: a collision is what counts")
    if bound is None:
        return _none("error", "the estimate's error stays within the suite's bound", "the suite states no bound")
    return Property("error", f"the estimate's error stays within {bound:g}", Always(_over("error", -1.0, -bound, False)))


def built_in(scenario: Scenario, bound: float | None = None, asked: Demands | None = None) -> tuple[Property, ...]:
    """Return the built-in properties of a scenario; `bound` is the suite's, of an error where nobody drives."""
    model, asked = scenario.brief().model, asked or Demands()
    return _no_collision(model), _brakes(model, scenario.horizon, asked), _detects(model, scenario.horizon, asked), _error(model, bound)


def own(scenario: Scenario, texts: Sequence[str]) -> tuple[Property, ...]:
    """Return a user's formulas as properties. Raises InputError for one that cannot be read, or whose window begins too late."""
    out, model = [], scenario.brief().model
    for text in texts:
        formula = parse(text, FLAGS)
        try:
            check_names(formula.signals, model)
        except NotApplicable as error:
            out.append(Property(text, text, None, reason=str(error)))
            continue
        _fits(formula, model.dt, scenario.horizon, 0)
        out.append(Property(text, text, formula))
    return tuple(out)


def _fits(formula: Formula, dt: float, horizon: int, start: int) -> None:
    window = getattr(formula, "within", None)
    if window is not None:
        start += window.steps(dt)[0]
        if start >= horizon:
            raise InputError("formula", str(formula), f"windows that begin before the horizon of {horizon * dt:g} s")
    for part in formula.parts:
        _fits(part, dt, horizon, start)


def conjunctions(properties: Sequence[Property], texts: Sequence[str] = ()) -> dict[str, tuple[str, ...]]:
    """Return names of the properties that are taken together, those with a meaning only; a user's own formulas all, as `trust`."""
    defined = [p.name for p in properties if p.formula is not None]
    if texts:
        return {"trust": tuple(defined)}
    return {name: tuple(p for p in members if p in defined) for name, members in CONJUNCTIONS.items()}
