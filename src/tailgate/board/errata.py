"""What stood on a board and was wrong: errata.json beside it, as the board itself holds what is right, and its history is the repository's.

    {"format": "tailgate-errata-1", "suite", "errata": [{"date", "part", "entries", "what", "moved", "until"}, ..]}

Of each: the day on which the right figures came, the `part` of the board, the `entries` whose figures are superseded (none named: all),
what was wrong, which ranks or flags moved, and the last commit with the board as it was (`until`). A wrong attack has
an erratum on the list of attacks (`tailgate.board.admission`), which also takes its damage out of every figure.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from tailgate.core.schema import read_model

FILE = "errata.json"


def _day(text: str) -> str:
    if date.fromisoformat(text).isoformat() != text:
        raise ValueError("expected a date, YYYY-MM-DD")
    return text


Said = Annotated[str, Field(min_length=1)]


class Erratum(BaseModel):
    """Figures that were superseded."""

    model_config = ConfigDict(strict=True, extra="forbid")
    date: Annotated[str, AfterValidator(_day)]
    part: Literal["rows", "detection", "timing"]
    entries: list[Said] = []
    what: Said
    moved: Said
    until: Annotated[str, Field(pattern="^[0-9a-f]{7,40}$")]

    def about(self, defence: str) -> bool:
        return not self.entries or defence in self.entries


class Errata(BaseModel):
    """A file of them, the oldest first."""

    model_config = ConfigDict(strict=True, extra="forbid")
    format: Literal["tailgate-errata-1"] = "tailgate-errata-1"
    suite: str
    errata: list[Erratum]


def errata_of(board: Path) -> Errata | None:
    """The errata that lie beside a board's file; none where there are none. Raises InputError that names what is not of the format."""
    path = board.parent / FILE
    return read_model(Errata, path, "errata", "the maintainers (docs/governance.md)") if path.is_file() else None
