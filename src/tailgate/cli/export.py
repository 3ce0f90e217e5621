"""tailgate leaderboard export: a board for a paper."""

from __future__ import annotations

import argparse
import sys

from tailgate.base import sizes
from tailgate.cli.shared import Commands, written


def add(actions: Commands) -> None:
    """Add `export` to the actions of `leaderboard`."""
    command = actions.add_parser(
        "export", help="write a board for a paper: CSV, LaTeX, BibTeX, SVG or PDF",
        description="Write the figures of a board as CSV, its head as a LaTeX table (booktabs), how to cite it as BibTeX, or damage by "
        "dose as a picture. Example: tailgate leaderboard export quick-v1 --format latex --most 14",
    )  # fmt: skip
    command.add_argument("board", metavar="BOARD", help="board.json, board.json.xz, or the name of a published board: quick-v1")
    command.add_argument("--format", required=True, metavar="FORM", help="csv, latex, bibtex, svg or pdf")
    command.add_argument("--most", type=int, metavar="N", help="at most N defences, the first in the order of the page (default: all)")
    command.add_argument("--out", metavar="FILE", help="file to write (default: print it)")
    command.set_defaults(run=_export)


def _export(options: argparse.Namespace) -> int:
    from tailgate.base.files import write_atomic
    from tailgate.board.export import exported
    from tailgate.board.files import load

    if options.most is not None:
        sizes.check("most", options.most)
    out = written("--out", options.out)
    content = exported(load(options.board), options.format, options.most)
    if out is not None:
        write_atomic(out, content)
    else:
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
    return 0
