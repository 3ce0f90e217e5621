"""Ranks of a board's entries, within each class of what defences use (`tailgate.evaluation.paired` has the tests)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.threat import KNOWLEDGE
from tailgate.evaluation.paired import Harm, compare, duel, outdone

from .entry import Levels
from .schema import Data
from .update import KeptPart
from .worst import Worst


def rank(found: list[Data], levels: Levels, dose: int, alpha: float, held: KeptPart | None) -> list[Data]:
    """Return the comparisons within each class, and put the rank sets into the entries that take one.

    Raises InputError where comparisons that a board has of entries that stay do not fit their cells.
    """
    out: list[Data] = []
    ranked = [entry for entry in found if entry["status"] == "ranked"]
    known = [] if held is None else [pair for pair in held.board["comparisons"] if held.steady >= {pair["a"], pair["b"]}]
    for group in dict.fromkeys(entry["class"] for entry in ranked):
        members = [entry for entry in ranked if entry["class"] == group]
        harm = {entry["defence"]: levels[entry["defence"]]["black"].all_harm(dose) for entry in members}
        bounds = [] if held is None else _still_bound(held, levels, harm, dose, group)
        pairs, ranks = compare(harm, group, alpha, [*known, *bounds])
        made = {(pair["a"], pair["b"]): pair for pair in pairs}
        for old in known:
            here = made.get((old["a"], old["b"]))
            if here is None or old.get("bound"):
                continue
            if not all(np.isclose(here[key], old[key]) for key in ("only_a", "only_b", "p")):
                expected = f"{here['p']:.3g}, as follows from the cells"
                raise InputError(f"board: comparison of {old['a']} and {old['b']}", old["p"], expected)
        out += pairs
        for entry in members:
            entry["rank"] = ranks[entry["defence"]]
    return out


def _still_bound(held: KeptPart, levels: Levels, harm: Mapping[str, Harm], dose: int, group: str) -> list[Data]:
    """Return the comparisons of entries that have met more attacks since, as far as the old ones still bound p."""
    out = []
    for old in held.board["comparisons"]:
        a, b, weak = old["a"], old["b"], old.get("weaker")
        if held.steady >= {a, b} or not held.entries.keys() & harm.keys() >= {a, b} or weak not in (a, b) or old["p"] >= 1.0:
            continue
        strong = b if weak == a else a
        before, now = Worst(held.before, weak, KNOWLEDGE[0], 0.05), levels[weak][KNOWLEDGE[0]]
        if before.named(before.at(dose)[0]) != now.named(now.at(dose)[0]):
            continue
        fresh, met = held.added.get(strong, frozenset()), levels[strong][KNOWLEDGE[0]]
        new = np.array([met.named(k)["attack"] in fresh for k in range(len(met.pairs))], bool)
        here = duel(group, a, b, harm[a], harm[b])
        p = min(here["p"], outgrown(old, harm[weak], harm[strong], len(before.pairs), new))
        out.append(here | {"p": p, "weaker": weak, "bound": True})
    return out


def outgrown(told: Data, weak: Harm, strong: Harm, tried: int, new: Array) -> float:
    """Return the largest p of a pair once both have met more attacks, if the weaker one's worst is still the same.

    tried: attacks that the weaker one had met; new (attacks,) bool: those that the other one had not.
    """
    met = strong._replace(damage=strong.damage[new], vague=strong.vague[new], worst=0)
    return float(min(1.0, max(told["p"] * len(weak.damage) / tried, 2.0 * outdone(weak, met) if new.any() else 0.0)))
