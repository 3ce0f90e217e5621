"""tailgate reproduce: the thesis, claim by claim."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.locks import alone
from tailgate.base.progress import console
from tailgate.cli.shared import Commands, print_json, say, table


def add(commands: Commands) -> None:
    """Add `reproduce` to the commands."""
    from tailgate.thesis import CHAPTERS

    command = commands.add_parser(
        "reproduce", help="the thesis claim by claim: what it says, what is measured, what holds",
        description="Reproduce the thesis, or one of its chapters: a table of claims, a report (HTML, Markdown, JSON) and its figures. "
        "Without a chapter all of them are run, and one report says where each figure, table and theorem is answered; chapters that an "
        "earlier run with the same seeds and sources has finished are kept.",
    )  # fmt: skip
    command.add_argument("chapter", metavar="CHAPTER", nargs="?", help=f"one of {', '.join(CHAPTERS)}; without it all of them")
    command.add_argument("--seeds", type=int, default=200, metavar="N", help="episodes per figure, at least 10 (default 200)")
    command.add_argument("--out", metavar="DIR", help="directory of the report (default reproduction, or reproduction/CHAPTER)")
    command.add_argument("--json", action="store_true", help="print the claims as JSON: id, claim, thesis, measured, holds, why")
    command.set_defaults(run=_reproduce)


def _reproduce(options: argparse.Namespace) -> int:
    from tailgate.thesis.run import as_json, flat, summary
    from tailgate.thesis.whole import chapter

    errors = Console(stderr=True)

    def tick(text: str) -> None:
        errors.print(text, highlight=False, markup=False)

    if options.chapter is None:
        options.kept = "the same command goes on after the chapters that are finished"
        return _whole(options, tick)
    place = Path(options.out) if options.out else Path("reproduction") / options.chapter
    report = chapter(options.chapter, options.seeds, place, tick)[0]
    page = place / "index.html"
    if options.json:
        print_json(as_json(report))
    else:
        made = Table(title=report.title)
        for heading in ("claim", "thesis", "measured", "holds", "why"):
            made.add_column(heading, overflow="fold")
        for claim in report.claims:
            head = f"{escape(claim.claim)}\n[dim]{escape(claim.id)}[/]"
            made.add_row(head, escape(flat(claim.thesis)), escape(flat(claim.measured)), claim.holds, escape(claim.why), end_section=True)
        console().print(made)
        say(summary(report))
    tick(f"report: {page}")
    return 0


def _whole(options: argparse.Namespace, tick: Callable[[str], None]) -> int:
    from tailgate.thesis.run import as_json, check_seeds, summary
    from tailgate.thesis.whole import counts, covered, facts, reproduce_whole, write_whole

    out = Path(options.out) if options.out else Path("reproduction")
    check_seeds(options.seeds)
    with alone(out):
        whole = reproduce_whole(options.seeds, out, tick)
        page = write_whole(whole, out)
    if options.json:
        print_json([claim for report in whole.reports for claim in as_json(report)])
    else:
        table(("chapter", "claims", "hold", "partly", "do not", "seconds"), counts(whole), "The thesis, claim by claim")
        say(f"{summary(*whole.reports)}. {covered(whole.coverage)}. Run time: {facts(whole)['run time']}.")
    tick(f"report: {page}")
    return 0
