"""tailgate leaderboard run, page and head: boards from suites, and the page of boards."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.locks import alone
from tailgate.base.progress import cells, progress
from tailgate.cli.shared import Commands, add_options, own_classes, print_json, table, telling_aside


def add(actions: Commands) -> None:
    """Add `run`, `page` and `head` to the actions of `leaderboard`."""
    command = actions.add_parser(
        "run", help="play suites, score them, and build the page of their boards",
        description="Play every defence of the suites against every attack, score the rows, and build the page: OUT/SUITE/rows.jsonl.xz "
        "(with --defence the rows go to a separate file), OUT/SUITE/board.json, OUT/page. Rows that `leaderboard attack` or `submit` "
        "put below OUT/SUITE count as well. Interrupted, the same command goes on.",
    )  # fmt: skip
    command.add_argument("suites", nargs="+", metavar="SUITE", help="suites by name or YAML file")
    add_options(command, "--out")
    command.add_argument("--defence", action="append", metavar="NAME", help="only these defences (repeatable)")
    command.add_argument("--attack", action="append", metavar="TEXT",
                         help="only these attacks, which the entries that --keep-entries keeps have not met (repeatable)")  # fmt: skip
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2); change no result")
    add_options(command, "--engine", "--address")
    command.add_argument("--beacon", default="", metavar="TEXT", help="the round: random text of after the submissions (default: none)")
    command.add_argument("--score-only", action="store_true", help="play nothing: score the rows that are there")
    command.add_argument("--keep-entries", action="store_true",
                         help="entries of OUT/SUITE/board.json stay that have no rows here, or not those of all their cells; "
                         "they may meet more attacks")  # fmt: skip
    command.add_argument("--train", action="store_true",
                         help="then make the suite's attackers against every defence that passes the gates, and play them")  # fmt: skip
    command.add_argument("--detection", action="store_true", help="then play detection as `leaderboard detect` does: slow")
    command.add_argument("--unattacked", action="store_true", help="also rank defences that no attack was trained against")
    add_options(command, "--no-replays")
    command.add_argument("--json", action="store_true", help="print the entries as JSON")
    command.set_defaults(run=_run, kept="the same command goes on")
    page = actions.add_parser("page", help="build the page of boards")
    page.add_argument("boards", nargs="+", metavar="FILE", help="board.json or board.json.xz files")
    page.add_argument("--out", required=True, metavar="DIR", help="directory of the page")
    add_options(page, "--title", "--no-replays")
    page.set_defaults(run=_page)
    head = actions.add_parser("head", help="print the head of a board as a Markdown table")
    head.add_argument("board", metavar="FILE", help="board.json, board.json.xz, or the name of a published board")
    head.add_argument("--most", type=int, metavar="N", help="print at most N defences, the first in the order of the page (default: all)")
    head.set_defaults(run=_head)


def _run(options: argparse.Namespace) -> int:
    own_classes()
    from tailgate.board.attachments import Attachments
    from tailgate.board.attacked import attack
    from tailgate.board.detect import detect
    from tailgate.board.files import board_in
    from tailgate.board.run import board_of, kept_board, play
    from tailgate.board.run_record import Record
    from tailgate.core.scenario import load_suite
    from tailgate.site.build import build_site

    if options.attack and not options.keep_entries:
        raise InputError("--attack", options.attack[0], "--keep-entries too: a board of some attacks alone would say too little")
    for name in ("unattacked", "score_only") if options.train else ():
        if getattr(options, name):
            raise InputError("--train", True, f"no --{name.replace('_', '-')}: it attacks every defence that was not")
    sizes.check("workers", options.workers)
    out, started = Path(options.out), time.perf_counter()
    suites = [load_suite(name) for name in options.suites]
    for suite in suites:
        Attachments.of(board_in(out / suite.name))  # refuses what is no such file before anything is played
    kept = {suite.name: kept_board(board_in(out / suite.name), suite, options.beacon) for suite in suites if options.keep_entries}
    boards = []
    with contextlib.ExitStack() as locks, progress(Console(stderr=True)) as update:
        for folder in sorted({out / suite.name for suite in suites}):
            locks.enter_context(alone(folder))
        for suite in suites:
            folder = out / suite.name
            record = Record(suite, folder, options.workers, options.keep_entries)
            if not options.score_only:
                counting = record.counting(lambda name, done, total: update(name, done, total, cells(done, total)))
                rows = play(
                    suite, folder, defences=options.defence, attacks=options.attack, workers=options.workers, beacon=options.beacon,
                    board=kept.get(suite.name), progress=counting,
                )  # fmt: skip
                print(f"rows: {rows}", file=sys.stderr)
            board = board_of(
                suite, folder, beacon=options.beacon or None, keep=options.keep_entries, require_adaptive=not options.unattacked
            )
            left = [entry["defence"] for entry in board["entries"] if entry["status"] == "unattacked"] if options.train else []
            for number, defence in enumerate(left, start=1):

                def numbered(label: str, *rest: Any, head: str = f"{number} of {len(left)}, {defence}") -> None:
                    update(f"{head}: {label}", *rest)

                attack(
                    suite, defence, folder / "attacked", beacon=options.beacon, workers=options.workers, progress=numbered,
                    counting=record.counting,
                )  # fmt: skip
            if left:
                board = board_of(suite, folder, beacon=options.beacon or None, keep=options.keep_entries)
            print(record.finish(board["suite"]["rows"]), file=sys.stderr)
            boards.append(detect(board_in(folder), suite, workers=options.workers, progress=update) if options.detection else board)
    measured = [Attachments.of(board_in(out / suite.name)) for suite in suites]
    page = build_site(boards, out / "page", replays=not options.no_replays, measured=measured)
    if options.json:
        print_json([{"suite": b["suite"]["name"], "entries": b["entries"]} for b in boards])
    for board in () if options.json else boards:
        print_board(board)
    print(f"page: {page} ({(time.perf_counter() - started) / 60:.1f} min)", file=sys.stderr)
    return 0


def print_board(board: dict[str, Any]) -> None:
    """Print the head of a board as a table."""
    from tailgate.board.head import lines, title

    headings, *rows = lines(board)
    table(headings, rows, title(board))


def _head(options: argparse.Namespace) -> int:
    from tailgate.board.files import load
    from tailgate.board.head import markdown

    board = load(options.board)
    if options.most is not None:
        sizes.check("most", options.most)
    print(markdown(board, options.most), end="")
    return 0


def _page(options: argparse.Namespace) -> int:
    from tailgate.board.attachments import Attachments
    from tailgate.board.files import load
    from tailgate.site.build import build_site

    boards = [load(name) for name in options.boards]
    measured = [Attachments.of(Path(name)) for name in options.boards]
    with telling_aside(Path(options.out) / "index.html"):
        print(build_site(boards, Path(options.out), title=options.title, replays=not options.no_replays, measured=measured))
    return 0
