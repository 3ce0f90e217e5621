"""tailgate timing: what the timing of a trained policy is worth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from tailgate.base import sizes
from tailgate.base.files import writable_directory
from tailgate.cli.shared import Commands, add_options, counted, own_classes, say, show, table, threat_of, working


def add(commands: Commands) -> None:
    """Add `timing` to the commands."""
    command = commands.add_parser(
        "timing", help="timing advantage of trained policies: their own times against those of another episode",
        description="Play policies at their own times and at those of their twins: yoked (the times of another episode of the policy), "
        "shuffled and periodic (as many steps, at random and evenly spread). Scenario, defence and threat model are those of the training "
        "unless given. Policies that differ in nothing but their training seed are one line.",
    )  # fmt: skip
    add_options(command, "policies")
    command.add_argument("--scenario", metavar="NAME", help="scenario instead of the one it was trained in")
    command.add_argument("--defence", metavar="NAME", help="defence instead of the one it was trained against")
    add_options(command, "--threat")
    command.add_argument("--dose", type=int, metavar="STEPS", help="attack budget instead of the training's")
    command.add_argument("--episodes", type=int, default=1000, metavar="N", help="episodes per policy and schedule (default 1000)")
    add_options(command, "--outcome", "--purpose")
    command.add_argument("--out", metavar="DIR", help="write timing.json and timing.png here (the picture needs tailgate[viz])")
    add_options(command, "--picture", "--json")
    command.set_defaults(run=_timing)


def _timing(options: argparse.Namespace) -> int:
    from tailgate.studies.policies import trained, write_report
    from tailgate.studies.timing import timing

    sizes.check("episodes", options.episodes)
    for text in options.policies:
        trained(text)  # a file that is no policy leaves no folder behind
    if options.out:
        writable_directory(Path(options.out))  # before anything is played
    own_classes()
    with working() as update:
        report = timing(
            options.policies, scenario=options.scenario, defence=options.defence, threat=threat_of(options), dose=options.dose,
            episodes=options.episodes, outcome=options.outcome, purpose=options.purpose,
            progress=counted(update, "playing", "policies"),
        )  # fmt: skip
    show(options, report, _print)
    if options.out:
        from tailgate.studies.figures import timing_figure

        for path in write_report(Path(options.out), "timing", report, timing_figure(report["entries"], options.picture), options.picture):
            print(f"written: {path}", file=sys.stderr)
    return 0


def _print(report: dict[str, Any]) -> None:
    from tailgate.studies.policies import between, shown
    from tailgate.studies.timing import TWINS

    for entry in report["entries"]:
        share = entry["unit"] == "0/1"
        runs = len(entry["policies"])
        budget = entry["threat_model"]["budget"]
        title = (
            f"{entry['learner']} against {entry['defence']} on {entry['scenario']}, budget {'unlimited' if budget is None else budget}, "
            f"{entry['episodes']} episodes, {runs} training seed{'' if runs == 1 else 's'}"
        )
        columns, rows = ("schedule", entry["outcome"], "interval", "attack steps", "advantage", "interval"), []
        for name, what in TWINS.items():
            found, gain = entry["outcomes"][name], entry["advantage"].get(name)
            more = ("", "") if gain is None else (shown(gain["value"], share, "+"), between(gain, share, "+"))
            steps = f"{entry['attack_steps'][name]:.1f}"
            rows.append((f"{name}: {what}", shown(found["value"], share), between(found, share), steps, *more))
        table(columns, rows, title, "95 % intervals; advantage: own less this, the same episodes")
        for flag in entry["flags"]:
            say(f"flag: {flag}")
