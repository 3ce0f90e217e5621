"""Calibration of a defence's threshold to a mean time between false alarms, on attack-free runs with manoeuvres.

Alarms feed back into the filter (a gate) and into the detector (a reset), so the closed loop is played.
One run without alarms gives the first guess: how often its score rises above each level.
A few closed-loop runs on the same random numbers correct the guess by secants on the logarithm of the mean time.
That logarithm is close to linear in the threshold. See `docs/detectors.md`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.core import Defence
from tailgate.evaluation.attack_free import HOUR, MOST_DIGITS, SILENT, Bench, Count, Crossings, Progress

MIXTURE = ("braking-v0", "stop-and-go-v0", "ornstein-uhlenbeck-v0")  # equal shares of the running time
TOLERANCE = 0.02  # of the mean time, on the seeds of the calibration
RUNS = 8  # most closed-loop runs
NARROWING = 24  # additional runs to find a jump of the score
LEAST = 20  # onsets in a run that the limit of steps shortens
DIGITS = 4  # of a threshold; up to MOST_DIGITS if scores are dense, as near 1
COARSE = 0.1  # largest effect of the last digit on the log mean time


@dataclass(frozen=True)
class Calibration:
    """A threshold with the wanted and the measured mean times, on the seeds of the fit and, if requested, on fresh seeds."""

    defence: str
    field: str
    threshold: float
    wanted_hours: float
    settled: bool  # within the tolerance; else the best run, or the least threshold with rarer alarms
    measured: Count
    fresh: Count | None
    seeds: dict[str, tuple[int, int]]  # of each scenario: first and last
    played: int  # steps of all runs

    @property
    def rarer(self) -> bool:
        """True if the alarm is surely rarer than wanted: the score jumps, and a lower threshold alarms too often."""
        return not self.settled and self.measured.interval()[0] > self.wanted_hours

    def as_data(self) -> dict[str, Any]:
        fresh = None if self.fresh is None else self.fresh.as_data() | {"purpose": "report"}
        return {
            "defence": self.defence, "field": self.field, "threshold": self.threshold,
            "wanted_hours": self.wanted_hours, "settled": self.settled, "rarer": self.rarer,
            "measured": self.measured.as_data() | {"purpose": "calibrate"}, "fresh": fresh,
            "seeds": {name: list(ends) for name, ends in self.seeds.items()}, "steps_played": self.played,
        }  # fmt: skip


def calibrate(
    defence: str | Defence,
    hours: float,
    *,
    scenarios: Sequence[str] = MIXTURE,
    onsets: int = 400,
    most_steps: int = 20_000_000,
    batch: int = 4096,
    check: bool = False,
    progress: Progress | None = None,
) -> Calibration:
    """Find a defence's threshold for a mean time of `hours` between the onsets of its false alarms.

    Parameters
    ----------
    defence : text or object; a defence without a threshold gets one on its score (core/score_threshold.py)
    hours : wanted mean time [h]
    scenarios : names, with equal shares of the running time
    onsets : length of a run, in multiples of `hours`
    most_steps : a shorter limit of a run; the interval then shows the lost precision
    batch : episodes played together
    check : measure the threshold again on fresh seeds of the purpose `report`

    Raises
    ------
    InputError
        A value is invalid, or no threshold gives this mean time.
    """
    if not (isinstance(hours, (int, float)) and math.isfinite(hours) and hours > 0.0):
        raise InputError("hours", hours, "a finite number above 0")
    for name, value in (("onsets", onsets), ("steps", most_steps), ("batch", batch)):
        sizes.check(name, value)
    bench = Bench.of(defence, scenarios, batch, progress)
    longest = bench.hours(most_steps)
    if longest < min(onsets, LEAST) * hours:
        most = f"at most {longest / LEAST:.3g} with {most_steps} steps, which leaves {LEAST} alarms; allow more steps"
        raise InputError("hours", hours, most)
    running = min(onsets * hours, longest)
    search = Search(bench, hours, running)
    threshold, measured = search.solve()
    fresh = bench.run(threshold, running, "report", f"{bench.text}: fresh runs for {hours:g} h") if check else None
    seeds = {place.name: (part[0], part[-1]) for place, part in zip(bench.places, bench.seeds(running), strict=True)}
    played = search.played + (fresh.steps if fresh is not None else 0)
    return Calibration(bench.text, bench.field, threshold, float(hours), search.settled, measured, fresh, seeds, played)


def rounded(threshold: float, digits: int) -> float:
    """Round to the digits that are reported, so that the reported threshold is the measured one."""
    return float(f"{threshold:.{digits}g}")


def _digit(threshold: float, digits: int) -> float:
    """Return the value of one unit in the last digit."""
    return 10.0 ** (math.floor(math.log10(abs(threshold))) + 1 - digits) if threshold else 0.0


class Search:
    """A search for the threshold that gives a mean time of `wanted` hours in runs of `running` hours."""

    def __init__(self, bench: Bench, wanted: float, running: float) -> None:
        self.bench, self.wanted, self.running = bench, wanted, running
        self.played, self.digits = 0, DIGITS
        self.settled = False  # found within the tolerance
        self.tried: dict[float, tuple[float, Count]] = {}  # log of the mean time over the wanted one
        self.low, self.high = -math.inf, math.inf  # alarms are too frequent at the first, too rare at the second

    def solve(self) -> tuple[float, Count]:
        """Return the rounded threshold and its measured count."""
        level, slope = self._guess()
        for _ in range(RUNS):
            level = rounded(level, self.digits)
            if level in self.tried:
                break
            before = min(self.tried, key=lambda held: abs(held - level)) if self.tried else None
            error = self._try(level)
            if self.settled:
                return level, self.tried[level][1]
            if before is not None and (secant := (error - self.tried[before][0]) / (level - before)) > 0.0:
                slope = secant
            level -= error / slope
            if not self.low < level < self.high:
                level = self._between()
        return self._best()

    def _try(self, level: float) -> float:
        """Return the log of the mean time over the wanted one, in a closed-loop run."""
        count = self._run(level, f"closed loop, run {len(self.tried) + 1}")
        error = math.log(count.seconds / HOUR / max(count.onsets, 0.5) / self.wanted)
        self.tried[level] = error, count
        self.low, self.high = (max(self.low, level), self.high) if error < 0.0 else (self.low, min(self.high, level))
        self.settled = abs(error) <= max(TOLERANCE, 0.6 * self.wanted / self.running)  # of few onsets, one
        return error

    def _between(self) -> float:
        return 0.5 * (self.low + self.high) if math.isfinite(self.high) else self.low + (abs(self.low) or 1.0)

    def _best(self) -> tuple[float, Count]:
        """Return the threshold with the nearest mean time.

        If its interval misses the wanted time, because the score jumps, return the least threshold with rarer alarms.
        """
        while True:
            best = min(self.tried, key=lambda held: abs(self.tried[held][0]))
            if self.tried[best][1].may_be(self.wanted):
                return best, self.tried[best][1]
            if (level := rounded(self._between(), self.digits)) in self.tried and self.digits < MOST_DIGITS:
                self.digits, level = MOST_DIGITS, rounded(self._between(), MOST_DIGITS)
            if level in self.tried or len(self.tried) >= RUNS + NARROWING:
                break
            self._try(level)
        return (self.high, self.tried[self.high][1]) if math.isfinite(self.high) else (best, self.tried[best][1])

    def _guess(self) -> tuple[float, float]:
        """Return a first threshold and the slope of the log mean time, from a run without alarms."""
        crossings = Crossings(keep=max(20_000, round(50 * self.running / self.wanted)))
        wanted = self._run(SILENT, "run without alarms", crossings).seconds / HOUR / self.wanted
        at, above, below = (crossings.level(share * wanted) for share in (1.0, 0.5, 2.0))
        if crossings.least == crossings.most:
            raise InputError("hours", self.wanted, f"a mean time that {self.bench.text} can have: its score does not move")
        if at is None or above is None:
            raise InputError("hours", self.wanted, f"a mean time that {self.bench.text} can have: its score does not rise that often")
        self.low = crossings.least
        spread, ratio = (above - at, 2.0) if below is None else (above - below, 4.0)
        slope = math.log(ratio) / spread if spread > 0.0 else 0.5
        while self.digits < MOST_DIGITS and _digit(at, self.digits) * slope > COARSE:
            self.digits += 1
        return at, slope

    def _run(self, level: float, label: str, crossings: Crossings | None = None) -> Count:
        count = self.bench.run(level, self.running, "calibrate", f"{self.bench.text}, {self.wanted:.3g} h: {label}", crossings)
        self.played += count.steps
        return count
