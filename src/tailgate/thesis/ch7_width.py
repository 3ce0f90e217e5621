"""How wide the monitor's interval is, against what it hears and what it mistakes (thesis 7.3.2)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tailgate.core import Array
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.evaluation.stats import Interval

from .ch7_loop import SCENARIO
from .ch7_trust import interval
from .claims import Claim, verdict
from .runs import median, play, share

EXACT = math.sqrt(3.0) * (1.0 + 1e-6)  # standard deviations in the bound of uniform noise
RAMP = "fdi_ramp:start_step=40,rate=-0.018"
DECLARED = (0.5, 1.0, 2.0, 4.0)  # the interval over the sensor's accuracy
SENSORS = (0.5, 1.0, 2.0)  # the accuracy over the scenario's, and the interval with it
RARE = 0.05  # share of runs with a false alarm that is none to speak of


class Heard(NamedTuple):
    """The alarms of a monitor, without an attack and under one."""

    false: Interval  # runs with an alarm without an attack
    after: float  # median time from the first attacked step to an alarm [s]; inf for never


def heard(scenario: Scenario, factor: float, seeds: int) -> Heard:
    """Play a monitor whose interval is `factor` times the accuracy of the scenario's sensor."""
    quiet, ramp = (play(scenario, f"safe_state:sigmas={factor * EXACT!r}", attack, seeds) for attack in ("none", RAMP))
    begin = (ramp.kind != 0).argmax(axis=0)
    alarm = ramp.alarm.any(axis=2) & ramp.live & (np.arange(len(ramp.kind))[:, None] >= begin)
    took: Array = np.where(alarm.any(axis=0), (alarm.argmax(axis=0) - begin) * ramp.dt, np.inf)
    return Heard(share((quiet.alarm.any(axis=2) & quiet.live).any(axis=0)), median(took))


def parts(seeds: int) -> Iterator[Claim]:
    """Return the claim on the size of the interval."""
    scenario, count = load_scenario(SCENARIO), max(10, seeds // 8)
    declared = {factor: heard(scenario, factor, count) for factor in DECLARED}
    sensors = {factor: declared[1.0] if factor == 1.0 else heard(_sensor(scenario, factor), 1.0, count) for factor in SENSORS}
    yield Claim(
        "7.3.2-size", "The smaller the interval, the higher the confidence in the sensor's measurements", "smaller: higher",
        {"interval over the same lidar's accuracy": _words(declared), "lidar's accuracy, and the interval with it": _words(sensors)},
        verdict(_better(declared) and _better(sensors), not _better(declared) and not _better(sensors)),
        f"{count} runs each, a distance that grows by 0.36 m/s: true where the sensor is the more accurate one; an interval that is only "
        "declared smaller hears an attack sooner until it is below the accuracy, where it takes noise for one",
    )  # fmt: skip


def _sensor(scenario: Scenario, factor: float) -> Scenario:
    """Return the same scenario with another accuracy."""
    noise = tuple(factor * factor * v for v in scenario.sensor.noise_var)
    return dataclasses.replace(scenario, sensor=dataclasses.replace(scenario.sensor, noise_var=noise))


def _better(found: dict[float, Heard]) -> bool:
    """Return whether smaller hears no later, and never by mistake."""
    ways = [found[factor] for factor in sorted(found)]
    return all(a.after <= b.after for a, b in pairwise(ways)) and all(h.false.value <= RARE for h in ways)


def _words(found: dict[float, Heard]) -> dict[str, object]:
    return {
        f"x {factor:g}": {"runs with a false alarm": interval(h.false), "heard after [s]": h.after if np.isfinite(h.after) else "never"}
        for factor, h in found.items()
    }
