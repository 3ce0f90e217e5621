"""The worst over attacks and scenarios at each dose: rates, curves and the critical dose.

No value here rises when an attack or a scenario is added: values are maxima of damage, and limits are corrected for their number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.evaluation.paired import Harm
from tailgate.evaluation.rows import Row
from tailgate.evaluation.stats import limits
from tailgate.studies.dose import CRITICAL, critical_dose, crossing, fitted

from .damage import MISSING, PLAYED, Key, Table, damaged
from .schema import Data


@dataclass(frozen=True, eq=False)
class Worst:
    """A defence against all attacks that know no more than `knowledge`, in all scenarios."""

    table: Table
    defence: str
    knowledge: str
    alpha: float

    @cached_property
    def pairs(self) -> list[tuple[str, int]]:
        """Return (scenario, index of the attacker) of every attack that has a meaning there.

        An attack that is not asked of everybody counts against the defences that it was played against.
        """
        index, known = self.table.defences.index(self.defence), self.table.known(self.knowledge)
        out: list[tuple[str, int]] = []
        for name in self.table.scenarios:
            applies, mine = self.table.applies[name], self.table.state[name][index]
            for i in known:
                if applies[i] and (self.table.attackers[i].attack in self.table.asked or (mine[i] != MISSING).any()):
                    out.append((name, i))
        return out

    @cached_property
    def lost(self) -> list[tuple[str, int]]:
        """Return the pairs without full figures."""
        index = self.table.defences.index(self.defence)
        return [(name, i) for name, i in self.pairs if (self.table.state[name][index, i] != PLAYED).any()]

    @property
    def complete(self) -> bool:
        """Return if no cell of this class is missing, and an attacker who knows just this was met: else it would be a lower class's."""
        return any(self.table.attackers[i].knowledge == self.knowledge for _, i in self.pairs) and not self.lost

    @cached_property
    def shares(self) -> Array:
        """Return (pairs, doses) share of damaged episodes."""
        return np.array([self._harm(name, i).mean(axis=-1) for name, i in self.pairs])

    def _harm(self, name: str, i: int) -> Array:
        return np.asarray(self.table.harm[name][self.table.defences.index(self.defence), i])

    def at(self, dose: int, scenarios: list[str] | None = None) -> tuple[int, float]:
        """Return (pair, damaged share) of the worst attack at a dose, in some scenarios or all; the first of equal ones."""
        shares = self.shares[:, dose].copy()
        if scenarios is not None:
            shares[[name not in scenarios for name, _ in self.pairs]] = -1.0
        worst = int(np.argmax(shares))
        return worst, float(shares[worst])

    def undamaged(self, pair: int, dose: int) -> float:
        """Return the undamaged share of a pair, as a quotient of whole numbers."""
        _, harm = self.harm(pair, dose)
        return float((len(harm) - harm.sum()) / len(harm))

    def spared(self, scenario: str, dose: int) -> Array:
        """Return (episodes,) bool: those of a scenario that no attack damaged."""
        return np.asarray(np.all([self._harm(name, i)[dose] == 0.0 for name, i in self.pairs if name == scenario], axis=0))

    def named(self, pair: int) -> Data:
        name, i = self.pairs[pair]
        return {"scenario": name, "attack": self.table.attackers[i].attack}

    def harm(self, pair: int, dose: int) -> tuple[tuple[int, ...], Array]:
        """Return seeds and damage (episodes,) of a pair."""
        name, i = self.pairs[pair]
        return self.table.seeds[name], self._harm(name, i)[dose]

    def vague(self, pair: int, dose: int) -> bool:
        """Return if nobody knows which episodes of a pair came to damage."""
        name, i = self.pairs[pair]
        return Key(name, dose, self.defence, self.table.attackers[i]) in self.table.vague

    def rows(self, pair: int, dose: int) -> list[Row]:
        """Return the rows of a pair at a dose, by seed; none of those that a board alone knows of."""
        name, i = self.pairs[pair]
        return self.table.cells.get(Key(name, dose, self.defence, self.table.attackers[i]), [])

    def all_harm(self, dose: int) -> Harm:
        """Return the damage of all pairs at a dose. Raises InputError for scenarios with other seeds: nothing would be paired."""
        found = {self.table.seeds[name] for name, _ in self.pairs}
        if len(found) != 1:
            raise InputError(f"rows of {self.defence}: seeds", f"{len(found)} sets of them", "the same seeds in every scenario")
        harm = np.stack([self._harm(name, i)[dose] for name, i in self.pairs])
        if np.isnan(harm).any():
            raise InputError(f"rows of {self.defence}", "attacks without full figures", "all episodes of every attack that counts")
        return Harm(found.pop(), harm, self.at(dose)[0], np.array([self.vague(k, dose) for k in range(len(self.pairs))], bool))

    def bounds(self, dose: int, scenarios: list[str] | None = None, sides: int = 1) -> tuple[float, float]:
        """Return limits of the worst damaged share that hold together for all pairs: alpha over their number, and over the sides."""
        chosen = [k for k, (name, _) in enumerate(self.pairs) if scenarios is None or name in scenarios]
        n = np.array([len(self.table.seeds[self.pairs[k][0]]) for k in chosen])
        hits = np.round(self.shares[chosen, dose] * n)
        low, high = limits(hits, n, self.alpha / (len(self.pairs) * sides))
        return float(low.max()), float(high.max())

    def rate(self, dose: int) -> Data:
        """Return the undamaged share against the worst, with its lower limit."""
        pair, _ = self.at(dose)
        return {
            "dose": self.table.doses[dose], "knowledge": self.knowledge,
            "undamaged": {"value": self.undamaged(pair, dose), "low": 1.0 - self.bounds(dose)[1]},
            "worst": self.named(pair), "attacks": len({i for _, i in self.pairs}),
        }  # fmt: skip

    @cached_property
    def numbers(self) -> list[int]:
        """Return indices of doses that are numbers."""
        return [i for i, dose in enumerate(self.table.doses) if dose is not None]

    @cached_property
    def _clean(self) -> list[tuple[str, Array]]:
        """Return damage of the clean runs by scenario: dose 0, where the suite has none itself."""
        if 0 in self.table.doses:
            return []
        found = ((name, self.table.clean.get((name, self.defence))) for name in self.table.scenarios)
        return [(name, np.array([damaged(row, self.table.suite) for row in rows], np.float64)) for name, rows in found if rows is not None]

    @cached_property
    def points(self) -> list[Data]:
        """Return the worst at each dose that is a number, dose 0 being no attack, with limits that hold together for all attacks."""
        out = []
        if self._clean:
            hits, n = (np.array([f(x) for _, x in self._clean], np.float64) for f in (np.sum, len))
            low, high = limits(hits, n, self.alpha / (2 * len(n)))
            worst = int(np.argmax(hits / n))
            out.append({
                "dose": 0, "value": float(hits[worst] / n[worst]), "low": float(low.max()), "high": float(high.max()),
                "scenario": self._clean[worst][0], "attack": "none",
            })  # fmt: skip
        for dose in self.numbers:
            pair, share = self.at(dose)
            low_, high_ = self.bounds(dose, sides=2)
            out.append({"dose": self.table.doses[dose], "value": share, "low": low_, "high": high_, **self.named(pair)})
        return out

    def curve(self) -> Data:
        """Return the dose-response of the worst, and its monotone regression."""
        line = fitted(np.array([point["value"] for point in self.points])).tolist()
        return {"defence": self.defence, "knowledge": self.knowledge, "points": self.points, "fitted": line}

    def critical(self) -> Data | None:
        """Return the critical dose with its interval. None where no dose is a number.

        The interval is where the lower and the upper limits cross that hold together for all pairs and doses. A bootstrap of the worst
        would not cover: the largest of many shares is biased upwards, and that of a resample once more (decision record 23). Values are
        null beyond the largest dose; the smallest dose is given for any up to it, and 0 for damage that needs no attack.
        """
        if not self.numbers:
            return None
        doses = np.array([self.table.doses[dose] for dose in self.numbers], np.float64)
        first = len(self.points) - len(doses)  # below the smallest dose nothing was played: a line down to no attack would be a guess
        line = fitted(np.array([point["value"] for point in self.points]))
        low, high = np.array([self.bounds(dose, sides=2 * len(doses)) for dose in self.numbers]).T
        ends = crossing(doses, low, high, CRITICAL)
        found = {"value": critical_dose(doses, line[first:], CRITICAL), "low": ends[0], "high": ends[1]}
        if line[:first].max(initial=0.0) > CRITICAL:
            found = dict.fromkeys(found, 0.0)
        at = next((point for point in self.points if point["value"] > CRITICAL), self.points[-1])
        found |= {"low": min(found["low"], found["value"]), "high": max(found["high"], found["value"])}  # the regression may leave them
        return {key: x if math.isfinite(x) else None for key, x in found.items()} | {
            "worst": {"scenario": at["scenario"], "attack": at["attack"]}
        }
