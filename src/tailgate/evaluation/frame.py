"""Rows in a notebook: as a table of cells, and as a DataFrame of pandas."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from types import ModuleType
from typing import TYPE_CHECKING, Any

from tailgate.base.extras import optional
from tailgate.evaluation.rows import Row
from tailgate.evaluation.summary import cell_of, summarise

if TYPE_CHECKING:
    from pandas import DataFrame

SHOWN = 40  # cells that a notebook shows
COLUMNS = ("scenario", "dose", "defence", "attack", "episodes", "collisions", "smallest gap [m]", "largest error")


def needs_pandas() -> ModuleType:
    """Return pandas. Raises ImportError that names the extra where it is missing."""
    found: ModuleType = optional("pandas", "pandas", "a DataFrame needs pandas")
    return found


def html_table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table in HTML; its texts stay text."""
    body = "".join("<tr>{}</tr>".format("".join(f"<td>{escape(text)}</td>" for text in line)) for line in lines)
    return f"<table><thead><tr>{''.join(f'<th>{escape(name)}</th>' for name in head)}</tr></thead><tbody>{body}</tbody></table>"


class Rows(list[Row]):
    """The rows of an evaluation: a list of mappings, one for each episode, that a notebook shows as a table of cells."""

    def summary(self) -> list[dict[str, Any]]:
        """Return an entry for each cell (`tailgate.evaluation.summary.summarise`)."""
        return summarise(self)

    def to_pandas(self, cells: bool = False) -> DataFrame:
        """Return a DataFrame.

        Parameters
        ----------
        cells
            A line for each cell, with names such as `crash.low`, instead of one for each episode.

        Raises
        ------
        ImportError
            Without pandas (extra `pandas`).
        """
        held = self.summary() if cells else list(self)
        frame: DataFrame = needs_pandas().json_normalize(held, max_level=1 if cells else 0)
        return frame

    def _repr_html_(self) -> str:
        entries = self.summary()
        more = f"<p>and {len(entries) - SHOWN} more cells</p>" if len(entries) > SHOWN else ""
        return f"{html_table(COLUMNS, map(_line, entries[:SHOWN]))}{more}"

    def __repr__(self) -> str:
        cells = len({cell_of(row) for row in self})
        return f"Rows of {len(self):,} episodes in {cells:,} cells; a list of mappings, .summary(), .to_pandas()"


def _line(entry: dict[str, Any]) -> tuple[str, ...]:
    """Return the texts of a cell's line."""
    share = entry["crash"]
    collisions = entry["reason"] if share is None else f"{share['value']:.1%} ({share['low']:.1%} to {share['high']:.1%})"
    medians = ("" if (held := entry.get(name)) is None else f"{held['median']:.2f}" for name in ("min_gap", "max_error"))
    dose = "own" if entry["dose"] is None else str(entry["dose"])
    return entry["scenario"], dose, entry["defence"], entry["attack"], str(entry["n"]), collisions, *medians
