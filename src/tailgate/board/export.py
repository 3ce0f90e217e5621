"""A board for a paper: its head as CSV or LaTeX, its figure as vectors, and how to cite it."""

from __future__ import annotations

import csv
import io
import re

from tailgate.base.errors import unknown
from tailgate.base.plots import MARKERS, canvas

from .files import read_board
from .head import lines, title
from .order import ordered
from .schema import Data

FORMATS = ("csv", "latex", "bibtex", "svg", "pdf")
SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
}  # fmt: skip
SIGNS = {"<=": r"$\leq$", ">=": r"$\geq$"}
TITLE = "Tailgate: a benchmark in which an adversary learns when to attack the sensors of adaptive cruise control"  # as in CITATION.cff
DRAWN = 8  # defences with a colour in the figure; the others are grey


def exported(board: Data, form: str, most: int | None = None) -> bytes:
    """Return a board in a form for papers.

    Parameters
    ----------
    board
        JSON data of a board.
    form
        csv and latex: the head, a line for each defence; bibtex: an entry for the board and one for the thesis; svg and pdf: damage by
        dose under the worst black-box attack.
    most
        At most this many defences, in the order of the page; by default all.

    Raises
    ------
    InputError
        For another form, and for what is no board.
    ImportError
        Where a picture is asked for without matplotlib.
    """
    if form not in FORMATS:
        raise unknown("--format", form, FORMATS)
    if form == "bibtex":
        return _bibtex(board).encode()
    if form in ("svg", "pdf"):
        return _figure(board, form, most)
    head, *body = lines(board)
    shown = [head, *body[:most]]
    return _csv(shown) if form == "csv" else _latex(shown, title(board)).encode()


def _csv(shown: list[tuple[str, ...]]) -> bytes:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(shown)
    return out.getvalue().encode()


def escaped(text: str) -> str:
    """Return text in which LaTeX reads every character as it is, but for <= and >=, which become their signs."""
    parts = re.split("([<>]=)", text)
    return "".join(SIGNS[part] if part in SIGNS else "".join(SPECIAL.get(one, one) for one in part) for part in parts)


def _latex(shown: list[tuple[str, ...]], caption: str) -> str:
    """Return a table of the package booktabs; a column with nothing in it is left out."""
    head, *body = shown
    kept = [i for i in range(len(head)) if any(line[i] for line in body)]
    rows = [" & ".join(escaped(line[i]) for i in kept) + r" \\" for line in (head, *body)]
    return "\n".join([
        r"\begin{table}", r"\centering", rf"\caption{{{escaped(caption)}}}", r"\label{tab:tailgate}",
        rf"\begin{{tabular}}{{{'l' * len(kept)}}}", r"\toprule",
        rows[0], r"\midrule", *rows[1:], r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
    ])  # fmt: skip


def _bibtex(board: Data) -> str:
    held = read_board(board).suite
    key = re.sub(r"[^A-Za-z0-9]+", "-", f"tailgate-{held.name}").strip("-")
    return f"""@misc{{{key},
  title = {{{TITLE}. Board {escaped(held.name)}}},
  author = {{{{The Tailgate developers}}}},
  year = {{2026}},
  note = {{Version {escaped(str(held.version))}, suite {escaped(held.hash)}}},
}}

@phdthesis{{dutta-2018,
  title = {{Security of Autonomous Systems under Physical Attacks}},
  author = {{Dutta, R. G.}},
  school = {{University of Central Florida}},
  year = {{2018}},
}}
"""


def _figure(board: Data, form: str, most: int | None) -> bytes:
    """Return damage by dose; equal boards give equal bytes."""
    held = read_board(board)
    curves = {curve.defence: curve for curve in held.curves if curve.knowledge == "black"}
    entries = [entry for entry in ordered(held.entries) if entry.defence in curves][:most]
    figure, ((axes,),) = canvas(6.4, 4.0)
    for i, entry in enumerate(entries):
        points = [point for point in curves[entry.defence].points if point.dose is not None]
        x, y = [point.dose for point in points], [100.0 * point.value for point in points]
        if i < DRAWN:
            axes.plot(x, y, marker=MARKERS[i], label=entry.defence)
        else:
            axes.plot(x, y, color="0.75", linewidth=0.8, zorder=0)
    axes.set(xlabel="dose [attacked steps]", ylabel="damaged episodes [%]", ylim=(-2, 102), title=f"{held.suite.name}, black box")
    axes.grid(alpha=0.3)
    if entries:
        figure.legend(fontsize="small", loc="outside right upper")
    out = io.BytesIO()
    metadata = {"Date": None} if form == "svg" else {"CreationDate": None, "Creator": None, "Producer": None}
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": held.suite.hash}):
        figure.savefig(out, format=form, metadata=metadata)
    return out.getvalue()
