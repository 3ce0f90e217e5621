"""The parts of a report: claims of the thesis with what is measured, tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from tailgate.base.plots import png
from tailgate.core import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

Holds = Literal["yes", "partly", "no"]
Data = Mapping[str, object] | Sequence[object] | str | float | None  # of JSON
Tick = Callable[[str], None]  # is given what begins


@dataclass(frozen=True)
class Claim:
    """One claim. `thesis` and `measured` are a number, a text, or figures by name; `why` says what the verdict rests on."""

    id: str
    claim: str
    thesis: Data
    measured: Data
    holds: Holds
    why: str = ""


def verdict(yes: bool, no: bool) -> Holds:
    """Return yes or no where one of them is met, else partly."""
    return "yes" if yes else "no" if no else "partly"


@dataclass(frozen=True)
class Table:
    """A table of text cells."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Figure:
    """A picture (PNG) with what it shows; `name` becomes its file's."""

    name: str
    caption: str
    png: bytes


@dataclass(frozen=True)
class Drawing:
    """A figure that is drawn only for a report with figures."""

    name: str
    caption: str
    draw: Callable[[], Picture]


Part = Claim | Table | Drawing


@dataclass
class Report:
    """Everything that one chapter's reproduction found, in the order in which it is read."""

    chapter: str
    title: str
    settings: Mapping[str, object]
    claims: list[Claim] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    drawn: bool = field(default=True, compare=False)  # whether drawings become figures

    def add(self, parts: Iterable[Part]) -> None:
        """Append each part to those of its kind."""
        for part in parts:
            if isinstance(part, Claim):
                self.claims.append(part)
            elif isinstance(part, Table):
                self.tables.append(part)
            elif self.drawn:
                self.figures.append(Figure(part.name, part.caption, png(part.draw())))


@dataclass(frozen=True)
class Spread:
    """Median, quartiles and central 95 % of a figure over seeds."""

    median: float
    q25: float
    q75: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Array) -> Spread:
        """Return the spread of values (n,)."""
        q = np.quantile(np.asarray(values, np.float64), [0.5, 0.25, 0.75, 0.025, 0.975])
        return cls(*(float(v) for v in q))

    def __str__(self) -> str:
        return f"{self.median:.2f} [{self.q25:.2f}, {self.q75:.2f}]"

    def covers(self, value: float) -> bool:
        """Return whether a single run with this figure is among the central 95 %."""
        return self.low <= value <= self.high

    def data(self) -> dict[str, float]:
        """Return median and quartiles, as reports have them."""
        return {"median": round(self.median, 6), "q25": round(self.q25, 6), "q75": round(self.q75, 6)}
