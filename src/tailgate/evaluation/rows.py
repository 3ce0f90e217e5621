"""Rows: one JSON object per episode and line, with everything needed to play it again. Files named *.xz are compressed."""

from __future__ import annotations

import contextlib
import json
import lzma
from collections.abc import Sequence
from pathlib import Path
from sys import intern
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, create_model

from tailgate.base.errors import InputError, said, wanted
from tailgate.base.reading import lines_of, parse_json
from tailgate.play.metrics import METRICS

if TYPE_CHECKING:
    from tailgate.evaluation.frame import Rows

# The columns that identify a cell: rows that differ in one of them are never summarised together.
KEYS = (
    "suite", "scenario", "dose", "knowledge", "defence", "attack", "purpose", "config_hash", "version", "defence_digest", "attack_digest",
)  # fmt: skip

IF_ANY = ("beacon", "versions", "uses")  # columns that older rows may lack; they tell cells apart as well

Row = dict[str, Any]  # one episode: KEYS, every metric, and all that is needed to play it again
CLEAN = "none"  # the attack that does nothing, and the defence that does nothing
AGAIN = "run the command that wrote it again to complete it"
_Text = Annotated[str, Field(strict=True)]
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)] | None
_FIELDS: dict[str, Any] = {
    **{key: (_Text, ...) for key in KEYS}, **{name: (_Number, ...) for name in METRICS},
    "dose": (Annotated[int, Field(strict=True)] | None, ...), "seed": (Annotated[int, Field(strict=True)], ...),
    "status": (Literal["ok", "error", "skipped"], ...), "reason": (_Text, ""), "scenario_file": (_Text, ""), "uses": (list[_Text], ...),
    "learned": (bool, ...), "optimal": (bool, ...), "metrics": (list[_Text], []),
}  # fmt: skip
_Row = create_model("Row", __config__=ConfigDict(extra="allow"), **_FIELDS)


def read_rows(path: Path | str) -> Rows:
    """Read and check the rows of a JSON Lines file; raise InputError that names the line."""
    from tailgate.evaluation.frame import Rows  # which needs the columns of this module

    path = Path(path)
    rows: list[Row] = []
    lines, number, ahead = lines_of(path), 1, b""
    try:
        line = next(lines, b"")
        while line:
            ahead = next(lines, b"")
            damage = "cut" if not ahead and not line.endswith(b"\n") else "damaged" if rows else ""
            rows.append(_row(line, f"rows {path}, line {number}", damage, number == 1))
            line, number = ahead, number + 1
    except (EOFError, lzma.LZMAError) as error:
        raise InputError("rows", str(path), f"a readable JSON Lines file ({said(error)}): {AGAIN}") from None
    except OSError as error:
        raise InputError("rows", str(path), f"a readable JSON Lines file ({said(error)})") from None
    return Rows(rows)


def _row(line: bytes, where: str, damage: str, first: bool) -> Row:
    """Check and return one line. `damage` says what happened to the file if the line is not JSON; `first`: it is the first line."""
    try:
        row = parse_json(line)
    except ValueError as error:
        loose: object = None
        with contextlib.suppress(ValueError):
            loose = parse_json(line, strict=False)
        if loose is not None:
            _check(loose, where)  # reports NaN and similar values with their field
        shown = line[:60].decode("utf-8", "replace").rstrip("\n")
        cut = f"; the file was {damage} here: {AGAIN}" if damage else ""
        why = "" if isinstance(error, json.JSONDecodeError) else f" ({error})"
        a_board = first and (b'"format"' in line[:200] or shown == "{")
        board = ", a row; a board is played again by `tailgate leaderboard check`" if a_board else ""
        raise InputError(where, shown, f"a JSON object{why}{board or cut}") from None
    _check(row, where)
    if row["status"] == "ok" and row["crashed"] not in (0.0, 1.0):
        raise InputError(f"{where}: crashed", row["crashed"], "0 or 1")
    for name in row.get("metrics", ()):
        if name not in row or not isinstance(row[name], int | float | None) or isinstance(row[name], bool):
            raise InputError(f"{where}: {name}", row.get(name), "a number or null: it is one of the row's metrics")
    return {intern(key): intern(value) if type(value) is str else value for key, value in row.items()}  # halves the memory


def _check(row: object, where: str) -> None:
    """Raise InputError unless the fields of a row are valid."""
    try:
        _Row.model_validate(row)
    except ValidationError as error:
        found = error.errors()[0]
        field = ".".join(str(part) for part in found["loc"])
        held = found["input"] if isinstance(row, dict) and field in row else None
        raise InputError(f"{where}: {field}", held, wanted(found)) from None


def packed(rows: Sequence[Row], path: Path) -> bytes:
    """Return the content of a file of rows: JSON Lines, compressed if it is named *.xz. Equal rows give equal bytes."""
    return lzma.compress(encode(rows), preset=2) if path.suffix == ".xz" else encode(rows)


def encode(rows: Sequence[Row]) -> bytes:
    """Return rows as JSON Lines; refuse NaN and infinity."""
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows).encode()
