"""tailgate bench: the speed of this package and of others, in one run."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tailgate.base.progress import console
from tailgate.cli.shared import Commands, print_json, table, working


def add(commands: Commands) -> None:
    """Add `bench` to the commands."""
    command = commands.add_parser(
        "bench", help="measure the speed of this package and of the peers that are installed, side by side",
        description="Measure environments, estimators and solvers next to their peers, interleaved in one run, and judge the ratios by "
        "their targets. Peers are extras; one that is not installed is reported as missing. Exit code 0 whatever the figures are: the "
        "machine may be busy. docs/speed.md says how it is done.",
    )  # fmt: skip
    command.add_argument("--only", action="append", metavar="NAME", help="this target, line or scaling only (repeatable)")
    command.add_argument("--list", action="store_true", help="list targets, lines and scalings, and measure nothing")
    command.add_argument("--device", default="cpu", metavar="NAME", help="cuda: this package on a card instead; bits are compared first")
    command.add_argument("--rounds", type=int, default=7, metavar="N", help="rounds of each line (default 7; half as many for scalings)")
    command.add_argument("--seconds", type=float, default=0.5, metavar="S", help="seconds of a line in a round, about (default 0.5)")
    command.add_argument("--out", metavar="DIR", help="write speed.json, speed.md and plots here (the plots need tailgate[viz])")
    command.add_argument("--json", action="store_true", help="print the record as JSON")
    command.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> int:
    from tailgate.bench.report import check_place, print_tables, write
    from tailgate.bench.run import bench
    from tailgate.bench.targets import chosen

    if options.device != "cpu":
        return _card(options)
    targets, lines, plots = chosen(options.only)
    if options.list:
        listed = {
            "targets": {target.name: target.what for target in targets}, "lines": {line.name: line.what for line in lines},
            "scalings": {plot.name: plot.what for plot in plots},
        }  # fmt: skip
        if options.json:
            print_json(listed)
        else:
            for kind, entries in listed.items():
                print(f"{kind}:")
                for name, what in entries.items():
                    print(f"  {name:<24}{what}")
        return 0
    if options.out:
        check_place(Path(options.out), {line.name for line in lines} | {plot.name for plot in plots})
    with working() as update:
        record = bench(options.only, options.rounds, options.seconds, update)
    if options.json:
        print_json(record)
    else:
        print_tables(record, console())
    if options.out:
        paths, why = write(record, Path(options.out))
        for path in paths:
            print(f"written: {path}", file=sys.stderr)
        if why:
            print(why, file=sys.stderr)
    return 0


def _card(options: argparse.Namespace) -> int:
    """Measure a card. Exit code 1 if its bits are not those of the processor."""
    from tailgate.bench import cards

    if options.list:
        for name, plant in cards.PLANTS.items():
            print(f"{name:<24}{plant.scenario}, {plant.defence}")
        return 0
    with working() as update:
        record = cards.bench(options.only, options.rounds, options.seconds, update)
    if options.json:
        print_json(record)
    else:
        cards.print_record(record, table)
    if options.out:
        path = cards.write(record, Path(options.out))
        print(f"written: {path}", file=sys.stderr)
    return 0 if record["equal"] else 1
