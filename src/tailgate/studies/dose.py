"""Dose-response: how much damage an attack does with how many steps, and the dose at which it becomes critical.

The curve is a monotone (isotonic) regression of the measured means, as a larger budget can be left unspent. The critical dose is where the
curve, straight between two measured doses, first exceeds the limit. Its interval is where limits that hold for all doses together cross it:
of shares those of Clopper and Pearson. A bootstrap would have no width where no episode was damaged. The interval of means is a percentile
bootstrap over episodes, the same for every dose. No interval covers the course of the curve between two doses that lie far apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.core.schema import as_data
from tailgate.evaluation.cells import Cell, cells_of, run
from tailgate.evaluation.stats import limits
from tailgate.play.metrics import unit_in

from .policies import is_policy, is_share, mean, misfit, outcome_for

CRITICAL = 0.10  # share of episodes with damage at which a dose is critical
RESAMPLES = 2000
LEVEL = 0.95


def fitted(values: Array) -> Array:
    """Return the monotone regression of means (doses,), all measured on as many episodes."""
    from scipy.optimize import isotonic_regression

    return np.asarray(isotonic_regression(values, increasing=True).x)


def critical_dose(doses: Array, curve: Array, limit: float) -> float:
    """Return the dose [steps] at which a monotone curve (doses,), straight between its points, first exceeds the limit; inf for never."""
    above = np.flatnonzero(curve > limit)
    if not len(above):
        return math.inf
    i = int(above[0])
    if i == 0:
        return float(doses[0])
    rise = (limit - curve[i - 1]) / (curve[i] - curve[i - 1])
    return float(doses[i - 1] + rise * (doses[i] - doses[i - 1]))


def crossing(doses: Array, low: Array, high: Array, limit: float) -> tuple[float, float]:
    """Return the interval of the critical dose from limits (doses,) of the damage, which only rises with the dose."""
    rising = np.minimum.accumulate(high[::-1])[::-1], np.maximum.accumulate(low)
    first, last = (critical_dose(doses, curve, limit) for curve in rising)
    return first, last


def critical_interval(doses: Array, outcomes: Array, limit: float, share: bool, seed: int = 0) -> tuple[float, float]:
    """Return the interval of the critical dose from outcomes (doses, episodes); inf where it lies beyond the largest dose.

    share: they are 0 or 1.
    """
    if share:
        hits, n = outcomes.sum(axis=1), np.full(len(doses), outcomes.shape[1])
        low, high = crossing(doses, *limits(hits, n, (1 - LEVEL) / (2 * len(doses))), limit)
        value = critical_dose(doses, fitted(outcomes.mean(axis=1)), limit)  # which the regression may put outside
        return min(low, value), max(high, value)
    rng = np.random.default_rng(seed)
    episodes = outcomes.shape[1]
    found = np.sort([
        critical_dose(doses, fitted(outcomes[:, rng.integers(episodes, size=episodes)].mean(axis=1)), limit) for _ in range(RESAMPLES)
    ])  # fmt: skip
    ends = math.floor((1 - LEVEL) / 2 * (RESAMPLES - 1)), math.ceil((1 + LEVEL) / 2 * (RESAMPLES - 1))
    return float(found[ends[0]]), float(found[ends[1]])


def dose_response(
    attacks: Sequence[str], defences: Sequence[str], scenario: str, doses: Sequence[int], *, episodes: int = 400,
    threat: dict[str, Any] | None = None, outcome: str | None = None, exceeds: float | None = None, limit: float | None = None,
    purpose: str = "report", workers: int = 1, rows_file: Path | None = None, progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Play, and return the report: a curve for each attack and defence. Dose 0 is no attack.

    outcome: a metric. exceeds: count the episodes in which it exceeds this value, instead of its mean. limit: of the mean or the share that
    makes a dose critical; 0.1 of shares, and none of means.
    """
    sizes.check("episodes", episodes)
    counted = outcome_for(outcome, scenario)
    if exceeds is not None and is_share(counted):
        raise InputError("exceeds", exceeds, f"nothing for {counted}, which is yes or no")
    for field, value in (("exceeds", exceeds), ("limit", limit)):
        if value is not None and not math.isfinite(value):
            raise InputError(field, value, "a finite number")
    share = is_share(counted) or exceeds is not None
    limit = CRITICAL if limit is None and share else limit
    if share and limit is not None and not 0.0 <= limit < 1.0:
        raise InputError("limit", limit, "a share from 0 on and below 1")
    steps = sorted(set(doses))
    if not steps or any(isinstance(dose, bool) or not isinstance(dose, int) or dose < 1 for dose in steps):
        raise InputError("doses", list(doses), "whole numbers of attack steps, at least 1")
    threat = dict(threat or {})
    against, tried = tuple(dict.fromkeys(defences)), tuple(dict.fromkeys(attacks))
    if not against or not tried:
        raise InputError("attacks and defences", [*tried, *against], "at least one of each")
    reasons = {
        attack: misfit(Cell("", scenario, steps[0], against[0], attack, 1, threat=threat)) for attack in tried if is_policy(attack)
    }  # fmt: skip
    playing = tuple(attack for attack in tried if not reasons.get(attack))
    suites = [Suite("dose-response", "", (scenario,), (0,), against, ("none",), episodes, threat)]
    suites.append(Suite("dose-response", "", (scenario,), tuple(steps), against, playing, episodes, threat))
    cells = [cell for suite in suites for cell in cells_of(suite, purpose=purpose)]
    rows = run(cells, rows_file, workers, progress)
    held: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for i, cell in enumerate(cells):
        held[cell.defence, cell.attack, cell.dose or 0] = rows[i * episodes : (i + 1) * episodes]
    curves = []
    for defence in against:
        for attack in playing:
            played = [held[defence, "none", 0], *(held[defence, attack, dose] for dose in steps)]
            curves.append(_curve(attack, defence, played, [0, *steps], counted, exceeds, limit))
    curves += [{"attack": attack, "defence": defence, "skipped": why} for defence in against for attack, why in reasons.items() if why]
    loaded = load_scenario(scenario).with_threat(**threat)
    return {
        "measure": "dose-response", "scenario": scenario, "purpose": purpose, "episodes": episodes, "outcome": counted,
        "unit": "0/1" if share else unit_in(counted, loaded.brief().model), "exceeds": exceeds, "limit": limit, "doses": [0, *steps],
        "threat": as_data(threat), "threat_model": as_data(loaded.threat_model), "curves": curves,
    }  # fmt: skip


def _curve(
    attack: str, defence: str, rows: list[list[dict[str, Any]]], doses: list[int], outcome: str, exceeds: float | None, limit: float | None
) -> dict[str, Any]:
    spec = Spec("attack", attack)
    head = {"attack": attack, "defence": defence, "knowledge": rows[-1][0]["knowledge"], "attack_digest": spec.digest}
    bad = next((row for group in rows for row in group if row["status"] != "ok"), None)
    if bad is not None:
        return head | {"skipped": bad["reason"]}
    if any(row[outcome] is None for group in rows for row in group):
        return head | {"skipped": f"{outcome} is undefined in some episodes"}
    values = np.array([[row[outcome] for row in group] for group in rows], np.float64)
    unit = outcome
    if exceeds is not None:
        values, unit = (values > exceeds).astype(np.float64), "crashed"
    curve, at = fitted(values.mean(axis=1)), np.array(doses, np.float64)
    points = [
        {"dose": dose, **mean(values[i : i + 1], unit)._asdict(), "fitted": float(curve[i])} for i, dose in enumerate(doses)
    ]  # fmt: skip
    spent = [float(np.mean([row["attack_steps"] for row in group])) for group in rows]
    out = head | {"points": points, "attack_steps": spent}
    if limit is None:
        return out
    low, high = critical_interval(at, values, limit, is_share(unit))
    named = {"value": critical_dose(at, curve, limit), "low": low, "high": high}
    return out | {"critical_dose": {key: value if math.isfinite(value) else None for key, value in named.items()}}
