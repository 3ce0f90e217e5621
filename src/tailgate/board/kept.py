"""What a board has beside the figures of its rows, kept when it is scored again: detection, stealth impact, cells that were checked."""

from __future__ import annotations

from typing import Any

from .cells import place_of
from .check import compared
from .detect import LINES
from .files import amended, read_board
from .schema import Board

Data = dict[str, Any]
SAME = ("hash", "version", "beacon")  # of the suite: what its episodes depend on


def with_kept(board: Data, old: Data) -> Data:
    """The board with `detection`, `stealth` and `checked` of an older one, of entries whose cells came out as they stand there.

    Cells may have come in since. Nothing is kept of a board of another suite, version or round. Raises InputError for an older one that is
    not of the format.
    """
    before = read_board(old, "board.json")
    if any(old["suite"].get(key) != board["suite"][key] for key in SAME):
        return board
    kept, fields = _unchanged(board, before), dict[str, Data]()
    for entry in (entry for entry in old["entries"] if entry["defence"] in kept):
        checked = entry.get("checked")
        again = {"checked": checked | {"cells": kept[entry["defence"]]}} if checked else {}
        fields[entry["defence"]] = {"stealth": entry.get("stealth")} | again
    return amended(board, fields, detection=_of(old.get("detection"), kept))


def _unchanged(board: Data, old: Board) -> dict[str, int]:
    """Defences all of whose old cells are on the board as they were, and how many cells they have there."""
    cells = {place_of(cell): cell for cell in board["cells"]}
    moved = {part.defence for part in old.cells if (here := cells.get(place_of(part.model_dump()))) is None or compared(part, here).why}
    names = [entry.defence for entry in old.entries if entry.defence not in moved]
    counts = {name: sum(cell["defence"] == name for cell in board["cells"]) for name in names}
    return {name: n for name, n in counts.items() if n}


def _of(detection: Data | None, defences: dict[str, int]) -> Data | None:
    """The figures of some defences; None where nothing is left."""
    if not detection:
        return None
    parts = {key: [line for line in detection[key] if line["defence"] in defences] for key in LINES if key in detection}
    return detection | parts if any(parts.values()) else None
