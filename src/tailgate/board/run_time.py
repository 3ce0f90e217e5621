"""What it took to play a board, as run.json beside it says (`tailgate.board.run_record` writes it), in a sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from tailgate.base.errors import InputError
from tailgate.core.schema import read_model

FILE = "run.json"
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]


class Command(BaseModel):
    """One command that played rows; processor_seconds with those of its workers."""

    model_config = ConfigDict(strict=True)
    seconds: Seconds
    processor_seconds: Seconds
    played: Count
    workers: Annotated[int, Field(ge=1)]
    processor: str
    cores: Annotated[int, Field(ge=1)]
    version: str
    commit: str | None


class Rows(BaseModel):
    """Rows that the commands played, and rows of the board that none of them did; null while they are being played.

    again: how many of those that were played stand for nothing, as they were played once more, by newer sources for instance.
    """

    model_config = ConfigDict(strict=True)
    played: Count
    kept: Count | None
    again: Count = 0


class RunTime(BaseModel):
    """A record of a run, whose commands add up."""

    model_config = ConfigDict(strict=True)
    format: Literal["tailgate-run-1"] = "tailgate-run-1"
    suite: str
    hash: str
    seconds: Seconds
    processor_seconds: Seconds
    rows: Rows
    commands: Annotated[list[Command], Field(min_length=1)]

    def said(self, rows: int) -> str:
        """In a sentence. rows: of the board, which may have met more attacks since."""
        count, machines = len(self.commands), dict.fromkeys((c.workers, c.processor) for c in self.commands)
        how = "one command" if count == 1 else f"{count} commands"
        where = ", ".join(f"{workers} worker{'s' * (workers > 1)}, {name}" for workers, name in machines)
        stand, again = self.rows.played - self.rows.again, f" ({self.rows.again} played twice)" * bool(self.rows.again)
        share = f"all {rows}" if stand >= rows else f"{stand} of {rows}"
        return f"{share} rows{again} by {how} in {lasting(self.seconds)}, {lasting(self.processor_seconds)} of processor time ({where})"


def lasting(seconds: float) -> str:
    """A time as people say it."""
    unit, name = next((u, n) for u, n in ((3600.0, "h"), (60.0, "min"), (1.0, "s")) if seconds >= 2 * u or u == 1.0)
    return f"{seconds / unit:.2g} {name}" if seconds < 100 * unit else f"{seconds / unit:.0f} {name}"


def run_of(board: Path) -> RunTime | None:
    """The record that lies beside a board's file; none where there is none or no such one, as a record decides nothing."""
    path = board.parent / FILE
    try:
        return read_model(RunTime, path, "run", "`tailgate leaderboard run`") if path.is_file() else None
    except InputError:
        return None
