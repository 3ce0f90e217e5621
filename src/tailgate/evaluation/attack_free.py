"""Runs without an attack, and the false alarms in them: what a threshold is found on, and what it gives elsewhere.

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

from tailgate.agents.scripted import NoAttack
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Model, draws
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec, entry_for, text_of
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.estimators.watched import watched
from tailgate.evaluation.stats import mean_time
from tailgate.play.trace import MEMORY, episodes_at_once, rollout

SILENT = 1e12  # a threshold that nothing reaches
MOST_DIGITS = 7  # of a threshold
RECORDED = 512  # episodes that are recorded side by side
NOTHING = NoAttack()
HOUR = 3600.0  # [s]
HOURS = 0.1  # mean time between alarm onsets [h]: the shortest that thresholds are calibrated to

Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


class Count(NamedTuple):
    """What clean runs gave: false-alarm onsets, running time and steps, and the onsets' variance over their mean, by episode."""

    onsets: int
    seconds: float
    steps: int
    dispersion: float

    @classmethod
    def of(cls, each: Array, seconds: float, steps: int) -> Count:
        """each (B,): onsets of each episode."""
        mean = float(each.mean())
        return cls(int(each.sum()), seconds, steps, float(each.var() / mean) if mean > 0.0 else 1.0)

    @property
    def hours(self) -> float | None:
        """Mean time between onsets [h]; None without any."""
        return self.seconds / HOUR / self.onsets if self.onsets else None

    def interval(self, level: float = 0.95) -> tuple[float, float | None]:
        """Limits of the mean time [h], for clusters of such dispersion; the upper one is None without any onset."""
        return mean_time(self.onsets, self.seconds / HOUR, self.dispersion, level)

    def may_be(self, hours: float) -> bool:
        """Whether the interval holds this mean time."""
        return (ends := self.interval())[0] <= hours and (ends[1] is None or hours <= ends[1])

    def as_data(self) -> dict[str, Any]:
        low, high = self.interval()
        return {
            "hours": self.hours, "low": low, "high": high, "onsets": self.onsets, "running_hours": self.seconds / HOUR, "steps": self.steps,
            "dispersion": self.dispersion,
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


def side_by_side(loop: Loop, most: int) -> int:
    """How many clean episodes of a loop, at most `most`, are played at once; it changes no bit of them."""
    return episodes_at_once(loop.model, loop.horizon, most_at_once(loop.model, min(most, RECORDED)))


def play_clean(loop: Loop, keys: draws.Keys) -> Iterator[tuple[Array, Array, Array]]:
    """(alarm (B, agents), score (B, agents), live (B,)) of each step without an attack; an episode ends with a collision."""
    trace = rollout(loop, NOTHING, keys)
    yield from zip(trace.alarm, trace.score, trace.live, strict=True)


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
    """(B, 2) alarm onsets of clean episodes in both halves of the drive, counted as the metric does, and the (B,) steps played.

    Of several agents any alarms.
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
