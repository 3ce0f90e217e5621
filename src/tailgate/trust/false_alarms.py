"""The price of detection: false alarms where nobody attacks, and from when on `detects` does not count.

An alarm that is on at random is on soon after anything. So detection counts in a scenario where the mean time between false alarms of its
clean run is no shorter than `Demands.false_alarms`. An alarm that stays on counts again after each deadline of a detection:
it would find an attack at that time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array
from tailgate.evaluation.rows import CLEAN
from tailgate.play.trace import Trace

HOUR = 3600.0  # [s]
DETECTS = "detects"  # the property that has this price

Row = dict[str, Any]


def false_alarms(trace: Trace, every: int) -> Array:
    """Count, by run (B,), how often any agent's alarm goes on without an attack, and once more for every `every` steps that it stays on."""
    on, stays, out = trace.alarm.any(axis=2) & trace.live, np.zeros(trace.batch, np.int64), np.zeros(trace.batch, np.int64)
    for now in on:
        out += now & (stays % every == 0)
        stays = np.where(now, stays + 1, 0)
    return out


class Price(NamedTuple):
    """False alarms and hours of a defence's clean run in a scenario; `reason` says why detection does not count."""

    scenario: str
    alarms: int
    running_hours: float
    hours: float | None  # mean time between them; None without any
    reason: str


def prices(rows: Sequence[Row], limit: float, nominal: Sequence[str]) -> dict[tuple[str, str], Price]:
    """Judge the first clean row of each defence and scenario. `limit`: shortest mean time between false alarms [h].

    `nominal` scenarios are judged. In others the vehicle is not the one that the defence knows. A lucky detection raises no bound there,
    as the worst scenario decides.
    """
    out: dict[tuple[str, str], Price] = {}
    for row in rows:
        key = row["defence"], row["scenario"]
        if row["attack"] == CLEAN and row["alarms"] is not None and key not in out:
            count, running = row["alarms"]["count"], row["alarms"]["steps"] * row["dt"] / HOUR
            often = (row["scenario_file"] or row["scenario"]) in nominal and count * limit > running
            every = f"one in {running / count * HOUR:.3g} s without an attack on {row['scenario']}" if often else ""
            reason = f"{DETECTS} does not count: false alarms, {every}, limit {limit * HOUR:g} s" if often else ""
            out[key] = Price(row["scenario"], count, running, running / count if count else None, reason)
    return out


def unpaid(row: Row, paid: Mapping[tuple[str, str], Price]) -> str:
    """Say why detection does not count in a row; empty where it does, and where it has no meaning."""
    if not any(p["name"] == DETECTS and p["formula"] is not None for p in row["properties"]):
        return ""
    price = paid.get((row["defence"], row["scenario"]))
    return price.reason if price is not None else f"{DETECTS} does not count: no clean run to judge by on {row['scenario']}"
