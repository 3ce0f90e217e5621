"""The detection board and stealth impact: figures that need thresholds, and so rows that no board has.

One threshold per defence, plant and wanted mean time between false alarms, found on clean runs of the plant's scenarios (calibrate). At
that threshold attacks are played, and an alarm counts that comes within the metrics' deadline. The stealth attack aims just below the same
threshold, so that a looser one lets it through with more. A defence without a threshold is watched: its score is compared with
one from outside. Those that only filter are scored by the standard chi-square of the innovation (tailgate.core.score_threshold).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate.base import sizes
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario, name_of
from tailgate.core.score_threshold import Watched
from tailgate.evaluation.attack_free import Bench
from tailgate.evaluation.calibrate import Calibration, calibrate
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.evaluation.stats import median_limits, proportion
from tailgate.play.trace import Trace, episodes_at_once, rollout

from .schema import Data

LEVEL = 0.95  # of intervals
UNTOUCHED = "no attack took effect"
NO_GATE = "the alarm is the scorer's, on a score with no gate that one could stay below"
Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


@dataclass(frozen=True)
class Effort:
    """The numbers that decide the figures, besides a suite and its round."""

    hours: tuple[float, ...] = (0.1, 1.0, 10.0)  # wanted mean times between false alarms
    episodes: int = 100  # of a scenario and an attack
    onsets: int = 100  # false alarms that a threshold is found on: its mean time is known to 20 %
    most_steps: int = 8_000_000  # of the longest clean run: 20 alarms at 10 h in steps of 0.1 s
    checked: int = 20  # false alarms that a run of one scenario at a threshold that was found should have

    def __post_init__(self) -> None:
        if not self.hours or not all(math.isfinite(h) and h > 0.0 for h in self.hours):
            raise InputError("hours", list(self.hours), "finite numbers above 0")
        if not 1 <= self.episodes <= 4096:
            raise InputError("episodes", self.episodes, "1 to 4096")
        for name, kind in (("onsets", "onsets"), ("most_steps", "steps"), ("checked", "onsets")):
            sizes.check(kind, getattr(self, name), name)


EFFORT = Effort()


def plants(scenarios: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return scenarios by plant, with as many agents, states and readings: those of one plant share a threshold.

    A score of fourteen readings is another than one of two; where a plant has several shapes, its name says which.
    """
    out: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for name in scenarios:
        scenario = load_scenario(name)
        model = scenario.brief().model
        out.setdefault((type(scenario.plant).__name__, (model.agents, model.states, len(model.sensors))), []).append(name)
    kinds = [kind for kind, _ in out]
    shape = "{} of {} agents with {} states and {} readings each"
    return {kind if kinds.count(kind) == 1 else shape.format(kind, *size): tuple(names) for (kind, size), names in out.items()}


@functools.lru_cache(maxsize=256)
def threshold(defence: str, scenarios: tuple[str, ...], hours: float, onsets: int, most_steps: int) -> Calibration:
    """Return the threshold of a defence for a mean time between false alarms [h] on these clean runs, and its measured time.

    Raises InputError where the time cannot be had: in that many steps, or as the score does not climb that often.
    """
    return calibrate(defence, hours, scenarios=scenarios, onsets=onsets, most_steps=most_steps)


class Found(NamedTuple):
    """A threshold, or why there is none; `rarer`: with every lower one that was tried the alarm is too frequent, with this one too rare."""

    level: float | None
    why: str = ""
    rarer: bool = False


def _found(defence: str, scenarios: tuple[str, ...], hours: float, effort: Effort) -> Found:
    try:
        made = threshold(defence, scenarios, float(hours), effort.onsets, effort.most_steps)
    except InputError as error:
        if error.field != "hours":
            raise
        return Found(None, str(error))
    if made.rarer or made.settled or made.measured.may_be(hours):
        return Found(made.threshold, rarer=made.rarer)
    had = f"{made.measured.hours:.3g} at {made.threshold:g}"
    return Found(None, str(InputError("hours", hours, f"a mean time that {defence} can have ({had})")))


def detection(
    suite: Suite, defences: Sequence[str], attacks: Sequence[str], effort: Effort = EFFORT, *, dose: int | None = None, beacon: str = "",
    progress: Progress | None = None,
) -> Data:  # fmt: skip
    """Return the field `detection` of a board: shares of attacked episodes with an alarm in time, and median delays [steps].

    The suite's nominal scenarios are played under its threat model, at its middle dose unless given. Thresholds are found on the clean
    runs of all scenarios of a plant together. `watched`: the threshold is compared with the score of a defence that has none. `rarer`: no
    threshold alarms as often as wanted; lower ones alarm more often, this one more rarely. `without` lists defences without figures,
    with the reason: a mean time that is out of reach.
    """
    update = progress or (lambda *_: None)
    found: list[Data] = []
    without: list[Data] = []
    work = [(defence, plant, names, h) for plant, names in plants(suite.nominal).items() for defence in defences for h in effort.hours]
    for done, (defence, plant, names, h) in enumerate(work, start=1):
        level, why, rarer = _found(defence, names, h, effort)
        if level is None:
            without.append({"defence": defence, "plant": plant, "hours": h, "reason": why})
        else:
            for name in names:
                bench = Bench.of(defence, [name], effort.episodes, None)
                made = bench.at(level)
                for attack in attacks:
                    rows = run_cell(_cell(suite, name, dose, defence, attack, effort.episodes, beacon), made, uses=bench.uses)
                    head = {"defence": defence, "scenario": name_of(name), "attack": attack, "hours": h, "threshold": level}
                    head |= {name: True for name, holds in (("watched", not bench.field), ("rarer", rarer)) if holds}
                    found.append(head | _detected(rows))
        update("detection", done, len(work), defence)
    return dataclasses.asdict(effort) | {"hours": list(effort.hours), "entries": found, "without": without}


def _cell(suite: Suite, scenario: str, dose: int | None, defence: str, attack: str, episodes: int, beacon: str) -> Cell:
    """Return the suite's own cell, to be played with another threshold."""
    budget = suite.middle_dose if dose is None else dose
    return Cell(suite.name, scenario, budget, defence, attack, episodes, threat=suite.granted, beacon=beacon)


def _detected(rows: Sequence[Data]) -> Data:
    """Return the detected share among the episodes in which an attack took effect."""
    met = [row for row in rows if row["status"] == "ok" and row["missed_deadline"] is not None]
    if not met or any(row["status"] == "error" for row in rows):
        reason = next((row["reason"] for row in rows if row["status"] != "ok"), UNTOUCHED)
        return {"detected": None, "delay": None, "reason": reason}
    delays = [row["detection_delay"] for row in met if row["detection_delay"] is not None]
    share = proportion(sum(row["missed_deadline"] == 0.0 for row in met), len(met))
    return {"detected": share._asdict(), "delay": float(np.median(delays)) if delays else None}


def stealth_impact(
    suite: Suite, defence: str, effort: Effort = EFFORT, *, attack: str = "stealth", dose: int | None = None, beacon: str = "",
    progress: Progress | None = None,
) -> list[Data] | None:  # fmt: skip
    """Return the field `stealth` of an entry: the error that the stealth attack reaches per time, by the time between false alarms.

    `deviation` [m/s] is the median of episodes, the most of scenarios; `reason` says why there is none. `low` and `high` are its limits of
    95 %, which hold together for all scenarios; few episodes have none (null). `threshold` is that of the plant where the deviation is.
    None where no threshold was found. Scenarios, threat model and dose are those of `detection`.
    """
    update = progress or (lambda *_: None)
    out: list[Data] = []
    for done, h in enumerate(effort.hours, start=1):
        reached: list[tuple[Found, Array | str]] = []
        for names in plants(suite.nominal).values():
            found = _found(defence, names, h, effort)
            cells = [] if found.level is None else [_cell(suite, name, dose, defence, attack, effort.episodes, beacon) for name in names]
            reached += [(found, _reached(found.level, cell)) for cell in cells if found.level is not None] or [(found, found.why)]
        out.append({"hours": h} | _impact(reached))
        update(f"stealth against {defence}", done, len(effort.hours), f"{h:g} h")
    return out if any(item["threshold"] is not None for item in out) else None


def _impact(found: Sequence[tuple[Found, Array | str]]) -> Data:
    """Return the largest median of the deviations in each scenario, with limits that hold for all together, or why there is none."""
    reached = [(held, values) for held, values in found if not isinstance(values, str)]
    if not reached:
        held, why = next(((held, why) for held, why in found if held.level is not None), found[0])
        return _level(held) | dict.fromkeys(("deviation", "low", "high")) | {"reason": why}
    limits = [median_limits(values, 1.0 - (1.0 - LEVEL) / len(reached)) for _, values in reached]
    low, high = map(max, zip(*limits, strict=True)) if None not in limits else (None, None)
    most, held = max(((float(np.median(values)), held) for held, values in reached), key=lambda pair: pair[0])
    return _level(held) | {"deviation": most, "low": low, "high": high}


def _level(found: Found) -> Data:
    return {"threshold": found.level} | ({"rarer": True} if found.rarer else {})


def _reached(level: float, cell: Cell) -> Array | str:
    """Return (n,) deviations of the episodes that were attacked, or why there are none."""
    made, spec = Bench.of(cell.defence, [cell.scenario], cell.seeds, None).at(level), Spec("attack", cell.attack)
    attack, defence = spec.make(), Spec("defence", cell.defence)
    if isinstance(made, Watched):
        return NO_GATE
    values: list[Array] = []
    try:
        loop = cell.place(attack, spec.entry.knowledge).loop(made, defence.entry.uses)
        size = episodes_at_once(loop.model, loop.horizon, cell.batch)
        for first in range(0, cell.seeds, size):
            values.append(deviation(rollout(loop, attack, draws.keys(cell.purpose, cell.episodes[first : first + size]))))
    except NotApplicable as error:
        return str(error)
    reached = np.concatenate(values)
    return reached[np.isfinite(reached)] if np.isfinite(reached).any() else UNTOUCHED


def deviation(trace: Trace) -> Array:
    """Return (B,) the largest error of an estimated gap while an episode is attacked, over the time of the attack [m/s]; NaN without one.

    Errors after the attack do not count: a gate that stays shut on honest readings loses a car for good, however little was injected.
    """
    attacked = (trace.kind != 0) & trace.live
    error = np.max(trace.model.error(trace.estimate, trace.truth), axis=2)
    steps = np.count_nonzero(attacked, axis=0)
    return np.asarray(np.max(np.where(attacked, error, 0.0), axis=0) / np.where(steps, steps * trace.model.dt, np.nan))
