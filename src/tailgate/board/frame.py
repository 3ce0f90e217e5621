"""A board in a notebook: as the table of its page's head, and as a DataFrame of pandas."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

from tailgate.evaluation.frame import html_table, needs_pandas

if TYPE_CHECKING:
    from pandas import DataFrame


class BoardData(dict[str, Any]):
    """The JSON data of a board: a mapping, that a notebook shows as the head of its page."""

    def to_pandas(self) -> DataFrame:
        """Return a DataFrame: a line for each defence, dose and knowledge, with the columns of `leaderboard export --format csv`.

        Raises
        ------
        ImportError
            Without pandas (extra `pandas`).
        InputError
            For what is no board.
        """
        from .export import COLUMNS, records

        frame: DataFrame = needs_pandas().DataFrame(records(self), columns=list(COLUMNS)).convert_dtypes()
        return frame

    def _repr_html_(self) -> str:
        from .head import filled_columns, lines, title

        shown = lines(self)
        head, *body = [[line[i] for i in filled_columns(self, shown)] for line in shown]
        return f"<p>{escape(title(self))}</p>{html_table(head, body)}"

    def __repr__(self) -> str:
        suite, entries, cells = self.get("suite", {}), self.get("entries", ()), self.get("cells", ())
        return f"Board {suite.get('name')} of {len(entries)} defences and {len(cells):,} cells; a mapping, .to_pandas()"
