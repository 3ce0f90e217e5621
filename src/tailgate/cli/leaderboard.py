"""tailgate leaderboard: boards, their page, submissions, and the check of rows."""

from __future__ import annotations

import argparse
from pathlib import Path

from tailgate.cli import admit, attack, board, check, clock, detect, export, gap, retrain, schedules, submit, trial, verify
from tailgate.cli.shared import Commands, add_options, telling_aside


def add(commands: Commands) -> None:
    """Add `leaderboard` to the commands."""
    command = commands.add_parser("leaderboard", help="score suites, attack and submit defences, verify rows, build pages")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    for action in (board, trial, attack, submit, verify, check, detect, clock, gap, schedules, retrain, admit, export):
        action.add(actions)
    build = actions.add_parser("build", help="one self-contained HTML page from rows files, without gates and limits of a board")
    build.add_argument("--rows", nargs="+", required=True, metavar="FILE", help="JSON Lines files of `tailgate evaluate`")
    build.add_argument("--out", required=True, metavar="DIR", help="directory of the page")
    add_options(build, "--title")
    build.set_defaults(run=_build)


def _build(options: argparse.Namespace) -> int:
    from tailgate.base.errors import InputError
    from tailgate.evaluation.rows import read_rows
    from tailgate.site.rows_page import build

    rows = [row for name in options.rows for row in read_rows(Path(name))]
    if not rows:
        raise InputError("--rows", options.rows, "at least one row of an evaluation in them")
    with telling_aside(Path(options.out) / "index.html"):
        print(build(rows, Path(options.out), title=options.title))
    return 0
