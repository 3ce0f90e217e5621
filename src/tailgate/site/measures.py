"""Measures on the pages of a site: pointwise worst, severity, availability and the mean gap, of boards that have them."""

from __future__ import annotations

from tailgate.board.attachments import EqualGap
from tailgate.board.measures import ABOUT, SOME
from tailgate.board.schema import LEVELS, Data, Entry, Level, MeanGap, Pointwise, UnderAttack
from tailgate.board.words import at_least, percent

from .suite import Suite, dose_text, figure

NONE = {"text": "\N{EN DASH}", "low": "", "sort": "", "about": ""}


def columns_of(suite: Suite) -> list[Data]:
    """Return heads of the table's columns at the middle dose, and how to read each; none on a board without measures."""
    if not suite.board.suite.measures:
        return []
    at = dose_text(suite.middle)
    heads = [{"name": "pointwise", "text": f"No attack damages at {at}"}]
    if any(entry.under_attack for entry in suite.board.entries):
        heads += [
            {"name": "severity", "text": f"Impact at {at} [m/s]"}, {"name": "availability", "text": f"Distance kept at {at}"},
            {"name": "mean_gap", "text": "Gap without an attack"},
        ]  # fmt: skip
    return [head | {"about": ABOUT[head["name"]]} for head in heads]


def cells_of(suite: Suite, entry: Entry, columns: list[Data]) -> list[dict[Level, Data]]:
    """Return an entry's cell of each column, by knowledge."""
    points = {(p.dose, p.knowledge): p for p in entry.pointwise}
    lines = {(u.dose, u.knowledge): u for u in entry.under_attack}
    found: dict[str, dict[Level, Data]] = {
        "pointwise": {level: _pointwise(points.get((suite.middle, level))) for level in LEVELS},
        "severity": {level: _severity(lines.get((suite.middle, level))) for level in LEVELS},
        "availability": {level: _availability(suite, lines.get((suite.middle, level))) for level in LEVELS},
        "mean_gap": dict.fromkeys(LEVELS, _gap(entry.mean_gap)),
    }
    return [found[column["name"]] for column in columns]


def table_of(suite: Suite, entry: Entry, equal: EqualGap | None = None) -> Data | None:
    """Return the section of an entry: a row per dose and knowledge; None on a board without measures."""
    if not suite.board.suite.measures:
        return None
    lines = {(u.dose, u.knowledge): u for u in entry.under_attack}
    rows = []
    for point in entry.pointwise:
        line = lines.get((point.dose, point.knowledge))
        severity = line.severity if line else None
        speeds = [severity.mean, severity.median, severity.q90, severity.most] if severity else [None] * 4
        rows.append({
            "dose": dose_text(point.dose), "knowledge": point.knowledge, "pointwise": _pointwise(point),
            "ends": [str(severity.collisions), str(severity.stops)] if severity else ["\N{EN DASH}"] * 2,
            "speeds": [figure(x, 3) for x in speeds], "reason": severity.reason if severity else "",
            "kept": _availability(suite, line),
        })  # fmt: skip
    return {"rows": rows, "road": bool(lines), "gap": _gap(entry.mean_gap), "about": ABOUT, "equal": _equal(suite, entry, equal)}


def _equal(suite: Suite, entry: Entry, equal: EqualGap | None) -> str:
    """Return the comparison at equal mean gap in a sentence; empty where nobody has made it."""
    held = next((line for line in equal.entries if line.defence == entry.defence), None) if equal else None
    if held is None:
        return ""
    share = f"{percent(held.undamaged.value)} (at least {at_least(held.undamaged.low)})"
    worst = "no attack did damage" if held.undamaged.value == 1.0 else f"worst: {suite.where(held.scenario, held.attack)}"
    return (
        f"At equal mean gap, behind a controller with {figure(held.factor, 3)} times the headway, {held.reference} keeps {share} of the "
        f"episodes undamaged at {dose_text(held.dose)}, black box; {worst}."
    )


def _pointwise(point: Pointwise | None) -> Data:
    if point is None or point.undamaged is None:
        return NONE | {"about": point.reason if point else ""}
    held = point.undamaged
    about = f"{point.scenario}, {point.attacks} attacks"
    return {"text": percent(held.value), "low": f"{percent(held.low)} to {percent(held.high)}", "sort": f"{held.value:.6g}", "about": about}


def _severity(line: UnderAttack | None) -> Data:
    if line is None or line.severity.mean is None:
        return NONE | {"about": line.severity.reason if line else ""}
    held = line.severity
    about = f"{held.collisions} collisions, {held.stops} stops without one"
    low = f"90%: {figure(held.q90, 3)}" if held.measured >= SOME else f"greatest: {figure(held.most, 3)}"
    return {"text": figure(held.mean, 3), "low": low, "sort": f"{held.mean:.6g}", "about": about}


def _availability(suite: Suite, line: UnderAttack | None) -> Data:
    if line is None or line.availability is None:
        return NONE
    worst = suite.where(line.worst.scenario, line.worst.attack)
    low, about = "", f"under {worst}"
    if line.least is not None:
        low, about = f"least {percent(line.least.value)}", f"{about}; least: {suite.where(line.least.scenario, line.least.attack)}"
    return {"text": percent(line.availability), "low": low, "sort": f"{line.availability:.6g}", "about": about}


def _gap(gap: MeanGap | None) -> Data:
    if gap is None:
        return NONE
    return {"text": gap_text(gap.value), "low": "", "sort": f"{gap.value:.6g}", "about": f"{gap.episodes} episodes"}


def gap_text(value: float) -> str:
    """Return a mean gap in percent, with its sign and one decimal."""
    return f"{100 * value:+.1f}%".replace("-", "\N{MINUS SIGN}")
