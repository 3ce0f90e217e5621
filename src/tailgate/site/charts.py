"""Places of lines, labels and ticks of a chart, in percent of its field: the templates draw them as inline SVG.

Places in percent keep text at its size whatever the width of the page is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

Data = dict[str, Any]
STYLES = 8  # line styles of the style sheet
LABEL = 20  # characters of a label at a line's end


class Dot(NamedTuple):
    """A figure on a line; low and high None where it has no interval."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Line:
    """dots: what was measured; fitted: heights of the line at the dots, else it goes through them."""

    label: str
    style: int
    dots: Sequence[Dot]
    fitted: Sequence[float] = ()


@dataclass(frozen=True)
class Axis:
    """A horizontal axis: `log` with the logarithm of 1 + x (for doses, which may be 0), `decades` with that of x."""

    low: float
    high: float
    scale: str = "linear"

    def _turned(self, x: float) -> float:
        if self.scale == "log":
            return math.log1p(max(x, 0.0))
        return math.log10(max(x, 1e-12)) if self.scale == "decades" else x

    def at(self, x: float) -> float:
        """Return percent from the left; 50 where the axis has no length."""
        a, b = self._turned(self.low), self._turned(self.high)
        return round(100 * (self._turned(x) - a) / (b - a), 2) if b > a else 50.0


def ticks_at(axis: Axis, places: Sequence[float], gap: float = 8.0) -> list[Data]:
    """Return ticks at the given places; of those closer than `gap` percent the later ones lose their text, the last never."""
    out: list[Data] = []
    where = sorted(set(places))
    last = axis.at(where[-1]) if where else 0.0
    shown = -math.inf
    for x in where:
        at = axis.at(x)
        text = f"{x:g}" if at == last or (at - shown >= gap and last - at >= gap) else ""
        shown = at if text else shown
        out.append({"x": at, "text": text})
    return out


def spread(heights: Sequence[float], gap: float, ties: Sequence[float] = ()) -> list[float]:
    """Return heights (percent from the top) moved apart to a distance of `gap`, within 0 to 100 where they fit; order is kept.

    ties: the order of equal heights.
    """
    order = sorted(range(len(heights)), key=lambda i: (round(heights[i]), ties[i] if ties else 0.0))
    gap = min(gap, 100 / max(len(order) - 1, 1))
    out = [0.0] * len(heights)
    below = -math.inf
    for i in order:
        below = out[i] = max(heights[i], below + gap)
    above = 100.0 + gap
    for i in reversed(order):
        above = out[i] = min(out[i], above - gap)
    return [round(y, 2) for y in out]


def shorten(text: str, most: int = LABEL) -> str:
    """Return the text, at most `most` characters long, with an ellipsis where it is cut."""
    return text if len(text) <= most else text[: most - 1].rstrip() + "\N{HORIZONTAL ELLIPSIS}"


def nice(top: float) -> float:
    """Return the next round number that is not below."""
    if not top > 0 or not math.isfinite(top):
        return 1.0
    unit = 10.0 ** math.floor(math.log10(top))
    return next(unit * m for m in (1, 1.5, 2, 3, 5, 10) if top <= unit * m * (1 + 1e-9))


def path_of(axis: Axis, points: Sequence[tuple[float, float]], top: float = 1.0) -> str:
    """Return points of a polyline on a 1000 x 1000 field."""
    return " ".join(f"{10 * axis.at(x):.1f},{1000 - 1000 * min(max(y / top, 0.0), 1.0):.1f}" for x, y in points)


def chart(
    lines: Sequence[Line], axis: Axis, ticks: Sequence[Data], *, top: float = 1.0, gap: float = 6.0, limit: float | None = None
) -> Data:
    """Return a chart's lines with bands, whiskers and labels at their right ends. gap: least distance of two labels [percent]."""

    def up(y: float) -> float:
        return round(100 - 100 * min(max(y / top, 0.0), 1.0), 2)

    drawn: list[Data] = []
    for line in lines:
        if not line.dots:
            continue
        heights = list(line.fitted) or [d.y for d in line.dots]
        sure = [d for d in line.dots if d.low is not None and d.high is not None]
        drawn.append({
            "label": line.label, "style": line.style % STYLES, "end": up(heights[-1]), "mean": up(sum(heights) / len(heights)),
            "path": path_of(axis, [(d.x, y) for d, y in zip(line.dots, heights, strict=True)], top),
            "dots": [{"x": axis.at(d.x), "y": up(d.y)} for d in line.dots],
            "whiskers": [{"x": axis.at(d.x), "low": up(d.low or 0.0), "high": up(d.high or 0.0)} for d in sure],
        })  # fmt: skip
    places = spread([d["end"] for d in drawn], gap, [d["mean"] for d in drawn])
    for item, y in zip(drawn, places, strict=True):
        item |= {"y": y, "text": shorten(item["label"])}
    drawn.sort(key=lambda item: item["y"])
    quarters = [{"y": up(top * i / 4), "value": top * i / 4} for i in range(5)]
    return {"lines": drawn, "xticks": list(ticks), "yticks": quarters, "limit": None if limit is None else up(limit)}
