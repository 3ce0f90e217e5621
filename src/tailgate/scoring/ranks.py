"""Rank sets: the ranks that exact paired tests cannot exclude, among defences that use the same things."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import binomtest

from tailgate.core import Array
from tailgate.errors import InputError
from tailgate.registry import USES
from tailgate.stats import holm

Harm = tuple[tuple[int, ...], Array]  # seeds and damage (episodes,), 0 or 1


def class_of(uses: Sequence[str]) -> str:
    """The class of a defence: what it uses, in the registry's order."""
    return " + ".join(use for use in USES if use in uses)


def mcnemar(only_a: int, only_b: int) -> float:
    """Exact two-sided p of McNemar's test: of the pairs that differ, each side has half under the null hypothesis."""
    n = only_a + only_b
    return float(binomtest(only_a, n).pvalue) if n else 1.0


def compare(harm: Mapping[str, Harm], group: str, alpha: float) -> tuple[list[dict[str, Any]], dict[str, dict[str, int]]]:
    """Comparisons of all pairs of a class, and each one's rank set: best, 1 + those that are surely better, and worst.

    only_a counts the episodes in which a alone came to damage. p is McNemar's, adjusted after Holm for all pairs of the class.
    """
    pairs: list[tuple[str, str, int, int]] = []
    for a, b in combinations(harm, 2):
        (seeds, x), (others, y) = harm[a], harm[b]
        if seeds != others:
            raise InputError(f"rows of {a} and {b}: seeds", f"{len(seeds)} and {len(others)}", "the same seeds in every scenario")
        pairs.append((a, b, int(np.sum(x > y)), int(np.sum(y > x))))
    p = [mcnemar(only_a, only_b) for _, _, only_a, only_b in pairs]
    out: list[dict[str, Any]] = [
        {"class": group, "a": a, "b": b, "only_a": only_a, "only_b": only_b, "p": raw, "adjusted": adjusted}
        for (a, b, only_a, only_b), raw, adjusted in zip(pairs, p, holm(p), strict=True)
    ]  # fmt: skip
    better, worse = dict.fromkeys(harm, 0), dict.fromkeys(harm, 0)
    for duel in out:
        if duel["adjusted"] <= alpha:
            winner, loser = (duel["b"], duel["a"]) if duel["only_a"] > duel["only_b"] else (duel["a"], duel["b"])
            better[loser] += 1
            worse[winner] += 1
    return out, {name: {"best": 1 + better[name], "worst": len(harm) - worse[name]} for name in harm}
