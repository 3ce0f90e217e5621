"""The signals of a trace that formulas may name, and the distance below which a gap is unsafe.

A sample is the end of a step: the road as it is then, and what was measured, decided and done in the step. Its time is (k + 1) dt, and a
formula is read at the first one, dt after the start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.core import Array, Model, NonNegative, Positive, param
from tailgate.envs.controllers.adaptive_cruise import STOP_ACCEL
from tailgate.play.metrics import TTC_CAP
from tailgate.play.trace import Trace

from .logic import Samples


@dataclass(frozen=True)
class SafeDistance:
    """The least gap from which a car can still stop behind one that brakes at its hardest (RSS, Shalev-Shwartz et al. 2017, definition 1).

        d = max(0, v r + a r^2 / 2 + (v + a r)^2 / (2 b) - v_l^2 / (2 b_l))

    For the response time r the car may still accelerate with a, then it brakes with b; the one ahead, at v_l, brakes with b_l.
    """

    response: NonNegative = param(0.6, "response time r [s]; the thesis's deadline for braking")
    accel: NonNegative = param(2.0, "acceleration a during it [m/s^2]; the cruise control's largest command")
    brake: Positive = param(-STOP_ACCEL, "deceleration b afterwards [m/s^2]; the braking limit of the thesis's follower")
    lead_brake: Positive = param(-STOP_ACCEL, "hardest deceleration b_l of the car ahead [m/s^2]; no manoeuvre here brakes harder")

    def of(self, speed: Array, lead_speed: Array) -> Array:
        """Return the distance [m] at speeds [m/s], elementwise."""
        after = speed + self.accel * self.response
        own = speed * self.response + 0.5 * self.accel * self.response**2 + after * after / (2.0 * self.brake)
        return np.asarray(np.maximum(own - lead_speed * lead_speed / (2.0 * self.lead_brake), 0.0))


class Signal(NamedTuple):
    """A named signal; `of` gives it for every agent, (K, B, N)."""

    unit: str
    about: str
    of: Callable[[Trace, SafeDistance], Array]
    most: bool  # of several agents the largest counts, else the smallest
    road: bool = True  # only cars that follow another have it


def _ttc(trace: Trace, _: SafeDistance) -> Array:
    closing = trace.speed - trace.lead_speed
    return np.minimum(np.where(closing > 0.0, np.maximum(trace.gap, 0.0) / np.where(closing > 0.0, closing, 1.0), TTC_CAP), TTC_CAP)


def _attacked(trace: Trace, _: SafeDistance) -> Array:
    return np.asarray((trace.kind != 0)[:, :, None] & trace.target.any(axis=3))


def _so_far(once: bool) -> Callable[[Trace, SafeDistance], Array]:
    """Return a signal that is on from the first step in which a command took effect, or `once`, in that step alone. Agents share it."""

    def of(trace: Trace, _: SafeDistance) -> Array:
        on = np.asarray(trace.kind != 0)
        count = np.cumsum(on, axis=0)
        found = on & (count == 1) if once else count > 0
        return np.broadcast_to(found[:, :, None], (*found.shape, trace.model.agents))

    return of


def _time(trace: Trace, _: SafeDistance) -> Array:
    t = trace.dt * np.arange(1, len(trace.kind) + 1)
    return np.broadcast_to(t[:, None, None], (len(t), trace.batch, trace.model.agents))


def _command(name: str) -> Callable[[Trace, SafeDistance], Array]:
    def of(trace: Trace, _: SafeDistance) -> Array:
        if not trace.model.actuators:
            raise NotApplicable(f"signal {name}", "a scenario without actuators", "one in which something is commanded")
        return np.asarray(trace.signals[name][..., 0])

    return of


SIGNALS: dict[str, Signal] = {
    "gap": Signal("m", "to the car ahead, bumper to bumper", lambda t, _: t.gap, False),
    "rear_gap": Signal("m", "to a car behind that is no agent; infinite without one", lambda t, _: t.rear_gap, False),
    "margin": Signal("m", "gap less the safe distance", lambda t, safe: t.gap - safe.of(t.speed, t.lead_speed), False),
    "safe": Signal("m", "the safe distance at the present speeds", lambda t, safe: safe.of(t.speed, t.lead_speed), True),
    "speed": Signal("m/s", "of the car itself", lambda t, _: t.speed, False),
    "lead_speed": Signal("m/s", "of the car ahead", lambda t, _: t.lead_speed, False),
    "closing": Signal("m/s", "own speed less that of the car ahead", lambda t, _: t.speed - t.lead_speed, True),
    "ttc": Signal("s", f"time to collision at the present speeds, at most {TTC_CAP:g}", _ttc, False),
    "accel": Signal("m/s^2", "of the car itself", lambda t, _: t.accel, False),
    "position": Signal("m", "of the car itself", lambda t, _: t.position, False),
    "control": Signal("m/s^2", "what the controller commands", _command("control"), False),
    "applied": Signal("m/s^2", "what the actuator gets, after the attack", _command("applied"), False),
    "gap_error": Signal("m", "estimated gap less the true one", lambda t, _: t.model.gap_error(t.estimate, t.truth), True),
    "speed_error": Signal("m/s", "estimated speed less the true one", lambda t, _: t.model.speed_error(t.estimate, t.truth), True),
    "error": Signal("m", "the estimate's error, as max_error counts it", lambda t, _: t.model.error(t.estimate, t.truth), True, False),
    "score": Signal("-", "the defence's score", lambda t, _: t.score, True, False),
    "alarm": Signal("0/1", "the defence's alarm is on", lambda t, _: t.alarm, True, False),
    "attack": Signal("0/1", "a command takes effect; with @i on agent i", _attacked, True, False),
    "attacked": Signal("0/1", "a command takes effect, or has", _so_far(once=False), True, False),
    "onset": Signal("0/1", "the first step in which a command takes effect", _so_far(once=True), True, False),
    "time": Signal("s", "since the start", _time, True, False),
}  # fmt: skip

FLAGS = {name for name, signal in SIGNALS.items() if signal.unit == "0/1"}


def check_names(names: Iterable[str], model: Model) -> None:
    """Raise InputError for a name that does not exist, NotApplicable for one that has no meaning in the scenario of this model."""
    for name in sorted(names):
        head, _, number = name.partition("@")
        if head not in SIGNALS:
            raise unknown("signal", head, SIGNALS)
        if SIGNALS[head].road and not model.followers.any():
            raise NotApplicable("signal", head, "a scenario in which somebody follows another")
        if head in ("margin", "safe", "lead_speed") and model.lane:
            raise NotApplicable("signal", head, "a scenario in which cars follow each other: a lane has no safe distance")
        if number and not (int(number) < model.agents and (not SIGNALS[head].road or model.followers[int(number)])):
            who = np.flatnonzero(model.followers) if SIGNALS[head].road else range(model.agents)
            raise NotApplicable("signal", name, f"one of the agents {', '.join(str(i) for i in who)}")


def sample(trace: Trace, names: Iterable[str], safe: SafeDistance) -> Samples:
    """Return signals (K, B) of a trace: `name` over all agents, the worst in the way that SIGNALS says, `name@i` of agent i."""
    names = sorted(set(names))
    check_names(names, trace.model)
    values: dict[str, Array] = {}
    each: dict[str, Array] = {}
    for name in names:
        head, _, number = name.partition("@")
        signal = SIGNALS[head]
        if head not in each:
            each[head] = np.asarray(signal.of(trace, safe), np.float64)
        if number:
            values[name] = each[head][:, :, int(number)]
            continue
        counted = each[head][:, :, trace.model.followers] if signal.road else each[head]
        values[name] = np.max(counted, axis=2) if signal.most else np.min(counted, axis=2)
    if not len(trace.kind):
        raise InputError("trace", 0, "at least one step")
    return Samples(trace.dt, trace.length, values, trace.horizon)
