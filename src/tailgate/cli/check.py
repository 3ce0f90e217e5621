"""tailgate leaderboard check: cells of a board played again, without its rows."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.base.locks import alone
from tailgate.cli.shared import Commands, add_options, counted, drawn_by, sample_seed, say, say_most, show, table, working

LONGEST = 160  # characters of a figure that are shown


def add(actions: Commands) -> None:
    """Add `check` to the actions of a command."""
    command = actions.add_parser(
        "check", help="play cells of a published board again, without its rows",
        description="Play cells of a board again and compare how many episodes came to damage, and the fingerprint of all decisions. "
        "Rates, critical doses and curves have to follow from the cells, ranks too where the cells say which episodes came to damage; "
        "where all cells of the board are played, gates, flags and all else are made again as well. With --detection, detection and "
        "stealth impact are played again instead. Exit code 1 when anything differs, or nothing could be checked. Registered names, the "
        "zoo, and files of policies that are here are played; a board never makes this command import code.",
    )  # fmt: skip
    command.add_argument("board", metavar="FILE", help="board.json, or board.json.xz")
    command.add_argument("--sample", type=int, metavar="N", help="check N cells, drawn at random (default: all)")
    add_options(command, "--sample-seed")
    command.add_argument("--defence", action="append", default=[], metavar="NAME", help="only the cells of these defences (repeatable)")
    add_options(command, "--workers")
    command.add_argument("--detection", action="store_true",
                         help="in place of the cells play detection and stealth impact again: --sample then counts entries")  # fmt: skip
    command.add_argument("--write", action="store_true", help="put into the board what was found, and hits and fingerprints of equal cells")
    add_options(command, "--json")
    command.set_defaults(run=_check)


def _check(options: argparse.Namespace) -> int:
    from tailgate.board.check import check, with_check
    from tailgate.board.detect import check_detection
    from tailgate.board.files import load, save
    from tailgate.board.run import LIST

    if options.detection and options.write:
        raise InputError("--write", True, "the cells of a board, without --detection")
    path = Path(options.board)
    board = load(path)
    asked = {"sample": options.sample, "sample_seed": sample_seed(options), "defences": options.defence, "workers": options.workers}
    with working() as update:
        if options.detection:
            report = check_detection(board, **asked, progress=update)
        else:
            report = check(board, **asked, listed=path.parent / LIST, progress=counted(update, "playing"))
    if options.write:
        with alone(path.parent):  # others may have written meanwhile
            save(with_check(load(path), report), path)
    show(options, report, _print_detection if options.detection else _print)
    return 1 if report["counts"]["differs"] or report.get("strays") or not report["counts"]["equal"] else 0


def _entries(report: dict[str, Any], title: str, columns: tuple[str, ...]) -> None:
    """Print a line for each entry."""
    table(columns, [[str(entry[key]) for key in columns] for entry in report["entries"]], title)


def _print_detection(report: dict[str, Any]) -> None:
    title = f"{report['suite']}: detection of {report['asked']} of {report['of']} entries played again{drawn_by(report)}; figures"
    _entries(report, title, ("defence", "equal", "differs", "unchecked"))
    for reason in report["reasons"]:
        say(f"{reason['defence']} unchecked: {reason['why']}")
    lines = []
    for found in report["findings"]:
        place = (found["of"], found["scenario"] or found["plant"], found["attack"], f"{found['hours']:g} h", found["field"])
        said = f"board {_words(found['board'])}, here {_words(found['here'])}"
        lines.append(f"    {found['defence']}: {', '.join(filter(None, place))}: {said}")
    say_most(lines, soft_wrap=True)


def _print(report: dict[str, Any]) -> None:
    counts, untrained, strays = report["counts"], report["untrained"], report["strays"]
    title = f"{report['suite']}: {counts['equal'] + counts['differs']} of {report['cells']} cells played again, {report['asked']} asked for"
    _entries(report, title + drawn_by(report), ("defence", "cells", "equal", "differs", "unchecked"))
    say_most([f"{r['cells']} cell{'s' * (r['cells'] != 1)} unchecked: {r['why']}" for r in report["reasons"]],
             " more reasons; --json lists all cells")  # fmt: skip
    if untrained:
        say("Attackers whose files are not here are trained again, those of PPO to the same weights on one machine type alone, by:")
        if not any(Path(held["folder"]).is_dir() for held in untrained):
            say("(Paths begin elsewhere: of a published board in the root of a clone, where most of these files are.)")
    lines = []
    for held in untrained:
        words = ["tailgate", "leaderboard", "attack", held["defence"], "--suite", report["suite"], "--out", held["folder"]]
        lines.append(f"    {shlex.join(words)}    # attackers: {held['policies']}, cells: {held['cells']}")
    say_most(lines, soft_wrap=True)
    if strays:
        say(f"{len(strays)} figure{'s differ' if len(strays) > 1 else ' differs'} from what is made here:")
    else:
        what = "ranks from its comparisons" if report["untold"] else "comparisons and ranks too"
        say(f"Rates, critical doses and curves of all entries follow from the cells, {what}.")
    if report["untold"]:
        say(f"Cells of {', '.join(report['untold'])} do not say which episodes came to damage, and tell limits of their comparisons.")
    lines = []
    for stray in strays:
        where, board, here = _first(stray["board"], stray["here"])
        place = ": ".join(filter(None, (stray["defence"], stray["field"] + where)))
        lines.append(f"    {place}: board {_words(board)}, here {_words(here)}")
    say_most(lines, soft_wrap=True)
    if not report["scored"]:
        which = "Comparisons, gates" if report["untold"] else "Gates"
        say(f"{which}, flags, clean figures, impacts and distances were not made again: that takes all cells of the board.")
    elif not strays:
        say("Ranks, gates and clean figures came out as the board says.")
    wrong = [finding for finding in report["findings"] if finding["verdict"] == "differs"]
    say_most([f"{f['scenario']}, {f['defence']}, {f['attack']}, dose {f['dose']}: {f['why']}" for f in wrong])


def _first(board: object, here: object) -> tuple[str, object, object]:
    """Return where two pieces of JSON first differ, and both values: a list may be long, and its difference at the end."""
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


def _words(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST else text[:LONGEST] + "..."
