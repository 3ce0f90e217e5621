"""Measures of a board that has more than the worst rate: pointwise worst, severity, availability, and the mean gap without an attack.

    pointwise      the share of episodes that no attack damaged: a bound with hindsight, as who attacks would have to know the best
                   attack of each episode beforehand
    severity       impact speeds of the collisions under the worst attack
    availability   the distance under the worst attack over that of the clean run, mean over episodes; and the least of all attacks
    gap            the mean gap in clean runs over that of the undefended car, less one

The pointwise worst follows from a board's cells, the others from rows alone. Where nobody drives there is the first one only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from tailgate.core import Array
from tailgate.evaluation.rows import CLEAN, Row
from tailgate.evaluation.stats import limits

from .damage import Reach, Table, damaged, has_road, stalled
from .schema import Data
from .worst import Worst

ABOUT = {  # how to read each
    "pointwise": "Share of episodes that none of the attacks damaged: a bound with hindsight, as an attacker would have to know beforehand "
    "which attack works in which episode",
    "severity": "Mean closing speed of the collisions under the worst attack, and the speed that nine of ten of them stay below; the "
    "greatest of fewer than ten. Of attacks that do as much damage the first one listed counts",
    "availability": "Distance under the worst attack over that without an attack, mean over episodes; least: under the attack that costs "
    "most distance",
    "mean_gap": "Mean gap without an attack over that of the undefended car, less one: a longer gap makes every attack harder",
}  # fmt: skip
SOME = 10  # collisions from which on nine of ten means something
SPEEDS = {"median": 0.5, "q90": 0.9, "most": 1.0}  # quantiles of impact speeds
VAGUE = "the board does not say which episodes came to damage"
NO_IMPACT = "no collision"
NO_IMPACT_SPEED = "collisions from behind alone, of which no speed is recorded"


def pointwise(worst: Worst, dose: int) -> Data:
    """Return the share of episodes that no attack damaged, in the scenario where it is least, with exact two-sided limits.

    An episode is a seed of a scenario. The limits hold for all scenarios together.
    """
    line = {"dose": worst.table.doses[dose], "knowledge": worst.knowledge, "attacks": len({i for _, i in worst.pairs})}
    if any(worst.vague(k, dose) for k in range(len(worst.pairs))):
        return line | {"undamaged": None, "scenario": "", "reason": VAGUE}
    names = list(dict.fromkeys(name for name, _ in worst.pairs))
    spared = [worst.spared(name, dose) for name in names]
    hits, n = (np.array([f(x) for x in spared], np.float64) for f in (np.sum, len))
    low, high = limits(hits, n, worst.alpha / (2 * len(n)))
    least = int(np.argmin(hits / n))
    share = {"value": float(hits[least] / n[least]), "low": float(low.min()), "high": float(high.min())}
    return line | {"undamaged": share, "scenario": names[least], "reason": ""}


def under_attack(worst: Worst, dose: int) -> Data | None:
    """Return severity and availability under the worst attack at a dose; None without its rows, or without a road."""
    pair, _ = worst.at(dose)
    rows = worst.rows(pair, dose)
    if not rows or not has_road(rows[0]):
        return None
    reach = worst.table.reach.get((worst.pairs[pair][0], worst.defence))
    return {
        "dose": worst.table.doses[dose], "knowledge": worst.knowledge, "worst": worst.named(pair),
        "severity": severity(rows, worst.table, reach), "availability": availability(rows, reach),
        "least": least_available(worst, dose),
    }  # fmt: skip


def severity(rows: Sequence[Row], table: Table, reach: Reach | None) -> Data:
    """Return how the damaged episodes of a cell ended: in collisions, at which closing speed [m/s], or in lost progress."""
    hurt = [row for row in rows if damaged(row, table.suite, reach)]
    crashes = [row for row in hurt if row["crashed"]]
    speeds = np.sort([row["impact_speed"] for row in crashes if row["impact_speed"] is not None])
    stops = sum(stalled(row, table.suite, reach) for row in hurt if not row["crashed"])
    line = {"collisions": len(crashes), "measured": len(speeds), "stops": stops}
    if not len(speeds):
        return line | {"mean": None, **dict.fromkeys(SPEEDS), "reason": NO_IMPACT_SPEED if crashes else NO_IMPACT}
    found = {name: float(np.quantile(speeds, q)) for name, q in SPEEDS.items()}
    return line | {"mean": float(speeds.mean()), **found, "reason": ""}


def availability(rows: Iterable[Row], reach: Reach | None) -> float | None:
    """Return the mean over episodes of the distance over that of the clean run; None where no clean run gets anywhere.

    An episode counts from 0 to 1. One that ends in a collision goes no farther.
    """
    known = [(row["distance_travelled"], reach[row["seed"]]) for row in rows if reach and reach.get(row["seed"], 0.0) > 0.0]
    return float(np.mean([min(max(there / clean, 0.0), 1.0) for there, clean in known])) if known else None


def least_available(worst: Worst, dose: int, attacks: Collection[str] | None = None) -> Data | None:
    """Return the least availability of all attacks and scenarios, or of some attacks; None without rows."""
    best: Data | None = None
    for k, (name, i) in enumerate(worst.pairs):
        if attacks is None or worst.table.attackers[i].attack in attacks:
            value = availability(worst.rows(k, dose), worst.table.reach.get((name, worst.defence)))
            if value is not None and (best is None or value < best["value"]):
                best = {"value": value, **worst.named(k)}
    return best


def extended(old: Sequence[Data], worst: Worst, dose: int, added: Collection[str]) -> Data | None:
    """Return the line of an entry that met more attacks, which alone have rows: its old line where the worst attack is still that one."""
    at = worst.table.doses[dose], worst.knowledge
    before = next((line for line in old if (line["dose"], line["knowledge"]) == at), None)
    pair, _ = worst.at(dose)
    found = under_attack(worst, dose) if worst.named(pair)["attack"] in added else before
    if found is None or before is None:
        return found
    both = [least for least in (before["least"], least_available(worst, dose, added)) if least is not None]
    return found | {"least": min(both, key=lambda least: float(least["value"]), default=None)}


def mean_gap(table: Table, defence: str) -> Data | None:
    """Return the mean gap in clean runs over that of the undefended car, less one: the mean over episodes of the nominal scenarios.

    None without clean runs of both, or without a road.
    """
    ratios: list[Array] = []
    for name in table.nominal():
        own, bare = table.clean.get((name, defence)), table.clean.get((name, CLEAN))
        if not own or not bare or not has_road(own[0]):
            return None
        pairs = [(a["time_gap_inflation"], b["time_gap_inflation"]) for a, b in zip(own, bare, strict=True) if not damaged(b, table.suite)]
        ratios.append(np.array([(1.0 + a) / (1.0 + b) for a, b in pairs]))
    every = np.concatenate(ratios)
    return {"value": float(every.mean() - 1.0), "episodes": len(every)} if len(every) else None
