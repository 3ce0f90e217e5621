"""A property that a search tries to break, read from traces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array
from tailgate.core.scenario import Scenario
from tailgate.play.trace import Trace
from tailgate.trust.logic import Always, And, Atom, Formula, Interval, Not, Or, robustness_along
from tailgate.trust.properties import own
from tailgate.trust.signals import SafeDistance, sample


class Claim(NamedTuple):
    """A formula of temporal logic about an episode."""

    formula: Formula

    def along(self, trace: Trace) -> dict[str, Array]:
        """Return the robustness (K, B) at every sample of the formula and of each of its parts, the whole first.

        Samples after an episode's end say nothing.
        """
        samples = sample(trace, self.formula.signals, SafeDistance())
        return {str(part): robustness_along(part, samples) for part in _parts(self.formula)}

    def robustness(self, trace: Trace) -> Array:
        """Return the robustness (B,) at the first sample: below 0 the property is violated."""
        samples = sample(trace, self.formula.signals, SafeDistance())
        return np.asarray(robustness_along(self.formula, samples)[0])


class Invariant(NamedTuple):
    """A property G[a,b] of what each sample shows: an episode breaks it at a step, and is not mended later."""

    within: Interval
    of: Formula

    def margins(self, trace: Trace, horizon: int) -> Array:
        """Return the robustness (horizon, B) of what must hold, at each sample; infinite outside the interval and after the end."""
        samples = sample(trace, self.of.signals, SafeDistance())
        first, last = self.within.steps(trace.dt)
        steps = np.arange(samples.count)[:, None]
        counted = samples.live & (steps >= first) & (steps <= (samples.count if last is None else last))
        out = np.full((horizon, trace.batch), np.inf)
        out[: samples.count] = np.where(counted, robustness_along(self.of, samples), np.inf)
        return out


def _parts(formula: Formula) -> list[Formula]:
    """Return a formula and its parts, the outer ones first."""
    return [formula, *(inner for part in formula.parts for inner in _parts(part))]


def claim_of(scenario: Scenario, text: str) -> Claim:
    """Return the property of a text.

    Raises
    ------
    InputError
        For a text that cannot be read, and for a property that has no meaning in the scenario.
    """
    (held,) = own(scenario, [text])
    if held.formula is None:
        raise NotApplicable("--property", text, f"one with a meaning in {scenario.name} ({held.reason})")
    if not held.formula.signals:
        raise InputError("--property", text, "one that reads a signal")
    return Claim(held.formula)


def invariant_of(claim: Claim) -> Invariant:
    """Return a property as an invariant.

    Raises
    ------
    InputError
        For a property of another form: how near an episode has come to breaking it is not known before its end.
    """
    formula = claim.formula
    if not isinstance(formula, Always) or not all(isinstance(part, Atom | And | Or | Not) for part in _parts(formula.of)):
        raise InputError("--property", str(formula), "G[a,b] of comparisons joined by and, or, not: no F, G, U below it")
    return Invariant(formula.within, formula.of)
