"""Exact paired tests of two defences, and the rank sets of a class: the ranks that these tests cannot exclude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.registry import USES
from tailgate.evaluation.stats import at_least, holm

Data = dict[str, Any]
PAIR = ("only_a", "only_b", "weaker", "p")  # what was found of two defences
CLOSE = 1e-6  # two libraries of special functions may differ in the last digits


class Harm(NamedTuple):
    """A defence against all its attacks in all scenarios, at one dose."""

    seeds: tuple[int, ...]
    damage: Array  # (attacks, episodes), 0 or 1
    worst: int  # the attack that does the most
    vague: Array  # (attacks,) bool: how many episodes came to damage is known, and not which

    @property
    def of_worst(self) -> Array:
        """Return (episodes,) the damage of the worst attack."""
        return np.asarray(self.damage[self.worst])


def class_of(uses: Sequence[str]) -> str:
    """Return the class of a defence: what it uses, in the registry's order."""
    return " + ".join(use for use in USES if use in uses)


def mcnemar(only_a: int, only_b: int) -> float:
    """Return the exact two-sided p of McNemar's test: of the pairs that differ, each side has half under the null hypothesis."""
    return min(1.0, 2.0 * float(at_least(max(only_a, only_b), only_a + only_b)))


def outdone(a: Harm, b: Harm, least: bool = False) -> float:
    """Return p of the null hypothesis that some attack harms b at least as much as a's worst harms a.

    a's worst attack is tested against every attack of b, one-sided. The largest p counts: an intersection-union test needs no correction.
    a's worst was chosen on these very episodes, which costs the factor of its attacks (Bonferroni).
    It is small where a is surely weaker. Where nobody knows which episodes were damaged, p is the largest that their numbers allow,
    or the least; it is 1 where b has as many.
    """
    vague = a.vague[a.worst] | b.vague
    only_a, only_b = apart(a.of_worst, b.damage, vague, least)
    blank = (only_a + only_b == 0) | (vague & (only_a <= only_b))
    p = np.where(blank, 1.0, at_least(only_a, only_a + only_b))
    return float(min(1.0, len(a.damage) * p.max()))


def apart(mine: Array, others: Array, vague: Array, least: bool = False) -> tuple[Array, Array]:
    """Return (attacks,) each: episodes in which `mine` (episodes,) alone shows damage, and in which `others` (attacks, episodes) alone do.

    Vague pairs count as many as their numbers allow, or as few. Their difference is given, so a p below one half rises with the number
    of pairs that differ.
    """
    only, other = np.sum(mine > others, axis=1), np.sum(others > mine, axis=1)
    most = np.minimum(others.sum(axis=1), len(mine) - mine.sum()).astype(int)
    some = np.maximum(other - only, 0) if least else most
    return np.where(vague, some + only - other, only), np.where(vague, some, other)


def duel(group: str, a: str, b: str, x: Harm, y: Harm) -> Data:
    """Compare two defences of a class.

    only_a counts the episodes in which a alone came to damage, each against its worst attack. p is twice the smaller of the two sides of
    `outdone`; `weaker` names that side. `bound`: some cell does not say which of its episodes came to damage. Then p, and
    all counts of episodes, are as large as they can be. Raises InputError for other seeds.
    """
    if x.seeds != y.seeds:
        raise InputError(f"rows of {a} and {b}: seeds", f"{len(x.seeds)} and {len(y.seeds)}", "the same seeds in every scenario")
    worst = np.array([x.vague[x.worst] | y.vague[y.worst]])
    only_a, only_b = (int(n[0]) for n in apart(x.of_worst, y.of_worst[None], worst))
    sides = outdone(x, y), outdone(y, x)
    made: Data = {"class": group, "a": a, "b": b, "only_a": only_a, "only_b": only_b, "weaker": a if sides[0] <= sides[1] else b}
    return made | {"p": min(1.0, 2.0 * min(sides))} | ({"bound": True} if x.vague.any() or y.vague.any() else {})


def credible(told: Data, here: Data, x: Harm, y: Harm) -> bool:
    """Return if a pair can have been found like that when more episodes were known than cells tell now, which give the bound `here`."""
    if told.get("weaker") not in (told["a"], told["b"]):
        return False
    only = told["only_a"], told["only_b"]
    weak, strong, first = (x, y, only[0]) if told["weaker"] == told["a"] else (y, x, only[1])
    low = outdone(weak, strong, least=True)
    if told.get("bound"):
        fits = only == (here["only_a"], here["only_b"])
    else:
        worst = np.array([x.vague[x.worst] | y.vague[y.worst]])
        few, many = (apart(x.of_worst, y.of_worst[None], worst, least)[0][0] for least in (True, False))
        fits = few <= only[0] <= many and only[0] - only[1] == here["only_a"] - here["only_b"]
        low = max(low, len(weak.damage) * float(at_least(first, sum(only))))  # against the other's worst: p is the largest of all
    return bool(fits and min(1.0, 2.0 * low) * (1.0 - CLOSE) <= told["p"] <= here["p"] * (1.0 + CLOSE))


def settled(duels: Sequence[Data], names: Sequence[str], alpha: float) -> tuple[list[Data], dict[str, dict[str, int]]]:
    """Return duels of all pairs of a class, with p adjusted after Holm, and each one's rank set.

    Its best rank is 1 + those that are surely better; its worst leaves out those that are surely worse.
    """
    out = [made | {"adjusted": adjusted} for made, adjusted in zip(duels, holm([made["p"] for made in duels]), strict=True)]
    better, worse = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    for made in out:
        if made["adjusted"] <= alpha:
            better[made["weaker"]] += 1
            worse[made["b"] if made["weaker"] == made["a"] else made["a"]] += 1
    return out, {name: {"best": 1 + better[name], "worst": len(names) - worse[name]} for name in names}


def compare(
    harm: Mapping[str, Harm], group: str, alpha: float, found: Sequence[Data] = ()
) -> tuple[list[Data], dict[str, dict[str, int]]]:  # fmt: skip
    """Return comparisons of all pairs of a class, and the rank set of each.

    found: pairs that were compared when more episodes were known; they count where that is no longer so, if numbers allow it (`credible`).
    """
    before = {(duel["a"], duel["b"]): duel for duel in found}
    duels = []
    for a, b in combinations(harm, 2):
        made, told = duel(group, a, b, harm[a], harm[b]), before.get((a, b))
        if told is not None and made.get("bound") and credible(told, made, harm[a], harm[b]):
            made |= {key: told[key] for key in PAIR}
            made = made if told.get("bound") else {key: value for key, value in made.items() if key != "bound"}
        duels.append(made)
    return settled(duels, list(harm), alpha)
