"""Metrics: functions Trace -> (B,) floats, NaN where undefined (null in a row). Names are the columns."""

from collections.abc import Callable

import numpy as np

from tailgate.core import Array
from tailgate.trace import Trace

TTC_CAP = 100.0  # [s]
RECOVERY_TOLERANCE = 2.0  # [m]
DETECTION_DEADLINE = 10  # [steps]

METRICS: dict[str, Callable[[Trace], Array]] = {}
UNITS: dict[str, str] = {}


def metric(unit: str) -> Callable[[Callable[[Trace], Array]], Callable[[Trace], Array]]:
    """Registers a metric under its function's name."""

    def add(function: Callable[[Trace], Array]) -> Callable[[Trace], Array]:
        METRICS[function.__name__] = function
        UNITS[function.__name__] = unit
        return function

    return add


def _total(x: Array) -> Array:
    """Sum over steps in their order: unlike np.sum, the same bits whatever the batch."""
    return np.asarray(np.add.accumulate(x, axis=0)[-1])


def _mean(x: Array, where: Array) -> Array:
    count = np.count_nonzero(where, axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(_total(np.where(where, x, 0.0)) / np.where(count, count, np.nan))


def _rms(x: Array, where: Array) -> Array:
    return np.asarray(np.sqrt(_mean(x * x, where)))


def _front(trace: Trace, name: str) -> Array:
    """(K, B) of a road signal: the first agent's (car following has one)."""
    return np.asarray(trace.signals[name][:, :, 0])


def _least(x: Array, where: Array) -> Array:
    return np.asarray(np.min(np.where(where, x, np.inf), axis=0))


def _finite(x: Array) -> Array:
    return np.where(np.isfinite(x), x, np.nan)


def _attacked(trace: Trace) -> Array:
    return np.asarray((trace.kind != 0) & trace.live)


def _alarm(trace: Trace) -> Array:
    return np.asarray(trace.alarm.any(axis=2) & trace.live)


def _first_step(event: Array) -> Array:
    """(B,) index of the first True step, NaN where there is none."""
    return np.where(event.any(axis=0), np.argmax(event, axis=0), np.nan)


@metric("0/1")
def collided(trace: Trace) -> Array:
    """The car hit the one ahead."""
    return np.asarray((trace.collided & trace.live).any(axis=0), np.float64)


@metric("0/1")
def rear_collided(trace: Trace) -> Array:
    """The car behind hit the car."""
    return np.asarray((trace.rear_collided & trace.live).any(axis=0), np.float64)


@metric("0/1")
def crashed(trace: Trace) -> Array:
    """Either collision: the damage that the safety board counts."""
    return np.maximum(collided(trace), rear_collided(trace))


@metric("m")
def min_gap(trace: Trace) -> Array:
    """Smallest gap to the car ahead."""
    return np.minimum(_least(_front(trace, "gap"), trace.live), trace.first["gap"][:, 0])


@metric("m/s")
def impact_speed(trace: Trace) -> Array:
    """Closing speed at the first collision with the car ahead, at least 0."""
    first = _first_step(trace.collided & trace.live)
    closing = _front(trace, "speed") - _front(trace, "lead_speed")
    at = closing[np.where(np.isnan(first), 0, first).astype(np.int64), np.arange(trace.batch)]
    return np.where(np.isnan(first), np.nan, np.maximum(at, 0.0))


@metric("s")
def min_ttc(trace: Trace) -> Array:
    """Smallest time to collision, capped at 100 s."""
    closing = _front(trace, "speed") - _front(trace, "lead_speed")
    gap = np.maximum(_front(trace, "gap"), 0.0)
    ttc = np.where(closing > 0.0, gap / np.where(closing > 0.0, closing, 1.0), TTC_CAP)
    return np.minimum(_least(ttc, trace.live), TTC_CAP)


@metric("m")
def rmse_position(trace: Trace) -> Array:
    """Root mean square error of the estimated position."""
    return _rms(trace.estimate[:, :, 0, 0] - trace.truth[:, :, 0, 0], trace.live)


@metric("m/s")
def rmse_velocity(trace: Trace) -> Array:
    """Root mean square error of the estimated velocity."""
    return _rms(trace.estimate[:, :, 0, 1] - trace.truth[:, :, 0, 1], trace.live)


@metric("m")
def max_error(trace: Trace) -> Array:
    """Largest error of the estimated position."""
    error = np.abs(trace.estimate[:, :, 0, 0] - trace.truth[:, :, 0, 0])
    return np.asarray(np.max(np.where(trace.live, error, 0.0), axis=0))


@metric("s")
def recovery_time(trace: Trace) -> Array:
    """From the last attack step until the gap error stays within 2 m; null without an attack, after a collision, or if it never does."""
    attacked = _attacked(trace)
    steps = np.arange(len(attacked))[:, None]
    last = np.max(np.where(attacked, steps, -1), axis=0)
    error = np.abs(_front(trace, "gap") - trace.desired_gap(_front(trace, "speed")))
    restless = np.max(np.where((error > RECOVERY_TOLERANCE) & trace.live, steps, -1), axis=0)
    calm_from = np.maximum(restless, last) + 1
    recovered = (last >= 0) & (calm_from < trace.length) & (crashed(trace) == 0.0)
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
    """Times that the alarm went on."""
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
    desired = trace.desired_gap(_front(trace, "speed"))
    return _mean(_front(trace, "gap") / np.maximum(desired, 1e-3) - 1.0, trace.live)


@metric("m")
def distance_travelled(trace: Trace) -> Array:
    """Distance from the start to the end of the episode."""
    last = np.maximum(trace.length - 1, 0)
    return np.asarray(_front(trace, "position")[last, np.arange(trace.batch)] - trace.first["position"][:, 0])


@metric("m/s^2")
def max_decel(trace: Trace) -> Array:
    """Hardest braking of the car."""
    return np.asarray(np.max(np.where(trace.live, np.maximum(-_front(trace, "accel"), 0.0), 0.0), axis=0))


@metric("m/s^3")
def rms_jerk(trace: Trace) -> Array:
    """Root mean square of the rate of change of the acceleration."""
    accel = np.concatenate([trace.first["accel"][None, :, 0], _front(trace, "accel")])
    return _rms((accel[1:] - accel[:-1]) / trace.dt, trace.live)


@metric("ratio")
def string_gain(trace: Trace) -> Array:
    """Root mean square acceleration of the car over that of the car ahead; null where the car ahead keeps its speed."""
    speed = np.concatenate([trace.first["lead_speed"][None, :, 0], _front(trace, "lead_speed")])
    lead = _rms((speed[1:] - speed[:-1]) / trace.dt, trace.live)
    return np.asarray(_rms(_front(trace, "accel"), trace.live) / np.where(lead > 0.01, lead, np.nan))


@metric("steps")
def attack_steps(trace: Trace) -> Array:
    """Steps in which an attack took effect."""
    return np.asarray(np.count_nonzero(_attacked(trace), axis=0), np.float64)


@metric("steps")
def refused_commands(trace: Trace) -> Array:
    """Commands that the channel refused."""
    return np.asarray(np.count_nonzero(trace.refused & trace.live, axis=0), np.float64)


def measure(trace: Trace) -> dict[str, Array]:
    """Every metric of a trace by name, (B,) each, NaN where undefined."""
    return {name: _finite(function(trace)) for name, function in METRICS.items()}
