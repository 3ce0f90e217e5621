"""tailgate leaderboard verify: rows played again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import MORE, SHOWN, Commands, add_options, counted, drawn_by, own_classes, sample_seed, say, show, working, written
from tailgate.cli.tables import table


def add(actions: Commands) -> None:
    """Add `verify` to the actions of a command."""
    command = actions.add_parser(
        "verify", help="play rows again and compare their hashes and figures",
        description="Play rows again and compare hashes, metrics and all else that they record. Exit code 1 when a row differs, or when "
        "none could be checked. A row never makes this command import code: registered names, the zoo, and files with the row's digest are "
        "played.",
    )  # fmt: skip
    command.add_argument("--rows", nargs="+", required=True, metavar="FILE", help="JSON Lines files of `tailgate evaluate`")
    command.add_argument("--sample", type=int, metavar="N", help="verify N rows, drawn at random (default: all)")
    add_options(command, "--sample-seed", "--workers")
    command.add_argument("--batch", type=int, metavar="N", help="episodes side by side instead of the rows' number; changes no result")
    command.add_argument("--trust-code", action="store_true", help="also import the classes that rows name; they run with your rights")
    command.add_argument(
        "--submission", action="append", default=[], metavar="SANDBOX/module:Class",
        help="class that rows of `leaderboard submit` are about, played again in a sandbox: bwrap/mydefence:Saturated (repeatable)",
    )  # fmt: skip
    command.add_argument("--out", metavar="FILE", help="also write the report here: OUT/SUITE/verified/NAME.json for the next board")
    add_options(command, "--json")
    command.set_defaults(run=_verify)


def _verify(options: argparse.Namespace) -> int:
    from tailgate.base.files import write_json
    from tailgate.board.verified import digest
    from tailgate.evaluation.rows import Row, read_rows
    from tailgate.evaluation.verify import verify

    out = written("--out", options.out)
    rows: list[Row] = []
    origin, held_in = [], []
    for name in options.rows:
        held = read_rows(Path(name))
        rows += held
        origin += [(name, line) for line in range(1, len(held) + 1)]
        held_in += [digest(Path(name))] * len(held)
    if not rows:
        raise InputError("--rows", options.rows, "at least one row of an evaluation in them")
    if options.trust_code or options.submission:
        own_classes()
    with working() as update:
        report = verify(
            rows, sample=options.sample, sample_seed=sample_seed(options), workers=options.workers, batch=options.batch,
            trust_code=options.trust_code,
            submissions=options.submission, files=held_in,
            progress=counted(update, "playing"),
        )  # fmt: skip
    for finding in report["findings"]:
        finding["file"], finding["line"] = origin[finding["line"] - 1]
    if out is not None:
        write_json(out, report)
    show(options, report, _print)
    return 1 if report["counts"]["differs"] or not report["counts"]["verified"] else 0


def _print(report: dict[str, Any]) -> None:
    counts = report["counts"]
    played = f"{counts['verified'] + counts['differs']} of {report['rows']} rows played again"
    columns = ("defence", "status", "verified", "differs", "unchecked")
    rows = [[str(entry[key]) for key in columns] for entry in report["entries"]]
    table(columns, rows, f"{report['status']}: {played}, {report['asked']} asked for{drawn_by(report)}")
    for reason in report["reasons"][:SHOWN]:
        say(f"{reason['rows']} rows {reason['why']}")
    if report["left_out"]:
        say(f"not made again, as they are somebody's own metrics: {', '.join(report['left_out'])}")
    wrong = [finding for finding in report["findings"] if finding["verdict"] == "differs"]
    for finding in wrong[:SHOWN]:
        named = f"{finding['scenario']}, {finding['defence']}, {finding['attack']}, dose {finding['dose']}, seed {finding['seed']}"
        say(f"{finding['file']}, line {finding['line']}: {named}")
        for part in finding["differences"]:
            say(f"    {part['field']}: row {part['row']!r}, here {part['here']!r}")
    if len(wrong) > SHOWN:
        say(f"and {len(wrong) - SHOWN} more{MORE}")
