"""False alarms on the pages of a board, at the thresholds of its detection: by scenario, and the flag `alarm drift`."""

from __future__ import annotations

from tailgate.board.schema import Alarms, Data
from tailgate.board.words import percent
from tailgate.evaluation.stats import at_least, mean_time

from .suite import Suite

FACTOR = 2.0  # times as often as wanted, or as rarely, from which on it is a flag
APART = 0.75  # of the drives with more false alarms in one half than in the other, from which on it is a flag
LEVEL = 0.05  # of each of the three, for all scenarios of an entry together


def robust(suite: Suite) -> set[str]:
    """Return scenarios whose plant or sensor a defence does not know."""
    return {scenario.name for scenario in suite.board.suite.scenarios if scenario.robustness}


def middle(suite: Suite) -> float:
    """Return the middle one of the wanted mean times between false alarms [h]."""
    hours = sorted(suite.board.detection.hours) if suite.board.detection else [0.0]
    return hours[len(hours) // 2]


def table_of(suite: Suite, defence: str) -> Data | None:
    """Return an entry's table: a row per scenario, a column per wanted mean time, and when in the drive alarms come at the middle one."""
    lines = suite.board.alarms(defence)
    if not lines:
        return None
    hours = list(dict.fromkeys(line.hours for line in lines))
    at = {(line.scenario, line.hours): line for line in lines}
    rows = []
    for scenario in dict.fromkeys(line.scenario for line in lines):
        cells = [_cell(at.get((scenario, h))) for h in hours]
        held = at.get((scenario, middle(suite)))
        first = percent(held.first / held.onsets) if held is not None and held.onsets else ""
        rows.append({"scenario": scenario, "told": scenario not in robust(suite), "cells": cells, "first": first})
    return {"hours": [time_text(h) for h in hours], "middle": time_text(middle(suite)), "rows": rows}


def together_of(suite: Suite) -> Data | None:
    """Return the table of all entries at the middle mean time: a column for each scenario."""
    hour, lines = middle(suite), [line for line in suite.board.alarms() if line.hours == middle(suite)]
    if not lines:
        return None
    names = [scenario.name for scenario in suite.board.suite.scenarios if any(line.scenario == scenario.name for line in lines)]
    at = {(line.defence, line.scenario): line for line in lines}
    rows = [
        {"name": suite.defences[defence], "page": suite.pages.get(defence, ""), "cells": [_cell(at.get((defence, name))) for name in names]}
        for defence in dict.fromkeys(line.defence for line in lines)
    ]
    heads = [{"name": name, "told": name not in robust(suite)} for name in names]
    return {"hour": time_text(hour), "heads": heads, "rows": rows}


def drifts_of(suite: Suite, defence: str) -> list[str]:
    """Return flags of an entry: false alarms surely far more or less often than its threshold was set for, or in one half alone."""
    hour = middle(suite)
    lines = [line for line in suite.board.alarms(defence) if line.hours == hour]
    told = [line for line in lines if line.scenario not in robust(suite)]
    ends = {line.scenario: mean_time(line.onsets, line.running, line.dispersion, 1.0 - LEVEL / len(lines)) for line in lines}
    often = [line for line in lines if (most := ends[line.scenario][1]) is not None and most < hour / FACTOR]
    often.sort(key=lambda line: line.mean or 0.0)
    out, set_to = [], f"alarm drift: set to one false alarm in {time_text(hour)}, it raises"
    if often:
        more = f", and on {len(often) - 1} more surely twice as often" if len(often) > 1 else ""
        out.append(f"{set_to} one in {_mean(often[0])} on {often[0].scenario}{more}")
    out += [f"{set_to} {_rarely(line)} on {line.scenario}" for line in told if not line.rarer and ends[line.scenario][0] > FACTOR * hour]
    return out + [f"alarm drift: {said}" for line in told if (said := _aside(line, LEVEL / len(told)))]


def _aside(line: Alarms, level: float) -> str:
    """Return a flag for alarms in one half of the drive. It counts drives, which are independent: onsets come in clusters."""
    drives, most = line.early + line.late, max(line.early, line.late)
    if not drives or at_least(most, drives, APART) > level / 2.0:
        return ""
    half = "first" if line.early > line.late else "second"
    return f"its false alarms on {line.scenario} come in the {half} half of the drive, in {most} of {drives} drives with more in one half"


def _rarely(line: Alarms) -> str:
    return f"none in {time_text(line.running)}" if line.mean is None else f"one in {_mean(line)}"


def _mean(line: Alarms) -> str:
    return "" if line.mean is None else time_text(line.mean)


def _cell(line: Alarms | None) -> Data:
    if line is None:
        return {"text": "\N{EN DASH}", "span": "", "rarer": False, "sort": ""}
    span = f"{time_text(line.low)} or more" if line.high is None else f"{time_text(line.low)} to {time_text(line.high)}"
    text = f"none in {time_text(line.running)}" if line.mean is None else _mean(line)
    return {"text": text, "span": span, "rarer": line.rarer, "sort": f"{line.low if line.mean is None else line.mean:.6g}"}


def time_text(hours: float) -> str:
    """Return a time in the unit that fits: 11 s, 4.2 min, 1.3 h."""
    for unit, scale in (("h", 1.0), ("min", 60.0)):
        if hours * scale >= 1.0 - 1e-9:
            return f"{hours * scale:.3g} {unit}" if hours * scale < 1000.0 else f"{hours * scale:.0f} {unit}"
    return f"{hours * 3600.0:.2g} s"
