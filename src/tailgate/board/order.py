"""The order of entries, the same on a page and in a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from .entry import CLAIMED, PROVISIONAL
from .schema import LEVELS, Critical, Entry

GROUPS = (  # status, title, what it means
    ("ranked", "Ranked", "with figures against every black-box attack, and through every gate"),
    ("unattacked", "Not attacked yet", "no attacker was trained against these: a good figure says little, and they take no rank"),
    ("unranked", "Unranked, for comparison", "classes outside a round, baselines, references and those that fail a gate or lack figures"),
)


def ordered(entries: Iterable[Entry]) -> list[Entry]:
    """Return entries by group, classes of authors who claim their figures first, then by class, rank and critical dose."""
    return sorted(entries, key=place_of)


def sort_dose(critical: Critical | None) -> float:
    """Return a critical dose as a number: above every dose where it was not reached, below every one where there is none."""
    if critical is None:
        return -1.0
    return math.inf if critical.value is None else critical.value


def place_of(entry: Entry) -> tuple[Any, ...]:
    """Return the key to sort by."""
    status = [name for name, *_ in GROUPS].index(entry.status)
    rank = (entry.rank.best, entry.rank.worst) if entry.rank else (math.inf, math.inf)
    doses = [-sort_dose(entry.critical_dose.get(level)) for level in LEVELS]
    return (status, not entry.why.startswith((CLAIMED, PROVISIONAL)), entry.class_.count("+"), entry.class_, rank, doses)
