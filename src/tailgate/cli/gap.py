"""tailgate leaderboard gap: entries with a longer gap, compared at equal mean gap."""

from __future__ import annotations

import argparse
from pathlib import Path

from tailgate.cli.shared import Commands, add_options, counted, table, working


def add(actions: Commands) -> None:
    """Add `gap` to the actions of a command."""
    command = actions.add_parser(
        "gap", help="compare entries that keep a longer gap with a plain filter that keeps the same",
        description="Compare each ranked entry of OUT/SUITE/board.json whose mean gap without an attack is longer than that of kf with kf "
        "behind a controller whose headway makes its mean gap equal, against the black-box attacks of the board that kf met. Writes "
        "OUT/SUITE/gap.json, which the pages of the entries show. With --defence figures are printed, not written.",
    )  # fmt: skip
    add_options(command, "suite", "--out")
    command.add_argument("--defence", action="append", default=[], metavar="NAME", help="only these (repeatable; default: ranked entries)")
    command.add_argument("--json", action="store_true", help="print the file")
    command.set_defaults(run=_gap)


def _gap(options: argparse.Namespace) -> int:
    from tailgate.board.equal_gap import measure_gap
    from tailgate.board.files import board_in, load
    from tailgate.board.words import at_least
    from tailgate.core.scenario import load_suite

    suite = load_suite(options.suite)
    folder = Path(options.out) / suite.name
    with working() as update:
        found = measure_gap(load(board_in(folder)), suite, options.defence, progress=counted(update, "equal gap", "entries"))
    path = None if options.defence else found.write(folder)  # part of a file would lose the rest
    if options.json:
        print(found.text(), end="")
        return 0
    rows = [
        (e.defence, f"{100 * e.gap:+.1f} %", f"{e.factor:.3g}", f"{100 * e.undamaged.value:.0f} %", at_least(e.undamaged.low), e.attack)
        for e in found.entries
    ]
    title = f"{suite.name}: kf at the mean gap of each entry"
    table(("defence", "mean gap", "headway, times", "kf undamaged", "at least", "worst"), rows, title)
    for line in found.without:
        print(f"{line.defence}: {line.why}")
    if path is not None:
        print(path)
    return 0
