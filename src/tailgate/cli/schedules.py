"""tailgate leaderboard timing: what the timing of a board's trained attackers is worth."""

from __future__ import annotations

import argparse
from pathlib import Path

from tailgate.cli.shared import Commands, add_options, counted, table, working

WORDS = {"more": "do more", "equal": "yoked equals own", "unknown": "undecided"}


def add(actions: Commands) -> None:
    """Add `timing` to the actions of a command."""
    command = actions.add_parser(
        "timing", help="measure what the timing of a board's trained attackers is worth",
        description="Play a trained attacker of each ranked entry again, at its own times and at those of its twins (another episode's, "
        "shuffled, evenly spread), and write OUT/SUITE/timing.json, which the pages of the entries show. With --defence figures are "
        "printed, not written.",
    )  # fmt: skip
    add_options(command, "suite", "--out")
    command.add_argument("--defence", action="append", default=[], metavar="NAME", help="only these (repeatable; default: all ranked)")
    command.add_argument("--episodes", type=int, metavar="N", help="fresh ones for each schedule (default: four times those of a cell)")
    command.add_argument("--json", action="store_true", help="print the file")
    command.set_defaults(run=_timing)


def _timing(options: argparse.Namespace) -> int:
    from tailgate.board.files import board_in, load
    from tailgate.board.timing import measure_timing
    from tailgate.core.scenario import load_suite
    from tailgate.site.timing import points

    suite = load_suite(options.suite)
    folder = Path(options.out) / suite.name
    board = load(board_in(folder))
    with working() as update:
        timing = measure_timing(
            board, suite, options.defence, episodes=options.episodes,
            progress=counted(update, "schedules", "entries"),
        )  # fmt: skip
    path = None if options.defence else timing.write(folder)  # part of a file would lose the rest
    if options.json:
        print(timing.text(), end="")
        return 0
    title = f"{suite.name}: damage [%] at own times, and at those of twins"
    columns = ("defence", "attacker", "scenario", "dose", "own", "yoked", "shuffled", "periodic", "advantage", "p", "own times")
    rows = []
    for entry in timing.entries:
        shares = (f"{100 * share.value:.0f}" for share in (entry.own, entry.yoked, entry.shuffled, entry.periodic))
        gain = f"{points(entry.advantage.value)} ({points(entry.advantage.low)} to {points(entry.advantage.high)})"
        who = "/".join(Path(entry.attack).with_suffix("").parts[-2:])
        texts = (entry.defence, who, entry.scenario, "own" if entry.dose is None else str(entry.dose), *shares)
        said = WORDS[entry.verdict] + "; twins do more" * entry.outdone
        rows.append((*texts, gain, f"{entry.advantage.adjusted:.2g}", said))
    table(columns, rows, title, "on fresh episodes; 95 %, p after Holm")
    for missing in timing.without:
        print(f"{missing.defence}: {missing.why}")
    print(path or "figures of some entries are not written")
    return 0
