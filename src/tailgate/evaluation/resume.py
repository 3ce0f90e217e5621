"""Rows of a long run, in parts: finished parts are kept next to the output until all are done, so that an interrupted run resumes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.base.files import remove, set_aside, sweep, writable_directory, write_atomic
from tailgate.base.locks import alone
from tailgate.evaluation.rows import encode, packed, read_rows

Rows = list[dict[str, Any]]
Wanted = Sequence[tuple[str, int]]  # cell and seed of each row of a part, in order


def complete(
    names: Sequence[str], pieces: Mapping[str, Wanted], out: Path | None, play: Callable[[list[int]], Generator[tuple[int, Rows]]],
    progress: Callable[[int, int], None] | None,
) -> Rows:  # fmt: skip
    """Play the parts of a run and return their rows in the order of `names`.

    With `out`, parts that an interrupted run finished are not played again, and the rows are written to it.

    Parameters
    ----------
    names : of the parts
    pieces : cell and seed of each row, by name
    play : plays the parts with these indices; yields (position in the indices, rows) as they finish
    progress : called with the numbers of finished and of all parts

    Raises
    ------
    InputError
        For rows of another cell or seed: a component was changed while it played, or another process has another version of it.
    """
    with contextlib.nullcontext() if out is None else Parts(out) as parts:
        done = {} if parts is None else parts.finished(pieces)
        missing = [i for i, name in enumerate(names) if name not in done]
        with contextlib.closing(play(missing)) as played:
            for position, rows in played:
                name = names[missing[position]]
                _check(rows, pieces[name])
                done[name] = rows
                if parts is not None:
                    parts.put(name, rows)
                if progress is not None:
                    progress(len(done), len(names))
        rows = [row for name in names for row in done[name]]
        if parts is not None:
            parts.finish(rows, pieces)
    return rows


def _check(rows: Rows, wanted: Wanted) -> None:
    """Raise InputError for rows that are not those of their cell and seeds."""
    for row, (cell, seed) in zip(rows, wanted, strict=True):
        if (row.get("cell"), row["seed"]) != (cell, seed):
            found = f"cell {row.get('cell')}, seed {row['seed']}"
            raise InputError(f"row of {row.get('defence')}", found, f"cell {cell}, seed {seed}: all processes with the same files")


class Parts:
    """The parts of a run that writes to `out`; as a context manager it locks `out` for this process.

    A part has a name. It is finished when all its rows exist and none failed.
    """

    def __init__(self, out: Path) -> None:
        if out.is_dir():
            raise InputError("out", str(out), "a file, not a directory")
        self.out, self.folder = out, out.with_name(f".{out.name}.parts")
        self.lock = alone(out)

    def __enter__(self) -> Parts:
        self.lock.__enter__()
        try:
            if self.folder.is_symlink():
                raise InputError("out", str(self.folder), "a folder that is no link")
            writable_directory(self.folder, asked=self.out)
            for place in (self.out, self.folder):
                sweep(place)
        except BaseException:
            self.lock.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.lock.__exit__(None, None, None)

    def finished(self, pieces: Mapping[str, Wanted]) -> dict[str, Rows]:
        """Return the rows of parts that an earlier run finished, by name, from part files or from the output."""
        before: dict[tuple[str, int], dict[str, Any]] = {}
        for row in self._read(self.out):
            before[str(row.get("cell")), row["seed"]] = row
        found = {}
        for name, wanted in pieces.items():
            for rows in (self._read(self._part(name)), [before[key] for key in wanted if key in before]):
                if [(row.get("cell"), row["seed"]) for row in rows] == list(wanted) and all(row["status"] != "error" for row in rows):
                    found[name] = rows
                    break
        return found

    def put(self, name: str, rows: Rows) -> None:
        """Write the rows of a part."""
        write_atomic(self._part(name), encode(rows))

    def finish(self, rows: Rows, pieces: Mapping[str, Wanted]) -> None:
        """Write all rows and remove the parts; an output that holds other rows is renamed first, because it is a result."""
        if self.out.is_file():
            cells = {cell for wanted in pieces.values() for cell, _ in wanted}
            try:
                held = {row.get("cell") for row in read_rows(self.out)}
            except InputError:
                held = {None}
            if not held <= cells:
                set_aside(self.out)
        write_atomic(self.out, packed(rows, self.out))
        for name in pieces:
            remove(self._part(name))
        with contextlib.suppress(OSError):  # other files are in it
            self.folder.rmdir()

    def _part(self, name: str) -> Path:
        return self.folder / f"{name}.jsonl"

    def _read(self, path: Path) -> Rows:
        """Return the rows of a file; none if it is missing or damaged, so that its cells are played again."""
        try:
            return read_rows(path) if path.is_file() else []
        except InputError:
            return []
