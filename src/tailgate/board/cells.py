"""The cells of a board: what became of the episodes of one scenario, dose, defence and attack; made of rows, and read back into a table."""

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
from tailgate.evaluation.rounds import numbered
from tailgate.evaluation.rows import CLEAN
from tailgate.evaluation.stats import proportion

from .damage import FAILED, MISSING, PLAYED, SKIPPED, Column, Key, Row, Table, columns_of, damaged, doses_of, in_order

Data = dict[str, Any]
share = functools.cache(proportion)  # a board has few different counts


def figures(rows: Sequence[Row], suite: Suite) -> Data:
    """Of the rows of a cell: how many were played and failed, why, the share that came to damage and which, and two fingerprints."""
    rows = sorted(rows, key=lambda row: int(row["seed"]))  # a round's seeds are not played in ascending order
    good = [damaged(row, suite) for row in rows if row["status"] == "ok"]
    return {
        "n": len(good), "failed": sum(row["status"] == "error" for row in rows),
        "reason": next((row["reason"] for row in rows if row["status"] != "ok"), ""),
        "damage": share(sum(good), len(good))._asdict() if good else None, "hits": digits(good) if len(good) == len(rows) else None,
        "decisions": _fingerprint(rows, "decision_hash"), "trace": _fingerprint(rows, "trace_hash"),
    }  # fmt: skip


def _fingerprint(rows: Sequence[Row], name: str) -> str:
    """Of one hash of every row of a cell. That of decisions is the same on every platform, that of traces on one."""
    told = "\n".join(f"{row['seed']} {row['status']} {row.get(name) or ''}" for row in rows)
    return hashlib.blake2b(told.encode(), digest_size=8).hexdigest()


def digits(hits: Sequence[bool]) -> str:
    """Which episodes came to damage as hexadecimal digits: a bit for each, by seed ascending, the first one the highest of its byte."""
    return np.packbits(np.asarray(hits, bool)).tobytes().hex()


def hits_of(cell: Data) -> Array:
    """(n,) bool of a cell: which episodes came to damage; as many as did, the first ones, where the board does not say which."""
    if (told := cell.get("hits")) is not None:
        return np.unpackbits(np.frombuffer(bytes.fromhex(told), np.uint8), count=cell["n"]).astype(bool)
    return np.arange(cell["n"]) < (round(cell["damage"]["value"] * cell["n"]) if cell["damage"] else 0)


def vague(cell: Data) -> bool:
    """Whether nobody can tell from a cell which of its episodes came to damage."""
    return cell.get("hits") is None and cell["damage"] is not None and 0.0 < cell["damage"]["value"] < 1.0


def ordered(cells: Sequence[Data], table: Table) -> list[Data]:
    """Cells in the order of the suite, clean runs first."""
    places, slots = list(table.scenarios), {dose: slot for slot, dose in enumerate(table.doses)}
    attacks = {column.attack: at for at, column in reversed(list(enumerate(table.columns)))}
    return sorted(cells, key=lambda cell: (
        places.index(cell["scenario"]), slots[cell["dose"]], table.defences.index(cell["defence"]),
        attacks.get(cell["attack"], -1), cell["knowledge"],
    ))  # fmt: skip


def cells_of(table: Table) -> list[Data]:
    """Every cell that has rows, in the order of the suite, clean runs first."""
    return ordered([
        {
            "scenario": key.scenario, "dose": table.doses[key.slot], "defence": key.defence, "attack": key.column.attack,
            "knowledge": key.column.knowledge, "learned": bool(rows[0].get("learned")), "optimal": bool(rows[0].get("optimal")),
        } | figures(rows, table.suite)
        for key, rows in table.cells.items()
    ], table)  # fmt: skip


def place_of(cell: Data) -> tuple[Any, ...]:
    """What tells a cell from the others of its board."""
    return cell["scenario"], cell["dose"], cell["defence"], cell["attack"], cell["knowledge"]


def shared_of(board: Data) -> tuple[str, ...]:
    """Attacks that all entries of a board have met in each of its cells, or had when somebody joined: who joins has to meet them too.

    Files of policies are left out, as they were trained against one of the entries, and what counts nowhere.
    """
    idle = {attack["attack"] for attack in board["attacks"] if attack.get("withdrawn") or attack.get("optimal")}
    places = {(cell["defence"], cell["scenario"], cell["dose"]) for cell in board["cells"]}
    met: dict[str, set[tuple[Any, ...]]] = {}
    for cell in board["cells"]:
        if cell["attack"] != CLEAN and not cell["attack"].endswith(".json"):
            met.setdefault(cell["attack"], set()).add((cell["defence"], cell["scenario"], cell["dose"]))
    marked = {attack["attack"] for attack in board["attacks"] if attack.get("shared")}
    return tuple(sorted((marked | {attack for attack, held in met.items() if held == places}) - idle))


def table_of(board: Data, suite: Suite) -> Table:
    """The table that a board's cells come from, without rows: clean runs know their damage alone.

    Raises InputError for a cell that is there twice, and for one of another suite.
    """
    places = {place.name: place for place in (load_scenario(name) for name in suite.scenarios)}
    doses, listed = doses_of(suite), (*suite.attacks, *(a["attack"] for a in board["attacks"] if a.get("admitted")))
    slots = {dose: slot for slot, dose in enumerate(doses)}
    cells: dict[Key, Data] = {}
    for i, cell in enumerate(board["cells"]):
        key = Key(cell["scenario"], slots.get(cell["dose"], -1), cell["defence"], Column(cell["attack"], cell["knowledge"]))
        if key.slot < 0 or key.scenario not in places:
            raise InputError(f"board.cells[{i}]", [cell["scenario"], cell["dose"]], f"a scenario and a dose of the suite {suite.name}")
        if key in cells:
            raise InputError(f"board.cells[{i}]", [*key[:3], *key.column], "a cell that is there once")
        cells[key] = cell
    counts = [(key.scenario, cell["n"] + cell["failed"]) for key, cell in cells.items()]
    episodes = {name: max((n for scenario, n in counts if scenario == name), default=0) for name in places}
    columns = columns_of((key.column for key in cells), listed)
    defences = in_order({key.defence for key in cells}, suite.defences)
    shape = len(defences), len(columns), len(doses)
    harm = {name: np.full((*shape, episodes[name]), np.nan) for name in places}
    state = {name: np.full(shape, MISSING) for name in places}
    clean: dict[tuple[str, str], list[Row]] = {}
    for key in sorted(cells, key=lambda key: key.slot):
        cell = cells[key]
        whole = cell["n"] == episodes[key.scenario]
        if key.column.attack == CLEAN:
            if whole:
                rows = [{"distance_travelled": 0.0, "crashed": bool(hit)} for hit in hits_of(cell)]
                clean.setdefault((key.scenario, key.defence), rows)
            continue
        at = defences.index(key.defence), columns.index(key.column), key.slot
        state[key.scenario][at] = FAILED if cell["failed"] else PLAYED if whole else SKIPPED
        if whole:
            harm[key.scenario][at] = hits_of(cell)
    marked = {mark: {key.column.attack for key, cell in cells.items() if cell.get(mark)} for mark in ("optimal", "learned")}
    marks = {mark: {column: column.attack in names for column in columns} for mark, names in marked.items()}
    withdrawn = frozenset(a["attack"] for a in board["attacks"] if a.get("withdrawn"))
    purpose, beacon = board["suite"].get("purpose") or "report", board["suite"].get("beacon") or ""
    seeds = {name: tuple(sorted(numbered(beacon, suite.name, purpose, 0, n))) for name, n in episodes.items()}
    return Table(
        suite, places, doses, defences, columns, seeds, {}, clean, harm, state, marks["optimal"], marks["learned"],
        tuple(dict.fromkeys(listed)), withdrawn, purpose, beacon, sum(episodes[key.scenario] for key in cells),
        frozenset(key for key, cell in cells.items() if vague(cell)), frozenset(shared_of(board)),
    )  # fmt: skip


def joined(table: Table, held: Table, kept: Collection[str], added: Mapping[str, Collection[str]]) -> Table:
    """The table of rows, and beside it what another one knows of the defences that are kept.

    Both are of the same episodes. Of a defence that is kept rows say what it does when nobody attacks, and against attacks that it had
    not met (`added`).
    """
    fresh = {key: rows for key, rows in table.cells.items() if key.defence not in kept or key.column.attack in added.get(key.defence, ())}
    parts = [(table, [name for name in table.defences if name not in kept]), (held, [name for name in held.defences if name in kept])]
    defences = in_order({name for _, names in parts for name in names}, table.suite.defences)
    met = {
        column for part, names in parts for i, column in enumerate(part.columns) for state in part.state.values()
        if (state[[part.defences.index(name) for name in names], i] != MISSING).any()
    } | {key.column for key in fresh}  # fmt: skip
    columns = columns_of(met, table.listed)
    shape = len(defences), len(columns), len(table.doses)
    harm = {name: np.full((*shape, len(seeds)), np.nan) for name, seeds in held.seeds.items()}
    state = {name: np.full(shape, MISSING) for name in held.seeds}
    for part, names in parts:
        shared = [column for column in part.columns if column in columns]
        mine = np.ix_([part.defences.index(name) for name in names], [part.columns.index(column) for column in shared])
        here = np.ix_([defences.index(name) for name in names], [columns.index(column) for column in shared])
        for name in held.seeds:
            harm[name][here], state[name][here] = part.harm[name][mine], part.state[name][mine]
    for key in (key for key in fresh if key.defence in kept and key.column in columns):
        at = defences.index(key.defence), columns.index(key.column), key.slot
        cell = table.defences.index(key.defence), table.columns.index(key.column), key.slot
        harm[key.scenario][at], state[key.scenario][at] = table.harm[key.scenario][cell], table.state[key.scenario][cell]
    optimal = {column: any(part.optimal.get(column, False) for part, _ in parts) for column in columns}
    learned = {column: any(part.learned.get(column, False) for part, _ in parts) for column in columns}
    clean = {at: rows for at, rows in held.clean.items() if at[1] in kept} | table.clean
    return dataclasses.replace(
        table, defences=defences, columns=columns, cells=fresh, clean=clean, harm=harm, state=state, optimal=optimal,
        learned=learned, vague=frozenset(key for key in held.vague if key.defence in kept), shared=held.shared,
    )  # fmt: skip
