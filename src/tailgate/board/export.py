"""A board for a paper: its figures as CSV, its head as LaTeX, a picture as vectors, and how to cite it."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tailgate.base.errors import unknown
from tailgate.base.plots import MARKERS, canvas, drawn
from tailgate.base.pytree import Array

from .files import read_board
from .head import filled_columns, lines, title
from .measures import SOME
from .order import ordered
from .schema import Curve, Data, Entry, Point, Rate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("csv", "latex", "bibtex", "svg", "pdf")
SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
}  # fmt: skip
SIGNS = {"<=": r"$\leq$", ">=": r"$\geq$"}
TITLE = "Tailgate: a benchmark in which an adversary learns when to attack the sensors of adaptive cruise control"  # as in CITATION.cff
COLUMNS = (
    "defence", "class", "status", "why", "rank_best", "rank_worst", "ranked_in_class", "knowledge", "dose", "undamaged", "undamaged_low",
    "attacks", "worst_scenario", "worst_attack", "no_attack_damages", "no_attack_damages_low", "no_attack_damages_high", "impacts",
    "impact_mean", "impact_q90", "impact_most", "distance_kept", "distance_kept_least", "critical_dose", "critical_dose_low",
    "critical_dose_high", "mean_gap_change",
)  # fmt: skip
DRAWN = 8  # defences with a colour in the figure; the others are grey


def exported(board: Data, form: str, most: int | None = None) -> bytes:
    """Return a board in a form for papers.

    Parameters
    ----------
    board
        JSON data of a board.
    form
        csv: numbers, a line for each defence, dose and knowledge (`COLUMNS`); latex: the head, a line for each defence; bibtex: an entry
        for the board and one for the thesis; svg and pdf: damage by dose under the worst black-box attack.
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
    if form == "csv":
        return _csv(board, most)
    head, *body = lines(board)
    return _latex(board, [head, *body[:most]]).encode()


def _csv(board: Data, most: int | None) -> bytes:
    out = io.StringIO()
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows(records(board, most))
    return out.getvalue().encode()


def records(board: Data, most: int | None = None) -> list[dict[str, object]]:
    """Return `COLUMNS` of a board: an entry for each defence, dose and knowledge, and one for a defence without figures.

    A figure that is missing has no key. `most`: as of `exported`.
    """
    held = read_board(board)
    entries = ordered(held.entries)
    ranked = Counter(entry.class_ for entry in entries if entry.rank)
    out = list[dict[str, object]]()
    for entry in entries[:most]:
        shared: dict[str, object] = {"defence": entry.defence, "class": entry.class_, "status": entry.status, "why": entry.why}
        if entry.rank:
            shared |= {"rank_best": entry.rank.best, "rank_worst": entry.rank.worst, "ranked_in_class": ranked[entry.class_]}
        if entry.mean_gap:
            shared["mean_gap_change"] = entry.mean_gap.value
        out += [shared | line for line in [_figures(entry, rate, held.suite.doses) for rate in entry.rates] or [{}]]
    return out


def _figures(entry: Entry, rate: Rate, doses: Sequence[int | None]) -> dict[str, object]:
    """Return the figures of a defence at one dose for one knowledge."""
    at = (rate.dose, rate.knowledge)
    out: dict[str, object] = {"knowledge": rate.knowledge, "dose": "none" if rate.dose is None else rate.dose, "attacks": rate.attacks}
    if rate.undamaged:
        out |= {"undamaged": rate.undamaged.value, "undamaged_low": rate.undamaged.low}
    if rate.worst:
        out |= {"worst_scenario": rate.worst.scenario, "worst_attack": rate.worst.attack}
    none = next((line.undamaged for line in entry.pointwise if (line.dose, line.knowledge) == at), None)
    if none:
        out |= {"no_attack_damages": none.value, "no_attack_damages_low": none.low, "no_attack_damages_high": none.high}
    harm = next((line for line in entry.under_attack if (line.dose, line.knowledge) == at), None)
    if harm:
        hard = harm.severity
        q90 = hard.q90 if hard.measured >= SOME else None  # of few, the greatest says more
        out |= {"impacts": hard.measured, "impact_mean": hard.mean, "impact_q90": q90, "impact_most": hard.most}
        out["distance_kept"] = harm.availability
        out["distance_kept_least"] = harm.least.value if harm.least else None
    critical = entry.critical_dose.get(rate.knowledge)
    if critical:
        least = min((dose for dose in doses if dose), default=0)
        ends = {"critical_dose": critical.value, "critical_dose_low": critical.low, "critical_dose_high": critical.high}
        out |= {name: "above" if end is None else "below" if 0 < end <= least else end for name, end in ends.items()}
    return out


def escaped(text: str) -> str:
    """Return text in which LaTeX reads every character as it is, but for <= and >=, which become their signs."""
    parts = re.split("([<>]=)", text)
    return "".join(SIGNS[part] if part in SIGNS else "".join(SPECIAL.get(one, one) for one in part) for part in parts)


def _latex(board: Data, shown: list[tuple[str, ...]]) -> str:
    """Return a table of the package booktabs."""
    kept, name = filled_columns(board, shown), re.sub(r"[^A-Za-z0-9]+", "-", board["suite"]["name"]).strip("-")
    rows = [" & ".join(escaped(line[i]) for i in kept) + r" \\" for line in shown]
    return "\n".join([
        r"% needs \usepackage{booktabs}", r"\begin{table}", r"\centering", rf"\caption{{{escaped(title(board))}}}",
        rf"\label{{tab:tailgate-{name}}}",
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
  note = {{Played with version {escaped(str(held.version))}, suite {escaped(held.hash)}}},
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
    if len(held.suite.doses) == 1:
        figure = _at_one_dose(entries, curves)
    else:
        figure = _over_doses(entries, curves)
    figure.axes[0].set_title(f"{held.suite.name}, black box")
    figure.axes[0].grid(alpha=0.3)
    return drawn(figure, form, held.suite.hash)


def _over_doses(entries: Sequence[Entry], curves: Mapping[str, Curve]) -> Figure:
    """Draw a line for each defence: the first ones in colour with their limits, the others grey."""
    figure, ((axes,),) = canvas(6.4, 4.0)
    for i, entry in enumerate(entries):
        points = [point for point in curves[entry.defence].points if point.dose is not None]
        x, y = [point.dose for point in points], [100.0 * point.value for point in points]
        if i < DRAWN:
            face = None if entry.rank else "white"
            axes.errorbar(x, y, _limits(points), marker=MARKERS[i], markerfacecolor=face, capsize=2, label=_label(entry))
        else:
            axes.plot(x, y, color="0.75", linewidth=0.8, zorder=0, label="others" if i == DRAWN else None)
    axes.set(xlabel="dose [attacked steps]", ylabel="damaged episodes [%]", ylim=(-2, 102))
    if entries:
        figure.legend(fontsize="small", loc="outside right upper")
    return figure


def _at_one_dose(entries: Sequence[Entry], curves: Mapping[str, Curve]) -> Figure:
    """Draw a mark with limits for each defence, in the order of the page; a line would join what was not played."""
    figure, ((axes,),) = canvas(6.4, 1.2 + 0.22 * max(len(entries), 1))
    last = [next(point for point in reversed(curves[entry.defence].points) if point.dose is not None) for entry in entries]
    x, limits = np.array([100.0 * point.value for point in last]), _limits(last)
    for ranked in (True, False):
        at = [i for i, entry in enumerate(entries) if bool(entry.rank) == ranked]
        face = "black" if ranked else "white"
        axes.errorbar(x[at], at, xerr=limits[:, at], fmt="o", color="black", markerfacecolor=face, capsize=2)
    axes.set_yticks(range(len(last)), [_label(entry) for entry in entries], fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel=f"damaged episodes at {last[0].dose} attacked steps [%]" if last else "", xlim=(-2, 102))
    return figure


def _label(entry: Entry) -> str:
    return entry.defence if entry.rank else f"{entry.defence} (no rank)"


def _limits(points: Sequence[Point]) -> Array:
    """Return how far the limits of shares lie below and above them (2, P) [%]; 0 where there are none."""
    ends = [(p.value if p.low is None else p.low, p.value if p.high is None else p.high) for p in points]
    low, high = np.array(ends).reshape(-1, 2).T
    value = np.array([p.value for p in points])
    return np.asarray(100.0 * np.maximum([value - low, high - value], 0.0))
