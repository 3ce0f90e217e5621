"""A board: every figure of a suite as JSON, a pure function of rows and the suite. docs/scoring.md says why each is made as it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence

from tailgate.base.errors import InputError
from tailgate.base.version import VERSION
from tailgate.core.scenario import Suite
from tailgate.core.threat import KNOWLEDGE
from tailgate.evaluation.attack_list import Admitted, standing, taken_back
from tailgate.evaluation.rows import Row
from tailgate.studies.dose import CRITICAL
from tailgate.training.adaptive import asked_of

from .cells import cells_of, ordered
from .damage import SKIPPED, Attacker, Table, tabulate
from .entry import Levels, curves, entry_of, extended, middle
from .ranks import rank
from .schema import FORMAT, Data
from .searched import found_for
from .update import KeptPart, kept_part
from .worst import Worst


def score(
    rows: Iterable[Row], suite: Suite, *, attacks: Sequence[Admitted] | None = None, alpha: float = 0.05, require_adaptive: bool = True,
    board: Data | None = None, shared: Sequence[str] = (), searches: Sequence[Data] = (), provisional: Collection[str] = (),
) -> Data:  # fmt: skip
    """Return the board of a suite from its rows, in the format of decision record 14. The order of the rows changes nothing.

    Parameters
    ----------
    attacks
        Attacks that joined the suite's after it was published (`attack_list.read`); every defence has to have met these too.
    require_adaptive
        Rank only defences that met an attack which was trained against them.
    board
        An earlier board of the suite: its other entries stay (`update.kept_part`), and ranks are made of both.
    shared
        Attacks on no list that every defence has to have met (`cells.shared_of`).
    searches
        What the standard ensemble found (`searched.searches_in`), where the suite asks for it.
    provisional
        Defences that take a rank although nobody but their author has played them.

    Raises
    ------
    InputError
        For rows that do not belong together, or do not fit the board.
    """
    if not 0.0 < alpha < 1.0:
        raise InputError("alpha", alpha, "a number above 0 and below 1")
    lines, rows = standing(attacks or ()), list(rows)
    for row in rows:
        line = lines.get(row["attack"])
        if line is not None and row["attack_digest"] != line.digest:
            raise InputError(f"rows of {row['attack']}: attack_digest", row["attack_digest"], f"{line.digest}, as it was admitted")
    joining = [text for text, line in lines.items() if line is not None]
    table = tabulate(rows, suite, joining, taken_back(attacks or ()))
    digests = {text: line.digest for text, line in lines.items() if line is not None}
    dose = middle(suite)
    held = None if board is None else kept_part(table, board, suite, alpha, require_adaptive, digests)
    table = dataclasses.replace(table, shared=frozenset(shared)) if held is None else held.table
    kept = {} if held is None else held.entries
    origins = _origins(table)
    levels: Levels = {d: {k: Worst(table, d, k, alpha) for k in KNOWLEDGE} for d in table.defences}
    asked = asked_of(suite) if require_adaptive and suite.adaptive else [] if require_adaptive else None
    added: dict[str, frozenset[str]] = {} if held is None else held.added
    trained = {} if board is None else {a["attack"]: a["trained_on"] for a in board["attacks"] if a.get("trained_on")}
    fresh, earlier = ({line["defence"]: line for line in lines} for lines in (searches, held.board.get("searches", ()) if held else ()))
    merged = {d: (earlier if d in kept else fresh).get(d) for d in table.defences}  # an entry that stays keeps its own
    searches = [line for line in merged.values() if line is not None]
    trained = found_for(searches, table.listed) | trained | {attack: str(origin["defence"]) for attack, origin in origins.items()}
    found = [
        extended(kept[d], table, levels[d], dose, trained, added[d]) if d in added else dict(kept[d]) if d in kept
        else entry_of(table, d, levels[d], dose, origins, trained | _found(merged[d]), asked, searches, provisional) for d in table.defences
    ]  # fmt: skip
    cells = ordered([*cells_of(table), *(held.cells if held else ())], table)
    return {
        "format": FORMAT, "suite": _suite(table, alpha) | {"require_adaptive": require_adaptive},
        "attacks": _attacks(table, lines, trained, cells, held), "entries": found, "cells": cells,
        "curves": [
            curve for d in table.defences
            for curve in (held.of("curves", d) if held is not None and d in kept and d not in added else curves(levels[d]))
        ],
        "comparisons": rank(found, levels, dose, alpha, held), "detection": None,
    } | {name: held for name, held in (("searches", searches), ("trust", (board or {}).get("trust"))) if held}  # fmt: skip


def _found(line: Data | None) -> dict[str, str]:
    """Return the attacks that were found against one defence, with its name: others may have been found so too."""
    return {} if line is None else found_for([line])


def _suite(table: Table, alpha: float) -> Data:
    suite = table.suite
    return {
        "name": suite.name, "about": suite.about, "version": VERSION, "hash": suite.hash, "doses": list(table.doses),
        "shown": {str(dose): why for dose, why in suite.shown.items()}, "limit": CRITICAL, "bound": suite.bound, "alpha": alpha,
        "scenarios": [
            {"name": name, "about": scenario.about, "robustness": name in table.robust(), "hash": scenario.config_hash}
            for name, scenario in table.scenarios.items()
        ],
        "episodes": max(len(seeds) for seeds in table.seeds.values()), "purpose": table.purpose, "beacon": table.beacon, "rows": table.rows,
    } | {name: value for name, value in (("progress", suite.progress), ("measures", suite.measures)) if value}  # fmt: skip


def _attacks(
    table: Table, lines: dict[str, Admitted | None], trained: dict[str, str], cells: list[Data], held: KeptPart | None
) -> list[Data]:  # fmt: skip
    out = []
    told = {} if held is None else {attack["attack"]: attack for attack in held.board["attacks"]}
    files = {key.attacker.attack: rows[0]["attack_digest"] for key, rows in table.cells.items()}
    for i, attacker in enumerate(table.attackers):
        line = lines.get(attacker.attack)
        left_out = [name for name in table.scenarios if (table.state[name][:, i] == SKIPPED).all()]
        notes = [f"left out on {', '.join(left_out)}: {_reason(cells, attacker)}"] if left_out else []
        notes += ["a computed optimum: shown, and not counted"] if table.optimal[attacker] else []
        notes += ["taken back by an erratum: not counted"] if attacker.attack in table.withdrawn else []
        out.append({
            "attack": attacker.attack, "knowledge": attacker.knowledge,
            "learned": table.learned[attacker], "optimal": table.optimal[attacker],
            "trained_on": trained.get(attacker.attack),
            "digest": told.get(attacker.attack, {}).get("digest") or files.get(attacker.attack) or None,
            "admitted": None if line is None else line.as_data(), "note": "; ".join(notes), "withdrawn": attacker.attack in table.withdrawn,
        } | ({"shared": True} if attacker.attack in table.shared.difference(table.listed) else {}))  # fmt: skip
    return out


def _reason(cells: list[Data], attacker: Attacker) -> str:
    """Return why an attack was left out."""
    mine = (c for c in cells if (c["attack"], c["knowledge"]) == attacker)
    return next((str(c["reason"]) for c in mine if c["reason"] and not c["failed"]), "")


def _origins(table: Table) -> dict[str, Row]:
    """Return how each learned attack of the table was trained: the rows' `trained`."""
    found = ((key.attacker.attack, table.cells[key][0].get("trained")) for key in sorted(table.cells))
    return {attack: origin for attack, origin in found if isinstance(origin, dict)}
