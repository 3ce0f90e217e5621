"""tailgate transfer: policies trained against one defence, played against others."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from tailgate.cli.shared import Commands, add_options, counted, own_classes, say, show, table, threat_of, working

MANY = 8  # defences, above which each has its line, without intervals


def add(commands: Commands) -> None:
    """Add `transfer` to the commands."""
    command = commands.add_parser(
        "transfer", help="the matrix trained on x played on of trained policies",
        description="Play policies against defences that they were not trained on. Scenario and threat model are those of the training "
        "unless given. An entry is the mean over the training seeds of what was trained on one defence.",
    )  # fmt: skip
    add_options(command, "policies")
    command.add_argument("--defence", action="append", metavar="NAME", default=[],
                         help="a defence to play on (repeatable; default: those that the policies were trained on); all: every "
                         "registered one that has a meaning in the scenario")  # fmt: skip
    command.add_argument("--scenario", metavar="NAME", help="scenario instead of the one that they were trained in")
    command.add_argument("--threat", action="append", metavar="key=value", help="the threat model's changes instead of the training's")
    command.add_argument("--dose", type=int, metavar="STEPS", help="attack budget instead of the training's")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes per policy and defence (default 400)")
    add_options(command, "--outcome", "--purpose", "--workers")
    command.add_argument("--out", metavar="DIR", help="write rows.jsonl, transfer.json and transfer.png here; resumes")
    add_options(command, "--picture", "--json")
    command.set_defaults(run=_transfer)


def _transfer(options: argparse.Namespace) -> int:
    from tailgate.studies.policies import write_report
    from tailgate.studies.transfer import transfer

    own_classes()
    threat = None if options.threat is None else threat_of(options)
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    with working() as update:
        report = transfer(
            options.policies, options.defence, scenario=options.scenario, threat=threat, dose=options.dose,
            episodes=options.episodes, outcome=options.outcome, purpose=options.purpose, workers=options.workers,
            rows_file=Path(options.out) / "rows.jsonl" if options.out else None,
            progress=counted(update, "playing"),
        )  # fmt: skip
    show(options, report, _print)
    if options.out:
        from tailgate.studies.figures import transfer_figure

        drawn = transfer_figure(report, options.picture) if report["entries"] else None
        for path in write_report(Path(options.out), "transfer", report, drawn, options.picture):
            print(f"written: {path}", file=sys.stderr)
    return 0 if report["entries"] else 1


def _print(report: dict[str, Any]) -> None:
    from tailgate.studies.policies import between, shown

    share = report["unit"] == "0/1"
    held = {(entry["trained_on"], entry["played_on"]): entry for entry in report["entries"]}
    seeds = {entry["trained_on"]: entry["seeds"] for entry in report["entries"]}
    wide = len(report["played_on"]) > MANY

    def figure(trained: str, played: str) -> str:
        entry = held.get((trained, played))
        if entry is None:
            return "-"
        return shown(entry["value"], share) + ("" if wide else f" ({between(entry, share)})")

    trained = [f"{name}, {seeds.get(name, 0)} seed{'' if seeds.get(name) == 1 else 's'}" for name in report["trained_on"]]
    played, none = report["played_on"], report["no_attack"]
    lines = [["(no attack)", *(shown(none[name], share) if name in none else "-" for name in played)]]
    lines += [[label, *(figure(name, at) for at in played)] for label, name in zip(trained, report["trained_on"], strict=True)]
    head = ["trained on", *(f"on {name}" for name in played)]
    if wide:  # many defences: a line each
        head, *lines = [list(line) for line in zip(["played on", *played], *lines, strict=True)]
    caption = "95 % intervals: --json, or --out" if wide else "95 % intervals"
    table(head, lines, f"{report['scenario']}: {report['outcome']}, {report['episodes']} episodes", caption)
    for entry in report["entries"]:
        for flag in entry.get("flags", ()):
            gain = entry["over_own"]
            figures = f"{shown(gain['value'], share, '+')} ({between(gain, share, '+')})"
            say(f"flag: {flag}: {entry['trained_on']} on {entry['played_on']}, {figures}")
    for reason in dict.fromkeys(item["reason"] for item in report["skipped"]):
        mine = [item for item in report["skipped"] if item["reason"] == reason]
        names = ", ".join(" on ".join(item[key] for key in ("policy", "defence") if key in item) for item in mine)
        say(f"skipped: {names}: {reason}")
