"""tailgate leaderboard try: from a class to its place on a board, by one command."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tailgate.base import sizes
from tailgate.cli.shared import Commands, add_options, own_classes, print_json, say, tell, working

FIELDS = ("defence", "status", "why", "rank", "class", "gates", "critical_dose", "rates", "flags")


def add(actions: Commands) -> None:
    """Add `try` to the actions of `leaderboard`."""
    command = actions.add_parser(
        "try", help="play, attack and rank a class of yours among the entries of a published board",
        description="Play a defence on a suite, attack it with everything that the suite asks for, and put it on the published board: its "
        "rank there, and the replay of its worst episode. The rank is provisional, as you have played it yourself on public seeds. "
        "Example: tailgate leaderboard try mydefence:Saturated:gain=0.1",
    )  # fmt: skip
    command.add_argument("defence", metavar="module:Class", help="class to try, module:Class:key=value")
    command.add_argument("--suite", default="quick-v1", metavar="NAME", help="suite by name or YAML file (default: quick-v1)")
    command.add_argument("--board", metavar="FILE", help="board that it joins (default: the published one of the suite)")
    command.add_argument("--out", default="tried", metavar="DIR", help="rows, attackers and page (default: tried)")
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2); change no result")
    add_options(command, "--engine", "--address")
    command.add_argument("--json", action="store_true", help="print the entry as JSON")
    command.set_defaults(run=_try, kept="the same command goes on after the searches that are finished")


def _try(options: argparse.Namespace) -> int:
    from tailgate.base.locks import alone
    from tailgate.base.reading import load_json
    from tailgate.board.attachments import Attachments
    from tailgate.board.gates import explained
    from tailgate.board.trial import try_out
    from tailgate.cli.board import print_board
    from tailgate.core.scenario import load_suite
    from tailgate.site.build import build_site

    own_classes()
    sizes.check("workers", options.workers)
    out, begun = Path(options.out), time.perf_counter()
    suite = load_suite(options.suite)
    with alone(out), working() as update:
        made = try_out(
            suite, options.defence, out, workers=options.workers, progress=update, say=tell,
            board=Path(options.board) if options.board else None,
        )  # fmt: skip
        folder = made.file.parent.parent / "page"
        page = build_site([made.board], folder, replays=[options.defence], measured=[Attachments.of(made.file)])
    entry, summary = made.entry, load_json(page.parent / "summary.json")
    replay = next(line["replay"] for line in summary["entries"] if line["defence"] == options.defence)
    if options.json:
        print_json({key: entry[key] for key in FIELDS} | {"page": str(page), "replay": str(page.parent / replay) if replay else None})
    else:
        print_board(made.board)
        if entry["rank"]:
            rank, of = entry["rank"], sum(e["rank"] is not None and e["class"] == entry["class"] for e in made.board["entries"])
            place = " to ".join(map(str, dict.fromkeys([rank["best"], rank["worst"]])))
            say(f"{options.defence}: rank {place} of {of} in class {entry['class']}, provisional")
        else:
            for line in explained(entry["gates"]) or [entry["why"]]:
                say(f"{options.defence}: no rank; {line}")
    took = f"{(time.perf_counter() - begun) / 60:.1f} min"
    print(f"page: {page}; replay: {page.parent / replay if replay else 'none'} ({took})", file=sys.stderr)
    return 0
