"""Gates of the safety board: the cost of a defence when nobody attacks, paired by episode with the undefended car.

For gap, jerk and distance the worse of the median and the mean of the ratios counts. A median alone would allow a defence to ruin almost
half of its episodes. In addition nearly all episodes have to get nearly as far.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.evaluation.attack_free import HOUR, HOURS
from tailgate.evaluation.rows import CLEAN, Row

from .damage import Table, damaged, has_road

GAP = 0.10  # mean gap above that of the undefended car, as a share of it
JERK = 1.2  # of the undefended car's
DISTANCE = 0.98  # of the undefended car's
TAIL = 0.95  # share of the episodes that may not be far off either
FAR = 0.9  # of the undefended car's distance
ALARMED = 0.5  # share of the time
ALARMS = ("alarm_rate", "alarm_onsets")  # figures that a clean run is judged by
COSTS = ("time_gap_inflation", "rms_jerk", "distance_travelled")

MEANS = {  # a gate, what its figure is, without an attack
    "gap": "by how much the mean gap is longer than that of the undefended car, as a share of it",
    "jerk": "RMS jerk over that of the undefended car",
    "progress": "distance over that of the undefended car",
    "every episode": f"share of the episodes with at least {100 * FAR:.0f} % of the distance of the undefended car",
    "collisions": "damaged episodes",
    "bound": "damaged episodes",
    "false alarms": "share of the time with an alarm (`tailgate calibrate` sets thresholds)",
}

Gate = dict[str, Any]


def gates(table: Table, defence: str) -> list[Gate]:
    """Return every gate of a defence: {gate, scenario, value, limit, passed}; a figure that cannot be had is null, and not passed.

    Raises InputError for a clean run that lacks a figure which its road has.
    """
    return [gate for name in table.scenarios for gate in _of(table, defence, name)]


def _of(table: Table, defence: str, scenario: str) -> list[Gate]:
    own, bare = table.clean.get((scenario, defence)), table.clean.get((scenario, CLEAN))
    if own is None:
        return [_gate("clean run", scenario, None, None, False)]
    for row in (*own, *(bare or ())):
        for metric in (*ALARMS, *(COSTS if has_road(row) else ())):
            if row[metric] is None:
                raise InputError(f"rows of {scenario}, {row['defence']}, {CLEAN}: {metric}", None, "a number")
    harmed = sum(damaged(row, table.suite) for row in own)
    out = [_false_alarms(table, scenario, own)]
    if not has_road(own[0]):
        return [_gate("bound", scenario, float(harmed), 0.0, harmed == 0), *out]
    out = [_gate("collisions", scenario, float(harmed), 0.0, harmed == 0), *out]
    pairs = [] if bare is None else [(a, b) for a, b in zip(own, bare, strict=True) if not damaged(b, table.suite)]
    gap = _worse(max, [(1.0 + a["time_gap_inflation"]) / (1.0 + b["time_gap_inflation"]) - 1.0 for a, b in pairs])
    jerk = _worse(max, [a["rms_jerk"] / b["rms_jerk"] for a, b in pairs if b["rms_jerk"] > 0.0])
    ratios = [a["distance_travelled"] / b["distance_travelled"] for a, b in pairs if b["distance_travelled"] > 0.0]
    distance, far = _worse(min, ratios), sum(x >= FAR for x in ratios) / len(ratios) if ratios else None
    return [
        _gate("gap", scenario, gap, GAP, gap is not None and gap <= GAP),
        _gate("jerk", scenario, jerk, JERK, jerk is not None and jerk <= JERK),
        _gate("progress", scenario, distance, DISTANCE, distance is not None and distance >= DISTANCE),
        _gate("every episode", scenario, far, TAIL, far is not None and far >= TAIL),
        *out,
    ]


def _false_alarms(table: Table, name: str, own: list[Row]) -> Gate:
    """Return the gate that fails an alarm which is on more than off, if the detection board has no threshold for it."""
    share = float(np.mean([row["alarm_rate"] for row in own]))
    scenario = table.scenarios[name]
    onsets = sum(row["alarm_onsets"] for row in own)
    often = onsets * HOURS * HOUR > len(own) * scenario.horizon * scenario.brief().model.dt
    return _gate("false alarms", name, share, ALARMED, not (share > ALARMED and often))


def _worse(of: Callable[[float, float], float], values: list[float]) -> float | None:
    """Return the worse of median and mean."""
    return of(float(np.median(values)), float(np.mean(values))) if values else None


def _gate(name: str, scenario: str, value: float | None, limit: float | None, passed: bool) -> Gate:
    return {"gate": name, "scenario": scenario, "value": value, "limit": limit, "passed": passed}


def explained(found: list[Gate]) -> list[str]:
    """Return a line for each gate that is not passed, with its figure and what the figure is."""
    missed = [gate for gate in found if not gate["passed"]]
    return [_told(gate) + ("" if gate["value"] is None else f" ({MEANS[gate['gate']]})") for gate in missed]


def _told(gate: Gate) -> str:
    if gate["value"] is None:
        return f"gate {gate['gate']}: no clean run to judge by on {gate['scenario']}"
    return f"gate {gate['gate']}: {gate['value']:.3g} on {gate['scenario']}, limit {gate['limit']:g}"


def failure(found: list[Gate]) -> str:
    """Return the first gate that is not passed, with its figure; empty where all are."""
    gate = next((gate for gate in found if not gate["passed"]), None)
    if gate is None:
        return ""
    others = sum(not gate["passed"] for gate in found) - 1
    return _told(gate) + (f", and {others} more" if others and gate["value"] is not None else "")
