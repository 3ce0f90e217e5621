"""tailgate transfer: policies trained against one defence, played against others."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.progress import cells, console, progress

MANY = 8  # defences, above which each has a line of its own, without intervals


def add(commands: Any) -> None:
    command = commands.add_parser(
        "transfer", help="the matrix trained on x played on of trained policies",
        description="Play policies against defences that they were not trained on. Scenario and threat model are those of the training "
        "unless given. An entry is the mean over the training seeds of what was trained on one defence.",
    )  # fmt: skip
    command.add_argument("policies", nargs="+", metavar="POLICY", help="JSON file of an exported policy, or zoo:name=NAME")
    command.add_argument("--defence", action="append", metavar="NAME", default=[],
                         help="a defence to play on (repeatable; default: those that the policies were trained on); all: every "
                         "registered one that has a meaning in the scenario")  # fmt: skip
    command.add_argument("--scenario", metavar="NAME", help="scenario instead of the one that they were trained in")
    command.add_argument("--threat", action="append", metavar="key=value", help="the threat model's changes instead of the training's")
    command.add_argument("--dose", type=int, metavar="STEPS", help="attack budget instead of the training's")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes per policy and defence (default 400)")
    command.add_argument("--outcome", metavar="METRIC", help="metric that is counted (default: the training's)")
    command.add_argument("--purpose", default="report", help="which seeds: train, tune, calibrate, select or report (default)")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1); changes no result")
    command.add_argument("--out", metavar="DIR", help="write rows.jsonl, transfer.json and transfer.png here; resumes")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=_transfer)


def _transfer(options: argparse.Namespace) -> int:
    from tailgate.studies.policies import changes, write_report
    from tailgate.studies.transfer import transfer

    sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `tailgate evaluate` does
    threat = None if options.threat is None else changes(options.threat)
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    with progress(Console(stderr=True)) as update:
        report = transfer(
            options.policies, options.defence, scenario=options.scenario, threat=threat, dose=options.dose,
            episodes=options.episodes, outcome=options.outcome, purpose=options.purpose, workers=options.workers,
            rows_file=Path(options.out) / "rows.jsonl" if options.out else None,
            progress=lambda done, total: update("playing", done, total, cells(done, total)),
        )  # fmt: skip
    if options.json:
        print(json.dumps(report, indent=1, allow_nan=False))
    else:
        _print(report)
    if options.out:
        from tailgate.studies.figures import transfer_figure

        for path in write_report(Path(options.out), "transfer", report, transfer_figure(report) if report["entries"] else None):
            print(f"written: {path}", file=sys.stderr)
    return 0 if report["entries"] else 1


def _print(report: dict[str, Any]) -> None:
    from tailgate.studies.policies import between, shown

    share, out = report["unit"] == "0/1", console()
    held = {(entry["trained_on"], entry["played_on"]): entry for entry in report["entries"]}
    seeds = {entry["trained_on"]: entry["seeds"] for entry in report["entries"]}
    wide = len(report["played_on"]) > MANY

    def figure(trained: str, played: str) -> str:
        entry = held.get((trained, played))
        if entry is None:
            return "-"
        return shown(entry["value"], share) + ("" if wide else f" ({between(entry, share)})")

    trained = [f"{escape(name)}, {seeds.get(name, 0)} seed{'' if seeds.get(name) == 1 else 's'}" for name in report["trained_on"]]
    played, none = report["played_on"], report["no_attack"]
    lines = [["(no attack)", *(shown(none[name], share) if name in none else "-" for name in played)]]
    lines += [[label, *(figure(name, at) for at in played)] for label, name in zip(trained, report["trained_on"], strict=True)]
    head = ["trained on", *(f"on {escape(name)}" for name in played)]
    if wide:  # many defences: a line each
        head, *lines = [list(line) for line in zip(["played on", *map(escape, played)], *lines, strict=True)]
    caption = "95 % intervals: --json, or --out" if wide else "95 % intervals"
    table = Table(title=f"{report['scenario']}: {report['outcome']}, {report['episodes']} episodes", caption=caption)
    for heading in head:
        table.add_column(heading, overflow="fold")
    for line in lines:
        table.add_row(*line)
    out.print(table)
    for entry in report["entries"]:
        for flag in entry.get("flags", ()):
            gain = entry["over_own"]
            out.print(f"flag: {flag}: {entry['trained_on']} on {entry['played_on']}, {shown(gain['value'], share, '+')} "
                      f"({between(gain, share, '+')})", markup=False)  # fmt: skip
    for reason in dict.fromkeys(item["reason"] for item in report["skipped"]):
        names = ", ".join(item.get("policy", item.get("defence")) for item in report["skipped"] if item["reason"] == reason)
        out.print(f"skipped: {names}: {reason}", markup=False)
