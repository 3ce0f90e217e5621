"""Update of a board: score the defences whose rows changed, and keep what the board says of the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tailgate.base.errors import InputError
from tailgate.base.version import plays_as
from tailgate.core.scenario import Suite
from tailgate.core.threat import KNOWLEDGE
from tailgate.evaluation.rows import CLEAN

from .cells import cell_key, cells_of, compared, joined, table_of
from .damage import Attacker, Table
from .files import amended, read_board
from .schema import DETECTION, Board, Data
from .worst import Worst

SAME = ("n", "failed", "damage", "hits", "decisions")  # of a cell that was played again


@dataclass(frozen=True)
class KeptPart:
    """The part of a board that stays: entries that were not played whole, their cells, and the table of these and the rows."""

    board: Data
    table: Table
    entries: dict[str, Data]  # by defence
    cells: list[Data]
    before: Table  # of the board alone
    added: dict[str, frozenset[str]]  # attacks that entries which stay have met in rows, and had not met
    steady: frozenset[str]  # defences that met no more than they had: a comparison of two of them holds

    def of(self, part: str, defence: str) -> list[Data]:
        """Return the board's lines of a defence: of `curves`, say."""
        return [line for line in self.board[part] if line["defence"] == defence]


def kept_part(table: Table, board: Data, suite: Suite, alpha: float, require_adaptive: bool, digests: Mapping[str, str]) -> KeptPart:
    """Return what stays of a board when a table of rows is added.

    A defence whose rows cover all cells that the board has of it is made of rows. Others stay as the board has them, or meet in rows
    attacks that they had not met. Cells that both have must come out equal; their damaged episodes are then known, if they were not.

    Parameters
    ----------
    board
        JSON that `read_board` has read.
    digests
        Digests of the files of attacks that joined the list.

    Raises
    ------
    InputError
        For a board of another suite, round, purpose, alpha, list of attacks or ranking rule; for rows that differ from it; for new cells
        of an attack that a defence has met already; and if an entry that stays would change by anything but its own rows.
    """
    said = {"beacon": "", "require_adaptive": True} | {key: value for key, value in board["suite"].items() if value is not None}
    mine = {"hash": suite.hash, "purpose": table.purpose, "beacon": table.beacon, "alpha": alpha, "require_adaptive": require_adaptive}
    for name, value in mine.items():
        if said.get(name) != value:
            raise InputError(f"board: suite.{name}", said.get(name), f"{value!r}, as the rows have it")
    for attack in board["attacks"]:
        if (line := attack.get("admitted")) and (digest := digests.get(attack["attack"], line["digest"])) != line["digest"]:
            raise InputError(f"board: digest of {attack['attack']}", line["digest"], f"{digest}, as on the list: play the whole suite")
    new = {cell_key(cell): cell for cell in cells_of(table)}
    hits = {key: cell["hits"] for key, cell in new.items()}
    held = table_of(board | {"cells": [cell | {"hits": hits.get(cell_key(cell), cell.get("hits"))} for cell in board["cells"]]}, suite)
    for name, seeds in held.seeds.items():
        if table.seeds.get(name, ()) != seeds:
            raise InputError(f"rows of {name}: seeds", f"{len(table.seeds.get(name, ()))} of them", f"the board's, which are {len(seeds)}")
    if other := ({*held.listed} - held.withdrawn) ^ ({*held.listed} & {*table.listed} - table.withdrawn):
        raise InputError("board: attacks", min(other), "the list of attacks that is here: play the whole suite")
    files = {key.attacker.attack: rows[0]["attack_digest"] for key, rows in table.cells.items()}
    entries: dict[str, Data] = {}
    cells: list[Data] = []
    added: dict[str, frozenset[str]] = {}
    steady: set[str] = set()
    for entry in board["entries"]:
        name = entry["defence"]
        old = {cell_key(cell): cell for cell in board["cells"] if cell["defence"] == name}
        again = {key: cell for key, cell in new.items() if cell["defence"] == name}
        for key in (key for key in again if key in old):
            if off := [field for field in SAME if old[key].get(field) is not None and old[key][field] != again[key][field]]:
                wanted = f"{old[key][off[0]]}, as the board has it: else play the whole suite"
                raise InputError(f"rows of {_said([key])}: {off[0]}", again[key][off[0]], wanted)
        steady |= {name} if again.keys() <= old.keys() else set()
        lost = [key for key, cell in old.items() if key not in again and cell["attack"] not in held.withdrawn]
        if again and not lost:
            continue
        met, more = {cell["attack"] for cell in old.values()}, [key for key in again if key not in old]
        if late := [key for key in more if key[3] in met]:
            raise InputError(f"rows of {name}", _said(late), f"rows of all {len(old)} cells that the board has, {_said(lost)} among them")
        entries[name] = entry
        if more:
            added[name] = frozenset(key[3] for key in more)
        cells += [cell | {"hits": hits[key]} if key in again else cell for key, cell in old.items()]
    if CLEAN not in table.defences and CLEAN in held.defences and not entries.keys() >= {*table.defences}:
        raise InputError("rows: defence", list(table.defences), f"{CLEAN} too: what a defence costs is measured against it")
    shared = {cell["attack"] for cell in cells} & {cell["attack"] for cell in new.values() if cell["defence"] not in entries}
    for attack in (attack for attack in board["attacks"] if attack["attack"] in shared and attack.get("digest")):
        if (digest := files[attack["attack"]]) != attack["digest"]:
            raise InputError(f"rows of {attack['attack']}: attack_digest", digest, f"{attack['digest']}, which the others have met")
    both = joined(table, held, entries, added)
    for name in entries:
        before, now = _counted(held, name), _counted(both, name)
        if odd := {pair for pair in before ^ now if pair in before or pair[1].attack not in added.get(name, ())}:
            where, attacker, _ = min(odd)
            wanted = f"an attack that counts against {name} as before: play the whole suite"
            raise InputError(f"rows of {attacker.attack} on {where}", "played", wanted)
    own = sum(len(rows) for rows in both.cells.values())
    whole = dataclasses.replace(both, rows=own + sum(len(held.seeds[c["scenario"]]) for c in cells))
    return KeptPart(board, whole, entries, cells, held, added, frozenset(steady))


def _counted(table: Table, defence: str) -> set[tuple[str, Attacker, bool]]:
    """Return scenario and attacker of every attack that counts against a defence, and if its figures are whole."""
    if defence not in table.defences:
        return set()
    worst = Worst(table, defence, KNOWLEDGE[-1], 0.05)
    return {(name, table.attackers[i], (name, i) in worst.lost) for name, i in worst.pairs}


def _said(keys: list[tuple[Any, ...]]) -> str:
    """Return the first cell in words, and how many more there are."""
    scenario, dose, defence, attack, _ = keys[0]
    more = f", and {len(keys) - 1} more" if len(keys) > 1 else ""
    return f"{scenario}, {defence}, {attack}, dose {dose}{more}"


def with_kept(board: Data, old: Data) -> Data:
    """Return the board with `detection`, `stealth` and `checked` of an older one, for entries whose cells came out as they are there.

    Cells may have come in since. Nothing is kept of a board of another suite, version or round. Raises InputError for an older one that is
    not of the format.
    """
    before = read_board(old, "board.json")
    was, now = ((suite.get("hash"), plays_as(suite.get("version")), suite.get("beacon")) for suite in (old["suite"], board["suite"]))
    if was != now:
        return board
    kept, fields = _unchanged(board, before), dict[str, Data]()
    for entry in (entry for entry in old["entries"] if entry["defence"] in kept):
        checked = entry.get("checked")
        again = {"checked": checked | {"cells": kept[entry["defence"]]}} if checked else {}
        fields[entry["defence"]] = {"stealth": entry.get("stealth")} | again
    return amended(board, fields, detection=_detection_of(old.get("detection"), kept))


def _unchanged(board: Data, old: Board) -> dict[str, int]:
    """Return defences whose old cells are all on the board as they were, and how many cells they have there."""
    cells = {cell_key(cell): cell for cell in board["cells"]}
    moved = {part.defence for part in old.cells if (here := cells.get(cell_key(part.model_dump()))) is None or compared(part, here).why}
    names = [entry.defence for entry in old.entries if entry.defence not in moved]
    counts = {name: sum(cell["defence"] == name for cell in board["cells"]) for name in names}
    return {name: n for name, n in counts.items() if n}


def _detection_of(detection: Data | None, defences: dict[str, int]) -> Data | None:
    """Return the figures of some defences; None where nothing is left."""
    if not detection:
        return None
    parts = {key: [line for line in detection[key] if line["defence"] in defences] for key in DETECTION if key in detection}
    return detection | parts if any(parts.values()) else None
