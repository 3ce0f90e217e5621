"""Attack-free runs and their false alarms, on which thresholds are calibrated and measured.

Several agents raise one alarm, which is on as long as any of them alarms. Its mean time is in hours of the system.
N agents that alarm independently therefore have N times as long each.
A step of a network without a sampling time counts as `dt`, 1 s.
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

from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Defence, Model, draws
from tailgate.core.loop import Loop
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.estimators.watched import watched
from tailgate.evaluation.cells import component
from tailgate.evaluation.stats import mean_time
from tailgate.play.trace import MEMORY, episodes_at_once, rollout

SILENT = 1e12  # a threshold that no score reaches
MOST_DIGITS = 7  # of a threshold
RECORDED = 512  # episodes that are recorded together
NOTHING = NoAttack()
HOUR = 3600.0  # [s]
HOURS = 0.1  # mean time between alarm onsets [h]: the shortest that thresholds are calibrated to

Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


class Count(NamedTuple):
    """The result of attack-free runs: false-alarm onsets, time [s], steps, and the variance of onsets per episode over their mean."""

    onsets: int
    seconds: float
    steps: int
    dispersion: float

    @classmethod
    def of(cls, each: Array, seconds: float, steps: int) -> Count:
        """Summarise the onsets of each episode, each (B,)."""
        mean = float(each.mean())
        return cls(int(each.sum()), seconds, steps, float(each.var() / mean) if mean > 0.0 else 1.0)

    @property
    def hours(self) -> float | None:
        """Mean time between onsets [h]; None without any."""
        return self.seconds / HOUR / self.onsets if self.onsets else None

    def interval(self, level: float = 0.95) -> tuple[float, float | None]:
        """Return limits of the mean time [h] for clustered onsets; the upper limit is None without any onset."""
        return mean_time(self.onsets, self.seconds / HOUR, self.dispersion, level)

    def may_be(self, hours: float) -> bool:
        """Return True if the interval contains this mean time."""
        return (ends := self.interval())[0] <= hours and (ends[1] is None or hours <= ends[1])

    def as_data(self) -> dict[str, Any]:
        low, high = self.interval()
        return {
            "hours": self.hours, "low": low, "high": high, "onsets": self.onsets, "running_hours": self.seconds / HOUR, "steps": self.steps,
            "dispersion": self.dispersion,
        }  # fmt: skip


class Crossings:
    """Counts how often a score rose above each level: a rise from a to b passes every level in [a, b)."""

    def __init__(self, keep: int) -> None:
        self.keep = keep
        self.low, self.high = np.empty(0), np.empty(0)
        self.least, self.most = math.inf, -math.inf  # scores that occurred

    def add(self, low: Array, high: Array) -> None:
        """Add the rises of some runs; keep only the `keep` highest, because lower levels are not needed."""
        low, high = np.concatenate([self.low, low]), np.concatenate([self.high, high])
        if len(high) > self.keep:
            top = np.argpartition(high, len(high) - self.keep)[-self.keep :]
            low, high = low[top], high[top]
        self.low, self.high = low, high

    def level(self, wanted: float) -> float | None:
        """Return the highest level that was passed at least `wanted` times, or None."""
        ends = np.unique(self.high)[::-1]
        above = len(self.high) - np.searchsorted(np.sort(self.high), ends)
        from_above = len(self.low) - np.searchsorted(np.sort(self.low), ends)
        enough = np.flatnonzero(above - from_above >= wanted)  # just below each end
        if not len(enough):
            return None
        i = enough[0]
        return float(0.5 * (ends[i] + ends[i + 1]) if i + 1 < len(ends) else ends[i])


def most_at_once(model: Model, most: int) -> int:
    """Return how many episodes, at most `most`, fit in memory together; a filter uses about ten covariances per agent."""
    return int(max(1, min(most, MEMORY // (80 * model.agents * model.states * model.states))))


def side_by_side(loop: Loop, most: int) -> int:
    """Return how many attack-free episodes of a loop, at most `most`, are played together; this changes no bit."""
    return episodes_at_once(loop.model, loop.horizon, most_at_once(loop.model, min(most, RECORDED)))


def play_clean(loop: Loop, keys: draws.Keys) -> Iterator[tuple[Array, Array, Array]]:
    """Yield (alarm (B, agents), score (B, agents), live (B,)) of each step without an attack; an episode ends with a collision."""
    trace = rollout(loop, NOTHING, keys)
    yield from zip(trace.alarm, trace.score, trace.live, strict=True)


@dataclass(frozen=True)
class Bench:
    """A defence on attack-free runs of some scenarios."""

    defence: Defence
    uses: tuple[str, ...]
    text: str
    places: tuple[Scenario, ...]
    batch: int
    progress: Progress

    @classmethod
    def of(cls, defence: str | Defence, scenarios: Sequence[str], batch: int, progress: Progress | None) -> Bench:
        made, entry, text = component("defence", defence)
        if not scenarios:
            raise InputError("scenario", list(scenarios), "at least one")
        places = tuple(load_scenario(name).with_threat(knowledge="black") for name in scenarios)  # nobody attacks
        if len({place.name for place in places}) < len(places):
            raise InputError("scenario", list(scenarios), "each scenario once")
        bench = cls(made, entry.uses, text, places, batch, progress or (lambda *_: None))
        for place in places:
            place.loop(bench.at(SILENT), entry.uses)  # a defence that does not fit fails here
        return bench

    def at(self, threshold: float) -> Defence:
        """Return the defence at a threshold: its own, its detector's (`threshold_field`), or else a threshold on its score."""
        return self._turned(threshold)[0]

    @cached_property
    def field(self) -> str:
        """The name of the threshold on the command line; empty if it is a threshold on the score."""
        return self._turned(SILENT)[1]

    def _turned(self, threshold: float) -> tuple[Defence, str]:
        own = getattr(self.defence, "threshold_field", None)
        if own is not None and dataclasses.is_dataclass(self.defence):
            return dataclasses.replace(self.defence, **{own: threshold}), str(own)
        if hasattr(self.defence, "with_threshold"):
            with contextlib.suppress(NotApplicable):
                inner = getattr(self.defence.parts()[1], "threshold_field", "") if hasattr(self.defence, "parts") else ""
                return self.defence.with_threshold(threshold), f"detector.{inner}" if inner else "threshold"
        return watched(self.defence, threshold), ""

    def seeds(self, hours: float) -> list[range]:
        """Return the seeds of each scenario, such that all together last `hours`, in equal shares of whole episodes.

        No two scenarios share a seed. A linear filter that knows its input sees only the noise, and would see it twice.
        """
        out, first = [], 0
        for place in self.places:
            count = max(1, math.ceil(hours * HOUR / len(self.places) / (place.horizon * place.brief().model.dt) - 1e-9))
            out.append(range(first, first + count))
            first += count
        return out

    def hours(self, steps: int) -> float:
        """Return the running time [h] of a number of steps."""
        return len(self.places) * steps / sum(1.0 / place.brief().model.dt for place in self.places) / HOUR

    def run(self, threshold: float, hours: float, purpose: str, label: str, crossings: Crossings | None = None) -> Count:
        """Play attack-free runs of `hours` in total; `crossings` collects how the score rises."""
        defence = self.at(threshold)
        loops = {place.name: place.loop(defence, self.uses) for place in self.places}
        chunks = []
        for place, seeds in zip(self.places, self.seeds(hours), strict=True):
            size = side_by_side(loops[place.name], self.batch)
            chunks += [(place, seeds[first : first + size]) for first in range(0, len(seeds), size)]
        counts: list[Array] = []
        steps = dict.fromkeys((place.name for place in self.places), 0)
        for done, (place, seeds) in enumerate(chunks, start=1):
            onsets, played = count_onsets(loops[place.name], draws.keys(purpose, seeds), crossings)
            counts.append(onsets.sum(axis=1))
            steps[place.name] += int(played.sum())
            self.progress(label, done, len(chunks), f"threshold {threshold:.{MOST_DIGITS}g}" if threshold < SILENT else "")
        seconds = math.fsum(steps[place.name] * place.brief().model.dt for place in self.places)
        return Count.of(np.concatenate(counts), seconds, sum(steps.values()))


def count_onsets(loop: Loop, keys: draws.Keys, crossings: Crossings | None = None) -> tuple[Array, Array]:
    """Return the (B, 2) alarm onsets in both halves of attack-free episodes, and the (B,) steps played.

    Onsets count as in the metric `alarm_onsets`: the alarm is on if any agent alarms.
    """
    batch = len(keys.key)
    alarmed, onsets, last = np.zeros(batch, bool), np.zeros((batch, 2), np.int64), np.full(batch, -np.inf)
    steps = np.zeros(batch, np.int64)
    low: list[Array] = []
    high: list[Array] = []
    for k, (alarms, scores, live) in enumerate(play_clean(loop, keys)):
        alarm = alarms.any(axis=1) & live
        onsets[:, int(2 * k >= loop.horizon)] += alarm & ~alarmed
        alarmed = alarm
        steps += live
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
