"""Tables that fit the terminal: texts fold at blanks, commas and colons, and no word is broken."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Container, Iterable, Sequence
from typing import NamedTuple

from rich.box import HEAVY_HEAD, SIMPLE_HEAD, Box
from rich.cells import cell_len
from rich.markup import escape
from rich.table import Table

from tailgate.base.errors import one_line
from tailgate.base.progress import console

PIECE = re.compile(r"[^\s,:]*[,:]+|[^\s,:]+|\s+")  # of a text: a line may end behind each
SHORT = 10  # characters of a text that is never replaced by its number


class _Style(NamedTuple):
    """The lines of a table, and the blanks on both sides of a text."""

    box: Box
    edge: bool
    padding: tuple[int, int]

    def around(self, columns: int) -> int:
        """Return how many characters of a line are no text."""
        return (columns + 1 if self.edge else columns - 1) + columns * sum(self.padding)


STYLES = (_Style(HEAVY_HEAD, True, (1, 1)), _Style(SIMPLE_HEAD, False, (0, 1)), _Style(SIMPLE_HEAD, False, (0, 0)))


class _Form(NamedTuple):
    """A table, and the lines below it that hold what it leaves out."""

    columns: list[str]
    rows: list[list[str]]
    numbers: list[bool]
    below: list[str]


def table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, caption: str | None = None, *,
    numbers: Container[int] = (),
) -> None:  # fmt: skip
    """Print a table of texts. numbers: the columns that are set to the right.

    A table that is too wide loses its vertical lines, then the columns with one value. If that is not enough, long texts of one column
    get numbers and are listed below. A table that is wider still is printed as a list, row by row.
    """
    out, whole = console(), _whole(columns, rows, numbers)
    for form, style in itertools.product(_forms(whole), STYLES):
        widths = _widths(form, out.width - style.around(len(form.columns)))
        if widths is not None:
            out.print(_made(form, style, widths, title, caption))
            for text in form.below:
                for line in _folded(text, out.width, "   "):
                    out.print(line, markup=False, highlight=False, soft_wrap=True)
            return
    _listed(whole, title, caption, out.width, lambda line: out.print(line, markup=False, highlight=False, soft_wrap=True))


def _whole(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: Container[int]) -> _Form:
    """Return a table with a text in each place, without control characters: rows may be anybody's. A row may end early."""
    filled = [["\n".join(map(one_line, text.split("\n"))) for text in (*row, *[""] * (len(columns) - len(row)))] for row in rows]
    return _Form(list(columns), filled, [i in numbers for i in range(len(columns))], [])


def _forms(whole: _Form) -> Iterable[_Form]:
    """Yield the table, and what it becomes when it has to be narrower."""
    yield whole
    few = _few(whole)
    yield from (few, _numbered(whole), _numbered(few))


def _few(form: _Form) -> _Form:
    """Return the table without the columns, but for the first, that have one value in all of several rows."""
    kept = [i for i in range(len(form.columns)) if i == 0 or len(form.rows) < 2 or len({row[i] for row in form.rows}) > 1]
    gone = [f"{form.columns[i]}: {form.rows[0][i]}" for i in range(len(form.columns)) if i not in kept]
    below = [f"in every row: {'; '.join(gone)}"] if gone else []
    return _Form([form.columns[i] for i in kept], [[row[i] for i in kept] for row in form.rows], [form.numbers[i] for i in kept], below)


def _numbered(form: _Form) -> _Form:
    """Return the table with numbers in place of the long texts of its widest column behind the first."""
    widths = [max(map(_least, (row[i] for row in form.rows)), default=0) for i in range(len(form.columns))]
    at = max(range(1, len(widths)), key=widths.__getitem__, default=0)
    long = list(dict.fromkeys(row[at] for row in form.rows if cell_len(row[at]) > SHORT)) if at else []
    names = {text: f"#{i}" for i, text in enumerate(long, 1)}
    rows = [[names.get(text, text) if i == at else text for i, text in enumerate(row)] for row in form.rows]
    return form._replace(rows=rows, below=[*form.below, *(f"{number} {' '.join(text.split())}" for text, number in names.items())])


def _least(text: str, heading: bool = False) -> int:
    """Return the width of the widest part of a text that is not broken."""
    return max((cell_len(part) for part in (text.split() if heading else PIECE.findall(text)) if part.strip()), default=0)


def _natural(text: str) -> int:
    return max(map(cell_len, text.split("\n")))


def _widths(form: _Form, room: int) -> list[int] | None:
    """Return the width of each column; none where no widths keep all words whole."""
    texts = [[row[i] for row in form.rows] for i in range(len(form.columns))]
    heads = form.columns
    widths = [max([_least(heads[i], True), *map(_least, texts[i])]) for i in range(len(heads))]
    wanted = [max([_least(heads[i], True), *map(_natural, texts[i])]) for i in range(len(heads))]
    whole = [max(wanted[i], _natural(heads[i])) for i in range(len(heads))]
    if sum(widths) > room:
        return None
    for most in (wanted, whole):  # texts come before headings; columns that want little get it all, the others the same
        order = sorted(range(len(heads)), key=lambda i: most[i] - widths[i])
        for done, i in enumerate(order):
            widths[i] += max(0, min(most[i] - widths[i], (room - sum(widths)) // (len(order) - done)))
    return widths


def _folded(text: str, width: int, indent: str = "", heading: bool = False) -> list[str]:
    """Return the lines of a text; only a part that is wider than a line is broken."""
    out = []
    for line in text.split("\n"):
        parts, now = (re.findall(r"\S+|\s+", line) if heading else PIECE.findall(line)), ""
        for part in parts:
            if now.strip() and cell_len(now) + cell_len(part.rstrip()) > width:
                out.append(now.rstrip())
                now = indent
            now += part if now.strip() or part.strip() else ""
        out.append(now.rstrip())
    return out


def _made(form: _Form, style: _Style, widths: Sequence[int], title: str | None, caption: str | None) -> Table:
    room = max([0, *(_least(text, True) for text in (title, caption) if text)])  # that a title's words need
    made = Table(
        title=title and escape(title), caption=caption and escape(caption), box=style.box, show_edge=style.edge, pad_edge=style.edge,
        padding=(0, style.padding[1], 0, style.padding[0]), min_width=room,
    )  # fmt: skip
    for i, heading in enumerate(form.columns):
        lines = "\n".join(_folded(heading, widths[i], heading=True))
        made.add_column(escape(lines), min_width=widths[i], no_wrap=True, justify="right" if form.numbers[i] else "left")
    for row in form.rows:
        made.add_row(*(escape("\n".join(_folded(text, widths[i]))) for i, text in enumerate(row)))
    return made


def _listed(form: _Form, title: str | None, caption: str | None, width: int, say: Callable[[str], None]) -> None:
    """Print each row as a list of its values."""
    wide = max(map(cell_len, form.columns)) + 2
    for line in _folded(title or "", width):
        say(line)
    for row in form.rows:
        say("-" * width)
        for heading, text in zip(form.columns, row, strict=True):
            first, *others = _folded(text, width - wide)
            say(f"{heading:<{wide}}{first}".rstrip())
            for line in others:
                say(" " * wide + line)
    for line in _folded(caption or "", width):
        say(line)
