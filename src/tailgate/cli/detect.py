"""tailgate leaderboard detect: the detection board and stealth-impact curves of a board."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from tailgate.base.progress import progress
from tailgate.cli.shared import Commands, add_options, own_classes


def add(actions: Commands) -> None:
    """Add `detect` to the actions of a command."""
    command = actions.add_parser(
        "detect", help="play detection and stealth impact of a board, without its rows",
        description="Find each defence's threshold for the wanted mean times between false alarms, play the black-box scripts of "
        "OUT/SUITE/board.json and the stealth attack at it, and count false alarms in every scenario. The board is written as soon as an "
        "entry is done, and an entry that it has is not played again: interrupted, the same command goes on.",
    )  # fmt: skip
    add_options(command, "suite", "--out")
    command.add_argument("--defence", action="append", default=[], metavar="NAME",
                         help="only these entries (repeatable); module:Class of the board is imported when it is named here")  # fmt: skip
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes, an entry each (default 2); change no result")
    add_options(command, "--engine", "--address")
    command.add_argument("--hours", action="append", type=float, metavar="H",
                         help="mean time between false alarms [h] (repeatable; default 0.1, 1 and 10)")  # fmt: skip
    command.add_argument("--episodes", type=int, metavar="N", help="episodes of a scenario and an attack (default 100)")
    command.add_argument("--onsets", type=int, metavar="N", help="false alarms that a threshold is found on (default 100: +-20 %%)")
    command.add_argument("--steps", type=int, metavar="N", help="longest clean run (default 8 million steps)")
    command.add_argument("--checked", type=int, metavar="N",
                         help="false alarms wanted at a found threshold (default 20), in a quarter of --steps at most")  # fmt: skip
    command.set_defaults(run=_detect, kept="the same command goes on")


def _detect(options: argparse.Namespace) -> int:
    from tailgate.board.detect import detect
    from tailgate.board.detection import Effort
    from tailgate.board.files import board_in, load
    from tailgate.core.scenario import load_suite

    own_classes()
    suite = load_suite(options.suite)
    path = board_in(Path(options.out) / suite.name)
    hours = None if options.hours is None else tuple(options.hours)
    given = {"hours": hours, "episodes": options.episodes, "onsets": options.onsets, "most_steps": options.steps}
    given["checked"] = options.checked
    effort = Effort(**{name: value for name, value in given.items() if value is not None})
    before, errors = load(path), Console(stderr=True)
    with progress(errors) as update:
        after = detect(path, suite, defences=options.defence, effort=effort, workers=options.workers, progress=update)
    if after == before:
        errors.print("the board is as it was: nothing was left to play, or nothing can be", highlight=False)
    print(path)
    return 0
