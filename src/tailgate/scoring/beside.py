"""Rows of some defences beside the cells that a board has of the others: what is played anew is what changed, and not the whole board."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from tailgate.errors import InputError
from tailgate.scenario import Suite

from .cells import cells_of, joined, place_of, table_of
from .damage import Table

Data = dict[str, Any]
SAME = ("n", "failed", "damage", "decisions")  # of a cell that was played again


@dataclass(frozen=True)
class Beside:
    """What a board keeps: its entries that were not played whole, their cells, and the table that these and the rows make together."""

    board: Data
    table: Table
    entries: dict[str, Data]  # by defence
    cells: list[Data]

    def of(self, part: str, defence: str) -> list[Data]:
        """The board's lines of a defence: of `curves`, say."""
        return [line for line in self.board[part] if line["defence"] == defence]


def silent(cells: list[Data], dose: int | None) -> list[str]:
    """Defences of which nobody knows which episodes came to damage in some cell at a dose that ranks depend on."""
    counted = (c for c in cells if c["dose"] == dose and c["knowledge"] == "black" and not c["optimal"])
    some = (c for c in counted if c.get("hits") is None and c["damage"] and 0.0 < c["damage"]["value"] < 1.0)
    return list(dict.fromkeys(c["defence"] for c in some))


def beside(table: Table, board: Data, suite: Suite, alpha: float) -> Beside:
    """A defence whose rows cover all cells that the board has of it is made of rows. Of one whose rows cover some, the board's entry stays,
    and these cells have to come out equal: which of their episodes came to damage is then known, if it was not. Without rows it stays too.

    board: JSON that `read_board` has read. Raises InputError for a board of another suite, round, purpose or alpha, for one whose list of
    attacks is another, for rows that differ from it, and for new cells of a defence that leave out some of its old ones.
    """
    for name, mine in (("hash", suite.hash), ("purpose", table.purpose), ("beacon", table.beacon), ("alpha", alpha)):
        if (said := board["suite"].get(name) or "") != mine:
            raise InputError(f"board: suite.{name}", said, f"{mine!r}, as the rows have it")
    held = table_of(board, suite)
    new = {place_of(cell): cell for cell in cells_of(table)}
    entries: dict[str, Data] = {}
    cells: list[Data] = []
    for entry in board["entries"]:
        name = entry["defence"]
        old = {place_of(cell): cell for cell in board["cells"] if cell["defence"] == name}
        again = {place: cell for place, cell in new.items() if cell["defence"] == name}
        lost = [place for place in old if place not in again]
        if not lost and again:
            continue
        if more := [place for place in again if place not in old]:
            raise InputError(f"rows of {name}", _said(more), f"rows of all {len(old)} cells that the board has, {_said(lost)} among them")
        for place, cell in again.items():
            if off := [field for field in SAME if old[place].get(field) is not None and old[place][field] != cell[field]]:
                raise InputError(f"rows of {_said([place])}: {off[0]}", cell[off[0]], f"{old[place][off[0]]}, as the board has it")
        entries[name] = entry
        cells += [cell | {"hits": again[place]["hits"]} if place in again else cell for place, cell in old.items()]
    both = joined(table, held, entries)
    own = sum(len(rows) for rows in both.cells.values())
    return Beside(board, dataclasses.replace(both, rows=own + sum(len(held.seeds[c["scenario"]]) for c in cells)), entries, cells)


def _said(places: list[tuple[Any, ...]]) -> str:
    scenario, dose, defence, attack, _ = places[0]
    more = f", and {len(places) - 1} more" if len(places) > 1 else ""
    return f"{scenario}, {defence}, {attack}, dose {dose}{more}"
