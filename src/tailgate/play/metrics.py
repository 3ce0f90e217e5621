"""Metrics: functions from a Trace to (B,) floats, NaN where undefined (null in a row). Their names are the columns of rows.

Their docstrings describe the quantity to readers of boards.
Among several agents, a metric of the road covers those that follow another vehicle; it is undefined without any.
In a lane the nearer line takes the place of the car ahead, and the closing speed is lateral. Metrics of braking are undefined there.
An estimate's error is that of the gap, or the norm of the whole state's error if there is no road (`Model.error`).
"""

import inspect
import warnings
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError, unknown
from tailgate.core import Array, Model
from tailgate.core.foreign import attribute_of, with_place
from tailgate.core.registry import GROUPS
from tailgate.play.trace import Trace

TTC_CAP = 100.0  # [s]
RECOVERY_TOLERANCE = 2.0  # [m]
DETECTION_DEADLINE = 10  # [steps]

Function = Callable[[Trace], Array]
METRICS: dict[str, Function] = {}
UNITS: dict[str, str] = {}  # on a road
LESS_IS_WORSE = ("min_gap", "min_ttc", "distance_travelled")
ERRORS = ("rmse_position", "max_error", "final_error")  # norms over states of mixed units if there is no road


def unit_in(name: str, model: Model) -> str:
    """Return the unit of a metric in episodes of this model; "-" if it has none, or several."""
    return "-" if name in ERRORS and not model.followers.any() else UNITS[name]


def check_outcome(field: str, name: str) -> None:
    """Raise InputError unless a metric can be the outcome of an attack: there more is worse."""
    if name not in METRICS:
        raise unknown(field, name, METRICS)
    if name in LESS_IS_WORSE:
        raise InputError(field, name, "a metric where more is worse, for example crashed, max_error or impact_speed")


def metric(unit: str) -> Callable[[Function], Function]:
    """Register a metric under its function's name."""

    def add(function: Function) -> Function:
        METRICS[function.__name__] = function
        UNITS[function.__name__] = unit
        return function

    return add


def _total(x: Array) -> Array:
    """Sum over steps in order; unlike np.sum, the bits do not depend on the batch."""
    return np.asarray(np.add.accumulate(x, axis=0)[-1])


def _mean(x: Array, where: Array) -> Array:
    count = np.count_nonzero(where, axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(_total(np.where(where, x, 0.0)) / np.where(count, count, np.nan))


def _rms(x: Array, where: Array) -> Array:
    return np.asarray(np.sqrt(_mean(x * x, where)))


def _pooled(x: Array, where: Array) -> Array:
    """Return the mean over steps and agents of x (K, B, N), in their order."""
    if not x.shape[2]:
        return np.full(x.shape[1], np.nan)
    return _mean(np.concatenate(np.moveaxis(x, 2, 0)), np.concatenate([where] * x.shape[2]))


def _cars(trace: Trace) -> bool:
    """Return if cars follow each other, so that they brake."""
    return bool(trace.model.followers.any()) and not trace.model.lane


def _road(trace: Trace, name: str) -> Array:
    """Return a road signal of the followers (K, B, followers)."""
    return np.asarray(trace.signals[name][:, :, trace.model.followers])


def _before(trace: Trace, name: str) -> Array:
    """Return a road signal of the followers before the first step (B, followers)."""
    return np.asarray(trace.first[name][:, trace.model.followers])


def _least(x: Array, where: Array) -> Array:
    """Return the smallest numbers (B,) of x (K, B, N)."""
    return np.asarray(np.min(np.where(where[:, :, None], x, np.inf), axis=(0, 2), initial=np.inf))


def _finite(x: Array) -> Array:
    return np.where(np.isfinite(x), x, np.nan)


def _attacked(trace: Trace) -> Array:
    return np.asarray((trace.kind != 0) & trace.live)


def _alarm(trace: Trace) -> Array:
    return np.asarray(trace.alarm.any(axis=2) & trace.live)


def _first_step(event: Array) -> Array:
    """Return the index (B,) of the first True step, NaN if there is none."""
    return np.where(event.any(axis=0), np.argmax(event, axis=0), np.nan)


@metric("0/1")
def collided(trace: Trace) -> Array:
    """A car hit the one ahead."""
    return np.asarray((trace.collided & trace.live).any(axis=0), np.float64)


@metric("0/1")
def rear_collided(trace: Trace) -> Array:
    """A car behind, no agent, hit the car."""
    return np.asarray((trace.rear_collided & trace.live).any(axis=0), np.float64)


@metric("0/1")
def crashed(trace: Trace) -> Array:
    """Either collision; boards of -v1 count lost progress as damage too."""
    return np.maximum(collided(trace), rear_collided(trace))


@metric("m")
def min_gap(trace: Trace) -> Array:
    """Smallest gap of any car to the one ahead."""
    return np.asarray(np.minimum(_least(_road(trace, "gap"), trace.live), np.min(_before(trace, "gap"), axis=1, initial=np.inf)))


@metric("m/s")
def impact_speed(trace: Trace) -> Array:
    """Closing speed at the first collision with the car ahead, where the gap is smallest, at least 0."""
    first = _first_step(trace.collided & trace.live)
    if not trace.model.followers.any():
        return np.full(trace.batch, np.nan)
    at = np.where(np.isnan(first), 0, first).astype(np.int64), np.arange(trace.batch)
    who = np.argmin(_road(trace, "gap")[at], axis=1)[:, None]
    closing = np.take_along_axis((_road(trace, "speed") - _road(trace, "lead_speed"))[at], who, axis=1)[:, 0]
    return np.where(np.isnan(first), np.nan, np.maximum(closing, 0.0))


@metric("s")
def min_ttc(trace: Trace) -> Array:
    """Smallest time to collision of any car, capped at 100 s."""
    closing = _road(trace, "speed") - _road(trace, "lead_speed")
    gap = np.maximum(_road(trace, "gap"), 0.0)
    ttc = np.where(closing > 0.0, gap / np.where(closing > 0.0, closing, 1.0), TTC_CAP)
    return np.where(trace.model.followers.any(), np.minimum(_least(ttc, trace.live), TTC_CAP), np.nan)


@metric("m")
def rmse_position(trace: Trace) -> Array:
    """Root mean square error of the estimated position, or gap; without a road of the norm of the state's error."""
    error, road = trace.model.error(trace.estimate, trace.truth), trace.model.followers
    error = error[:, :, road] if road.any() else error
    return np.asarray(np.sqrt(_pooled(error * error, trace.live)))


@metric("m/s")
def rmse_velocity(trace: Trace) -> Array:
    """Root mean square error of the estimated velocity."""
    error = trace.model.speed_error(trace.estimate, trace.truth)[:, :, trace.model.followers]
    return np.asarray(np.sqrt(_pooled(error * error, trace.live)))


@metric("m")
def max_error(trace: Trace) -> Array:
    """Largest error of an estimated position, or gap; without a road of the norm of the state's error."""
    error = trace.model.error(trace.estimate, trace.truth)
    return np.asarray(np.max(np.where(trace.live[:, :, None], error, 0.0), axis=(0, 2)))


@metric("m")
def final_error(trace: Trace) -> Array:
    """Error of the estimated position, or gap, at the episode's last step, the largest of an agent; without a road of the state's norm."""
    error = np.max(trace.model.error(trace.estimate, trace.truth), axis=2)
    return np.asarray(error[trace.length - 1, np.arange(trace.batch)])


@metric("s")
def recovery_time(trace: Trace) -> Array:
    """From the last attack step until every gap stays within 2 m of the desired one; null without an attack, a collision, or if never."""
    attacked = _attacked(trace)
    steps = np.arange(len(attacked))[:, None]
    last = np.max(np.where(attacked, steps, -1), axis=0)
    error = np.abs(_road(trace, "gap") - trace.desired_gap(_road(trace, "speed")))
    restless = np.max(np.where((error > RECOVERY_TOLERANCE).any(axis=2) & trace.live, steps, -1), axis=0)
    calm_from = np.maximum(restless, last) + 1
    recovered = (last >= 0) & (calm_from < trace.length) & (crashed(trace) == 0.0) & _cars(trace)
    return np.where(recovered, (calm_from - last) * trace.dt, np.nan)


@metric("steps")
def detection_delay(trace: Trace) -> Array:
    """From the first attack step to the first alarm not before it; null if none."""
    onset = _first_step(_attacked(trace))
    steps = np.arange(len(trace.kind))[:, None]
    return np.asarray(_first_step(_alarm(trace) & (steps >= onset)) - onset)


@metric("0/1")
def missed_deadline(trace: Trace) -> Array:
    """No alarm within 10 steps of the first attack step; null without an attack."""
    onset, delay = _first_step(_attacked(trace)), detection_delay(trace)
    late = ~(delay <= DETECTION_DEADLINE)
    return np.where(np.isnan(onset), np.nan, late.astype(float))


@metric("count")
def alarm_onsets(trace: Trace) -> Array:
    """Number of times that the alarm went on."""
    alarm = _alarm(trace)
    before = np.concatenate([np.zeros_like(alarm[:1]), alarm[:-1]])
    return np.asarray(np.count_nonzero(alarm & ~before, axis=0), np.float64)


@metric("share")
def alarm_rate(trace: Trace) -> Array:
    """Share of the steps with an alarm."""
    return _mean(_alarm(trace).astype(float), trace.live)


@metric("ratio")
def time_gap_inflation(trace: Trace) -> Array:
    """Mean gap over the desired gap at the same speed, less one."""
    desired = trace.desired_gap(_road(trace, "speed"))
    return _pooled(_road(trace, "gap") / np.maximum(desired, 1e-3) - 1.0, trace.live)


@metric("m")
def distance_travelled(trace: Trace) -> Array:
    """Distance from the start to the end of the episode, of the car that comes least far."""
    last = np.maximum(trace.length - 1, 0)
    moved = _road(trace, "position")[last, np.arange(trace.batch)] - _before(trace, "position")
    return _finite(np.min(moved, axis=1, initial=np.inf))


@metric("m/s^2")
def max_decel(trace: Trace) -> Array:
    """Hardest braking of any car that follows another."""
    hardest = np.max(np.where(trace.live[:, :, None], -_road(trace, "accel"), 0.0), axis=(0, 2), initial=0.0)
    return np.where(_cars(trace), hardest, np.nan)


@metric("m/s^3")
def rms_jerk(trace: Trace) -> Array:
    """Root mean square of the rate of change of the acceleration."""
    accel = np.concatenate([_before(trace, "accel")[None], _road(trace, "accel")])
    jerk = (accel[1:] - accel[:-1]) / trace.dt
    return np.asarray(np.sqrt(_pooled(jerk * jerk, trace.live)))


@metric("ratio")
def string_gain(trace: Trace) -> Array:
    """Root mean square acceleration of the last car over that of the car ahead of the first; null where that keeps its speed."""
    if not _cars(trace):
        return np.full(trace.batch, np.nan)
    speed = np.concatenate([_before(trace, "lead_speed")[None], _road(trace, "lead_speed")])[:, :, 0]
    lead = _rms((speed[1:] - speed[:-1]) / trace.dt, trace.live)
    return np.asarray(_rms(_road(trace, "accel")[:, :, -1], trace.live) / np.where(lead > 0.01, lead, np.nan))


@metric("steps")
def muted_steps(trace: Trace) -> Array:
    """Steps in which a defence muted its own probe to listen for an attacker: measurements that it gave up."""
    muted = ~trace.probe.all(axis=2) & trace.live
    return np.asarray(np.count_nonzero(muted, axis=0), np.float64)


@metric("steps")
def attack_steps(trace: Trace) -> Array:
    """Steps in which an attack took effect."""
    return np.asarray(np.count_nonzero(_attacked(trace), axis=0), np.float64)


@metric("steps")
def refused_commands(trace: Trace) -> Array:
    """Commands that the channel refused."""
    return np.asarray(np.count_nonzero(trace.refused & trace.live, axis=0), np.float64)


class Own(NamedTuple):
    """Somebody's metric: the name of its column, and its function."""

    name: str
    function: Function

    def __call__(self, trace: Trace) -> Array:
        """Return the values (B,). Raises InputError for anything else."""
        values = np.asarray(self.function(trace))
        if values.shape != (trace.batch,) or values.dtype.kind not in "bif":
            raise InputError(f"metric {self.name}", f"{values.dtype} {values.shape}", f"numbers of shape ({trace.batch},), one an episode")
        return _finite(values)


def own_metric(text: str) -> Own:
    """Return the metric of an entry point of the group `tailgate.metrics`, by its name, or the function that is named as module:function.

    Raises
    ------
    InputError
        For what is neither, and for a name that every row has.
    """
    if not isinstance(text, str):
        raise InputError("metric", text, "text: module:function, or the name of an entry point")
    if text in METRICS and not METRICS[text].__module__.startswith("tailgate."):
        return Own(text, METRICS[text])  # registered by `metric`
    points = _points()
    if text in points:
        try:
            found = Own(text, points[text].load())
        except Exception as error:  # whatever somebody's package does
            raise InputError("metric", text, f"an entry point that can be loaded ({with_place(error)})") from None
    elif ":" in text:
        found = Own(text.partition(":")[2], attribute_of("metric", text, inspect.isfunction, "function"))  # type: ignore[arg-type]
    elif text in METRICS:
        raise InputError("metric", text, "one of your own: every row has this one")
    elif points:
        raise unknown("metric", text, points)
    else:
        raise InputError("metric", text, "module:function, or the name of an entry point of the group tailgate.metrics")
    if not inspect.isfunction(found.function):
        raise InputError("metric", text, "a function of a trace")
    if METRICS.get(found.name, found.function) is not found.function:
        raise InputError("metric", text, "a name that is not taken")
    return found


def own_metrics() -> list[Own]:
    """Return the metrics of all entry points; one that cannot be loaded is a warning."""
    out = []
    for name in sorted(_points()):
        try:
            out.append(own_metric(name))
        except InputError as error:  # of a package that nobody asked for
            warnings.warn(str(error), stacklevel=2)
    return out


@cache
def _points() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUPS["metric"])}


def measure(trace: Trace) -> dict[str, Array]:
    """Return every metric of a trace by name, (B,) each, NaN where undefined."""
    return {name: _finite(function(trace)) for name, function in METRICS.items()}
