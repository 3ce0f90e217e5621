"""The cells of a board, one for each scenario, dose, defence and attack: made of rows, and read back into a table."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.scenario import Suite, load_scenario
from tailgate.evaluation.checks import LAST_BITS, Finding
from tailgate.evaluation.rounds import numbered
from tailgate.evaluation.rows import CLEAN, Row
from tailgate.evaluation.stats import proportion

from .damage import FAILED, MISSING, PLAYED, SKIPPED, Attacker, Key, Reach, Table, attackers_of, comparable, damaged, doses_of, in_order
from .schema import CellLine, Data

PRINTS = ("hits", "decisions", "trace")  # which older boards lack
COMPARED = ("n", "failed", "damage", *PRINTS)
NO_CLEAN = "no whole clean run to compare progress with"
share = functools.cache(proportion)  # a board has few different counts


def figures(rows: Sequence[Row], suite: Suite, reach: Reach | None = None) -> Data:
    """Return a cell's figures: how many rows were played and failed, why, the damaged share and which episodes, and two fingerprints.

    reach: distances of the defence's clean runs, where the suite counts lost progress.
    """
    rows = sorted(rows, key=lambda row: int(row["seed"]))  # a round's seeds are not played in ascending order
    known = comparable(rows, suite, reach)
    good = [damaged(row, suite, reach) for row in rows if row["status"] == "ok"] if known else []
    reason = next((row["reason"] for row in rows if row["status"] != "ok"), "")
    return {
        "n": len(good), "failed": sum(row["status"] == "error" for row in rows) if known else len(rows),
        "reason": reason if known else NO_CLEAN,
        "damage": share(sum(good), len(good))._asdict() if good else None, "hits": digits(good) if len(good) == len(rows) else None,
        "decisions": _fingerprint(rows, "decision_hash"), "trace": _fingerprint(rows, "trace_hash"),
    }  # fmt: skip


def _fingerprint(rows: Sequence[Row], name: str) -> str:
    """Return a hash of one hash of every row. Decisions have the same on every platform, traces on one."""
    told = "\n".join(f"{row['seed']} {row['status']} {row.get(name) or ''}" for row in rows)
    return hashlib.blake2b(told.encode(), digest_size=8).hexdigest()


def compared(part: CellLine, here: Data) -> Finding:
    """Compare a cell of a board with its figures here, as `figures` makes them. A print that the board lacks counts as equal."""
    said = {name: value for name, value in part.model_dump(include=set(COMPARED)).items() if name not in PRINTS or value is not None}
    off = [name for name in COMPARED if name in said and said[name] != here[name]]
    parts = [part for name in off for part in _parts(name, said[name], here[name])]
    why = f"trace {LAST_BITS}" if off == ["trace"] else ", ".join(f"{name}: board {one}, here {other}" for name, one, other in parts)
    return Finding("differs" if off else "equal", why, here=here)


def _parts(name: str, says: object, here: object) -> list[tuple[str, object, object]]:
    """Return the parts of a figure that differ: a share with limits part by part."""
    if not isinstance(says, dict) or not isinstance(here, dict):
        return [(name, says, here)]
    return [(name if key == "value" else f"{name}.{key}", value, here.get(key)) for key, value in says.items() if value != here.get(key)]


def digits(hits: Sequence[bool]) -> str:
    """Return damaged episodes as hexadecimal digits: a bit for each, by seed ascending, the first one the highest of its byte."""
    return np.packbits(np.asarray(hits, bool)).tobytes().hex()


def hits_of(cell: Data) -> Array:
    """Return (n,) bool: the damaged episodes of a cell. Where the board gives their number only, the first ones count as damaged."""
    if (told := cell.get("hits")) is not None:
        return np.unpackbits(np.frombuffer(bytes.fromhex(told), np.uint8), count=cell["n"]).astype(bool)
    return np.arange(cell["n"]) < (round(cell["damage"]["value"] * cell["n"]) if cell["damage"] else 0)


def vague(cell: Data) -> bool:
    """Return if a cell tells how many episodes came to damage, but not which."""
    return cell.get("hits") is None and cell["damage"] is not None and 0.0 < cell["damage"]["value"] < 1.0


def ordered(cells: Sequence[Data], table: Table) -> list[Data]:
    """Return cells in the order of the suite, clean runs first."""
    scenarios, at_dose = list(table.scenarios), {dose: i for i, dose in enumerate(table.doses)}
    attacks = {attacker.attack: at for at, attacker in reversed(list(enumerate(table.attackers)))}
    return sorted(cells, key=lambda cell: (
        scenarios.index(cell["scenario"]), at_dose[cell["dose"]], table.defences.index(cell["defence"]),
        attacks.get(cell["attack"], -1), cell["knowledge"],
    ))  # fmt: skip


def cells_of(table: Table) -> list[Data]:
    """Return every cell that has rows, in the order of the suite, clean runs first."""
    return ordered([
        {
            "scenario": key.scenario, "dose": table.doses[key.dose], "defence": key.defence, "attack": key.attacker.attack,
            "knowledge": key.attacker.knowledge, "learned": bool(rows[0].get("learned")), "optimal": bool(rows[0].get("optimal")),
        } | figures(rows, table.suite, table.reach.get((key.scenario, key.defence)))
        for key, rows in table.cells.items()
    ], table)  # fmt: skip


def cell_key(cell: Data) -> tuple[Any, ...]:
    """Return the key of a cell, which no other cell of its board has."""
    return cell["scenario"], cell["dose"], cell["defence"], cell["attack"], cell["knowledge"]


def shared_of(board: Data) -> tuple[str, ...]:
    """Return the attacks that every newcomer has to meet: all entries have met them in each cell, or had when somebody joined.

    Files of policies are left out, as each was trained against one of the entries. So are attacks that do not count.
    """
    idle = {attack["attack"] for attack in board["attacks"] if attack.get("withdrawn") or attack.get("optimal")}
    everywhere = {(cell["defence"], cell["scenario"], cell["dose"]) for cell in board["cells"]}
    met: dict[str, set[tuple[Any, ...]]] = {}
    for cell in board["cells"]:
        if cell["attack"] != CLEAN and not cell["attack"].endswith(".json"):
            met.setdefault(cell["attack"], set()).add((cell["defence"], cell["scenario"], cell["dose"]))
    marked = {attack["attack"] for attack in board["attacks"] if attack.get("shared")}
    return tuple(sorted((marked | {attack for attack, held in met.items() if held == everywhere}) - idle))


def table_of(board: Data, suite: Suite) -> Table:
    """Return the table of a board's cells, without rows: clean runs know their damage alone.

    Raises InputError for a cell that is there twice, and for one of another suite.
    """
    scenarios = {scenario.name: scenario for scenario in (load_scenario(name) for name in suite.scenarios)}
    doses, listed = doses_of(suite), (*suite.attacks, *(a["attack"] for a in board["attacks"] if a.get("admitted")))
    at_dose = {dose: i for i, dose in enumerate(doses)}
    cells: dict[Key, Data] = {}
    for i, cell in enumerate(board["cells"]):
        key = Key(cell["scenario"], at_dose.get(cell["dose"], -1), cell["defence"], Attacker(cell["attack"], cell["knowledge"]))
        if key.dose < 0 or key.scenario not in scenarios:
            raise InputError(f"board.cells[{i}]", [cell["scenario"], cell["dose"]], f"a scenario and a dose of the suite {suite.name}")
        if key in cells:
            raise InputError(f"board.cells[{i}]", [*key[:3], *key.attacker], "a cell that is there once")
        cells[key] = cell
    counts = [(key.scenario, cell["n"] + cell["failed"]) for key, cell in cells.items()]
    episodes = {name: max((n for scenario, n in counts if scenario == name), default=0) for name in scenarios}
    attackers = attackers_of((key.attacker for key in cells), listed)
    defences = in_order({key.defence for key in cells}, suite.defences)
    shape = len(defences), len(attackers), len(doses)
    harm = {name: np.full((*shape, episodes[name]), np.nan) for name in scenarios}
    state = {name: np.full(shape, MISSING) for name in scenarios}
    clean: dict[tuple[str, str], list[Row]] = {}
    for key in sorted(cells, key=lambda key: key.dose):
        cell = cells[key]
        whole = cell["n"] == episodes[key.scenario]
        if key.attacker.attack == CLEAN:
            if whole:
                rows = [{"attack": CLEAN, "distance_travelled": 0.0, "crashed": bool(hit)} for hit in hits_of(cell)]
                clean.setdefault((key.scenario, key.defence), rows)
            continue
        at = defences.index(key.defence), attackers.index(key.attacker), key.dose
        state[key.scenario][at] = FAILED if cell["failed"] else PLAYED if whole else SKIPPED
        if whole:
            harm[key.scenario][at] = hits_of(cell)
    marked = {mark: {key.attacker.attack for key, cell in cells.items() if cell.get(mark)} for mark in ("optimal", "learned")}
    marks = {mark: {attacker: attacker.attack in names for attacker in attackers} for mark, names in marked.items()}
    withdrawn = frozenset(a["attack"] for a in board["attacks"] if a.get("withdrawn"))
    purpose, beacon = board["suite"].get("purpose") or "report", board["suite"].get("beacon") or ""
    seeds = {name: tuple(sorted(numbered(beacon, suite.name, purpose, 0, n))) for name, n in episodes.items()}
    return Table(
        suite, scenarios, doses, defences, attackers, seeds, {}, clean, harm, state, marks["optimal"], marks["learned"],
        tuple(dict.fromkeys(listed)), withdrawn, purpose, beacon, sum(episodes[key.scenario] for key in cells),
        frozenset(key for key, cell in cells.items() if vague(cell)), frozenset(shared_of(board)),
    )  # fmt: skip


def joined(table: Table, held: Table, kept: Collection[str], added: Mapping[str, Collection[str]]) -> Table:
    """Return the table of rows, joined with another one's defences that are kept. Both are of the same episodes.

    A kept defence has rows for clean runs, and for attacks that it had not met (`added`).
    """
    fresh = {key: rows for key, rows in table.cells.items() if key.defence not in kept or key.attacker.attack in added.get(key.defence, ())}
    parts = [(table, [name for name in table.defences if name not in kept]), (held, [name for name in held.defences if name in kept])]
    defences = in_order({name for _, names in parts for name in names}, table.suite.defences)
    met = {
        attacker for part, names in parts for i, attacker in enumerate(part.attackers) for state in part.state.values()
        if (state[[part.defences.index(name) for name in names], i] != MISSING).any()
    } | {key.attacker for key in fresh}  # fmt: skip
    attackers = attackers_of(met, table.listed)
    shape = len(defences), len(attackers), len(table.doses)
    harm = {name: np.full((*shape, len(seeds)), np.nan) for name, seeds in held.seeds.items()}
    state = {name: np.full(shape, MISSING) for name in held.seeds}
    for part, names in parts:
        shared = [attacker for attacker in part.attackers if attacker in attackers]
        mine = np.ix_([part.defences.index(name) for name in names], [part.attackers.index(attacker) for attacker in shared])
        here = np.ix_([defences.index(name) for name in names], [attackers.index(attacker) for attacker in shared])
        for name in held.seeds:
            harm[name][here], state[name][here] = part.harm[name][mine], part.state[name][mine]
    for key in (key for key in fresh if key.defence in kept and key.attacker in attackers):
        at = defences.index(key.defence), attackers.index(key.attacker), key.dose
        cell = table.defences.index(key.defence), table.attackers.index(key.attacker), key.dose
        harm[key.scenario][at], state[key.scenario][at] = table.harm[key.scenario][cell], table.state[key.scenario][cell]
    optimal = {attacker: any(part.optimal.get(attacker, False) for part, _ in parts) for attacker in attackers}
    learned = {attacker: any(part.learned.get(attacker, False) for part, _ in parts) for attacker in attackers}
    clean = {at: rows for at, rows in held.clean.items() if at[1] in kept} | table.clean
    return dataclasses.replace(
        table, defences=defences, attackers=attackers, cells=fresh, clean=clean, harm=harm, state=state, optimal=optimal,
        learned=learned, vague=frozenset(key for key in held.vague if key.defence in kept), shared=held.shared,
    )  # fmt: skip
