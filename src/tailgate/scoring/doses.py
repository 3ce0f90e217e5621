"""The worst over attacks and scenarios at each dose: rates, curves and the critical dose.

Everything here falls or stays when an attack or a scenario is added: values are maxima of damage, limits are corrected for their number,
and the resamples of the bootstrap do not depend on what is compared.
"""

from __future__ import annotations

import functools
import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from tailgate.core import Array
from tailgate.errors import InputError
from tailgate.strength.dose import CRITICAL, LEVEL, critical_dose, fitted

from .damage import MISSING, PLAYED, Table, damaged
from .ranks import Harm

RESAMPLES = 1000
Data = dict[str, Any]


def limits(successes: Array, n: Array, alpha: float) -> tuple[Array, Array]:
    """One-sided Clopper-Pearson limits of shares, lower and upper, each missed with a chance of at most alpha."""
    low = np.where(successes > 0, stats.beta.ppf(alpha, np.maximum(successes, 1), n - successes + 1), 0.0)
    high = np.where(successes < n, stats.beta.isf(alpha, successes + 1, np.maximum(n - successes, 1)), 1.0)
    return low, high


@functools.cache
def weights(scenario: str, episodes: int) -> Array:
    """(episodes, RESAMPLES) how often each resample of a scenario holds each episode: the same for all attacks, doses and defences."""
    seed = int.from_bytes(hashlib.blake2b(scenario.encode(), digest_size=8).digest(), "little")
    rng = np.random.default_rng(seed)
    return np.asarray(rng.multinomial(episodes, np.full(episodes, 1.0 / episodes), RESAMPLES).T, np.float64)


def monotone(values: Array) -> Array:
    """The monotone regression of each column of values (doses, resamples), as strength.dose.fitted gives for one."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    out = np.full(values.shape, -np.inf)
    for i in range(len(values)):
        for j in range(i + 1):  # the largest, over blocks that begin at j, of the least mean that ends at or behind i
            means = [(total[k + 1] - total[j]) / (k + 1 - j) for k in range(i, len(values))]
            out[i] = np.maximum(out[i], np.min(means, axis=0))
    return out


def crossings(doses: Array, curves: Array, limit: float) -> Array:
    """(resamples,) the critical dose of each column of monotone curves (doses, resamples); inf where there is none."""
    above = curves > limit
    at = np.argmax(above, axis=0)
    column = np.arange(curves.shape[1])
    before = np.maximum(at - 1, 0)
    low, high = curves[before, column], curves[at, column]
    rise = np.where(high > low, (limit - low) / np.where(high > low, high - low, 1.0), 1.0)
    found = np.where(at == 0, doses[0], doses[before] + rise * (doses[at] - doses[before]))
    return np.where(above.any(axis=0), found, np.inf)


@dataclass(frozen=True, eq=False)
class Worst:
    """A defence against all attacks that know no more than `knowledge`, in all scenarios."""

    table: Table
    defence: str
    knowledge: str
    alpha: float

    @cached_property
    def pairs(self) -> list[tuple[str, int]]:
        """(scenario, column) of every attack that has a meaning there. One that is not listed counts against
        the defences that it was played against, and is asked of nobody else."""
        guard = self.table.defences.index(self.defence)
        out: list[tuple[str, int]] = []
        for name in self.table.scenarios:
            applies, mine = self.table.applies(name), self.table.state[name][guard]
            for i in self.table.known(self.knowledge):
                listed = self.table.columns[i].attack in self.table.listed
                if applies[i] and (listed or (mine[i] != MISSING).any()):
                    out.append((name, i))
        return out

    @cached_property
    def lost(self) -> list[tuple[str, int]]:
        """The pairs without full figures."""
        guard = self.table.defences.index(self.defence)
        return [(name, i) for name, i in self.pairs if (self.table.state[name][guard, i] != PLAYED).any()]

    @property
    def complete(self) -> bool:
        """Whether every figure of this class can be had."""
        return bool(self.pairs) and not self.lost

    @cached_property
    def shares(self) -> Array:
        """(pairs, slots) share of damaged episodes."""
        return np.array([self._harm(name, i).mean(axis=-1) for name, i in self.pairs])

    def _harm(self, name: str, i: int) -> Array:
        return np.asarray(self.table.harm[name][self.table.defences.index(self.defence), i])

    def at(self, slot: int, scenarios: list[str] | None = None) -> tuple[int, float]:
        """(pair, share of damaged episodes) of the worst attack at a dose, in some scenarios or all; the first of equal ones."""
        shares = self.shares[:, slot].copy()
        if scenarios is not None:
            shares[[name not in scenarios for name, _ in self.pairs]] = -1.0
        worst = int(np.argmax(shares))
        return worst, float(shares[worst])

    def undamaged(self, pair: int, slot: int) -> float:
        """Share of undamaged episodes of a pair, as a quotient of whole numbers."""
        _, harm = self.harm(pair, slot)
        return float((len(harm) - harm.sum()) / len(harm))

    def named(self, pair: int) -> Data:
        name, i = self.pairs[pair]
        return {"scenario": name, "attack": self.table.columns[i].attack}

    def harm(self, pair: int, slot: int) -> tuple[tuple[int, ...], Array]:
        """Seeds and damage (episodes,) of a pair."""
        name, i = self.pairs[pair]
        return self.table.seeds[name], self._harm(name, i)[slot]

    def all_harm(self, slot: int) -> Harm:
        """Of all pairs at a dose. Raises InputError where the scenarios have not the same seeds: nothing would be paired."""
        found = {self.table.seeds[name] for name, _ in self.pairs}
        if len(found) != 1:
            raise InputError(f"rows of {self.defence}: seeds", f"{len(found)} sets of them", "the same seeds in every scenario")
        return Harm(found.pop(), np.stack([self._harm(name, i)[slot] for name, i in self.pairs]), self.at(slot)[0])

    def bounds(self, slot: int, scenarios: list[str] | None = None, sides: int = 1) -> tuple[float, float]:
        """Limits of the worst share of damage that hold together for all pairs: alpha over their number, and over the sides."""
        chosen = [k for k, (name, _) in enumerate(self.pairs) if scenarios is None or name in scenarios]
        n = np.array([len(self.table.seeds[self.pairs[k][0]]) for k in chosen])
        hits = np.round(self.shares[chosen, slot] * n)
        low, high = limits(hits, n, self.alpha / (len(self.pairs) * sides))
        return float(low.max()), float(high.max())

    def rate(self, slot: int) -> Data:
        """Share of undamaged episodes against the worst, with its lower limit."""
        pair, _ = self.at(slot)
        return {
            "dose": self.table.doses[slot], "knowledge": self.knowledge,
            "undamaged": {"value": self.undamaged(pair, slot), "low": 1.0 - self.bounds(slot)[1]},
            "worst": self.named(pair), "attacks": len({i for _, i in self.pairs}),
        }  # fmt: skip

    @cached_property
    def numbers(self) -> list[int]:
        """Slots of doses that are numbers."""
        return [slot for slot, dose in enumerate(self.table.doses) if dose is not None]

    @cached_property
    def _clean(self) -> list[tuple[str, Array]]:
        """Damage of the clean runs by scenario: dose 0, where the suite has none of its own."""
        if 0 in self.table.doses:
            return []
        found = ((name, self.table.clean.get((name, self.defence))) for name in self.table.scenarios)
        return [(name, np.array([damaged(row, self.table.suite) for row in rows], np.float64)) for name, rows in found if rows is not None]

    @cached_property
    def points(self) -> list[Data]:
        """The worst at each dose that is a number, dose 0 being no attack, with limits that hold together for all attacks."""
        out = []
        if self._clean:
            hits, n = (np.array([f(x) for _, x in self._clean], np.float64) for f in (np.sum, len))
            low, high = limits(hits, n, self.alpha / (2 * len(n)))
            worst = int(np.argmax(hits / n))
            out.append({
                "dose": 0, "value": float(hits[worst] / n[worst]), "low": float(low.max()), "high": float(high.max()),
                "scenario": self._clean[worst][0], "attack": "none",
            })  # fmt: skip
        for slot in self.numbers:
            pair, share = self.at(slot)
            low_, high_ = self.bounds(slot, sides=2)
            out.append({"dose": self.table.doses[slot], "value": share, "low": low_, "high": high_, **self.named(pair)})
        return out

    def curve(self) -> Data:
        """The dose-response of the worst, and its monotone regression."""
        line = fitted(np.array([point["value"] for point in self.points])).tolist()
        return {"defence": self.defence, "knowledge": self.knowledge, "points": self.points, "fitted": line}

    def critical(self) -> Data | None:
        """The critical dose with its bootstrap interval. None where no dose is a number.

        Values are null beyond the largest dose; the smallest dose stands for any up to it, and 0 for damage that needs no attack.
        """
        if not self.numbers:
            return None
        doses = np.array([point["dose"] for point in self.points], np.float64)
        first = len(doses) - len(self.numbers)  # below the smallest dose nothing was played: a line down to no attack would be a guess
        line, lines = fitted(np.array([point["value"] for point in self.points])), monotone(self._drawn())
        clean = line[:first].max(initial=0.0) > CRITICAL
        value = 0.0 if clean else critical_dose(doses[first:], line[first:], CRITICAL)
        cleans = lines[:first].max(axis=0, initial=0.0) > CRITICAL
        drawn = np.sort(np.where(cleans, 0.0, crossings(doses[first:], lines[first:], CRITICAL)))
        low, high = math.floor((1 - LEVEL) / 2 * (RESAMPLES - 1)), math.ceil((1 + LEVEL) / 2 * (RESAMPLES - 1))
        at = next((point for point in self.points if point["value"] > CRITICAL), self.points[-1])
        # the worst of a resample is worse than that of the rows: what it says too low is widened to what was measured
        found = {"value": value, "low": min(float(drawn[low]), value), "high": max(float(drawn[high]), value)}
        return {key: x if math.isfinite(x) else None for key, x in found.items()} | {
            "worst": {"scenario": at["scenario"], "attack": at["attack"]}
        }

    def _drawn(self) -> Array:
        """(points, resamples) the worst share in each resample, chosen anew."""
        worst = np.zeros((len(self.points), RESAMPLES))
        first = len(self.points) - len(self.numbers)
        for name in self.table.scenarios:
            w = weights(name, len(self.table.seeds.get(name, ()))) if self.table.seeds.get(name) else None
            if w is None:
                continue
            for scenario, clean in self._clean:
                if scenario == name:
                    worst[0] = np.maximum(worst[0], clean @ w / len(clean))
            mine = [i for scenario, i in self.pairs if scenario == name]
            if mine:
                harm = np.stack([self._harm(name, i)[self.numbers] for i in mine])  # whole numbers: exact in any order of summation
                worst[first:] = np.maximum(worst[first:], (harm @ w).max(axis=0) / harm.shape[-1])
        return worst
