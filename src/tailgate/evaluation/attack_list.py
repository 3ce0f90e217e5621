"""The list of attacks that were admitted after a suite was published: results/SUITE/attacks.jsonl, which only ever grows.

A line holds the hash of the line before it, and a hash of itself. A line that was changed, moved or removed between others is refused.
The hashes have no key: who changes a line on purpose can make them again, which the repository's history shows.
A try that failed is a line too. A wrong attack stays, and a later line, an erratum, takes it back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date as day
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError, said
from tailgate.base.files import write_atomic
from tailgate.base.reading import parse_json, read_bytes
from tailgate.core.scenario import Suite, config_path, list_suites, load_suite
from tailgate.core.schema import build


@dataclass(frozen=True)
class Admitted:
    """A line of the list: an attack that was admitted, or was tried and refused, or, with a reason in `erratum`, is taken back."""

    attack: str
    digest: str  # of the file that it comes from; empty for a registered one
    knowledge: str
    date: str  # YYYY-MM-DD
    evidence: tuple[dict[str, Any], ...] = ()  # the paired tests: defence, scenario, dose, worst, only_new, only_worst, p, adjusted, level
    refused: bool = False
    erratum: str = ""
    before: str = ""  # hash of the line before
    hash: str = ""  # of this line
    beacon: str = ""  # the round of the seeds that it was tried on; empty: the public ones, on which it may have been tuned

    def as_data(self) -> dict[str, Any]:
        """Return JSON data of the line; lines from before there were beacons have none."""
        data = dataclasses.asdict(self) | {"evidence": list(self.evidence)}
        return data if self.beacon else {key: value for key, value in data.items() if key != "beacon"}

    def sealed(self, before: str) -> Admitted:
        """Return the same line behind another, with the hashes that it has there."""
        bare = dataclasses.replace(self, before=before, hash="")
        text = json.dumps(bare.as_data(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return dataclasses.replace(bare, hash=hashlib.blake2b(text.encode(), digest_size=16).hexdigest())


def read(path: Path) -> list[Admitted]:
    """Return the lines, checked; none where there is no file. Raises InputError that names the first line that was changed."""
    if not path.is_file():
        return []
    out: list[Admitted] = []
    try:
        lines = read_bytes(path).splitlines()
    except OSError as error:
        raise InputError(path.name, str(path), f"a readable JSON Lines file ({said(error)})") from None
    for number, line in enumerate(lines, start=1):
        where, shown = f"{path.name}, line {number}", line[:60].decode("utf-8", "replace")
        try:
            data = parse_json(line)
        except ValueError as error:
            raise InputError(where, shown, f"a JSON object ({error})") from None
        if not isinstance(data, dict):
            raise InputError(where, shown, "a JSON object")
        held = build(Admitted, data, where)
        if held.sealed(out[-1].hash if out else "") != held:
            raise InputError(where, held.attack, "the line as it was written, behind the one that was before it")
        out.append(held)
    return out


def published(suite: Suite) -> Path | None:
    """Return the list of a suite of the package, which holds where no folder of boards has one; None for a suite that has none."""
    if suite.name not in list_suites():
        return None
    path = config_path("suites", suite.name, "suite").with_suffix(".attacks.jsonl")
    return path if path.is_file() and load_suite(suite.name).hash == suite.hash else None


def list_of(suite: Suite, path: Path | None = None) -> list[Admitted]:
    """Return the lines of a folder's list, else of the package's."""
    if path is not None and path.is_file():
        return read(path)
    shipped = published(suite)
    return [] if shipped is None else read(shipped)


def attacks_of(suite: Suite, path: Path | None = None) -> tuple[str, ...]:
    """Return the attacks of a suite, and those that have joined them."""
    joined = (text for text, line in standing(list_of(suite, path)).items() if line is not None)
    return tuple(dict.fromkeys([*suite.attacks, *joined]))


def append(path: Path, line: Admitted) -> Admitted:
    """Put a line at the end; the others are not touched. Returns it with its hashes."""
    try:
        day.fromisoformat(line.date)
    except ValueError:
        raise InputError("date", line.date, "a date, YYYY-MM-DD") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path.parent):
        held = read(path)
        line = line.sealed(held[-1].hash if held else "")
        old = path.read_bytes() if held else b""
        write_atomic(path, old + (json.dumps(line.as_data(), allow_nan=False) + "\n").encode())
    return line


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock a folder: two writers at a time would lose the line of one."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def standing(lines: Sequence[Admitted]) -> dict[str, Admitted | None]:
    """Return the line that holds of each attack of the list, or None where it was refused or the last word is an erratum."""
    return {line.attack: None if line.erratum or line.refused else line for line in lines}


def taken_back(lines: Sequence[Admitted]) -> list[str]:
    """Return attacks whose last line is an erratum: they count nowhere. A refused one is on no list, and counts where it was played."""
    last = {line.attack: line for line in lines}
    return [attack for attack, line in last.items() if line.erratum]


def next_level(lines: Sequence[Admitted], alpha: float) -> float:
    """Return the level of the next try."""
    tries = 1 + sum(not line.erratum for line in lines)
    return alpha / (tries * (tries + 1))
