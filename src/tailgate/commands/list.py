"""tailgate list: what there is."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.table import Table

from tailgate.errors import InputError
from tailgate.progress import console


def add(commands: Any) -> None:
    command = commands.add_parser("list", help="what there is: defences and their parts, attacks, scenarios, suites; or a scenario's graph")
    groups = ["defences", "filters", "detectors", "mitigations", "attacks", "scenarios", "suites"]
    command.add_argument("what", nargs="?", choices=groups, help="only these")
    command.add_argument("--graph", metavar="SCENARIO", help="draw who hears whom in this scenario instead (needs tailgate[viz])")
    command.add_argument("--out", metavar="FILE", help="the drawing: .png (default: SCENARIO.png), .svg or .pdf")
    command.add_argument("--json", action="store_true", help="print cards with every parameter as JSON")
    command.set_defaults(run=_list)


def _list(options: argparse.Namespace) -> int:
    if options.graph is not None:
        return _draw(options)
    if options.out is not None:
        raise InputError("--out", options.out, "a drawing to write: --graph SCENARIO")
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


def _draw(options: argparse.Namespace) -> int:
    from tailgate.drawing import draw_graph, edges
    from tailgate.scenario import load_scenario

    place = load_scenario(options.graph)
    brief = place.brief()
    model, attacked = brief.model, [i for i in range(brief.model.agents) if brief.granted[i].any()]
    path = Path(options.out or f"{place.name}.png")
    title = f"{place.name}: double rings are open to attack" if model.agents > 1 else place.name
    draw_graph(model, path, attacked, title)
    facts = {"scenario": place.name, "agents": model.agents, "edges": len(edges(model.graph)), "attacked": attacked, "drawing": str(path)}
    if options.json:
        print(json.dumps(facts, indent=1))
    else:
        whom = ", ".join(map(str, attacked))
        print(f"{place.name}: {model.agents} agents, {facts['edges']} edges, open to attack: {whom}; drawn in {path}")
    return 0
