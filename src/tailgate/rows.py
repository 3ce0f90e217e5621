"""Rows: one JSON object per episode and line, with everything that is needed to play it again. Files that end in .xz are compressed."""

import json
import lzma
from collections.abc import Sequence
from pathlib import Path
from sys import intern
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, create_model

from tailgate.errors import InputError, said, wanted
from tailgate.metrics import METRICS

# What tells one cell from another: rows that differ in one of these are never summed up together.
KEYS = (
    "suite", "scenario", "dose", "knowledge", "defence", "attack", "purpose", "config_hash", "version", "defence_digest", "attack_digest",
)  # fmt: skip

AGAIN = "the command that wrote it makes it whole, given once more"
LARGEST = 8_000_000_000  # bytes of rows in a compressed file
_Text = Annotated[str, Field(strict=True)]
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)] | None
_FIELDS: dict[str, Any] = {
    **{key: (_Text, ...) for key in KEYS}, **{name: (_Number, ...) for name in METRICS},
    "dose": (Annotated[int, Field(strict=True)] | None, ...), "seed": (Annotated[int, Field(strict=True)], ...),
    "status": (Literal["ok", "error", "skipped"], ...), "reason": (_Text, ""), "scenario_file": (_Text, ""), "uses": (list[_Text], ...),
    "learned": (bool, ...), "optimal": (bool, ...),
}  # fmt: skip
_Row = create_model("Row", __config__=ConfigDict(extra="allow"), **_FIELDS)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a JSON Lines file, checked; raises InputError that names the line."""
    try:
        held = path.read_bytes()
        text = (_unpacked(held) if path.suffix == ".xz" else held).decode("utf-8")
    except (EOFError, lzma.LZMAError) as error:
        raise InputError("rows", str(path), f"a readable JSON Lines file ({said(error)}): {AGAIN}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("rows", str(path), f"a readable JSON Lines file ({said(error)})") from None
    rows: list[dict[str, Any]] = []
    lines = text.splitlines()
    for number, line in enumerate(lines, start=1):
        where = f"rows {path}, line {number}"
        try:
            row = json.loads(line)
        except ValueError:
            what = "cut" if number == len(lines) and not text.endswith("\n") else "damaged" if rows else ""
            cut = f"; the file was {what} here: {AGAIN}" if what else ""
            board = ", a row; a board is played again by `tailgate leaderboard check`" if '"format"' in text[:200] else ""
            raise InputError(where, line[:60], f"a JSON object{board or cut}") from None
        try:
            _Row.model_validate(row)
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"])
            shown = first["input"] if isinstance(row, dict) and field in row else None
            raise InputError(f"{where}: {field}", shown, wanted(first)) from None
        if row["status"] == "ok" and row["crashed"] not in (0.0, 1.0):
            raise InputError(f"{where}: crashed", row["crashed"], "0 or 1")
        rows.append({intern(key): intern(value) if type(value) is str else value for key, value in row.items()})  # half the memory
    return rows


def _unpacked(held: bytes) -> bytes:
    """The text of a compressed file, of at most LARGEST bytes: a small file may hold a great many."""
    reader = lzma.LZMADecompressor()
    out = reader.decompress(held, LARGEST + 1)
    if len(out) > LARGEST:
        raise OSError(f"more than {LARGEST} bytes")
    if not reader.eof:
        raise EOFError("the file was cut")
    return out


def packed(rows: Sequence[dict[str, Any]], path: Path) -> bytes:
    """What a file of rows holds: JSON Lines, compressed where its name ends in .xz. The same rows give the same bytes."""
    return lzma.compress(encode(rows), preset=2) if path.suffix == ".xz" else encode(rows)


def encode(rows: Sequence[dict[str, Any]]) -> bytes:
    """Rows as JSON Lines; NaN and infinity are refused."""
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows).encode()
