"""tailgate selfplay: attacker and defender in turns, and how exploitable the defender is."""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from tailgate.base.progress import progress
from tailgate.cli.keys import listed
from tailgate.cli.shared import Commands, add_options, say, show, table


def add(commands: Commands) -> None:
    """Add `selfplay` to the commands."""
    command = commands.add_parser(
        "selfplay", help="train attacker and defender in turns, and measure how exploitable the defender is",
        description="An attacker against a defender that turns the knobs of its defence. Without --config, the preset `selfplay`: its "
        "values are the defaults below.",
        keys=_keys,
    )  # fmt: skip
    command.add_argument("--config", metavar="FILE", help="preset by name, or YAML file")
    command.add_argument(
        "--resume", action="store_true",
        help="continue: what is finished is not trained again, unless its opponents are others now; rounds may grow",
    )  # fmt: skip
    add_options(command, "--json", "overrides")
    command.set_defaults(run=_selfplay, kept="what was finished is kept")


def _keys() -> str:
    from tailgate.training.keys import selfplay_keys

    return listed(selfplay_keys())


def _selfplay(options: argparse.Namespace) -> int:
    from tailgate.training.selfplay import Game, load_config

    config = load_config(options.config, list(options.overrides), options.resume)
    errors = Console(stderr=True)
    errors.print(f"[bold]{config.name}[/]: self-play with [bold]{config.defence}[/] on {config.scenario}, files in {config.directory}")
    place = f" out={config.out}" if config.out != type(config)().out else ""
    options.kept = f"what was finished is kept, go on with: tailgate selfplay --resume name={config.name}{place}"
    with progress(errors) as update:
        report = Game(config, update, options.resume).run()
    show(options, report, _print_report)
    errors.print(f"defender: {report['defender']}\nreport:   {config.directory / 'report.json'}")
    return 0


def _print_report(report: dict[str, Any]) -> None:
    defenders = list(dict.fromkeys(row["defender"] for row in report["table"]))
    fixed = ", ".join(f"{name}={value:g}" for name, value in report["fixed"].items() if name != "setting")
    title = f"{report['episodes']} fresh episodes on {report['scenario']}: collisions [95 % interval], cost of care"
    rows = []
    for name in dict.fromkeys(row["attack"] for row in report["table"]):
        cells = [row for row in report["table"] if row["attack"] == name]
        rows.append((name, *(f"{_share(row['collisions'])}, {row['cost']:.3f}" for row in cells)))
    table(("attack", *defenders), rows, title, f"best fixed setting: {fixed}")
    for defender, gain in report["exploitability"].items():
        found = gain["fresh"]["collisions"]
        weak = f"; the search was too weak: its fresh attacker does {_share(found)}, less than known ones" if gain["weak_search"] else ""
        told = f"{gain['attack']} less self-play's last attacker"
        say(f"exploitability, {defender}: at least {_points(gain)} ({told}){weak}")
    for defender, most in report["worst"].items():
        say(f"worst known attack, {defender}: {_share(most['collisions'])} by {most['attack']}")
    say(f"worst known attacks, fixed less trained: {_points(report['worst_fixed_minus_trained'])}")


def _share(interval: dict[str, float]) -> str:
    return f"{100 * interval['value']:.1f} % [{100 * interval['low']:.1f}, {100 * interval['high']:.1f}]"


def _points(gain: dict[str, float]) -> str:
    return f"{100 * gain['value']:+.1f} points, 95 % interval {100 * gain['low']:+.1f} to {100 * gain['high']:+.1f}"
