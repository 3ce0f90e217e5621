"""The threshold at which a defence raises a false alarm once in a wanted time, on clean runs with manoeuvres.

Alarms feed back into the filter (a gate) and into the detector (a reset), so the loop itself is played. One run without alarms gives the
first guess: how often its score climbs over each level. A few closed-loop runs on the same random numbers then correct it, by secants on
the logarithm of the mean time, which is close to linear in the threshold. `docs/detectors.md` tells more.

Several agents raise one alarm: that of the group, on as long as any of them alarms. Its mean time is in hours of the system, not of agents;
N agents that alarm independently have N times as long each. A step of a network without a step of its own counts as `dt`, 1 s.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from tailgate import draws
from tailgate.agents.scripted import NoAttack
from tailgate.core import Array, Model, no_command
from tailgate.errors import InputError, NotApplicable
from tailgate.estimators.watched import watched
from tailgate.fused import Constants, fuse
from tailgate.loop import Loop
from tailgate.registry import Spec, entry_for, text_of
from tailgate.scenario import Scenario, load_scenario
from tailgate.trace import MEMORY, episodes_at_once, rollout

MIXTURE = ("braking-v0", "stop-and-go-v0", "ornstein-uhlenbeck-v0")  # equal shares of the running time
SILENT = 1e12  # a threshold that nothing reaches
TOLERANCE = 0.02  # of the mean time, on the seeds of the calibration
RUNS = 8  # closed-loop runs at most
NARROWING = 24  # more of them, to find where a score jumps
LEAST = 20  # onsets in a run that the limit of steps has cut
DIGITS = 4  # of a threshold
MOST_DIGITS = 7  # of one where the score is crowded, as near 1
COARSE = 0.1  # what the last digit may change of the log mean time
RECORDED = 512  # episodes of the fused engine at a time
NOTHING = NoAttack()
HOUR = 3600.0

Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


class Count(NamedTuple):
    """What clean runs gave: false-alarm onsets, running time and steps, and the onsets' variance over their mean, by episode."""

    onsets: int
    seconds: float
    steps: int
    dispersion: float

    @property
    def hours(self) -> float | None:
        """Mean time between onsets [h]; None without any."""
        return self.seconds / HOUR / self.onsets if self.onsets else None

    def interval(self, level: float = 0.95) -> tuple[float, float | None]:
        """Exact Poisson interval of the mean time [h]; its upper end is None without any onset.

        Onsets that come in clusters tell less than their number says: it and the time are divided by the dispersion where that is above 1.
        """
        clusters = max(self.dispersion, 1.0)
        n, time, tail = self.onsets / clusters, self.seconds / HOUR / clusters, (1.0 - level) / 2.0
        low = time / float(0.5 * stats.chi2.ppf(1.0 - tail, 2.0 * n + 2.0))
        return low, time / float(0.5 * stats.chi2.ppf(tail, 2.0 * n)) if n else None

    def may_be(self, hours: float) -> bool:
        """Whether the interval holds this mean time."""
        return (ends := self.interval())[0] <= hours and (ends[1] is None or hours <= ends[1])

    def as_data(self) -> dict[str, Any]:
        low, high = self.interval()
        return {
            "hours": self.hours, "low": low, "high": high, "onsets": self.onsets, "running_hours": self.seconds / HOUR, "steps": self.steps,
            "dispersion": self.dispersion,
        }  # fmt: skip


@dataclass(frozen=True)
class Calibration:
    """A threshold, what was wanted of it, and what it gave: on the seeds that it was fitted to, and on fresh ones if asked for."""

    defence: str
    field: str
    threshold: float
    wanted_hours: float
    settled: bool  # within the tolerance; else the best of the runs, or the least threshold among them that alarms more rarely
    measured: Count
    fresh: Count | None
    seeds: dict[str, tuple[int, int]]  # of each scenario: first and last
    played: int  # steps in all runs together

    @property
    def rarer(self) -> bool:
        """Whether the alarm is surely rarer than wanted: the score jumps, and below the threshold it is too frequent."""
        return not self.settled and self.measured.interval()[0] > self.wanted_hours

    def as_data(self) -> dict[str, Any]:
        fresh = None if self.fresh is None else self.fresh.as_data() | {"purpose": "report"}
        return {
            "defence": self.defence, "field": self.field, "threshold": self.threshold,
            "wanted_hours": self.wanted_hours, "settled": self.settled, "rarer": self.rarer,
            "measured": self.measured.as_data() | {"purpose": "calibrate"}, "fresh": fresh,
            "seeds": {name: list(ends) for name, ends in self.seeds.items()}, "steps_played": self.played,
        }  # fmt: skip


class Crossings:
    """How often a score climbed over each level: a climb from a to b passes every level in [a, b)."""

    def __init__(self, keep: int) -> None:
        self.keep = keep
        self.low, self.high = np.empty(0), np.empty(0)
        self.least, self.most = math.inf, -math.inf  # scores that were seen

    def add(self, low: Array, high: Array) -> None:
        """The climbs of some runs. Only the `keep` highest are kept: levels below them are not asked for."""
        low, high = np.concatenate([self.low, low]), np.concatenate([self.high, high])
        if len(high) > self.keep:
            top = np.argpartition(high, len(high) - self.keep)[-self.keep :]
            low, high = low[top], high[top]
        self.low, self.high = low, high

    def level(self, wanted: float) -> float | None:
        """The highest level that was passed at least `wanted` times; None where there is none."""
        ends = np.unique(self.high)[::-1]
        above = len(self.high) - np.searchsorted(np.sort(self.high), ends)
        from_above = len(self.low) - np.searchsorted(np.sort(self.low), ends)
        enough = np.flatnonzero(above - from_above >= wanted)  # just below each end
        if not len(enough):
            return None
        i = enough[0]
        return float(0.5 * (ends[i] + ends[i + 1]) if i + 1 < len(ends) else ends[i])


def most_at_once(model: Model, most: int) -> int:
    """How many episodes, at most `most`, have room in memory side by side: a filter works on some ten covariances of each agent."""
    return int(max(1, min(most, MEMORY // (80 * model.agents * model.states * model.states))))


def play_clean(loop: Loop, keys: draws.Keys) -> Iterator[tuple[Array, Array, Array]]:
    """(alarm (B, agents), score (B, agents), live (B,)) of each step without an attack; an episode ends with a collision.

    A loop that has lanes is played by the fused engine, whose record is to the same bits.
    """
    if _fused(loop):
        trace = rollout(loop, NOTHING, keys)
        yield from zip(trace.alarm, trace.score, trace.live, strict=True)
        return
    state = loop.start(keys)
    nothing = no_command(len(keys.key), loop.model.agents, len(loop.model.wires))
    for _ in range(loop.horizon):
        live = ~state.ended
        if not live.any():
            return
        state, frame = loop.advance(state, nothing)
        yield frame.estimate.alarm, frame.estimate.score, live


def _fused(loop: Loop) -> bool:
    return isinstance(fuse(loop.bare, NOTHING), Constants)


@dataclass(frozen=True)
class Bench:
    """A defence on clean runs of some scenarios."""

    defence: Any
    uses: tuple[str, ...]
    text: str
    places: tuple[Scenario, ...]
    batch: int
    progress: Progress

    @classmethod
    def of(cls, defence: Any, scenarios: Sequence[str], batch: int, progress: Progress | None) -> Bench:
        if isinstance(defence, str):
            spec = Spec("defence", defence)
            made, uses, text = spec.make(), spec.entry.uses, defence
        else:
            entry = entry_for("defence", type(defence))
            made, uses, text = defence, entry.uses, text_of(entry, defence)
        if not scenarios:
            raise InputError("scenario", list(scenarios), "at least one")
        places = tuple(load_scenario(name).with_threat(knowledge="black") for name in scenarios)  # nobody attacks
        if len({place.name for place in places}) < len(places):
            raise InputError("scenario", list(scenarios), "each scenario once")
        bench = cls(made, uses, text, places, batch, progress or (lambda *_: None))
        for place in places:
            place.loop(bench.at(SILENT), uses)  # what does not fit together fails here
        return bench

    def at(self, threshold: float) -> Any:
        """The defence at a threshold: its own, its detector's (`threshold_field`), or of a watch on its score where it has none."""
        return self._turned(threshold)[0]

    @cached_property
    def field(self) -> str:
        """The parameter that is the threshold, as the command line names it; empty where it is that of a watch on the score."""
        return self._turned(SILENT)[1]

    def _turned(self, threshold: float) -> tuple[Any, str]:
        own = getattr(self.defence, "threshold_field", None)
        if own is not None and dataclasses.is_dataclass(self.defence):
            return dataclasses.replace(self.defence, **{own: threshold}), str(own)  # type: ignore[type-var]
        if hasattr(self.defence, "with_threshold"):
            with contextlib.suppress(NotApplicable):
                inner = getattr(self.defence.parts()[1], "threshold_field", "") if hasattr(self.defence, "parts") else ""
                return self.defence.with_threshold(threshold), f"detector.{inner}" if inner else "threshold"
        return watched(self.defence, threshold), ""

    def seeds(self, hours: float) -> list[range]:
        """Seeds of each scenario, so that all together last `hours` (a little more, as episodes are whole) in equal shares.

        No two scenarios share a seed: a linear filter that knows its input sees the noise alone, not the manoeuvre, and would see it twice.
        """
        out, first = [], 0
        for place in self.places:
            count = max(1, math.ceil(hours * HOUR / len(self.places) / (place.horizon * place.brief().model.dt) - 1e-9))
            out.append(range(first, first + count))
            first += count
        return out

    def hours(self, steps: int) -> float:
        """Running time of a number of steps."""
        return len(self.places) * steps / sum(1.0 / place.brief().model.dt for place in self.places) / HOUR

    def run(self, threshold: float, hours: float, purpose: str, label: str, crossings: Crossings | None = None) -> Count:
        """Clean runs of `hours` in all; `crossings` collects how the score climbs."""
        guard = self.at(threshold)
        loops = {place.name: place.loop(guard, self.uses) for place in self.places}
        chunks = []
        for place, seeds in zip(self.places, self.seeds(hours), strict=True):
            loop = loops[place.name]
            size = most_at_once(loop.model, self.batch)
            size = episodes_at_once(loop.model, loop.horizon, min(size, RECORDED)) if _fused(loop) else size
            chunks += [(place, seeds[first : first + size]) for first in range(0, len(seeds), size)]
        counts: list[Array] = []
        steps = dict.fromkeys((place.name for place in self.places), 0)
        for done, (place, seeds) in enumerate(chunks, start=1):
            onsets, played = count_onsets(loops[place.name], draws.keys(purpose, seeds), crossings)
            counts.append(onsets)
            steps[place.name] += played
            self.progress(label, done, len(chunks), f"threshold {threshold:.{MOST_DIGITS}g}" if threshold < SILENT else "")
        each = np.concatenate(counts)
        mean = float(each.mean())
        seconds = math.fsum(steps[place.name] * place.brief().model.dt for place in self.places)
        return Count(int(each.sum()), seconds, sum(steps.values()), float(each.var() / mean) if mean > 0.0 else 1.0)


def count_onsets(loop: Loop, keys: draws.Keys, crossings: Crossings | None = None) -> tuple[Array, int]:
    """(B,) alarm onsets of clean episodes, as the metric of that name counts them, and the steps played. Of several agents any alarms."""
    batch, steps = len(keys.key), 0
    alarmed, onsets, last = np.zeros(batch, bool), np.zeros(batch, np.int64), np.full(batch, -np.inf)
    low: list[Array] = []
    high: list[Array] = []
    for alarms, scores, live in play_clean(loop, keys):
        alarm = alarms.any(axis=1) & live
        onsets += alarm & ~alarmed
        alarmed = alarm
        steps += int(np.count_nonzero(live))
        if crossings is not None:
            score = scores.max(axis=1)
            crossings.least = min(crossings.least, score[live].min(initial=math.inf))
            crossings.most = max(crossings.most, score[live].max(initial=-math.inf))
            climbed = live & (score > last)
            low.append(last[climbed])
            high.append(score[climbed])
            last = score
    if crossings is not None:
        crossings.add(np.concatenate(low), np.concatenate(high))
    return onsets, steps


def calibrate(
    defence: Any,
    hours: float,
    *,
    scenarios: Sequence[str] = MIXTURE,
    onsets: int = 400,
    most_steps: int = 20_000_000,
    batch: int = 4096,
    check: bool = False,
    progress: Progress | None = None,
) -> Calibration:
    """The threshold of a defence (text or object) for a mean time of `hours` between the onsets of its false alarms.

    A run lasts `onsets` times that, on seeds of the purpose `calibrate`, or `most_steps` steps if that is less: the interval then says
    how little it knows. With `check` it is measured again on fresh seeds of the purpose `report`.
    Raises InputError for bad values, and where the time cannot be had. A defence without a threshold is watched (tailgate.watch).
    """
    if not (isinstance(hours, (int, float)) and math.isfinite(hours) and hours > 0.0):
        raise InputError("hours", hours, "a finite number above 0")
    for name, value in (("onsets", onsets), ("steps", most_steps), ("batch", batch)):
        if value < 1:
            raise InputError(name, value, "a whole number not below 1")
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
    """To the digits that are reported: what was measured is what stands there."""
    return float(f"{threshold:.{digits}g}")


def _digit(threshold: float, digits: int) -> float:
    """The last digit's worth."""
    return 10.0 ** (math.floor(math.log10(abs(threshold))) + 1 - digits) if threshold else 0.0


class Search:
    """Looks for the threshold that gives a mean time of `wanted` hours in runs of `running` hours."""

    def __init__(self, bench: Bench, wanted: float, running: float) -> None:
        self.bench, self.wanted, self.running = bench, wanted, running
        self.played, self.digits = 0, DIGITS
        self.settled = False  # found within the tolerance
        self.tried: dict[float, tuple[float, Count]] = {}  # log of the mean time over the wanted one
        self.low, self.high = -math.inf, math.inf  # with the one the alarm is too frequent, with the other too rare

    def solve(self) -> tuple[float, Count]:
        """The threshold, rounded, and what it gave."""
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
        """Log of the mean time over the wanted one, in a closed-loop run."""
        count = self._run(level, f"closed loop, run {len(self.tried) + 1}")
        error = math.log(count.seconds / HOUR / max(count.onsets, 0.5) / self.wanted)
        self.tried[level] = error, count
        self.low, self.high = (max(self.low, level), self.high) if error < 0.0 else (self.low, min(self.high, level))
        self.settled = abs(error) <= max(TOLERANCE, 0.6 * self.wanted / self.running)  # of few onsets, one
        return error

    def _between(self) -> float:
        return 0.5 * (self.low + self.high) if math.isfinite(self.high) else self.low + (abs(self.low) or 1.0)

    def _best(self) -> tuple[float, Count]:
        """That of the nearest mean time; where its interval does not hold the wanted one, as the score jumps, the least that is rarer."""
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
        """From a run without alarms: the level, and the slope of the log mean time there."""
        crossings = Crossings(keep=max(20_000, round(50 * self.running / self.wanted)))
        wanted = self._run(SILENT, "run without alarms", crossings).seconds / HOUR / self.wanted
        at, above, below = (crossings.level(share * wanted) for share in (1.0, 0.5, 2.0))
        if crossings.least == crossings.most:
            raise InputError("hours", self.wanted, f"a mean time that {self.bench.text} can have: its score does not move")
        if at is None or above is None:
            raise InputError("hours", self.wanted, f"a mean time that {self.bench.text} can have: its score does not climb that often")
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
