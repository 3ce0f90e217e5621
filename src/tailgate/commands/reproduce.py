"""tailgate reproduce: the thesis, claim by claim."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.progress import console


def add(commands: Any) -> None:
    from tailgate.reproduce import CHAPTERS

    command = commands.add_parser(
        "reproduce", help="the thesis claim by claim: what it says, what is measured, what holds",
        description="Reproduce a chapter of the thesis: a table of claims, a report (HTML, Markdown, JSON) and its figures.",
    )  # fmt: skip
    command.add_argument("chapter", metavar="CHAPTER", help=f"one of {', '.join(CHAPTERS)}")
    command.add_argument("--seeds", type=int, default=200, metavar="N", help="episodes per figure, at least 10 (default 200)")
    command.add_argument("--out", metavar="DIR", help="directory of the report (default reproduction/CHAPTER)")
    command.add_argument("--json", action="store_true", help="print the claims as JSON: id, claim, thesis, measured, holds, why")
    command.set_defaults(run=_reproduce)


def _reproduce(options: argparse.Namespace) -> int:
    from tailgate.reproduce.run import as_json, flat, reproduce, summary, write

    errors = Console(stderr=True)
    report = reproduce(options.chapter, options.seeds, lambda text: errors.print(text, highlight=False))
    page = write(report, Path(options.out) if options.out else Path("reproduction") / options.chapter)
    if options.json:
        print(json.dumps(as_json(report), indent=1, allow_nan=False))
    else:
        table = Table(title=report.title)
        for heading in ("claim", "thesis", "measured", "holds", "why"):
            table.add_column(heading, overflow="fold")
        for claim in report.claims:
            head = f"{escape(claim.claim)}\n[dim]{escape(claim.id)}[/]"
            table.add_row(head, flat(claim.thesis), escape(flat(claim.measured)), claim.holds, claim.why, end_section=True)
        out = console()
        out.print(table)
        out.print(summary(report), highlight=False)
    errors.print(f"report: {page}", highlight=False)
    return 0
