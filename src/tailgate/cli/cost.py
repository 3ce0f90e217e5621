"""tailgate cost: what the protection of messages costs in time and control."""

from __future__ import annotations

import argparse
from typing import Any

from tailgate.cli.shared import Commands, add_options, counted, say, show, table, working


def add(commands: Commands) -> None:
    """Add `cost` to the commands."""
    command = commands.add_parser(
        "cost", help="what authenticated messages cost: schedulability, delay, control",
        description="Of a system of tasks and messages, say for every set of authenticated messages if all deadlines are met, how late a "
        "command is, and what that delay costs the closed loop. docs/attacks.md is about attacks; docs/security-cost.md about this.",
    )  # fmt: skip
    command.add_argument("--security", required=True, metavar="NAME", help="system by name or YAML file, such as platoon-v2v")
    command.add_argument("--level", type=float, metavar="W", help="security level that is asked for, instead of the file's")
    add_options(command, "--json")
    command.set_defaults(run=_cost)


def _cost(options: argparse.Namespace) -> int:
    import dataclasses

    from tailgate.base.errors import InputError
    from tailgate.studies.timing_budget import choices, load_budget

    budget = load_budget(options.security)
    if options.level is not None:
        most = sum(message.weight for message in budget.messages)
        if not 0.0 <= options.level <= most:
            raise InputError("--level", options.level, f"a number from 0 to the sum of all weights ({most:g})")
        budget = dataclasses.replace(budget, level=options.level)
    with working() as update:
        report = choices(budget, counted(update, "closed loop", "delays"))
    show(options, report, _print)
    return 0 if report["best"] is not None else 1


def _print(report: dict[str, Any]) -> None:
    rows = []
    for row in report["sets"]:
        names, load = ", ".join(row["authenticated"]) or "none", f"{100 * max(row['load'].values()):.0f} %"
        head = (f"{row['period']:g}", f"{row['level']:g}", names, load)
        cost = row["cost"]
        if cost is None:
            rows.append((*head, row["why"], "-", "-", "-"))
            continue
        figures = f"{cost['min_gap']:.2f}", f"{cost['rmse_position']:.3f}", f"{100 * cost['crashed']:.0f} %"
        rows.append((*head, f"{1000 * row['delay']:.0f} ({row['latency']} steps)", *figures))
    columns = ("period [s]", "level", "authenticated", "largest load", "delay [ms]", "smallest gap [m]", "error [m]", "collisions")
    table(columns, rows, f"{report['name']}: {report['scenario']}, {report['defence']}, {report['seeds']} episodes, medians")
    best = report["best"]
    if best is None:
        say(f"no set of level {report['asked']:g} meets its deadlines in time and without a collision")
        return
    names = ", ".join(best["authenticated"]) or "none"
    say(f"best of level {report['asked']:g}: authenticate {names} at a period of {best['period']:g} s")
    held = report["threat"]
    wires = ",".join(held["authenticated"])
    say(f'its attacker: --threat "authenticated=[{wires}]" --threat key_interval={held["key_interval"]}', soft_wrap=True)
