"""tailgate timing: what the timing of a trained policy is worth."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base import sizes
from tailgate.base.files import writable_directory
from tailgate.base.progress import console, progress


def add(commands: Any) -> None:
    command = commands.add_parser(
        "timing", help="timing advantage of trained policies: their own times against those of another episode",
        description="Play policies at their own times and at those of their twins: yoked (the times of another episode of the policy), "
        "shuffled and periodic (as many steps, at random and evenly spread). Scenario, defence and threat model are those of the training "
        "unless given. Policies that differ in nothing but their training seed are one line.",
    )  # fmt: skip
    command.add_argument("policies", nargs="+", metavar="POLICY", help="JSON file of an exported policy, or zoo:name=NAME")
    command.add_argument("--scenario", metavar="NAME", help="scenario instead of the one it was trained in")
    command.add_argument("--defence", metavar="NAME", help="defence instead of the one it was trained against")
    command.add_argument("--threat", action="append", metavar="key=value", default=[], help="change the threat model (repeatable)")
    command.add_argument("--dose", type=int, metavar="STEPS", help="attack budget instead of the training's")
    command.add_argument("--episodes", type=int, default=1000, metavar="N", help="episodes per policy and schedule (default 1000)")
    command.add_argument("--outcome", metavar="METRIC", help="metric that is counted (default: the training's)")
    command.add_argument("--purpose", default="report", help="which seeds: train, tune, calibrate, select or report (default)")
    command.add_argument("--out", metavar="DIR", help="write timing.json and timing.png here (the picture needs tailgate[viz])")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=_timing)


def _timing(options: argparse.Namespace) -> int:
    from tailgate.studies.policies import changes, trained, write_report
    from tailgate.studies.timing import timing

    sizes.check("episodes", options.episodes)
    for text in options.policies:
        trained(text)  # a file that is no policy leaves no folder behind
    if options.out:
        writable_directory(Path(options.out))  # before anything is played
    sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `tailgate evaluate` does
    with progress(Console(stderr=True)) as update:
        report = timing(
            options.policies, scenario=options.scenario, defence=options.defence, threat=changes(options.threat), dose=options.dose,
            episodes=options.episodes, outcome=options.outcome, purpose=options.purpose,
            progress=lambda done, total: update("playing", done, total, f"{done} of {total} policies"),
        )  # fmt: skip
    if options.json:
        print(json.dumps(report, indent=1, allow_nan=False))
    else:
        _print(report)
    if options.out:
        from tailgate.studies.figures import timing_figure

        for path in write_report(Path(options.out), "timing", report, timing_figure(report["entries"])):
            print(f"written: {path}", file=sys.stderr)
    return 0


def _print(report: dict[str, Any]) -> None:
    from tailgate.studies.policies import between, shown
    from tailgate.studies.timing import TWINS

    out = console()
    for entry in report["entries"]:
        share = entry["unit"] == "0/1"
        runs = len(entry["policies"])
        budget = entry["threat_model"]["budget"]
        title = (
            f"{entry['learner']} against {entry['defence']} on {entry['scenario']}, budget {'unlimited' if budget is None else budget}, "
            f"{entry['episodes']} episodes, {runs} training seed{'' if runs == 1 else 's'}"
        )
        table = Table(title=escape(title), caption="95 % intervals; advantage: own less this, the same episodes")
        for heading in ("schedule", entry["outcome"], "interval", "attack steps", "advantage", "interval"):
            table.add_column(heading, overflow="fold")
        for name, what in TWINS.items():
            found, gain = entry["outcomes"][name], entry["advantage"].get(name)
            more = ("", "") if gain is None else (shown(gain["value"], share, "+"), between(gain, share, "+"))
            table.add_row(
                f"{name}: {what}", shown(found["value"], share), between(found, share), f"{entry['attack_steps'][name]:.1f}", *more
            )
        out.print(table)
        for flag in entry["flags"]:
            out.print(f"flag: {flag}")
