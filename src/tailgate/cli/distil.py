"""tailgate distil: a learned policy as rules that a person can read."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tailgate.base.files import writable_directory
from tailgate.cli.shared import Commands, add_options, own_classes, played_by, say, show, table, telling_aside, threat_of, working


def add(commands: Commands) -> None:
    """Add the command."""
    command = commands.add_parser(
        "distil", help="a learned policy as a few rules that a person can read, and what they lose",
        description="Fit a small decision tree to the decisions of a learned policy, in states that the tree gets into itself. The fewest "
        "rules that do about as much harm are written as a file, which `evaluate` plays as an attack.",
    )  # fmt: skip
    command.add_argument("policy", metavar="POLICY", help="a learned policy: policy:path=FILE, or zoo:name=NAME")
    command.add_argument("--scenario", metavar="NAME", help="where it plays (default: where it was trained)")
    command.add_argument("--defence", metavar="NAME", help="defence that it attacks (default: the one that it was trained on)")
    add_options(command, "--threat")
    command.add_argument("--leaves", type=int, metavar="N", help="leaves of the tree (default: the fewest that lose little)")
    command.add_argument("--loss", type=float, default=0.05, metavar="X", help="share of the episodes that rules may lose (default 0.05)")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="report episodes of the comparison (default 400)")
    command.add_argument("--out", default="rules.json", metavar="FILE", help="the rules (default: rules.json)")
    add_options(command, "--json")
    command.set_defaults(run=_distil)


def _distil(options: argparse.Namespace) -> int:
    from tailgate.studies.distil import distil

    own_classes()
    out = Path(options.out)
    writable_directory(out.parent)
    with telling_aside(out), working() as update:
        report = distil(
            options.policy, out, scenario=options.scenario, defence=options.defence, threat=threat_of(options),
            leaves=options.leaves, loss=options.loss, episodes=options.episodes, tell=lambda done, of: update("trees", done, of, ""),
        )  # fmt: skip
    show(options, report, _print)
    return 0


def _print(report: dict[str, Any]) -> None:
    for line in report["rules"]:
        say(line)
    table(
        ["leaves", "damaged, select episodes"], [[str(one["leaves"]), f"{one['damage']:.1%}"] for one in report["trees"]],
        f"rules against {report['defence']} in {report['scenario']}",
    )  # fmt: skip
    lost = report["difference"]
    if not report["reached"]:
        say("no tree of these sizes does as much as was asked for: more --leaves, or a larger --loss")
    say(
        f"the rules damage {report['damage']:.1%} of {report['episodes']} report episodes, the policy {report['policy_damage']:.1%}: "
        f"{100 * lost['value']:+.1f} points [{100 * lost['low']:+.1f}, {100 * lost['high']:+.1f}]"
    )
    say(f"written to {report['file']}")
    again = played_by(report["scenario"], report["defence"], f"rules:path={report['file']}", report["threat"])
    say(f"to play them: {again}", soft_wrap=True)
