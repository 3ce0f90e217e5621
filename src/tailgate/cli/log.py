"""tailgate log: episodes for those who learn a detector."""

from __future__ import annotations

import argparse

from tailgate.cli.shared import Commands, add_options, counted, own_classes, print_json, say, table, working
from tailgate.core.schema import scalar


def add(commands: Commands) -> None:
    """Add `log` to the commands."""
    command = commands.add_parser(
        "log", help="write clean and attacked episodes as Parquet, for learning a detector (needs tailgate[log])",
        description="Write episodes of a suite as Parquet, one row per step and agent, with labels: training and development episodes, "
        "whose seeds no board uses. Attacks that the suite holds out are left out. An interrupted log goes on; a whole one stays as it is.",
    )  # fmt: skip
    command.add_argument("--suite", default="quick-v0", metavar="NAME", help="suite by name or YAML file (default quick-v0)")
    command.add_argument("--out", required=True, metavar="DIR", help="directory of the log: new, or with this log")
    command.add_argument("--episodes", type=int, default=100, metavar="N", help="training episodes per cell (default 100)")
    command.add_argument("--dev-episodes", type=int, default=25, metavar="N", help="development episodes per cell (default 25)")
    add_options(command, "--scenario")
    command.add_argument("--defence", action="append", metavar="NAME", help="a defence instead of the suite's standard one (repeatable)")
    command.add_argument("--attack", action="append", metavar="NAME", help="an attack next to none, instead of the suite's (repeatable)")
    command.add_argument("--dose", action="append", metavar="STEPS", help="attack budget instead of the suite's middle one (repeatable)")
    command.add_argument("--json", action="store_true", help="print what was written as JSON")
    command.set_defaults(run=_log, kept="the same command goes on")


def _log(options: argparse.Namespace) -> int:
    from tailgate.studies.log import write_log

    own_classes()
    with working() as update:
        held = write_log(
            options.suite, options.out, episodes=options.episodes, dev_episodes=options.dev_episodes, scenarios=options.scenario,
            doses=None if options.dose is None else [scalar(dose) for dose in options.dose], defences=options.defence,
            attacks=options.attack, progress=counted(update, "playing"),
        )  # fmt: skip
    if options.json:
        print_json(held)
        return 0
    rows = [(file["path"], str(file["rows"]), f"{file['bytes'] / 1e6:.1f}", file["sha256"][:16]) for file in held["files"]]
    table(("file", "rows", "megabytes", "SHA-256"), rows, f"episodes of {held['suite']} in {options.out}")
    say(f"held out: {', '.join(held['held_out']) or 'nothing'}")
    if held["skipped"]:
        say(f"{len(held['skipped'])} pairings have no meaning and are left out; README.md names them")
    return 0
