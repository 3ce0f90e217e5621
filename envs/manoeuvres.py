"""Manoeuvres of the leader: its acceleration [m/s^2] at each step."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError, said
from tailgate.base.reading import read_bytes
from tailgate.core import Array, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Accel, Gain, Lag, PositiveGain, PositiveSpeed, Rate, Speed, Spread, Time, TimeSpan, check_order
from tailgate.core.registry import register


def _within(span: tuple[float, float], u: Array) -> Array:
    return np.asarray(span[0] + (span[1] - span[0]) * u)


def between(t: Array, begin: float, end: float, value: float, otherwise: float) -> Array:
    """Return `value` [m/s^2] from the time `begin` until `end` [s], `otherwise` before and after, elementwise."""
    out: Array = np.where((t >= begin) & (t < end), value, otherwise)
    return out


def halt(t: Array, onset: Array, decel: float, speed: Array, dt: float) -> Array:
    """Return a braking with `decel` from the time `onset` [s] until the vehicle stops, elementwise [m/s^2]."""
    out: Array = np.where(t >= onset, np.maximum(-decel, -speed / dt), 0.0)
    return out


CRUISE, BRAKE, DWELL, SPEED_UP = 0, 1, 2, 3  # phases of stop and go, in this order


def phase_over(phase: Array, clock: Array, speed: Array, low: float, high: float) -> Array:
    """Return if a phase of stop and go ends, elementwise: braking and speeding up at a speed [m/s], the others by the clock."""
    out: Array = np.where(phase == BRAKE, speed <= low, np.where(phase == SPEED_UP, speed >= high, clock <= 0.0))
    return out


def stop_and_go(phase: Array, speed: Array, low: float, high: float, decel: float, rate: float, dt: float) -> Array:
    """Return the acceleration in a phase of stop and go [m/s^2], elementwise; no more than the phase's last speed needs."""
    slow = np.minimum(np.maximum(-decel, (low - speed) / dt), 0.0)
    fast = np.maximum(np.minimum(rate, (high - speed) / dt), 0.0)
    out: Array = np.where(phase == BRAKE, slow, np.where(phase == SPEED_UP, fast, 0.0))
    return out


def drawn_back(a: Array, speed: Array, mean_speed: float, pull: float, limit: float) -> Array:
    """Return a random acceleration a plus the return to the mean speed, within the limit [m/s^2], elementwise."""
    out: Array = num.clip(a + pull * (mean_speed - speed), -limit, limit)
    return out


@register("manoeuvre", "constant", reference="Dutta 2018, (4.11), (4.12)")
@dataclass(frozen=True)
class Constant:
    """A constant acceleration throughout."""

    value: Accel = param(-0.108, "acceleration [m/s^2]")

    def prepare(self, dt: float) -> None:
        return None

    def start(self, plan: None, draws: Draws) -> None:
        return None

    def accel(self, plan: None, state: None, k: Array, speed: Array, draws: Draws) -> tuple[None, Array]:
        return None, np.full(len(k), self.value)


class Clocked:
    """A manoeuvre that depends on the time alone: its plan is the step [s]."""

    def prepare(self, dt: float) -> float:
        return dt

    def start(self, plan: float, draws: Draws) -> None:
        return None


@register("manoeuvre", "pulse", reference="Dutta 2018, section 6.6")
@dataclass(frozen=True)
class Pulse(Clocked):
    """A constant acceleration for some time, none before and after."""

    value: Accel = param(0.3, "acceleration [m/s^2]")
    begin: Time = param(18.0, "time at which it begins [s]")
    end: Time = param(30.0, "time at which it ends [s]")

    def __post_init__(self) -> None:
        check_order("manoeuvre pulse.begin, end", (self.begin, self.end))

    def accel(self, plan: float, state: None, k: Array, speed: Array, draws: Draws) -> tuple[None, Array]:
        return None, between(k * plan, self.begin, self.end, self.value, 0.0)


@register("manoeuvre", "switched", reference="Dutta 2018, section 3.5.2, scenario (ii)")
@dataclass(frozen=True)
class Switched(Clocked):
    """One constant acceleration, and from some time on another."""

    value: Accel = param(-0.1082, "acceleration at first [m/s^2]")
    then: Accel = param(0.012, "acceleration afterwards [m/s^2]")
    at: Time = param(100.0, "time of the switch, which the thesis does not give [s]")

    def accel(self, plan: float, state: None, k: Array, speed: Array, draws: Draws) -> tuple[None, Array]:
        return None, between(k * plan, 0.0, self.at, self.value, self.then)


class SinePlan(NamedTuple):
    cos: float  # cosine of the angle of one step
    sin: float


class SineState(NamedTuple):
    cos: Array  # (B,) of the angle so far
    sin: Array


@register("manoeuvre", "sine")
@dataclass(frozen=True)
class Sine:
    """Accelerates and slows down as a cosine of time, so that the mean speed stays: for frequency responses."""

    amplitude: Gain = param(0.5, "largest acceleration [m/s^2]")
    frequency: PositiveGain = param(0.05, "frequency [Hz]")

    def prepare(self, dt: float) -> SinePlan:
        angle = 2.0 * math.pi * self.frequency * dt
        turn = num.expm(np.array([[0.0, -angle], [angle, 0.0]]))
        return SinePlan(float(turn[0, 0]), float(turn[1, 0]))

    def start(self, plan: SinePlan, draws: Draws) -> SineState:
        batch = len(draws.key)
        return SineState(np.ones(batch), np.zeros(batch))

    def accel(self, plan: SinePlan, state: SineState, k: Array, speed: Array, draws: Draws) -> tuple[SineState, Array]:
        """Turn the angle from step to step: the last bits of a library's cosine may depend on the batch."""
        after = SineState(plan.cos * state.cos - plan.sin * state.sin, plan.sin * state.cos + plan.cos * state.sin)
        return after, self.amplitude * state.cos


class BrakingState(NamedTuple):
    onset: Array  # (B,) [s]


@register("manoeuvre", "braking")
@dataclass(frozen=True)
class Braking:
    """Brakes at a random time until it stops."""

    onset: TimeSpan = param((25.0, 35.0), "the onset is uniform on this span [s]")
    decel: Rate = param(4.0, "deceleration [m/s^2]")

    def __post_init__(self) -> None:
        check_order("manoeuvre braking.onset", self.onset)

    def prepare(self, dt: float) -> float:
        return dt

    def start(self, plan: float, draws: Draws) -> BrakingState:
        return BrakingState(_within(self.onset, draws.uniform()))

    def accel(self, plan: float, state: BrakingState, k: Array, speed: Array, draws: Draws) -> tuple[BrakingState, Array]:
        return state, halt(k * plan, state.onset, self.decel, speed, plan)


class StopAndGoState(NamedTuple):
    phase: Array  # (B,) int8
    clock: Array  # (B,) [s] left of a cruise or a dwell


@register("manoeuvre", "stop_and_go")
@dataclass(frozen=True)
class StopAndGo:
    """Cruises, brakes to a low speed, dwells there and speeds up again, with random times."""

    cruise: TimeSpan = param((10.0, 30.0), "length of a cruise, uniform on this span [s]")
    dwell: TimeSpan = param((3.0, 6.0), "length of a dwell at the low speed, uniform on this span [s]")
    decel: Rate = param(3.0, "deceleration [m/s^2]")
    accel_rate: Rate = param(1.5, "acceleration back to cruise [m/s^2]")
    low_speed: Speed = param(0.0, "speed of the dwell [m/s]")
    cruise_speed: PositiveSpeed = param(29.05, "speed of the cruise [m/s]")

    def __post_init__(self) -> None:
        check_order("manoeuvre stop_and_go.cruise", self.cruise)
        check_order("manoeuvre stop_and_go.dwell", self.dwell)
        if self.low_speed >= self.cruise_speed:
            raise InputError("manoeuvre stop_and_go.low_speed", self.low_speed, f"less than cruise_speed ({self.cruise_speed})")

    def prepare(self, dt: float) -> float:
        return dt

    def start(self, plan: float, draws: Draws) -> StopAndGoState:
        clock = _within(self.cruise, draws.uniform())
        return StopAndGoState(np.zeros(len(clock), np.int8), clock)

    def accel(self, plan: float, state: StopAndGoState, k: Array, speed: Array, draws: Draws) -> tuple[StopAndGoState, Array]:
        dt = plan
        phase, clock = state.phase, state.clock - dt
        done = phase_over(phase, clock, speed, self.low_speed, self.cruise_speed)
        if num.some(done):
            u = draws.uniform()
            phase = np.where(done, (phase + 1) % 4, phase).astype(np.int8)
            fresh = np.where(phase == CRUISE, _within(self.cruise, u), _within(self.dwell, u))
            clock = np.where(done, fresh, clock)
        accel = stop_and_go(phase, speed, self.low_speed, self.cruise_speed, self.decel, self.accel_rate, dt)
        return StopAndGoState(phase, clock), accel


class OrnsteinUhlenbeckPlan(NamedTuple):
    keep: float
    kick: float


class OrnsteinUhlenbeckState(NamedTuple):
    accel: Array  # (B,)


@register("manoeuvre", "ornstein_uhlenbeck", reference="Uhlenbeck and Ornstein 1930")
@dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Random accelerations with a correlation time, drawn back to a mean speed."""

    sd: Spread = param(0.8, "standard deviation of the random acceleration [m/s^2]")
    correlation: Lag = param(3.0, "correlation time [s]")
    mean_speed: PositiveSpeed = param(25.0, "mean speed [m/s]")
    pull: Gain = param(0.1, "return to the mean speed [1/s]")
    limit: Rate = param(3.0, "largest |acceleration| [m/s^2]")

    def prepare(self, dt: float) -> OrnsteinUhlenbeckPlan:
        keep = float(num.exp(-dt / self.correlation))
        return OrnsteinUhlenbeckPlan(keep, self.sd * math.sqrt(1.0 - keep * keep))

    def start(self, plan: OrnsteinUhlenbeckPlan, draws: Draws) -> OrnsteinUhlenbeckState:
        return OrnsteinUhlenbeckState(self.sd * draws.normal())

    def accel(
        self, plan: OrnsteinUhlenbeckPlan, state: OrnsteinUhlenbeckState, k: Array, speed: Array, draws: Draws
    ) -> tuple[OrnsteinUhlenbeckState, Array]:
        a = plan.keep * state.accel + plan.kick * draws.normal()
        return OrnsteinUhlenbeckState(a), drawn_back(a, speed, self.mean_speed, self.pull, self.limit)


LONGEST = 1e5  # [s] of a profile, at most: its plan has a speed for each step


class ProfilePlan(NamedTuple):
    dt: float
    speed: Array  # (K,) at k dt


def read_profile(path: Path, where: str = "manoeuvre profile.path") -> tuple[Array, Array]:
    """Return times [s] and speeds [m/s] of a CSV file with the header `t,v`, validated; errors name the field `where`."""
    try:
        rows = list(csv.reader(read_bytes(path).decode("utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(where, str(path), f"a readable CSV file ({said(error)})") from None
    if not rows or [c.strip() for c in rows[0]] != ["t", "v"]:
        raise InputError(where, rows[0] if rows else "an empty file", "the header t,v (seconds, metres per second)")
    times: list[float] = []
    speeds: list[float] = []
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            t, v = (float(c) for c in row)
        except ValueError:
            raise InputError(f"{where}, line {line}", ",".join(row), "two numbers t,v") from None
        if not (math.isfinite(t) and math.isfinite(v)) or v < 0:
            raise InputError(f"{where}, line {line}", ",".join(row), "finite numbers, and a speed not below 0")
        if times and t <= times[-1]:
            raise InputError(f"{where}, line {line}", t, f"a time after {times[-1]}")
        times.append(t)
        speeds.append(v)
    if len(times) < 2:
        raise InputError(where, len(times), "at least two samples")
    if times[-1] - times[0] > LONGEST:
        raise InputError(where, times[-1] - times[0], f"at most {LONGEST:g} s from the first sample to the last")
    return np.array(times), np.array(speeds)


def resampled(times: Array, speeds: Array, dt: float, steps: int) -> Array:
    """Return the speeds (steps,) [m/s] at dt apart from the first time on, linear between samples and constant after the last."""
    out: Array = np.interp(times[0] + dt * np.arange(steps), times, speeds)
    return out


def towards(wanted: Array, speed: Array, dt: float) -> Array:
    """Return the acceleration [m/s^2] that leads to a speed [m/s] in one step, elementwise."""
    out: Array = (wanted - speed) / dt
    return out


@register("manoeuvre", "profile")
@dataclass(frozen=True)
class Profile:
    """Follows the speeds of a CSV file (header t,v), linear between its samples and constant after the last."""

    path: Path = param(Path("profile.csv"), "CSV file with times [s] and speeds [m/s]")

    @property
    def initial_speed(self) -> float:
        """First speed of the file [m/s], which the plant's leader has to start with."""
        return float(read_profile(self.path)[1][0])

    def prepare(self, dt: float) -> ProfilePlan:
        times, speeds = read_profile(self.path)
        return ProfilePlan(dt, resampled(times, speeds, dt, math.ceil((times[-1] - times[0]) / dt) + 2))

    def start(self, plan: ProfilePlan, draws: Draws) -> None:
        return None

    def accel(self, plan: ProfilePlan, state: None, k: Array, speed: Array, draws: Draws) -> tuple[None, Array]:
        return None, towards(num.take(plan.speed, np.minimum(k + 1, len(plan.speed) - 1)), speed, plan.dt)
