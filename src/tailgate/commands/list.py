"""tailgate list: what there is."""

from __future__ import annotations

import argparse
import json
from typing import Any

from rich.table import Table

from tailgate.progress import console


def add(commands: Any) -> None:
    command = commands.add_parser("list", help="what there is: defences and their parts, attacks, scenarios, suites")
    groups = ["defences", "filters", "detectors", "mitigations", "attacks", "scenarios", "suites"]
    command.add_argument("what", nargs="?", choices=groups, help="only these")
    command.add_argument("--json", action="store_true", help="print cards with every parameter as JSON")
    command.set_defaults(run=_list)


def _list(options: argparse.Namespace) -> int:
    from tailgate.registry import entries
    from tailgate.scenario import list_scenarios, list_suites, load_scenario, load_suite

    cards: dict[str, list[dict[str, Any]]] = {
        "defences": [entry.card() for entry in entries("defence").values()],
        "filters": [entry.card() for entry in entries("filter").values()],
        "detectors": [entry.card() for entry in entries("detector").values()],
        "mitigations": [entry.card() for entry in entries("mitigation").values()],
        "attacks": [entry.card() for entry in entries("attack").values()],
        "scenarios": [{"name": name, "summary": load_scenario(name).about} for name in list_scenarios()],
        "suites": [{"name": name, "summary": load_suite(name).about} for name in list_suites()],
    }
    chosen = {key: value for key, value in cards.items() if options.what in (None, key)}
    if options.json:
        print(json.dumps(chosen, indent=1))
        return 0
    out = console()
    for title, group in chosen.items():
        table = Table("name", "what it is", "parameters (default)", title=title)
        for card in group:
            fields = ", ".join(f"{k} ({json.dumps(p['default'])})" for k, p in card.get("parameters", {}).items())
            table.add_row(card["name"], card["summary"], fields)
        out.print(table)
    return 0
