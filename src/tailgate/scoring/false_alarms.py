"""What a threshold of the detection board gives: false alarms on fresh clean runs of every scenario of a suite, robustness rows among them.

A threshold is found on all scenarios of a plant together, whose vehicle and sensors are as the defence is told. Elsewhere the alarm may
come more often, and within a drive it may come early or late: a filter with a constant gain alarms while it settles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from tailgate import draws
from tailgate.clean import HOUR, Bench, Count, count_onsets, side_by_side
from tailgate.core import Array
from tailgate.rounds import numbered
from tailgate.scenario import Suite

from .detection import plants

PURPOSE = "report"
BATCH = 4096  # episodes at once; changes no figure
Data = dict[str, Any]


def false_alarms(suite: Suite, detected: Sequence[Data], wanted: int, most_steps: int, *, beacon: str = "") -> list[Data]:
    """The field `alarms` of a detection board: for each threshold in the lines `detected`, what it gives in each scenario of its plant.

    Each line has the `onsets` in so many hours of `running`, the mean time between them with its limits [h] (`mean`, None without any,
    `low`, `high`), how many of them came in the `first` half of the drive, and `p`, of a sign test over episodes that both halves have as
    many. A run lasts as long as `wanted` false alarms should take, or `most_steps` steps if that is less.
    """
    out, done = [], set[tuple[str, tuple[str, ...], float]]()
    for line in detected:
        names = _of_plant(suite, line["scenario"])
        if (key := (line["defence"], names, line["hours"])) in done:
            continue
        done.add(key)
        head = {name: line[name] for name in ("defence", "hours", "threshold", "watched", "rarer") if name in line}
        for name in names:
            out.append(head | {"scenario": name} | _counted(suite.name, name, line, wanted, most_steps, beacon))
    return out


def _of_plant(suite: Suite, scenario: str) -> tuple[str, ...]:
    return next(names for names in plants(suite.scenarios).values() if scenario in names)


def _counted(suite: str, scenario: str, line: Data, wanted: int, most_steps: int, beacon: str) -> Data:
    bench = Bench.of(line["defence"], [scenario], BATCH, None)
    loop = bench.places[0].loop(bench.at(line["threshold"]), bench.uses)
    dt = loop.model.dt
    steps = min(wanted * line["hours"] * HOUR / dt, float(most_steps))
    seeds = numbered(beacon, suite, PURPOSE, 0, max(1, math.ceil(steps / loop.horizon - 1e-9)))
    size, each, played = side_by_side(loop, BATCH), [], 0
    for first in range(0, len(seeds), size):
        onsets, some = count_onsets(loop, draws.keys(PURPOSE, seeds[first : first + size]))
        each.append(onsets)
        played += some
    halves = np.concatenate(each)
    count = Count.of(halves.sum(axis=1), played * dt, played)
    low, high = count.interval()
    return {
        "onsets": count.onsets, "running": count.seconds / HOUR, "mean": count.hours, "low": low, "high": high,
        "first": int(halves[:, 0].sum()), "p": sign_test(halves[:, 0], halves[:, 1]),
    }  # fmt: skip


def sign_test(x: Array, y: Array) -> float:
    """Exact two-sided p of as many episodes with x > y as with x < y; alarms that come in clusters count once an episode."""
    more, less = int(np.count_nonzero(x > y)), int(np.count_nonzero(x < y))
    return float(stats.binomtest(more, more + less).pvalue) if more + less else 1.0
