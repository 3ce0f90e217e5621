"""Words of a page: names of components, shares, lower limits and numbers as people read them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

from tailgate.base.reading import YAML_ENDS
from tailgate.core.spec_text import split_text

SUFFIXES = (".json", *YAML_ENDS)  # of policies and programs


@dataclass(frozen=True)
class Name:
    """A component's text from a row, as people read it. `base` is the name that a card may exist for."""

    label: str
    params: tuple[str, ...] = ()
    base: str = ""
    policy: bool = False

    @property
    def full(self) -> str:
        return " ".join((self.label, *self.params))


def names_of(texts: Iterable[str]) -> dict[str, Name]:
    """Return the name of each text. Policies and programs go by as many folders of their path as tell them apart."""
    split = {text: _split(text) for text in texts}
    paths = {
        text: tuple(p for p in re.split(r"[\\/]", head.rpartition(".")[0]) if p) for text, (head, _) in split.items()
        if head.endswith(SUFFIXES)
    }  # fmt: skip
    out = {}
    for text, (head, params) in split.items():
        if text in paths and (head.endswith(".json") or len(paths[text]) > 1):
            others, depth = {*paths.values()} - {paths[text]}, 2
            while depth < len(paths[text]) and any(p[-depth:] == paths[text][-depth:] for p in others):
                depth += 1
            policy = head.endswith(".json")
            out[text] = Name("/".join(paths[text][-depth:]), params, "policy" if policy else head, policy)
        elif head == "zoo":
            name = next((p.removeprefix("name=") for p in params if p.startswith("name=")), "zoo")
            out[text] = Name(name, tuple(p for p in params if not p.startswith("name=")), "zoo", True)
        elif found := re.fullmatch(r"(\w+)\((\{.*\})\)", head, re.DOTALL):  # an object that was evaluated from Python
            out[text] = Name(found[1], tuple(found[2].strip("{}").replace('"', "").split(",")) if found[2] != "{}" else ())
        else:
            out[text] = Name(head, params, head)
    return out


def _split(text: str) -> tuple[str, tuple[str, ...]]:
    """Return head and parameters. The text is never resolved: a page must not import what a row names."""
    head, tail = split_text(text)
    if not tail or text.endswith(")"):
        return text, ()
    params = tuple(re.split(r",\s*(?=\w+=)", tail))
    path = next((p for p in params if head in ("policy", "program") and p.startswith("path=") and p.endswith(SUFFIXES)), None)
    return (head, params) if path is None else (path.removeprefix("path="), tuple(p for p in params if p != path))


def percent(value: float) -> str:
    """Return whole percents, but never 0 % or 100 % for a share that is not."""
    if value < 0:
        return f"\N{MINUS SIGN}{percent(-value)}"
    if value in (0, 1) or 0.005 <= value < 0.995:
        return f"{100 * value:.0f}%"
    if value < 0.0005 or value > 0.9995:
        return "<0.1%" if value < 0.5 else ">99.9%"
    return f"{100 * value:.1f}%"


def at_least(share: float, digits: int = 0) -> str:
    """Return a lower limit in percent, never rounded up; below one percent with one decimal, if it is not 0."""
    if digits == 0 and 0.001 <= share < 0.01:
        digits = 1
    unit = 10**digits
    return f"{math.floor(100 * unit * share + 1e-9) / unit:.{digits}f}%"


def shade(value: float) -> str:
    """Return the class of the colour scale: s0 for none at all, then one per ten percent."""
    return f"s{math.ceil(min(max(value, 0.0), 1.0) * 10 - 1e-9)}"


def steps(value: float) -> str:
    """Return a number of decisions, short."""
    for size, unit in ((1_000_000, "M"), (1_000, "k")):
        if value >= size:
            return f"{value / size:.4g}{unit}"
    return f"{value:.0f}"


def ticks(end: float) -> list[dict[str, Any]]:
    """Return round places on an axis from 0 to end, at most six."""
    unit = 10.0 ** math.floor(math.log10(end))
    size = next(unit * m for m in (0.2, 0.5, 1, 2) if end <= 5 * unit * m)
    return [{"x": round(100 * i * size / end, 2), "text": steps(i * size)} for i in range(math.floor(end / size + 1e-9) + 1)]


def breakable(text: str) -> Markup:
    """Return escaped text, with places where a narrow column may break it."""
    return Markup(re.sub(r"([=_/:,])", r"\1<wbr>", str(escape(text))))


def spans(numbers: Iterable[int]) -> str:
    """Return whole numbers as ranges: 0-49, 100."""
    out: list[list[int]] = []
    for number in sorted(set(numbers)):
        if out and number == out[-1][1] + 1:
            out[-1][1] = number
        else:
            out.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}\N{EN DASH}{b}" for a, b in out)
