"""tailgate leaderboard clock: what a step of each defence costs."""

from __future__ import annotations

import argparse
from pathlib import Path

from tailgate.base import sizes
from tailgate.cli.shared import Commands, add_options, counted, table, working


def add(actions: Commands) -> None:
    """Add `clock` to the actions of a command."""
    command = actions.add_parser(
        "clock", help="measure what a step of each defence costs",
        description="Time the defences of a suite alone, step by step in one episode, in turn, and write OUT/SUITE/step_time.json, which "
        "the pages of the entries show. The machine should have nothing else to do. With --defence figures are printed, not written.",
    )  # fmt: skip
    add_options(command, "suite", "--out")
    command.add_argument("--defence", action="append", default=[], metavar="NAME", help="only these (repeatable; default: the suite's)")
    command.add_argument("--rounds", type=int, default=5, metavar="N", help="episodes of each (default 5)")
    command.add_argument("--json", action="store_true", help="print the file")
    command.set_defaults(run=_clock)


def _clock(options: argparse.Namespace) -> int:
    from tailgate.base.files import writable_directory
    from tailgate.board.clock import measure
    from tailgate.core.scenario import load_suite

    sizes.check("rounds", options.rounds)
    suite = load_suite(options.suite)
    folder = None if options.defence else writable_directory(Path(options.out) / suite.name)  # part of a file would lose the rest
    with working() as update:
        clock = measure(
            suite, options.defence, rounds=options.rounds,
            progress=counted(update, "timing"),
        )  # fmt: skip
    path = None if folder is None else clock.write(folder)
    if options.json:
        print(clock.text(), end="")
        return 0
    of = "one car" if clock.agents == 1 else f"{clock.agents} agents"
    entries = sorted(clock.entries, key=lambda entry: entry.median)
    rows = [(entry.defence, *(f"{value:.1f}" for value in (entry.median, entry.low, entry.high))) for entry in entries]
    title = f"a step in {clock.scenario}, one episode of {of}, {clock.processor} [us]"
    table(("defence", "median", "least", "largest"), rows, title, numbers=(1, 2, 3))
    timed = {entry.defence for entry in clock.entries}
    if missing := [name for name in suite.defences if not options.defence and name not in timed]:
        print(f"without a meaning there: {', '.join(missing)}")
    if path is not None:
        print(path)
    return 0
