"""False alarms at a threshold of the detection board, on fresh clean runs of every scenario of a suite.

A threshold is found on all scenarios of a plant together, whose vehicle and sensors the defence knows. Elsewhere the alarm may come more
often. Within a drive it may come early or late: a filter with a constant gain alarms while it settles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tailgate.core import Array, draws
from tailgate.core.scenario import Suite, name_of
from tailgate.evaluation.attack_free import HOUR, Bench, Count, count_onsets, side_by_side
from tailgate.evaluation.rounds import numbered

from .detection import plants
from .schema import Data

PURPOSE = "report"
FIRST = 4096  # number of the first seed: cells of a board and detection have no more episodes, which are numbered from 0
BATCH = 4096  # episodes at once; changes no figure


@dataclass(frozen=True)
class Drives:
    """Clean drives of a scenario: alarm onsets (B, 2) in both halves, steps played (B,), the most that there can be, and the step [s]."""

    halves: Array
    steps: Array
    horizon: int
    dt: float

    @property
    def count(self) -> Count:
        return Count.of(self.halves.sum(axis=1), float(self.steps.sum()) * self.dt, int(self.steps.sum()))

    @property
    def sides(self) -> tuple[int, int]:
        """How many whole drives have more onsets in their first half, and in their second: drives are independent, onsets are not."""
        first, second = self.halves[self.steps == self.horizon].T
        return int(np.count_nonzero(first > second)), int(np.count_nonzero(first < second))


def false_alarms(suite: Suite, detected: Sequence[Data], wanted: int, most_steps: int, *, beacon: str = "") -> list[Data]:
    """Return the field `alarms` of a detection board: false alarms of each threshold in `detected`, in each scenario of its plant.

    A run lasts as long as `wanted` false alarms should take, or `most_steps` steps if that is less. No two scenarios of a plant share a
    seed: a filter that knows its input sees the noise alone, and would see it twice. Each line has

    - the `onsets` in `running` hours, and their `dispersion` by drives;
    - the time between them [h]: `mean` (None without any) with its limits `low` and `high`;
    - the number of onsets in the `first` half of the drive, and of drives with more of them `early` and `late`.
    """
    out, done = [], set[tuple[str, tuple[str, ...], float]]()
    for line in detected:
        names = next(names for names in plants(suite.scenarios).values() if line["scenario"] in map(name_of, names))
        if (key := (line["defence"], names, line["hours"])) in done:
            continue
        done.add(key)
        first, drives = FIRST, dict[str, Drives]()
        for name in names:
            drives[name] = _drive(suite.name, name, line, wanted, most_steps, first, beacon)
            first += len(drives[name].steps)
        least = dispersion([drives[name] for name in names if name not in suite.robustness])
        head = {name: line[name] for name in ("defence", "hours", "threshold", "watched", "rarer") if name in line}
        out += [head | {"scenario": name_of(name)} | _figures(drives[name], least) for name in names]
    return out


def _drive(suite: str, scenario: str, line: Mapping[str, Any], wanted: int, most_steps: int, first: int, beacon: str) -> Drives:
    bench = Bench.of(line["defence"], [scenario], BATCH, None)
    loop = bench.places[0].loop(bench.at(line["threshold"]), bench.uses)
    steps = min(wanted * line["hours"] * HOUR / loop.model.dt, float(most_steps))
    seeds = numbered(beacon, suite, PURPOSE, first, max(1, math.ceil(steps / loop.horizon - 1e-9)))
    size = side_by_side(loop, BATCH)
    parts = [count_onsets(loop, draws.keys(PURPOSE, seeds[at : at + size])) for at in range(0, len(seeds), size)]
    halves, played = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Drives(halves, played, loop.horizon, loop.model.dt)


def dispersion(drives: Sequence[Drives]) -> float:
    """Return variance over mean of the onsets of a drive, within scenarios, of all together; 1 without any.

    A threshold for several scenarios together may be silent in one, which then says nothing of its clusters.
    """
    each = [one.halves.sum(axis=1) for one in drives]
    mean = math.fsum(float(x.sum()) for x in each)
    return math.fsum(float(x.var()) * len(x) for x in each) / mean if mean else 1.0


def _figures(drives: Drives, least: float) -> Data:
    count = drives.count
    count = count._replace(dispersion=max(count.dispersion, least))
    low, high = count.interval()
    early, late = drives.sides
    return {
        "onsets": count.onsets, "running": count.seconds / HOUR, "dispersion": count.dispersion, "mean": count.hours, "low": low,
        "high": high, "first": int(drives.halves[:, 0].sum()), "early": early, "late": late,
    }  # fmt: skip
