"""Recorded following: what a car read of the one ahead, validated, on a uniform grid of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array

LEAST, FEWEST = 5.0, 20  # shortest segment that is kept [s], and the fewest samples of a recording
RATE = (0.005, 2.0)  # admitted distance of samples [s]
FASTEST = 100.0  # admitted speed [m/s]
HURRIED = 60.0  # typical speed that is more likely in another unit [m/s]
FARTHEST = 1000.0  # admitted gap [m]
MISSING = 0.5  # largest share of missing readings
REPEATED = 0.01  # largest share of repeated times
BREAK = 1.5  # times the distance of samples: in a longer one samples are lost
SILENCE = 0.5  # lost samples in a longer time end a segment; in a shorter one they are readings that did not arrive [s]
MOST = 5_000_000  # samples
OFF = 5.0  # median difference of relative speed and the gap's rate that no sensor has [m/s]


class Raw(NamedTuple):
    """The columns of a file, (K,) each: t [s], gap [m], relative speed (positive: opening) and own speed [m/s]; NaN: missing."""

    name: str
    t: Array
    gap: Array
    relative_speed: Array
    speed: Array


class Segment(NamedTuple):
    """Samples dt [s] apart, (K,) each; `seen` is False where a reading is missing, and the values are then those before."""

    begin: float  # [s]
    gap: Array
    relative_speed: Array
    speed: Array
    seen: Array


@dataclass(frozen=True)
class Recording:
    """One car behind another; `repairs` counts what was mended."""

    name: str
    dt: float
    segments: tuple[Segment, ...]
    repairs: dict[str, int] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        return sum(len(part.gap) for part in self.segments)

    @property
    def typical_speed(self) -> float:
        """The median of the own speed [m/s]."""
        return float(np.median(np.concatenate([part.speed for part in self.segments])))

    @property
    def hours(self) -> float:
        return self.samples * self.dt / 3600.0


def checked(raw: Raw, where: str) -> Recording:
    """Return the recording on a uniform grid. Repairs are counted; what is not one of them is refused.

    Repeated times are dropped (up to 1 %), missing or impossible readings are marked, and samples that jitter are interpolated.
    Lost samples count as readings that did not arrive. A hole of more than 0.5 s ends a segment; segments below 5 s are dropped.

    Raises
    ------
    InputError
        Too few samples, times that go back or do not end, own speeds that are missing, or units that cannot be meant. It names `where`,
        the recording and the column.
    """
    name = f"{where}: {raw.name}" if raw.name else where
    repairs: dict[str, int] = {}
    t = raw.t
    if len(t) < FEWEST:
        raise InputError(f"{name}: samples", len(t), f"at least {FEWEST}")
    if len(t) > MOST:
        raise InputError(f"{name}: samples", len(t), f"at most {MOST}")
    if not np.isfinite(t).all():
        raise InputError(f"{name}: time", f"{int((~np.isfinite(t)).sum())} that are no number", "a time [s] in every sample")
    step = np.diff(t)
    if (step < 0.0).any():
        at = int(np.argmax(step < 0.0))
        raise InputError(f"{name}: time", float(t[at + 1]), f"a time not before {float(t[at])}")
    again = np.concatenate([[False], step == 0.0])
    if again.any():
        if again.sum() > max(1, REPEATED * len(t)):
            raise InputError(f"{name}: time", f"{int(again.sum())} repeated", f"at most {REPEATED:.0%} of the {len(t)} samples")
        repairs["repeated times dropped"] = int(again.sum())
        raw = Raw(raw.name, *(column[~again] for column in raw[1:]))
        t, step = raw.t, np.diff(raw.t)
    usual = round(float(np.median(step)), 6)
    if not RATE[0] <= usual <= RATE[1]:
        raise InputError(f"{name}: time between samples", usual, f"{RATE[0]:g} to {RATE[1]:g} s; is the unit a second?")
    raw = _possible(raw, name, repairs)
    longest = max(BREAK * usual, SILENCE + 1e-6)
    holes = np.flatnonzero(step > longest) + 1
    if len(holes):
        repairs["holes in time"] = len(holes)
    parts = np.split(np.arange(len(t)), holes)
    dt = _distance(t, parts, usual)
    segments = []
    for part in parts:
        if (part[-1] - part[0]) * dt < LEAST:
            repairs["samples of short segments dropped"] = repairs.get("samples of short segments dropped", 0) + len(part)
            continue
        segments.append(_uniform(raw, part, dt, repairs))
    if not segments:
        raise InputError(f"{name}: time", f"{len(holes)} holes", f"a segment of {LEAST:g} s without a hole above {longest:g} s")
    out = Recording(raw.name, float(f"{dt:.4g}"), tuple(segments), repairs)  # one rate is one number, however times are rounded
    if (absent := out.samples - sum(int(part.seen.sum()) for part in segments)) > MISSING * out.samples:
        raise InputError(f"{name}: gap", f"{absent} of {out.samples} missing or lost", f"at most {MISSING:.0%}")
    _meant(out, name)
    return out


def _possible(raw: Raw, name: str, repairs: dict[str, int]) -> Raw:
    """Return the columns with impossible readings marked as missing; refuse own speeds that are missing, and impossible units."""
    speed = raw.speed
    if not np.isfinite(speed).all():
        raise InputError(f"{name}: own speed", f"{int((~np.isfinite(speed)).sum())} that are no number", "a speed [m/s] in every sample")
    if (speed < -1.0).any() or (speed > FASTEST).any():
        worst = float(speed[np.argmax(np.abs(speed))])
        raise InputError(f"{name}: own speed", worst, f"0 to {FASTEST:g} m/s; is the unit m/s?")
    gap, relative = raw.gap.copy(), raw.relative_speed.copy()
    known = np.isfinite(gap)
    if (gap[known] > FARTHEST).any():
        raise InputError(f"{name}: gap", float(gap[known].max()), f"at most {FARTHEST:g} m; is the unit a metre?")
    if (np.abs(relative[np.isfinite(relative)]) > FASTEST).any():
        raise InputError(f"{name}: relative speed", float(np.nanmax(np.abs(relative))), f"at most {FASTEST:g} m/s; is the unit m/s?")
    missing = ~known | ~np.isfinite(relative)
    if missing.any():
        repairs["readings that are no number"] = int(missing.sum())
    no_car = ~missing & (gap <= 0.0)
    if no_car.any():
        repairs["gaps not above 0"] = int(no_car.sum())
    lost = missing | no_car
    if lost.sum() > MISSING * len(gap):
        raise InputError(f"{name}: gap", f"{int(lost.sum())} of {len(gap)} missing", f"at most {MISSING:.0%} missing or not above 0")
    gap[lost] = relative[lost] = np.nan
    return Raw(raw.name, raw.t, gap, relative, np.maximum(speed, 0.0))


def _distance(t: Array, parts: Sequence[Array], usual: float) -> float:
    """Return the distance of samples [s]: the usual one or the mean, whichever the times are nearer to multiples of."""
    steps: Array = np.concatenate([np.diff(t[part]) for part in parts])
    mean = round(float(steps[steps <= BREAK * usual].mean()), 9)

    def off(dt: float) -> float:
        return float(np.mean(np.concatenate([np.abs((t[part] - t[part[0]] + 0.5 * dt) % dt - 0.5 * dt) for part in parts])))

    return min(usual, mean, key=off)


def _uniform(raw: Raw, part: Array, dt: float, repairs: dict[str, int]) -> Segment:
    """Return the samples of a segment on a grid of about dt [s]; where samples are lost, the own speed is interpolated."""
    t = raw.t[part]
    count = round(float((t[-1] - t[0]) / dt)) + 1
    grid, dt = np.asarray(np.linspace(t[0], t[-1], count)), float((t[-1] - t[0]) / (count - 1))  # a rounded dt would add up
    columns: list[Array] = [raw.gap[part], raw.relative_speed[part], raw.speed[part]]
    places = np.rint((t - t[0]) / dt).astype(np.int64)
    if np.abs(t - t[0] - dt * places).max() > 1e-6 + 0.02 * dt:
        repairs["samples interpolated to even times"] = repairs.get("samples interpolated to even times", 0) + count
    if count != len(t) or np.abs(t - grid).max() > 1e-6 + 0.02 * dt:
        columns = [np.interp(grid, t, column) for column in columns]  # a missing neighbour leaves NaN
    before = np.clip(np.searchsorted(t, grid, "right") - 1, 0, len(t) - 2)
    lost = (t[before + 1] - t[before] > BREAK * dt) & (np.minimum(grid - t[before], t[before + 1] - grid) > 0.5 * dt)
    if lost.any():
        repairs["lost samples"] = repairs.get("lost samples", 0) + int(lost.sum())
        columns[:2] = (np.where(lost, np.nan, column) for column in columns[:2])
    gap, relative, speed = columns
    seen = np.isfinite(gap) & np.isfinite(relative)
    return Segment(float(t[0]), _kept(gap, seen), _kept(relative, seen), speed, seen)


def _kept(values: Array, seen: Array) -> Array:
    """Return values (K,) with the last one seen in place of what is missing; before the first, that."""
    at = np.maximum.accumulate(np.where(seen, np.arange(len(values)), -1))
    return np.asarray(values[np.where(at < 0, int(np.argmax(seen)) if seen.any() else 0, at)]) if seen.any() else np.zeros(len(values))


def _meant(recording: Recording, name: str) -> None:
    """Refuse a relative speed that is not the gap's rate: another sign or unit."""
    rate, told = [], []
    for part in recording.segments:
        wide = max(1, round(1.0 / recording.dt))  # over a second: noise of a difference hides the rate
        if len(part.gap) <= wide:
            continue
        both = part.seen[wide:] & part.seen[:-wide]
        total = np.concatenate([[0.0], np.cumsum(0.5 * (part.relative_speed[1:] + part.relative_speed[:-1]) * recording.dt)])
        over = wide * recording.dt
        rate.append((part.gap[wide:] - part.gap[:-wide])[both] / over)
        told.append((total[wide:] - total[:-wide])[both] / over)
    x, y = np.concatenate([np.zeros(0), *told]), np.concatenate([np.zeros(0), *rate])
    if len(x) < 20:
        return
    off = float(np.median(x - y))
    if abs(off) > OFF:
        wanted = "the gap's rate; are all speeds in the unit that is named?"
        raise InputError(f"{name}: relative speed", f"{off:.1f} m/s off the gap's rate", wanted)
    if x.std() < 0.05:  # nobody moves against the other
        return
    slope = float(np.dot(x, y) / np.dot(x, x))
    if slope < -0.5:
        raise InputError(f"{name}: relative speed", f"{slope:.2f} times the gap's rate", "one that is positive where the gap grows")
    if not 0.4 <= slope <= 2.5 and np.corrcoef(x, y)[0, 1] > 0.8:
        raise InputError(f"{name}: relative speed", f"the gap's rate over {slope:.2f}", "the gap's rate; are the units m and m/s?")
