"""tailgate dose-response: damage against budget."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, add_options, counted, own_classes, say, show, table, threat_of, working


def add(commands: Commands) -> None:
    """Add `dose-response` to the commands."""
    command = commands.add_parser(
        "dose-response", help="outcome against attack budget, and the dose at which an attack becomes critical",
        description="Play attacks at several budgets. The curve is a monotone regression; the critical dose is where it first exceeds the "
        "limit, with a bootstrap interval.",
    )  # fmt: skip
    command.add_argument("attacks", nargs="+", metavar="ATTACK", help="attacks, as for `tailgate evaluate`")
    command.add_argument("--defence", action="append", required=True, metavar="NAME", help="a defence (repeatable)")
    command.add_argument("--scenario", required=True, metavar="NAME", help="scenario, by name or YAML file")
    command.add_argument("--doses", required=True, metavar="N,N,...", help="budgets of attack steps; 0, no attack, is always played")
    add_options(command, "--threat")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes per point (default 400)")
    command.add_argument("--outcome", metavar="METRIC", help="metric that is counted (default: crashed, or rmse_position without a road)")
    command.add_argument("--exceeds", type=float, metavar="VALUE", help="count the episodes in which the metric exceeds this, not its mean")
    command.add_argument("--limit", type=float, metavar="VALUE", help="share or mean that makes a dose critical (default: 0.1 of shares)")
    add_options(command, "--purpose", "--workers")
    command.add_argument("--out", metavar="DIR", help="write rows.jsonl, dose-response.json and dose-response.png here; resumes")
    add_options(command, "--picture", "--json")
    command.set_defaults(run=_dose)


def _dose(options: argparse.Namespace) -> int:
    from tailgate.studies.dose import dose_response
    from tailgate.studies.policies import write_report

    own_classes()
    try:
        doses = [int(text) for text in options.doses.split(",")]
    except ValueError:
        raise InputError("--doses", options.doses, "whole numbers with commas between, for example 5,10,20") from None
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    with working() as update:
        report = dose_response(
            options.attacks, options.defence, options.scenario, doses, episodes=options.episodes, threat=threat_of(options),
            outcome=options.outcome, exceeds=options.exceeds, limit=options.limit, purpose=options.purpose, workers=options.workers,
            rows_file=Path(options.out) / "rows.jsonl" if options.out else None,
            progress=counted(update, "playing"),
        )  # fmt: skip
    show(options, report, _print)
    if options.out:
        from tailgate.studies.figures import dose_figure

        picture = dose_figure(report, options.picture) if any("points" in curve for curve in report["curves"]) else None
        for path in write_report(Path(options.out), "dose-response", report, picture, options.picture):
            print(f"written: {path}", file=sys.stderr)
    return 1 if _nothing(report) else 0


def _print(report: dict[str, Any]) -> None:
    from tailgate.studies.policies import shown

    share = report["unit"] == "0/1"
    what = report["outcome"] if report["exceeds"] is None else f"{report['outcome']} > {report['exceeds']:g}"
    limited, doses = report["limit"] is not None, report["doses"]
    columns = ["defence", "attack", *map(str, doses), *([f"critical dose (above {shown(report['limit'], share)})"] if limited else [])]
    rows = []
    for curve in report["curves"]:
        figures = ["-"] * len(doses) if "skipped" in curve else [shown(point["value"], share) for point in curve["points"]]
        critical = [_critical(curve["critical_dose"], doses)] if limited and "skipped" not in curve else []
        rows.append((curve["defence"], curve["attack"], *figures, *critical))
    title = f"{report['scenario']}: {what} by dose in attack steps, {report['episodes']} episodes a point"
    table(columns, rows, title, numbers=range(2, 2 + len(doses)))
    for curve in report["curves"]:
        if "skipped" in curve:
            say(f"skipped: {curve['attack']} on {curve['defence']}: {curve['skipped']}")
    if _nothing(report):
        say("nothing was played; --threat, --scenario or another attack change that")


def _nothing(report: dict[str, Any]) -> bool:
    return all("skipped" in curve for curve in report["curves"])


def _critical(found: dict[str, float | None], doses: list[int]) -> str:
    """Return a critical dose, its interval, and the played doses that it lies between; beyond the last it is only known to be larger."""
    value, low, high = (f"> {doses[-1]}" if found[key] is None else f"{found[key]:.1f}" for key in ("value", "low", "high"))
    text = f"{value} ({low} to {high})" if value != low or low != high else value
    at = found["value"]
    if at is None:
        return text
    i = next(i for i, dose in enumerate(doses) if dose >= at)
    return f"{text}, played: {doses[max(i - 1, 0)]} and {doses[i]}"
