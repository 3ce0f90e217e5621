"""tailgate leaderboard verify: rows played again."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.errors import InputError
from tailgate.base.progress import cells, console, progress

SHOWN = 20  # rows that are listed, at most


def add(actions: Any) -> None:
    """Adds `verify` to the actions of a command."""
    command = actions.add_parser(
        "verify", help="play rows again and compare their hashes and figures",
        description="Play rows again and compare hashes, metrics and all else that they record. Exit code 1 when a row differs, or when "
        "none could be checked. A row never makes this command import code: registered names, the zoo, and files with the row's digest are "
        "played.",
    )  # fmt: skip
    command.add_argument("--rows", nargs="+", required=True, metavar="FILE", help="JSON Lines files of `tailgate evaluate`")
    command.add_argument("--sample", type=int, metavar="N", help="so many rows, drawn at random (default: all)")
    command.add_argument("--sample-seed", type=int, metavar="N", help="which ones (default: a new secret each time; the report names it)")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1); changes no result")
    command.add_argument("--batch", type=int, metavar="N", help="episodes side by side instead of the rows' number; changes no result")
    command.add_argument("--trust-code", action="store_true", help="also import the classes that rows name; they run with your rights")
    command.add_argument(
        "--submission", action="append", default=[], metavar="SANDBOX/module:Class",
        help="class that rows of `leaderboard submit` are about, played again in a sandbox: bwrap/mydefence:Saturated (repeatable)",
    )  # fmt: skip
    command.add_argument("--out", metavar="FILE", help="also write the report here: OUT/SUITE/verified/NAME.json for the next board")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=_verify)


def _verify(options: argparse.Namespace) -> int:
    from tailgate.base.files import writable_directory, write_atomic
    from tailgate.board.verified import digest
    from tailgate.evaluation.rows import read_rows
    from tailgate.evaluation.verify import verify

    if options.out is not None:  # before anything is played
        writable_directory(Path(options.out).parent)

    seed = secrets.randbits(32) if options.sample_seed is None else options.sample_seed  # who could foresee it would forge the others
    rows, origin, held_in = [], [], []
    for name in options.rows:
        held = read_rows(Path(name))
        rows += held
        origin += [(name, line) for line in range(1, len(held) + 1)]
        held_in += [digest(Path(name))] * len(held)
    if not rows:
        raise InputError("--rows", options.rows, "at least one row of an evaluation in them")
    if options.trust_code or options.submission:
        sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `tailgate evaluate` does
    with progress(Console(stderr=True)) as update:
        report = verify(
            rows, sample=options.sample, sample_seed=seed, workers=options.workers, batch=options.batch,
            trust_code=options.trust_code,
            submissions=options.submission, files=held_in,
            progress=lambda done, total: update("playing", done, total, cells(done, total)),
        )  # fmt: skip
    for finding in report["findings"]:
        finding["file"], finding["line"] = origin[finding["line"] - 1]
    text = json.dumps(report, indent=1, allow_nan=False)
    if options.out is not None:
        write_atomic(Path(options.out), text.encode() + b"\n")
    if options.json:
        print(text)
    else:
        _print(report)
    return 1 if report["counts"]["differs"] or not report["counts"]["verified"] else 0


def _print(report: dict[str, Any]) -> None:
    out = console()
    drawn = "" if report["sample"] is None else f", drawn by the seed {report['sample_seed']}"
    played = report["counts"]["verified"] + report["counts"]["differs"]
    table = Table(title=f"{report['status']}: {played} of {report['rows']} rows played again, {report['asked']} asked for{drawn}")
    for heading in ("defence", "status", "verified", "differs", "unchecked"):
        table.add_column(heading, overflow="fold")
    for entry in report["entries"]:
        table.add_row(escape(entry["defence"]), entry["status"], *(str(entry[key]) for key in ("verified", "differs", "unchecked")))
    out.print(table)
    for reason in report["reasons"][:SHOWN]:
        out.print(f"{reason['rows']} rows {reason['why']}", markup=False, highlight=False)
    wrong = [finding for finding in report["findings"] if finding["verdict"] == "differs"]
    for finding in wrong[:SHOWN]:
        named = f"{finding['scenario']}, {finding['defence']}, {finding['attack']}, dose {finding['dose']}, seed {finding['seed']}"
        out.print(f"{finding['file']}, line {finding['line']}: {named}", markup=False, highlight=False)
        for part in finding["differences"]:
            out.print(f"    {part['field']}: row {part['row']!r}, here {part['here']!r}", markup=False, highlight=False)
    if len(wrong) > SHOWN:
        out.print(f"and {len(wrong) - SHOWN} more; --json lists them all", highlight=False)
