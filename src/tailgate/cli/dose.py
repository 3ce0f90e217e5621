"""tailgate dose-response: damage against budget."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.errors import InputError
from tailgate.base.progress import cells, console, progress


def add(commands: Any) -> None:
    command = commands.add_parser(
        "dose-response", help="outcome against attack budget, and the dose at which an attack becomes critical",
        description="Play attacks at several budgets. The curve is a monotone regression; the critical dose is where it first exceeds the "
        "limit, with a bootstrap interval.",
    )  # fmt: skip
    command.add_argument("attacks", nargs="+", metavar="ATTACK", help="attacks, as for `tailgate evaluate`")
    command.add_argument("--defence", action="append", required=True, metavar="NAME", help="a defence (repeatable)")
    command.add_argument("--scenario", required=True, metavar="NAME", help="scenario, by name or YAML file")
    command.add_argument("--doses", required=True, metavar="N,N,...", help="budgets of attack steps; 0, no attack, is always played")
    command.add_argument("--threat", action="append", metavar="key=value", default=[], help="change the threat model (repeatable)")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes per point (default 400)")
    command.add_argument("--outcome", metavar="METRIC", help="metric that is counted (default: crashed, or rmse_position without a road)")
    command.add_argument("--exceeds", type=float, metavar="VALUE", help="count the episodes in which the metric exceeds this, not its mean")
    command.add_argument("--limit", type=float, metavar="VALUE", help="share or mean that makes a dose critical (default: 0.1 of shares)")
    command.add_argument("--purpose", default="report", help="which seeds: train, tune, calibrate, select or report (default)")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1); changes no result")
    command.add_argument("--out", metavar="DIR", help="write rows.jsonl, dose-response.json and dose-response.png here; resumes")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=_dose)


def _dose(options: argparse.Namespace) -> int:
    from tailgate.studies.dose import dose_response
    from tailgate.studies.policies import changes, write_report

    sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `python -m` does
    try:
        doses = [int(text) for text in options.doses.split(",")]
    except ValueError:
        raise InputError("--doses", options.doses, "whole numbers with commas between, for example 5,10,20") from None
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    with progress(Console(stderr=True)) as update:
        report = dose_response(
            options.attacks, options.defence, options.scenario, doses, episodes=options.episodes, threat=changes(options.threat),
            outcome=options.outcome, exceeds=options.exceeds, limit=options.limit, purpose=options.purpose, workers=options.workers,
            rows_file=Path(options.out) / "rows.jsonl" if options.out else None,
            progress=lambda done, total: update("playing", done, total, cells(done, total)),
        )  # fmt: skip
    if options.json:
        print(json.dumps(report, indent=1, allow_nan=False))
    else:
        _print(report)
    if options.out:
        from tailgate.studies.figures import dose_figure

        picture = dose_figure(report) if any("points" in curve for curve in report["curves"]) else None
        for path in write_report(Path(options.out), "dose-response", report, picture):
            print(f"written: {path}", file=sys.stderr)
    return 1 if _nothing(report) else 0


def _print(report: dict[str, Any]) -> None:
    from tailgate.studies.policies import shown

    share = report["unit"] == "0/1"
    what = report["outcome"] if report["exceeds"] is None else f"{report['outcome']} > {report['exceeds']:g}"
    table = Table(title=f"{report['scenario']}: {what} by dose in attack steps, {report['episodes']} episodes a point")
    table.add_column("defence", overflow="fold")
    table.add_column("attack", overflow="fold")
    for dose in report["doses"]:
        table.add_column(str(dose), justify="right", overflow="fold")
    if report["limit"] is not None:
        table.add_column(f"critical dose (above {shown(report['limit'], share)})", overflow="fold")
    for curve in report["curves"]:
        head = [escape(curve["defence"]), escape(curve["attack"])]
        if "skipped" in curve:
            table.add_row(*head, *["-"] * len(report["doses"]))
            continue
        figures = [shown(point["value"], share) for point in curve["points"]]
        table.add_row(*head, *figures, *([] if report["limit"] is None else [_critical(curve["critical_dose"], report["doses"])]))
    out = console()
    out.print(table)
    for curve in report["curves"]:
        if "skipped" in curve:
            out.print(f"skipped: {curve['attack']} on {curve['defence']}: {curve['skipped']}", markup=False)
    if _nothing(report):
        out.print("nothing was played; --threat, --scenario or another attack change that", markup=False, highlight=False)


def _nothing(report: dict[str, Any]) -> bool:
    return all("skipped" in curve for curve in report["curves"])


def _critical(found: dict[str, float | None], doses: list[int]) -> str:
    """A critical dose, its interval, and the played doses that it lies between; beyond the last it is only known to be larger."""
    value, low, high = (f"> {doses[-1]}" if found[key] is None else f"{found[key]:.1f}" for key in ("value", "low", "high"))
    text = f"{value} ({low} to {high})" if value != low or low != high else value
    at = found["value"]
    if at is None:
        return text
    i = next(i for i, dose in enumerate(doses) if dose >= at)
    return f"{text}, played: {doses[max(i - 1, 0)]} and {doses[i]}"
