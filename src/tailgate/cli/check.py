"""tailgate leaderboard check: cells of a board played again, without its rows."""

from __future__ import annotations

import argparse
import json
import secrets
import shlex
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.errors import InputError
from tailgate.base.progress import cells, console, progress

SHOWN = 20  # cells that are listed, at most
LONGEST = 160  # characters of a figure that are shown


def add(actions: Any) -> None:
    """Adds `check` to the actions of a command."""
    command = actions.add_parser(
        "check", help="play cells of a published board again, without its rows",
        description="Play cells of a board again and compare how many episodes came to damage, and the fingerprint of all decisions. "
        "Rates, critical doses and curves have to follow from the cells, ranks too where the cells say which episodes came to damage; "
        "where all cells of the board are played, gates, flags and all else are made again as well. With --detection, detection and "
        "stealth impact are played again instead. Exit code 1 when anything differs, or nothing could be checked. Registered names, the "
        "zoo, and files of policies that are here are played; a board never makes this command import code.",
    )  # fmt: skip
    command.add_argument("board", metavar="FILE", help="board.json")
    command.add_argument("--sample", type=int, metavar="N", help="so many cells, drawn at random (default: all)")
    command.add_argument("--sample-seed", type=int, metavar="N", help="which ones (default: a new secret each time; the report names it)")
    command.add_argument("--defence", action="append", default=[], metavar="NAME", help="only the cells of these defences (repeatable)")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1); changes no result")
    command.add_argument("--detection", action="store_true",
                         help="in place of the cells play detection and stealth impact again: --sample then counts entries")  # fmt: skip
    command.add_argument("--write", action="store_true", help="put into the board what was found, and hits and fingerprints of equal cells")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=_check)


def _check(options: argparse.Namespace) -> int:
    from tailgate.board.check import check, with_check
    from tailgate.board.detect import check_detection
    from tailgate.board.files import load, save

    if options.detection and options.write:
        raise InputError("--write", True, "the cells of a board, without --detection")
    path = Path(options.board)
    board = load(path)
    seed = secrets.randbits(32) if options.sample_seed is None else options.sample_seed
    asked = {"sample": options.sample, "sample_seed": seed, "defences": options.defence, "workers": options.workers}
    with progress(Console(stderr=True)) as update:
        if options.detection:
            report = check_detection(board, **asked, progress=update)
        else:
            report = check(board, **asked, progress=lambda done, total: update("playing", done, total, cells(done, total)))
    if options.write:
        save(with_check(board, report), path)
    if options.json:
        print(json.dumps(report, indent=1, allow_nan=False))
    elif options.detection:
        _print_detection(report)
    else:
        _print(report)
    return 1 if report["counts"]["differs"] or report.get("strays") or not report["counts"]["equal"] else 0


def _table(report: dict[str, Any], title: str, columns: tuple[str, ...]) -> Table:
    """A line for each entry."""
    table = Table(title=title)
    for heading in columns:
        table.add_column(heading, overflow="fold")
    for entry in report["entries"]:
        table.add_row(*(escape(str(entry[key])) for key in columns))
    return table


def _print_detection(report: dict[str, Any]) -> None:
    out = console()
    title = f"{report['suite']}: detection of {report['asked']} of {report['of']} entries played again{_seed(report)}; figures"
    out.print(_table(report, title, ("defence", "equal", "differs", "unchecked")))
    for reason in report["reasons"]:
        out.print(f"{reason['defence']} unchecked: {reason['why']}", markup=False, highlight=False)
    findings: list[dict[str, Any]] = report["findings"]
    for found in findings[:SHOWN]:
        words = (found["of"], found["scenario"] or found["plant"], found["attack"], f"{found['hours']:g} h", found["field"])
        said = f"board {_words(found['board'])}, here {_words(found['here'])}"
        out.print(f"    {found['defence']}: {', '.join(filter(None, words))}: {said}", markup=False, highlight=False, soft_wrap=True)
    if len(findings) > SHOWN:
        out.print(f"and {len(findings) - SHOWN} more; --json lists them all", highlight=False)


def _seed(report: dict[str, Any]) -> str:
    return "" if report["sample"] is None else f", drawn by the seed {report['sample_seed']}"


def _print(report: dict[str, Any]) -> None:
    out = console()
    played = report["counts"]["equal"] + report["counts"]["differs"]
    title = f"{report['suite']}: {played} of {report['cells']} cells played again, {report['asked']} asked for{_seed(report)}"
    out.print(_table(report, title, ("defence", "cells", "equal", "differs", "unchecked")))
    reasons: list[dict[str, Any]] = report["reasons"]
    for reason in reasons[:SHOWN]:
        out.print(f"{reason['cells']} cell{'s' * (reason['cells'] != 1)} unchecked: {reason['why']}", markup=False, highlight=False)
    if len(reasons) > SHOWN:
        out.print(f"and {len(reasons) - SHOWN} more reasons; --json lists all cells", highlight=False)
    untrained: list[dict[str, Any]] = report["untrained"]
    if untrained:
        out.print("Attackers whose files are not here are trained again, those of PPO to the same weights on one machine type alone, by:")
    if untrained and not any(Path(held["folder"]).is_dir() for held in untrained):
        out.print("(Paths begin elsewhere: of a published board in the root of a clone, where most of these files are.)")
    for held in untrained[:SHOWN]:
        words = ["tailgate", "leaderboard", "attack", held["defence"], "--suite", report["suite"], "--out", held["folder"]]
        many = f"attackers: {held['policies']}, cells: {held['cells']}"
        out.print(f"    {shlex.join(words)}    # {many}", markup=False, highlight=False, soft_wrap=True)
    if len(untrained) > SHOWN:
        out.print(f"and {len(untrained) - SHOWN} more; --json lists them all", highlight=False)
    strays: list[dict[str, Any]] = report["strays"]
    if strays:
        out.print(f"{len(strays)} figure{'s differ' if len(strays) > 1 else ' differs'} from what is made here:")
    else:
        what = "ranks from its comparisons" if report["untold"] else "comparisons and ranks too"
        out.print(f"Rates, critical doses and curves of all entries follow from the cells, {what}.")
    if report["untold"]:
        out.print(f"Cells of {', '.join(report['untold'])} do not say which episodes came to damage, and tell limits of their comparisons.",
                  markup=False, highlight=False)  # fmt: skip
    for stray in strays[:SHOWN]:
        where, board, here = _first(stray["board"], stray["here"])
        place = ": ".join(filter(None, (stray["defence"], stray["field"] + where)))
        said = f"board {_words(board)}, here {_words(here)}"
        out.print(f"    {place}: {said}", markup=False, highlight=False, soft_wrap=True)
    if len(strays) > SHOWN:
        out.print(f"and {len(strays) - SHOWN} more; --json lists them all", highlight=False)
    if not report["scored"]:
        which = "Comparisons, gates" if report["untold"] else "Gates"
        out.print(f"{which} and clean figures were not made again: that takes all cells of the board.")
    elif not strays:
        out.print("Ranks, gates and clean figures came out as the board says.")
    findings: list[dict[str, Any]] = report["findings"]
    wrong = [finding for finding in findings if finding["verdict"] == "differs"]
    for finding in wrong[:SHOWN]:
        named = f"{finding['scenario']}, {finding['defence']}, {finding['attack']}, dose {finding['dose']}"
        out.print(f"{named}: {finding['why']}", markup=False, highlight=False)
    if len(wrong) > SHOWN:
        out.print(f"and {len(wrong) - SHOWN} more; --json lists them all", highlight=False)


def _first(board: Any, here: Any) -> tuple[str, Any, Any]:
    """Where two pieces of JSON first differ, and what stands there: a list may be long, and its difference at the end."""
    from tailgate.board.consistency import same

    pairs: list[tuple[str, Any, Any]] = []
    if isinstance(board, dict) and isinstance(here, dict):
        pairs = [(f".{name}", board.get(name), here.get(name)) for name in dict.fromkeys((*board, *here))]
    elif isinstance(board, list) and isinstance(here, list) and len(board) == len(here):
        pairs = [(f"[{i}]", *both) for i, both in enumerate(zip(board, here, strict=True))]
    for step, one, other in pairs:
        if not same(one, other):
            where, one, other = _first(one, other)
            return step + where, one, other
    return "", board, here


def _words(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST else text[:LONGEST] + "..."
