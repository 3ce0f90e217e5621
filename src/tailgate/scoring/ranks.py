"""Rank sets: the ranks that exact paired tests cannot exclude, among defences that use the same things."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binom, binomtest

from tailgate.core import Array
from tailgate.errors import InputError
from tailgate.registry import USES
from tailgate.stats import holm


class Harm(NamedTuple):
    """A defence against all its attacks in all scenarios, at one dose."""

    seeds: tuple[int, ...]
    damage: Array  # (attacks, episodes), 0 or 1
    worst: int  # the attack that does the most

    @property
    def of_worst(self) -> Array:
        """(episodes,) what the worst attack does."""
        return np.asarray(self.damage[self.worst])


def class_of(uses: Sequence[str]) -> str:
    """The class of a defence: what it uses, in the registry's order."""
    return " + ".join(use for use in USES if use in uses)


def mcnemar(only_a: int, only_b: int) -> float:
    """Exact two-sided p of McNemar's test: of the pairs that differ, each side has half under the null hypothesis."""
    n = only_a + only_b
    return float(binomtest(only_a, n).pvalue) if n else 1.0


def outdone(a: Harm, b: Harm) -> float:
    """p of the null hypothesis that some attack harms b at least as much as a's worst harms a: small where a is surely the weaker one.

    a's worst attack is tested against every attack of b, one-sided, and the largest p counts (an intersection-union test, which needs no
    correction). That a's worst was chosen on these very episodes costs the factor of its attacks (Bonferroni).
    """
    mine = a.of_worst
    only_a, only_b = np.sum(mine > b.damage, axis=1), np.sum(b.damage > mine, axis=1)
    p = np.where(only_a + only_b > 0, binom.sf(only_a - 1, only_a + only_b, 0.5), 1.0)
    return float(min(1.0, len(a.damage) * p.max()))


def compare(harm: Mapping[str, Harm], group: str, alpha: float) -> tuple[list[dict[str, Any]], dict[str, dict[str, int]]]:
    """Comparisons of all pairs of a class, and each one's rank set: best, 1 + those that are surely better, and worst.

    only_a counts the episodes in which a alone came to damage, each against its worst attack. p is twice the smaller of the two sides of
    `outdone`, adjusted after Holm for all pairs of the class; `weaker` is the side that it speaks of.
    """
    pairs: list[tuple[str, str, int, int, str]] = []
    p = []
    for a, b in combinations(harm, 2):
        if harm[a].seeds != harm[b].seeds:
            raise InputError(
                f"rows of {a} and {b}: seeds", f"{len(harm[a].seeds)} and {len(harm[b].seeds)}", "the same seeds in every scenario"
            )
        x, y = harm[a].of_worst, harm[b].of_worst
        sides = outdone(harm[a], harm[b]), outdone(harm[b], harm[a])
        pairs.append((a, b, int(np.sum(x > y)), int(np.sum(y > x)), a if sides[0] <= sides[1] else b))
        p.append(min(1.0, 2.0 * min(sides)))
    out: list[dict[str, Any]] = [
        {"class": group, "a": a, "b": b, "only_a": only_a, "only_b": only_b, "weaker": weaker, "p": raw, "adjusted": adjusted}
        for (a, b, only_a, only_b, weaker), raw, adjusted in zip(pairs, p, holm(p), strict=True)
    ]  # fmt: skip
    better, worse = dict.fromkeys(harm, 0), dict.fromkeys(harm, 0)
    for duel in out:
        if duel["adjusted"] <= alpha:
            better[duel["weaker"]] += 1
            worse[duel["b"] if duel["weaker"] == duel["a"] else duel["a"]] += 1
    return out, {name: {"best": 1 + better[name], "worst": len(harm) - worse[name]} for name in harm}
