"""The charts of a board's site: dose-response curves of each defence and of all together, and stealth-impact curves."""

from __future__ import annotations

from collections.abc import Sequence

from tailgate.board.order import ordered
from tailgate.board.schema import LEVELS, Curve, Data, Entry, Stealth

from .charts import STYLES, Axis, Dot, Line, chart, nice, path_of, ticks_at
from .suite import Suite, figure

TOGETHER = STYLES  # defences with a line each in the chart of all: as many as there are line styles
SCALES = ("log", "linear")
BLANK = {"text": figure(None), "span": "", "reason": "", "rarer": False}  # of a figure that a board has not


def dots_of(curve: Curve) -> Line:
    """Return the points of a curve at doses that are numbers, in order, with the fit at each."""
    kept = [(p, i) for i, p in enumerate(curve.points) if p.dose is not None]
    kept.sort(key=lambda item: item[0].dose or 0)
    fitted = [curve.fitted[i] for _, i in kept] if curve.fitted else []
    style = LEVELS.index(curve.knowledge)
    dots = [Dot(float(p.dose or 0), p.value, p.low, p.high) for p, _ in kept]
    return Line(curve.knowledge, style, dots, fitted)


def curves_of(suite: Suite, wanted: Sequence[Entry] | None = None, gap: float = 14.0) -> list[Data]:
    """Return one chart per defence on each scale, with a line per knowledge."""
    out = []
    for entry in ordered(suite.board.entries) if wanted is None else wanted:
        lines = [line for c in suite.board.curves if c.defence == entry.defence and (line := dots_of(c)).dots]
        if lines:
            lines.sort(key=lambda line: line.style)
            charts = []
            for scale in SCALES:
                axis = suite.axis(scale)
                drawn = chart(lines, axis, ticks_at(axis, suite.places, 16.0), gap=gap, limit=suite.board.suite.limit)
                charts.append(drawn | {"scale": scale})
            out.append({"name": suite.defences[entry.defence], "page": suite.pages.get(entry.defence, ""), "charts": charts})
    return out


def together_of(suite: Suite) -> Data | None:
    """Return the black-box curves of all defences on one field: the first in the table with a line each, the others faint."""
    by_defence = {c.defence: dots_of(c) for c in suite.board.curves if c.knowledge == "black"}
    there = [(e, by_defence[e.defence]) for e in ordered(suite.board.entries) if e.defence in by_defence and by_defence[e.defence].dots]
    if not there:
        return None
    named = there[:TOGETHER]
    charts = []
    for scale in SCALES:
        axis = suite.axis(scale)
        lines = [Line(suite.defences[e.defence].full, i, line.dots, line.fitted) for i, (e, line) in enumerate(named)]
        rest = []
        for _, line in there:
            heights = list(line.fitted) or [d.y for d in line.dots]
            rest.append(path_of(axis, [(d.x, y) for d, y in zip(line.dots, heights, strict=True)]))
        drawn = chart(lines, axis, ticks_at(axis, suite.places), limit=suite.board.suite.limit)
        charts.append(drawn | {"scale": scale, "rest": rest[len(named) :], "all": rest})
    return {"charts": charts, "named": len(named), "of": len(there)}


def stealth_of(suite: Suite, wanted: Sequence[Entry] | None = None) -> Data | None:
    """Return chart and table of the deviation that a stealthy attacker reaches, by the mean time between false alarms."""
    entries = ordered(suite.board.entries) if wanted is None else wanted
    there = [(e, sorted(e.stealth, key=lambda s: s.hours)) for e in entries if e.stealth]
    hours = sorted({s.hours for _, held in there for s in held})
    tops = [s.deviation if s.high is None else s.high for _, held in there for s in held if s.deviation is not None]
    if not tops:
        return None
    axis = Axis(hours[0], hours[-1], "decades")
    lines = [
        Line(suite.defences[e.defence].full, i, [Dot(s.hours, s.deviation, s.low, s.high) for s in held if s.deviation is not None])
        for i, (e, held) in enumerate(there[:TOGETHER])
    ]  # fmt: skip
    drawn = chart(lines, axis, ticks_at(axis, hours), top=nice(max(tops)))
    for tick in drawn["yticks"]:
        tick["text"] = figure(tick["value"], 3)
    rows = []
    for e, held in there:
        by_hour = {s.hours: reached_of(s) for s in held}
        cells = [by_hour.get(h, BLANK) for h in hours]
        rows.append({"name": suite.defences[e.defence], "page": suite.pages.get(e.defence, ""), "cells": cells})
    return {"chart": drawn, "hours": [figure(h) for h in hours], "rows": rows, "named": min(len(there), TOGETHER), "of": len(there)}


def reached_of(item: Stealth) -> Data:
    """Return one figure of stealth impact in words."""
    span = "" if item.low is None or item.high is None else f"{figure(item.low, 3)} to {figure(item.high, 3)}"
    return BLANK | {
        "hours": figure(item.hours), "threshold": figure(item.threshold), "text": figure(item.deviation, 3), "span": span,
        "reason": item.reason, "rarer": item.rarer,
    }  # fmt: skip
