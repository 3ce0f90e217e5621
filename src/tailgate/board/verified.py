"""Verified entries of a board: reports of `leaderboard verify` in its folder say how many rows came out equal."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from tailgate.core.schema import read_model

from .files import amended
from .schema import Count, Data


class Again(BaseModel):
    """The verdicts on those rows of one defence that were asked for."""

    model_config = ConfigDict(strict=True)
    defence: str
    verified: Count
    differs: Count
    unchecked: Count

    @property
    def asked(self) -> int:
        return self.verified + self.differs + self.unchecked


class File(BaseModel):
    """A file of rows that was looked into, by its SHA-256."""

    model_config = ConfigDict(strict=True)
    file: str
    entries: list[Again]


class Report(BaseModel):
    """The part of a report of `leaderboard verify` that a board needs."""

    model_config = ConfigDict(strict=True)
    format: Literal["tailgate-verify-1"]
    files: list[File]


def digest(path: Path) -> str:
    """Return the SHA-256 of a file of rows."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_report(path: Path) -> Report:
    """Return a report. Raises InputError that names the file for anything else than one of `leaderboard verify`."""
    return read_model(Report, path, "verified", "leaderboard verify")


def with_verified(board: Data, folder: Path, files: Mapping[str, Mapping[str, int]]) -> Data:
    """Return the board with `verified` in each entry: {"rows", "verified", "differs", "unchecked"}, or null where nobody has looked.

    files: SHA-256 of each file of rows that the board is made of, and how many rows of each defence it has. A report on any other file,
    or on one that has changed since, does not count. If two reports are on one file, the one counts that found a difference, then the one
    that asked for more rows. A defence has figures only if rows of all its files were played again.
    """
    looked: dict[tuple[str, str], Again] = {}
    for path in sorted(folder.glob("*.json")):
        for file in read_report(path).files:
            for again in file.entries:
                key = file.file, again.defence
                if key not in looked or (bool(again.differs), again.asked) > (bool(looked[key].differs), looked[key].asked):
                    looked[key] = again

    changes: dict[str, Data] = {}
    for name in (entry["defence"] for entry in board["entries"] if "verified" not in entry):
        mine = {(sha, name): rows[name] for sha, rows in files.items() if name in rows}
        counts = None
        if set(mine) <= set(looked):
            verdicts = {key: sum(getattr(looked[place], key) for place in mine) for key in ("verified", "differs", "unchecked")}
            counts = {"rows": sum(mine.values())} | verdicts
        changes[name] = {"verified": counts}
    return amended(board, changes)
