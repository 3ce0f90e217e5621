"""Runs the chapters, and writes a report as JSON, Markdown and one HTML page."""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Callable
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

import tailgate
from tailgate.errors import InputError, unknown
from tailgate.files import writable_directory, write_atomic

from .claims import Claim, Report

CHAPTERS = {name: f"tailgate.reproduce.{name}" for name in ("ch3", "ch4", "ch5", "ch6")}


def reproduce(chapter: str, seeds: int = 200, tick: Callable[[str], None] = lambda _: None, figures: bool = True) -> Report:
    """Reproduce one chapter. Raises InputError for one that does not exist."""
    if chapter not in CHAPTERS:
        raise unknown("chapter", chapter, CHAPTERS)
    if seeds < 10:
        raise InputError("seeds", seeds, "a whole number not below 10")
    report: Report = import_module(CHAPTERS[chapter]).reproduce(seeds, tick, figures)
    return report


def as_json(report: Report) -> list[dict[str, Any]]:
    """The claims: id, claim, thesis, measured, holds, why."""
    return [dataclasses.asdict(claim) for claim in report.claims]


def flat(value: Any) -> str:
    """JSON data as people read it, in one line."""
    if isinstance(value, dict):
        if set(value) == {"median", "q25", "q75"}:
            return f"{_number(value['median'])} [{_number(value['q25'])}, {_number(value['q75'])}]"
        parts = (f"{key} ({flat(v)})" if isinstance(v, dict) and "median" not in v else f"{key}: {flat(v)}" for key, v in value.items())
        return "; ".join(parts)
    if isinstance(value, list):
        return ", ".join(flat(v) for v in value)
    return _number(value) if isinstance(value, float) else str(value)


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def summary(report: Report) -> str:
    """How many claims hold."""
    counts = {verdict: sum(c.holds == verdict for c in report.claims) for verdict in ("yes", "partly", "no")}
    return f"{len(report.claims)} claims: {counts['yes']} hold, {counts['partly']} hold partly, {counts['no']} do not"


def markdown(report: Report) -> str:
    """The report as a Markdown text; figures as files beside it."""
    lines = [f"# {report.title}", "", f"{summary(report)}. Tailgate {tailgate.__version__}.", ""]
    lines += [f"- {key}: {flat(value)}" for key, value in report.settings.items()]
    lines += ["", "| id | claim | thesis | measured | holds | why |", "|---|---|---|---|---|---|"]
    lines += ["| " + " | ".join(_cell(v) for v in _columns(c)) + " |" for c in report.claims]
    for table in report.tables:
        lines += ["", f"## {table.title}", "", "| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
        lines += ["| " + " | ".join(_cell(v) for v in row) + " |" for row in table.rows]
    for figure in report.figures:
        lines += ["", f"![{figure.caption}]({figure.name}.png)", "", figure.caption]
    return "\n".join(lines) + "\n"


def _columns(claim: Claim) -> tuple[str, ...]:
    return claim.id, claim.claim, flat(claim.thesis), flat(claim.measured), claim.holds, claim.why


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def html(report: Report) -> str:
    """One self-contained page."""
    template = files("tailgate.reproduce").joinpath("page.html").read_text(encoding="utf-8")
    pictures = [(f.name, f.caption, base64.b64encode(f.png).decode()) for f in report.figures]
    page = Environment(autoescape=True, undefined=StrictUndefined).from_string(template)
    return page.render(
        report=report, summary=summary(report), flat=flat, pictures=pictures, version=tailgate.__version__,
        settings={key: flat(value) for key, value in report.settings.items()},
    )  # fmt: skip


def write(report: Report, directory: Path) -> Path:
    """report.json, report.md, index.html and a PNG per figure; returns the page."""
    writable_directory(directory)
    data = {"chapter": report.chapter, "version": tailgate.__version__, "settings": report.settings, "claims": as_json(report)}
    data["tables"] = [dataclasses.asdict(table) for table in report.tables]
    write_atomic(directory / "report.json", json.dumps(data, indent=1, allow_nan=False).encode() + b"\n")
    for figure in report.figures:
        write_atomic(directory / f"{figure.name}.png", figure.png)
    write_atomic(directory / "report.md", markdown(report).encode())
    page = directory / "index.html"
    write_atomic(page, html(report).encode())
    return page
