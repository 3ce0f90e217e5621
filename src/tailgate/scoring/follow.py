"""What follows from the cells of a board: shares of damage decide its rates, critical doses, curves and robustness, without any row."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tailgate.errors import InputError
from tailgate.scenario import Suite, load_scenario
from tailgate.threat import KNOWLEDGE

from .board import curves, middle, of_worst, shown
from .cells import share
from .damage import CLEAN, FAILED, MISSING, PLAYED, SKIPPED, Column, Key, Row, Table, columns_of, doses_of, in_order
from .doses import Worst

Data = dict[str, Any]
CLOSE = 1e-6  # two libraries of special functions may differ in the last digits


def strays(board: Data, suite: Suite) -> list[Data]:
    """Figures that do not follow from the board's cells: `defence` (empty: of the board), `field`, what the `board` says, what is `here`.

    A cell that is missing is one that was not played: an entry with figures or a rank needs all.
    The board has been read by `read_board`; raises InputError for a cell that is there twice.
    """
    table, out = table_of(board, suite), []
    held, slots = board["suite"], shown(table)
    told = {"doses": list(table.doses), "shown": [str(table.doses[slot]) for slot in slots] if suite.shown else [], "bound": suite.bound}
    said = {"doses": held["doses"], "shown": list(held.get("shown", {})), "bound": held.get("bound")}
    out += [_stray("", f"suite.{key}", said[key], told[key]) for key in told if not same(said[key], told[key])]
    for i, cell in enumerate(board["cells"]):
        here = share(_hits(cell), cell["n"])._asdict() if cell["n"] else None
        if not same(cell["damage"], here):
            out.append(_stray(cell["defence"], f"cells[{i}].damage", cell["damage"], here))
    slot = middle(table)
    for entry in board["entries"]:
        name = entry["defence"]
        if name not in table.defences:
            out.append(_stray(name, "cells", 0, "cells of every attack, scenario and dose"))
            continue
        levels: dict[str, Worst] = {k: Worst(table, name, k, held.get("alpha", 0.05)) for k in KNOWLEDGE}
        here = of_worst(table, levels, slot) | {"curves": curves(levels)}
        mine = entry | {"curves": [curve for curve in board["curves"] if curve["defence"] == name]}
        out += [_stray(name, key, mine.get(key), here[key]) for key in here if not same(mine.get(key), here[key])]
        if entry["status"] != "unranked" and (lost := levels["black"].lost):
            where, column = lost[0][0], table.columns[lost[0][1]]
            out.append(_stray(name, "status", entry["status"], f"unranked: not all cells of {column.attack} on {where} are there"))
    return out


def table_of(board: Data, suite: Suite) -> Table:
    """The table that the shares of a board's cells come from; which of the episodes came to damage is not known, and made up."""
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
        hits = np.arange(episodes[key.scenario]) < _hits(cell)
        whole = cell["n"] == len(hits)
        if key.column.attack == CLEAN:
            if whole:
                rows = [{"distance_travelled": 0.0, "crashed": bool(hit)} for hit in hits]
                clean.setdefault((key.scenario, key.defence), rows)
            continue
        at = defences.index(key.defence), columns.index(key.column), key.slot
        state[key.scenario][at] = FAILED if cell["failed"] else PLAYED if whole else SKIPPED
        if whole:
            harm[key.scenario][at] = hits
    marked = {mark: {key.column.attack for key, cell in cells.items() if cell.get(mark)} for mark in ("optimal", "learned")}
    marks = {mark: {column: column.attack in names for column in columns} for mark, names in marked.items()}
    withdrawn = frozenset(a["attack"] for a in board["attacks"] if a.get("withdrawn"))
    return Table(
        suite, places, doses, defences, columns, {name: tuple(range(n)) for name, n in episodes.items()}, {}, clean, harm, state,
        marks["optimal"], marks["learned"], tuple(dict.fromkeys(listed)), withdrawn, board["suite"].get("purpose", ""),
        board["suite"].get("beacon") or "", 0,
    )  # fmt: skip


def same(a: Any, b: Any) -> bool:
    """Whether two pieces of JSON say the same, numbers to six digits."""
    if isinstance(a, dict) and isinstance(b, dict):
        return all(same(a.get(key), b.get(key)) for key in {*a, *b})
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, int | float) and isinstance(b, int | float) and not isinstance(a, bool) and not isinstance(b, bool):
        return math.isclose(a, b, rel_tol=CLOSE, abs_tol=CLOSE)
    return bool(a == b)


def _hits(cell: Data) -> int:
    return round(cell["damage"]["value"] * cell["n"]) if cell["damage"] else 0


def _stray(defence: str, field: str, board: Any, here: Any) -> Data:
    return {"defence": defence, "field": field, "board": board, "here": here}
