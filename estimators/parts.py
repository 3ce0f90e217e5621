"""The three parts of a composed defence: filter, detector, mitigation.

Each step: the filter predicts and gives an innovation; the detector judges it; the mitigation says which readings the filter may use.
P is the type of a part's plan, S that of its state (see `tailgate.core.components`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from tailgate import num
from tailgate.core import Array, Innovation, Model, Prior, Received
from tailgate.core.nouns import P, S


class Verdict(NamedTuple):
    """A detector's judgement of one step: score (B, N), alarm (B, N) bool, suspect (B, N, q) bool: the readings that it blames."""

    score: Array
    alarm: Array
    suspect: Array


class Decision(NamedTuple):
    """A mitigation's answer to a verdict.

    accept (B, N, q) bool: the readings to use. mode (B, N) int8 for the controller. instead (B, N, q): readings to use in place of those
    received. forget (B, N) bool: where the filter shall first forget how sure it was. limits (B, N, m, 2): the least and the largest
    command that the controller may give.
    """

    accept: Array
    mode: Array
    instead: Array | None = None
    forget: Array | None = None
    limits: Array | None = None


class Filter(Protocol[P, S]):
    """A state estimator, split where a gate may cut in: predict, innovation, update."""

    def prepare(self, model: Model) -> P:
        """Return the plan."""

    def start(self, plan: P, prior: Prior) -> S:
        """Return the state of B episodes from the prior, mean (B, N, n) and cov (B, N, n, n)."""

    def predict(self, plan: P, state: S, known_u: Array) -> S:
        """Return the state one step later, before its measurement; known_u (B, N, inputs) is the model's input."""

    def innovation(self, plan: P, state: S, received: Received) -> Innovation:
        """Return r (B, N, q) and S (B, N, q, q) of a predicted state; r is 0 where nothing was received."""

    def update(self, plan: P, state: S, innovation: Innovation, accept: Array) -> S:
        """Return the state after an update with the sensors that `accept` (B, N, q) names."""

    def forget(self, plan: P, state: S, where: Array) -> S:
        """Return a predicted state that, in the rows of `where` (B, N), believes the next measurement almost entirely."""

    def gain(self, plan: P, state: S, innovation: Innovation) -> Array:
        """Return the gain K (B, N, n, q) of an update with every sensor, which a white-box attacker computes."""

    def estimate(self, state: S) -> Array:
        """Return the estimate x (B, N, n)."""


class Detector(Protocol[P, S]):
    """A monitor of innovations. One that alarms at a threshold names that parameter in the class attribute `threshold_field`."""

    def prepare(self, model: Model) -> P:
        """Return the plan."""

    def start(self, plan: P, batch: int) -> S:
        """Return the state of B = `batch` episodes."""

    def step(self, plan: P, state: S, innovation: Innovation) -> tuple[S, Verdict]:
        """Return the next state and the verdict on an innovation, r (B, N, q) and S (B, N, q, q)."""

    def gate(self, plan: P, state: S) -> Array | float | None:
        """Return the largest r' S^-1 r (B, N) that raises no alarm in the next step; None where there is no such number.

        Negative in the rows where the memory alone raises an alarm, whatever is received.
        """


class Mitigation(Protocol[P, S]):
    """A reaction to verdicts."""

    def prepare(self, model: Model) -> P:
        """Return the plan."""

    def start(self, plan: P, batch: int) -> S:
        """Return the state of B = `batch` episodes."""

    def step(self, plan: P, state: S, verdict: Verdict, received: Received) -> tuple[S, Decision]:
        """Return the next state and the decision: the readings to use, and the mode asked of the controller."""


@dataclass(frozen=True)
class Memoryless:
    """Base class of detectors and mitigations without memory."""

    def start(self, plan: object, batch: int) -> None:
        return None


@dataclass(frozen=True)
class Stateless(Memoryless):
    """Base class of detectors and mitigations without memory and constants."""

    def prepare(self, model: Model) -> None:
        return None


def normalised(innovation: Innovation) -> Array:
    """Return the normalised innovation squared r' S^-1 r (B, N)."""
    return num.quadratic(innovation.r, num.inverse(innovation.S))


def blame_all(score: Array, alarm: Array, innovation: Innovation) -> Verdict:
    """Return the verdict of a detector that cannot tell the sensors apart."""
    return Verdict(score, alarm, np.broadcast_to(alarm[..., None], innovation.r.shape))
