"""Damage, and the table of all rows by cell that the figures of a board are made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.version import plays_as
from tailgate.core import Array
from tailgate.core.scenario import Scenario, Suite, load_scenario
from tailgate.core.threat import KNOWLEDGE
from tailgate.evaluation.rows import CLEAN, Row
from tailgate.play.metrics import METRICS

PLAYED, MISSING, SKIPPED, FAILED = range(4)  # what became of a cell
Reach = Mapping[int, float]  # distance of a defence's clean runs in a scenario, by seed [m]


class Attacker(NamedTuple):
    """An attack with the knowledge that it was granted."""

    attack: str
    knowledge: str


class Key(NamedTuple):
    """A cell: `dose` is an index of the suite's doses."""

    scenario: str
    dose: int
    defence: str
    attacker: Attacker


def order(knowledge: str) -> int:
    """Return 0 for black box, and more for those who know more."""
    return KNOWLEDGE.index(knowledge)


def has_road(row: Row) -> bool:
    """Return if somebody follows another in the episode of a row that was played."""
    return row["distance_travelled"] is not None


def damaged(row: Row, suite: Suite, reach: Reach | None = None) -> bool:
    """Return if a row that was played ended in a collision, in front or behind; without a road, in an error above the suite's bound.

    Where the suite counts lost progress, an attacked car is damaged too that covers too little of its clean distance (`reach`).
    """
    if has_road(row):
        return bool(row["crashed"]) or stalled(row, suite, reach)
    if suite.bound is None:
        raise InputError(f"suite {suite.name}: bound", None, f"an error that counts as damage: nobody drives in {row['scenario']}")
    return bool(row["crashed"]) or row["max_error"] > suite.bound


def stalled(row: Row, suite: Suite, reach: Reach | None) -> bool:
    """Return if an attacked row covers less than the suite's share of the distance of its clean run on the same seed.

    Raises InputError where that run is not known.
    """
    share = suite.progress
    if share is None or not judged_by_clean(row, suite):
        return False
    if reach is None or row["seed"] not in reach:
        what = f"rows of {row['scenario']}, {row['defence']}, seed {row['seed']}: clean run"
        raise InputError(what, None, f"a row of the attack {CLEAN}: {suite.name} counts lost progress")
    return bool(row["distance_travelled"] < share * reach[row["seed"]])


def judged_by_clean(row: Row, suite: Suite) -> bool:
    """Return if the damage of a row that was played depends on the clean run."""
    return suite.progress is not None and row["attack"] != CLEAN and has_road(row)


def reach_of(rows: Iterable[Row]) -> dict[int, float]:
    """Return the distances of clean runs on a road, by seed [m]."""
    return {row["seed"]: row["distance_travelled"] for row in rows if row["status"] == "ok" and has_road(row)}


@dataclass(frozen=True, eq=False)
class Table:
    """Rows by cell, everything in a fixed order: that of the suite, then by name. The order of the rows changes nothing.

    harm[scenario] (defences, attackers, doses, episodes) is 1 for damage and 0 for none, NaN where nothing was played; state[scenario]
    (defences, attackers, doses) says why. Clean rows are apart in `clean`, by scenario and defence.
    """

    suite: Suite
    scenarios: dict[str, Scenario]
    doses: tuple[int | None, ...]  # ascending, none last
    defences: tuple[str, ...]
    attackers: tuple[Attacker, ...]
    seeds: dict[str, tuple[int, ...]]  # of each scenario
    cells: dict[Key, list[Row]]  # rows by seed
    clean: dict[tuple[str, str], list[Row]]
    harm: dict[str, Array]
    state: dict[str, Array]
    optimal: dict[Attacker, bool]
    learned: dict[Attacker, bool]
    listed: tuple[str, ...]  # the suite's attacks, and those that were admitted
    withdrawn: frozenset[str]  # attacks that an erratum took back
    purpose: str
    beacon: str  # of the round; empty for public seeds
    rows: int
    vague: frozenset[Key] = frozenset()  # cells of a board that do not say which episodes came to damage: the first ones stand for them
    shared: frozenset[str] = frozenset()  # what is on no list and all entries of a board have met: who joins has to have met it too
    reach: Mapping[tuple[str, str], Reach] = dataclasses.field(default_factory=dict)  # of clean runs, by scenario and defence

    @cached_property
    def asked(self) -> frozenset[str]:
        """Return the attacks that every defence has to have met."""
        return self.shared.union(self.listed)

    def known(self, knowledge: str) -> list[int]:
        """Return indices of attackers that know no more than this. Computed optima are ceilings, and count nowhere."""
        return [
            i for i, attacker in enumerate(self.attackers)
            if order(attacker.knowledge) <= order(knowledge) and not self.optimal[attacker] and attacker.attack not in self.withdrawn
        ]  # fmt: skip

    def nominal(self) -> list[str]:
        """Return scenarios with the plant that the defence knows."""
        return self.named(self.suite.nominal)

    def robust(self) -> list[str]:
        """Return the suite's scenarios for robustness."""
        return self.named(self.suite.robustness)

    def named(self, texts: Iterable[str]) -> list[str]:
        """Return the names, as rows have them, of some of the suite's scenarios: that of a file is not its path."""
        names = dict(zip(self.suite.scenarios, self.scenarios, strict=True))
        return [names[text] for text in texts]

    @cached_property
    def applies(self) -> dict[str, Array]:
        """The attacks that count, by scenario: (attackers,) bool.

        An attack does not count without a meaning against any defence, or if no defence owes it.
        """
        owed = np.array([attacker.attack in self.asked for attacker in self.attackers], bool)
        out = {}
        for name, state in self.state.items():
            played = ~np.isin(state, (SKIPPED, MISSING)).all(axis=(0, 2))
            out[name] = np.asarray(played | (owed & (state == MISSING).any(axis=(0, 2))))
        return out


def tabulate(rows: Iterable[Row], suite: Suite, added: Sequence[str] = (), withdrawn: Iterable[str] = ()) -> Table:
    """Return the table of rows. A seed of a cell counts once, however often it was played.

    added: attacks that joined the suite's later. Raises InputError for rows that do not belong together.
    """
    rows = list(rows)
    if not rows:
        raise InputError("rows", rows, "at least one row of an evaluation")
    if not suite.scenarios or not suite.doses:
        raise InputError(f"suite {suite.name}", list(suite.scenarios), "at least one scenario and one dose")
    scenarios = {scenario.name: scenario for scenario in (load_scenario(name) for name in suite.scenarios)}
    doses = doses_of(suite)
    at_dose = {
        (name, suite.threat.get("budget", scenario.threat_model.budget) if dose is None else dose): i
        for name, scenario in scenarios.items() for i, dose in reversed(list(enumerate(doses)))
    }  # fmt: skip
    held: dict[Key, dict[int, Row]] = {}
    hashes: dict[tuple[str, int | None, str], tuple[str, ...]] = {}
    for row in rows:
        _belongs(row, suite, scenarios)
        dose = at_dose.get((row["scenario"], row["dose"]))
        if dose is None:
            raise InputError(f"rows of {row['scenario']}: dose", row["dose"], f"one of the suite's doses {list(suite.doses)}")
        asked = row["scenario"], row["dose"], row["knowledge"]
        if asked not in hashes:
            hashes[asked] = hashes_of(scenarios[row["scenario"]], suite, row["dose"], row["knowledge"])
        if row["config_hash"] not in hashes[asked]:
            what = f"rows of {row['scenario']}, {row['defence']}, {row['attack']}: config_hash"
            raise InputError(what, row["config_hash"], f"{' or '.join(hashes[asked])}: the scenario under the suite's own threat model")
        key = Key(row["scenario"], dose, row["defence"], Attacker(row["attack"], row["knowledge"]))
        by_seed = held.setdefault(key, {})
        _same_cell(key, next(iter(by_seed.values()), row), row)
        _same_result(key, by_seed.setdefault(row["seed"], row), row)
    for field in ("purpose", "version", "beacon"):
        found = sorted({_of_one(field, row.get(field, "")) for row in rows})
        if len(found) > 1:
            raise InputError(f"rows: {field}", found, "rows of one")
    _same_component(rows)
    cells = {key: [by_seed[seed] for seed in sorted(by_seed)] for key, by_seed in held.items()}
    seeds = _seeds(cells)
    defences = in_order({key.defence for key in cells}, suite.defences)
    listed = tuple(dict.fromkeys([*suite.attacks, *added]))
    attackers = attackers_of((key.attacker for key in cells), listed)
    clean: dict[tuple[str, str], list[Row]] = {}
    for key in sorted(cells, key=lambda key: (key.dose, order(key.attacker.knowledge))):
        if key.attacker.attack == CLEAN and all(row["status"] == "ok" for row in cells[key]):
            clean.setdefault((key.scenario, key.defence), cells[key])  # the same at every dose
    reach = {at: reach_of(runs) for at, runs in clean.items()}
    shape = (len(defences), len(attackers), len(doses))
    harm = {name: np.full((*shape, len(seeds.get(name, ()))), np.nan) for name in scenarios}
    state = {name: np.full(shape, MISSING) for name in scenarios}
    for key, members in cells.items():
        if key.attacker.attack == CLEAN:
            continue
        at = defences.index(key.defence), attackers.index(key.attacker), key.dose
        statuses = {row["status"] for row in members}
        if not comparable(members, suite, reach.get((key.scenario, key.defence))):
            statuses = {"error"}
        state[key.scenario][at] = FAILED if "error" in statuses else SKIPPED if "skipped" in statuses else PLAYED
        if statuses == {"ok"}:
            harm[key.scenario][at] = [damaged(row, suite, reach.get((key.scenario, key.defence))) for row in members]
    marks = {
        mark: {one: any(bool(m[0].get(mark)) for key, m in cells.items() if key.attacker.attack == one.attack) for one in attackers}
        for mark in ("optimal", "learned")
    }  # fmt: skip
    return Table(
        suite, scenarios, doses, defences, attackers, seeds, cells, clean, harm, state, marks["optimal"], marks["learned"],
        listed, frozenset(withdrawn), rows[0]["purpose"], str(rows[0].get("beacon", "")), sum(len(members) for members in cells.values()),
        reach=reach,
    )  # fmt: skip


def comparable(rows: Sequence[Row], suite: Suite, reach: Reach | None) -> bool:
    """Return if a cell can be judged: where the suite counts lost progress, a defence without whole clean runs cannot be."""
    return reach is not None or not any(row["status"] == "ok" and judged_by_clean(row, suite) for row in rows)


def hashes_of(scenario: Scenario, suite: Suite, dose: int | None, knowledge: str) -> tuple[str, ...]:
    """Return the possible values of `config_hash` under the suite's threat model: without and with readings in the attacker's sight."""
    threat = suite.threat | {"knowledge": knowledge} | ({} if dose is None else {"budget": dose})
    found = [scenario.with_threat(**threat | sight).config_hash for sight in ({}, {"sees_measurement": True})]
    return tuple(dict.fromkeys(found))


def doses_of(suite: Suite) -> tuple[int | None, ...]:
    """Return the suite's doses, ascending, the scenario's own last."""
    return tuple(sorted(set(suite.doses), key=lambda dose: (dose is None, dose or 0)))


def attackers_of(played: Iterable[Attacker], listed: Sequence[str]) -> tuple[Attacker, ...]:
    """Return played and listed attackers: by the list, then by name, the least knowing first. Clean runs have none."""
    granted: dict[str, set[str]] = {name: set() for name in listed}
    for attacker in played:
        granted.setdefault(attacker.attack, set()).add(attacker.knowledge)
    return tuple(
        Attacker(name, level) for name in in_order(set(granted), listed) if name != CLEAN
        for level in sorted(granted[name] or {"black"}, key=order)
    )  # fmt: skip


def in_order(names: set[str], first: Sequence[str]) -> tuple[str, ...]:
    """Return the names in the order of the suite; those that it does not know come last, by name."""
    return (*(name for name in dict.fromkeys(first) if name in names), *sorted(names - set(first)))


def _belongs(row: Row, suite: Suite, scenarios: dict[str, Scenario]) -> None:
    if row["suite"] != suite.name:
        raise InputError("rows: suite", row["suite"], f"rows of the suite {suite.name}")
    if row["scenario"] not in scenarios:
        raise InputError("rows: scenario", row["scenario"], f"one of the suite's: {', '.join(scenarios)}")
    if row["knowledge"] not in KNOWLEDGE:
        raise InputError("rows: knowledge", row["knowledge"], f"one of {', '.join(KNOWLEDGE)}")


def _of_one(field: str, value: object) -> str:
    """Return a field of a row as rows of one board share it: versions that play the same are one."""
    return plays_as(value) if field == "version" else str(value)


def _same_cell(key: Key, one: Row, other: Row) -> None:
    for field in ("config_hash", "defence_digest", "attack_digest", "version"):
        if _of_one(field, one[field]) != _of_one(field, other[field]):
            raise InputError(f"rows of {named(key)}: {field}", [one[field], other[field]], "rows of one")


def _same_result(key: Key, one: Row, other: Row) -> None:
    """Raise InputError where an episode came out in two ways: else the file that is read last would decide."""
    for field in ("trace_hash", "status", "uses", "learned", "trained", "optimal", "submission", *METRICS):
        if one.get(field) != other.get(field):
            raise InputError(f"rows of {named(key)}, seed {one['seed']}: {field}", [one.get(field), other.get(field)], "rows of one result")


def named(key: Key) -> str:
    """Return a cell as people read it, without its dose."""
    return f"{key.scenario}, {key.defence}, {key.attacker.attack} ({key.attacker.knowledge})"


def _same_component(rows: Sequence[Row]) -> None:
    """Raise InputError where a defence or an attack is not the same one in all rows."""
    for family in ("defence", "attack"):
        first: dict[str, tuple[Any, Any]] = {}
        for row in rows:
            mine = row[f"{family}_digest"], row.get("versions", {}).get(family)
            if first.setdefault(row[family], mine) != mine:
                raise InputError(f"rows of the {family} {row[family]}: digest and version", [first[row[family]], mine], "rows of one")


def _seeds(cells: dict[Key, list[Row]]) -> dict[str, tuple[int, ...]]:
    """Return the seeds of each scenario, which all cells share: without that no comparison is paired."""
    out: dict[str, tuple[tuple[int, ...], Key]] = {}
    for key in sorted(cells, key=lambda key: (-len(cells[key]), key)):  # the one with fewer is the odd one
        mine = tuple(row["seed"] for row in cells[key])
        seeds, first = out.setdefault(key.scenario, (mine, key))
        if mine != seeds:
            most = f"the {len(seeds)} seeds of {first.defence}, {first.attacker.attack}: play as many"
            raise InputError(f"rows of {named(key)}: seeds", f"{len(mine)} of them", most)
    return {name: seeds for name, (seeds, _) in out.items()}
