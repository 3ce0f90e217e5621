"""tailgate leaderboard attack: make a suite's attackers against a defence, and play them on it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tailgate.base import sizes
from tailgate.cli.shared import Commands, add_options, own_classes, working


def add(actions: Commands) -> None:
    """Add `attack` to the actions of a command."""
    command = actions.add_parser(
        "attack", help="make a suite's attackers against a defence, and play them on it",
        description="Run the standard attack ensemble against the defence, or train the learners that the suite names, as its plan says. "
        "What they make is played on the defence at every dose. A defence without these rows takes no rank. Interrupted, the same command "
        "goes on.",
    )  # fmt: skip
    command.add_argument("defence", metavar="NAME", help="registered defence, or a class in a sandbox: bwrap/module:Class")
    command.add_argument("--suite", required=True, metavar="NAME", help="suite that says what is searched or trained")
    command.add_argument("--out", required=True, metavar="DIR", help="attackers go to DIR/policies or DIR/found, rows to DIR/NAME*.jsonl")
    command.add_argument("--seeds", type=int, metavar="N", help="training seeds instead of the suite's")
    command.add_argument("--episodes", type=int, metavar="N", help="report episodes per cell instead of the suite's")
    command.add_argument("--beacon", default="", metavar="TEXT", help="the round of the board: its seeds are played")
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2); change no result")
    add_options(command, "--engine", "--address")
    command.add_argument("--set", action="append", default=[], metavar="key=value", help="change the training (repeatable): steps=10000")
    command.set_defaults(run=_attack, kept="the same command goes on")


def _attack(options: argparse.Namespace) -> int:
    from tailgate.board.attacked import attack
    from tailgate.core.scenario import load_suite

    own_classes()

    sizes.check("workers", options.workers)
    if options.episodes is not None:  # before anything is trained
        sizes.check("episodes", options.episodes)
    with working() as update:
        made = attack(
            load_suite(options.suite), options.defence, Path(options.out), seeds=options.seeds, episodes=options.episodes,
            beacon=options.beacon, workers=options.workers, changes=tuple(options.set), progress=update,
        )  # fmt: skip
    for file in made.files:
        print(file)
    print(f"{len(made.policies)} trained policies, {made.rows} rows", file=sys.stderr)
    return 0
