"""tailgate zoo: putting trained policies into the zoo."""

from __future__ import annotations

import argparse
from pathlib import Path

from tailgate.cli.shared import Commands, show, table


def add(commands: Commands) -> None:
    """Add `zoo` to the commands."""
    command = commands.add_parser("zoo", help="put trained policies into the package's zoo (`tailgate list zoo` shows it)")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    more = actions.add_parser(
        "add", help="copy the policies of a training run into the zoo",
        description="Copy the policies of a training run into the zoo as PREFIX-SEED, with the record of their training, and measure "
        "their outcome on report seeds.",
    )  # fmt: skip
    more.add_argument("run_directory", metavar="RUN_DIR", help="directory of `tailgate train`, with policy-SEED.json files")
    more.add_argument("--name", required=True, metavar="PREFIX", help="names in the zoo: PREFIX-SEED")
    more.add_argument("--summary", default="", metavar="TEXT", help="a sentence (default: learner, defence, scenario and seed)")
    more.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes that the outcome is measured on (default 400)")
    more.add_argument("--replace", action="store_true", help="replace policies of the same names")
    more.add_argument("--json", action="store_true", help="print what was added as JSON")
    more.set_defaults(run=_add, kept="policies that were added stay")


def _add(options: argparse.Namespace) -> int:
    from tailgate.studies.collect import add_run, facts
    from tailgate.studies.policies import between, shown

    paths = add_run(Path(options.run_directory), options.name, options.summary, episodes=options.episodes, replace=options.replace)
    added = [facts(path) for path in paths]
    rows = []
    for item in added:
        measured = item["measured"]
        share = measured["unit"] == "0/1"
        rows.append((
            item["name"], measured["outcome"], f"{shown(measured['value'], share)} ({between(measured, share)})",
            shown(measured["no_attack"]["value"], share), str(item["bytes"]), item["sha256"][:12],
        ))  # fmt: skip
    columns = ("name", "outcome", "on report seeds", "no attack", "bytes", "sha256")
    show(options, added, lambda _: table(columns, rows, "added to the zoo"))
    return 0
