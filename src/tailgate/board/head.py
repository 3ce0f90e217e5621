"""The head of a board: a line for each defence, as text cells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from .files import read_board
from .measures import SOME
from .order import ordered
from .words import at_least

Board = dict[str, Any]


def title(board: Board) -> str:
    """Return suite, episodes, and whose seeds they are."""
    suite = board["suite"]
    seeds = f"seeds of the beacon {suite['beacon']}" if suite["beacon"] else "public seeds: for development"
    free = "" if suite.get("require_adaptive", True) else ", ranked without attackers made against each"
    return f"{suite['name']}, {suite['episodes']} episodes a cell, black box, {seeds}{free}"


def lines(board: Board) -> list[tuple[str, ...]]:
    """Return headings, then the defences in the order of the page: rank, critical dose, least undamaged share at the shown doses.

    Raises InputError for what is no board.
    """
    parts = read_board(board).entries
    suite = board["suite"]
    doses = list(suite["shown"]) or [str(dose) for dose in suite["doses"]]
    trusted = any(entry.get("trust") for entry in board["entries"])
    measured, middle = bool(suite.get("measures")), doses[len(doses) // 2]
    road = measured and any(entry.get("under_attack") for entry in board["entries"])
    more = [f"no attack damages at {middle}"] * measured + [f"impact at {middle} [m/s]", f"distance kept at {middle}", "gap"] * road
    out: list[tuple[str, ...]] = [(
        "defence", "class", "rank", "critical dose", *(f"undamaged at {dose}" for dose in doses), *more,
        *["trust (safety)"] * trusted, "why not",
    )]  # fmt: skip
    by_name = {entry["defence"]: entry for entry in board["entries"]}
    for entry in [by_name[part.defence] for part in ordered(parts)]:
        rank, critical = entry["rank"], entry["critical_dose"]["black"]
        rates = {str(rate["dose"]): rate["undamaged"] for rate in entry["rates"] if rate["knowledge"] == "black"}
        shown = [_share(rates[d]) if d in rates else "-" for d in doses]
        ranked = sum(e["rank"] is not None and e["class"] == entry["class"] for e in board["entries"])
        place = "-" if rank is None else "alone" if ranked == 1 else " to ".join(map(str, dict.fromkeys([rank["best"], rank["worst"]])))
        dose = "-" if critical is None else _dose(critical, suite["doses"])
        bound = [_trust(entry.get("trust"))] * trusted
        extra = [_pointwise(entry, middle)] * measured + [*_under_attack(entry, middle), _gap(entry.get("mean_gap"))] * road
        out.append((entry["defence"], entry["class"], place, dose, *shown, *extra, *bound, entry["why"]))
    return out


def markdown(board: Board, most: int | None = None) -> str:
    """Return the head as a Markdown table of at most this many defences; a column with nothing in it is left out."""
    heading, *body = lines(board)
    heading = tuple(f"{text}, black box" if text.startswith(("critical", "undamaged")) else text for text in heading)
    told = filled_columns(board, [heading, *body[:most]])
    rows = [[line[i].replace("|", "\\|") for i in told] for line in (heading, *body[:most])]
    rows.insert(1, ["---"] * len(told))
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows) + "\n"


def filled_columns(board: Board, shown: Sequence[Sequence[str]]) -> list[int]:
    """Return the numbers of the columns with something in them; with one dose a critical dose says no more than the share."""
    one = len(board["suite"]["doses"]) == 1
    return [i for i, text in enumerate(shown[0]) if any(line[i] for line in shown[1:]) and not (one and text.startswith("critical"))]


def _share(undamaged: Board) -> str:
    return f"{100 * undamaged['value']:.0f} % (at least {at_least(undamaged['low']).rstrip('%')})"


def _line(lines: Iterable[Board], dose: str) -> Board | None:
    return next((line for line in lines if str(line["dose"]) == dose and line["knowledge"] == "black"), None)


def _pointwise(entry: Board, dose: str) -> str:
    line = _line(entry.get("pointwise", ()), dose)
    held = line["undamaged"] if line else None
    if held is None:
        return "-"
    return f"{100 * held['value']:.0f} % ({at_least(held['low']).rstrip('%')} to {math.ceil(100 * held['high'] - 1e-9)})"


def _under_attack(entry: Board, dose: str) -> list[str]:
    """Return the mean impact speed with its 90th percentile, and the kept distance with the least of all attacks."""
    line = _line(entry.get("under_attack", ()), dose)
    if line is None:
        return ["-", "-"]
    hard, kept, least = line["severity"], line["availability"], line["least"]
    impact = f"- ({hard['collisions']} from behind)" if hard["collisions"] else "-"
    if hard["mean"] is not None:
        few = hard["measured"] < SOME
        impact = f"{hard['mean']:.3g} ({'greatest' if few else '90 %'}: {hard['most' if few else 'q90']:.3g})"
    return [impact, "-" if kept is None else f"{100 * kept:.0f} %" + (f" (least {100 * least['value']:.0f})" if least else "")]


def _gap(gap: Board | None) -> str:
    return "-" if gap is None else f"{100 * gap['value']:+.1f} %"


def _trust(held: Board | None) -> str:
    bound = held["safety"]["black"] if held else None
    return "-" if bound is None else f"at least {at_least(bound['lower'], 1)}"


def _dose(critical: Board, doses: list[int | None]) -> str:
    most = max((dose for dose in doses if dose is not None), default=0)
    least = min((dose for dose in doses if dose), default=0)

    def words(x: float | None) -> str:
        return f"> {most}" if x is None else f"<= {least}" if 0 < x <= least else f"{x:.3g}"

    low, value, high = (words(critical[k]) for k in ("low", "value", "high"))
    return f"{value} [{low}, {high}]"
