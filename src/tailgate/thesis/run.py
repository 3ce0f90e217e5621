"""Runs the chapters, writes a report as JSON, Markdown and one HTML page, and reads one back."""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from tailgate.base import sizes
from tailgate.base.assets import templates
from tailgate.base.errors import InputError, unknown
from tailgate.base.files import writable_directory, write_atomic, write_html, write_json
from tailgate.base.reading import load_json
from tailgate.base.version import VERSION

from .claims import Claim, Figure, Report, Table

CHAPTERS = {name: f"tailgate.thesis.{name}" for name in ("ch3", "ch4", "ch5", "ch6", "ch7")}


def reproduce(chapter: str, seeds: int = 200, tick: Callable[[str], None] = lambda _: None, figures: bool = True) -> Report:
    """Reproduce one chapter. Raises InputError for one that does not exist."""
    check_chapter(chapter)
    check_seeds(seeds)
    report: Report = import_module(CHAPTERS[chapter]).reproduce(seeds, tick, figures)
    return report


def check_chapter(chapter: str) -> None:
    """Raise InputError for a chapter that does not exist."""
    if chapter not in CHAPTERS:
        raise unknown("chapter", chapter, CHAPTERS)


def check_seeds(seeds: int) -> None:
    """Raise InputError for too few seeds, and for more than the memory holds."""
    if seeds < 10:
        raise InputError("seeds", seeds, "a whole number not below 10")
    sizes.check("seeds", seeds)


def data_of(report: Report) -> dict[str, Any]:
    """Return title, settings, claims and tables as JSON data."""
    tables = [dataclasses.asdict(table) for table in report.tables]
    return {"title": report.title, "settings": report.settings, "claims": as_json(report), "tables": tables}


def as_json(report: Report) -> list[dict[str, Any]]:
    """Return the claims: id, claim, thesis, measured, holds, why."""
    return [dataclasses.asdict(claim) for claim in report.claims]


def flat(value: object) -> str:
    """Return JSON data as people read it, in one line."""
    if isinstance(value, dict):
        if set(value) == {"median", "q25", "q75"}:
            return f"{_number(value['median'])} [{_number(value['q25'])}, {_number(value['q75'])}]"
        if set(value) == {"share", "low", "high"}:
            return f"{value['share']:.4g} [{value['low']:.4g}, {value['high']:.4g}]"
        parts = (
            f"{key} ({flat(v)})" if isinstance(v, dict) and not {"median", "share"} & set(v) else f"{key}: {flat(v)}"
            for key, v in value.items()
        )
        return "; ".join(parts)
    if isinstance(value, list):
        return ", ".join(flat(v) for v in value)
    if value is None:
        return "not measured"
    return _number(value) if isinstance(value, float) else str(value)


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def summary(*reports: Report) -> str:
    """Return how many claims hold."""
    claims = [claim for report in reports for claim in report.claims]
    counts = {verdict: sum(c.holds == verdict for c in claims) for verdict in ("yes", "partly", "no")}
    return f"{len(claims)} claims: {counts['yes']} hold, {counts['partly']} hold partly, {counts['no']} do not"


def markdown(report: Report) -> str:
    """Return the report as a Markdown text; figures are files in the same folder."""
    return "\n".join([f"# {report.title}", "", f"{summary(report)}. Tailgate {VERSION}.", "", *body(report)]) + "\n"


def body(report: Report, folder: str = "", level: str = "##") -> list[str]:
    """Return what is below the title: settings, claims, tables and figures, whose files are in `folder`."""
    lines = [f"- {key}: {flat(value)}" for key, value in report.settings.items()]
    lines += ["", *rows(("id", "claim", "thesis", "measured", "holds", "why"), [_columns(c) for c in report.claims])]
    for table in report.tables:
        lines += ["", f"{level} {table.title}", "", *rows(table.columns, table.rows)]
    for figure in report.figures:
        lines += ["", f"![{figure.caption}]({folder}{figure.name}.png)", "", figure.caption]
    return lines


def rows(heads: Sequence[str], cells: Iterable[Sequence[str]]) -> list[str]:
    """Return a Markdown table."""
    return [
        "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads), *("| " + " | ".join(_cell(v) for v in row) + " |" for row in cells),
    ]  # fmt: skip


def _columns(claim: Claim) -> tuple[str, ...]:
    return claim.id, claim.claim, flat(claim.thesis), flat(claim.measured), claim.holds, claim.why


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def html(report: Report) -> str:
    """Return one self-contained page."""
    return page("page.html", report=report, summary=summary(report), version=VERSION)


def page(name: str, **values: object) -> str:
    """Return a page from one of the templates."""
    helpers = {"flat": flat, "prose": prose, "base64": lambda figure: base64.b64encode(figure.png).decode()}
    return templates("tailgate.thesis", trim=False).get_template(name).render(**helpers, **values)


def prose(text: str) -> Markup:
    """Return a text of a report as HTML: text between backticks is code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def write(report: Report, directory: Path, **stamp: object) -> Path:
    """Write report.json, report.md, index.html and a PNG per figure; return the page. `stamp`: further fields of report.json."""
    writable_directory(directory)
    held = data_of(report)
    data = {"chapter": report.chapter, "title": held.pop("title"), "version": VERSION, **stamp, **held}
    data["figures"] = [{"name": figure.name, "caption": figure.caption} for figure in report.figures]
    for figure in report.figures:
        write_atomic(directory / f"{figure.name}.png", figure.png)
    write_atomic(directory / "report.md", markdown(report).encode())
    written = directory / "index.html"
    write_html(written, html(report).encode())
    write_json(directory / "report.json", data)  # last: what was cut off has none
    return written


def read(directory: Path) -> tuple[Report, dict[str, Any]] | None:
    """Return the report in a directory and all fields of its report.json; None if there is none that can be read."""
    try:
        data = load_json(directory / "report.json")
        tables = [Table(t["title"], tuple(t["columns"]), tuple(tuple(row) for row in t["rows"])) for t in data["tables"]]
        figures = [Figure(f["name"], f["caption"], (directory / f"{f['name']}.png").read_bytes()) for f in data["figures"]]
        claims = [Claim(**claim) for claim in data["claims"]]
        return Report(data["chapter"], data["title"], data["settings"], claims, tables, figures), data
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
