"""tailgate list: what there is."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, print_json, table

if TYPE_CHECKING:
    from tailgate.core.registry import Family


def add(commands: Commands) -> None:
    """Add `list` to the commands."""
    about = "what there is: defences, attacks, the zoo, scenarios and their parts, suites, metrics, traces; or a graph"
    command = commands.add_parser("list", help=about)
    groups = list(_cards())
    command.add_argument("what", nargs="?", choices=groups, metavar="GROUP",
                         help=f"only these: {', '.join(groups)} (attacks: with the zoo of trained policies)")  # fmt: skip
    command.add_argument("--all", action="store_true", help="everything, with parameters (default: how many there are of each)")
    command.add_argument("--graph", metavar="SCENARIO", help="draw who hears whom in this scenario instead (needs tailgate[viz])")
    command.add_argument("--out", metavar="FILE", help="the drawing: .png (default: SCENARIO.png), .svg or .pdf")
    command.add_argument("--json", action="store_true", help="print cards with every parameter as JSON")
    command.set_defaults(run=_list)


def _list(options: argparse.Namespace) -> int:
    if options.graph is not None:
        return _draw(options)
    if options.out is not None:
        raise InputError("--out", options.out, "a drawing to write: --graph SCENARIO")
    wanted = ("attacks", "zoo") if options.what == "attacks" else (options.what,)
    chosen = {key: cards() for key, cards in _cards().items() if options.what is None or key in wanted}
    if options.json:
        print_json(chosen)
        return 0
    if options.what is None and not options.all:
        counts = [(name, str(len(group)), f"tailgate list {name}") for name, group in chosen.items()]
        table(("what", "how many", "listed by"), counts, caption="tailgate list --all: everything", numbers=(1,))
        return 0
    for title, group in chosen.items():
        if title == "zoo":
            _zoo_table(group)
        elif title == "traces":
            _trace_table(group)
        else:
            fields = [", ".join(f"{k} ({json.dumps(p['default'])})" for k, p in card.get("parameters", {}).items()) for card in group]
            rows = [(card["name"], card["summary"], text) for card, text in zip(group, fields, strict=True)]
            table(("name", "what it is", "parameters (default)"), rows, title)
    return 0


def _cards() -> dict[str, Callable[[], list[dict[str, Any]]]]:
    """Return the groups, each with a function that returns its cards."""
    families: tuple[Family, ...] = (
        "defence", "filter", "detector", "mitigation", "attack", "plant", "sensor", "controller", "manoeuvre", "reward",
    )  # fmt: skip
    groups: dict[str, Callable[[], list[dict[str, Any]]]] = {f"{family}s": partial(_registered, family) for family in families}
    return groups | {"metrics": _metrics, "zoo": _zoo, "scenarios": _scenarios, "suites": _suites, "traces": _traces}


def _registered(family: Family) -> list[dict[str, Any]]:
    from tailgate.core.registry import entries

    return [entry.card() for entry in entries(family).values()]


def _metrics() -> list[dict[str, Any]]:
    from tailgate.core.registry import summary_of
    from tailgate.play.metrics import METRICS, UNITS, own_metrics

    found = METRICS | {one.name: one.function for one in own_metrics()}
    return [{"name": name, "summary": summary_of(function), "unit": UNITS.get(name, "-")} for name, function in sorted(found.items())]


def _zoo() -> list[dict[str, Any]]:
    from tailgate.agents.policy.zoo import zoo_card, zoo_names

    return [zoo_card(name) for name in zoo_names()]


def _scenarios() -> list[dict[str, Any]]:
    from tailgate.core.scenario import list_scenarios, load_scenario

    return [{"name": name, "summary": load_scenario(name).about} for name in list_scenarios()]


def _suites() -> list[dict[str, Any]]:
    from tailgate.core.scenario import list_suites, load_suite

    return [{"name": name, "summary": load_suite(name).about} for name in list_suites()]


def _traces() -> list[dict[str, Any]]:
    from tailgate.core.traces import as_card, cards

    return [as_card(name) for name in cards()]


def _zoo_table(group: list[dict[str, Any]]) -> None:
    from tailgate.studies.policies import between, shown

    rows = list[tuple[str, ...]]()
    for card in group:
        threat, measured, decisions = card["threat"] or {}, card["measured"], card["decisions"]
        outcome = "-"
        if measured:
            share = measured["unit"] == "0/1"
            outcome = f"{measured['outcome']} {shown(measured['value'], share)}\n{between(measured, share)}"
        count = "-" if decisions is None else f"{decisions / 1e6:.2g} M" if decisions >= 1e6 else f"{decisions / 1e3:.0f} k"
        budget = "unlimited" if threat.get("budget") is None else f"{threat['budget']} steps"
        rows.append((
            card["name"], f"{card['scenario']}\n{card['defence']}", f"{card['learner']}\n{count}", "\n".join(threat.get("kinds", ())),
            f"{budget}\n{threat.get('fdi_bound', '-')}", card["knowledge"] + ("\n+ measurement" if threat.get("sees_measurement") else ""),
            outcome, card["sha256"][:12],
        ))  # fmt: skip
    heads = ("name", "scenario, defence", "learner, decisions", "kinds", "budget, bound", "sees", "outcome", "sha256")
    table(heads, rows, "zoo: trained policies, played as zoo:name=NAME", "outcome: on report seeds, with its 95 % interval")


def _trace_table(group: list[dict[str, Any]]) -> None:
    rows = []
    for card in group:
        size, source = f"{card['seconds']:.0f} s\n{card['rate']:g} Hz", f"{card['source']}; {card['attribution']}"
        rows.append((card["name"], card["summary"], ", ".join(card["columns"]), size, card["licence"], source))
    table(("name", "what it is", "columns", "length, rate", "licence", "source"), rows, "traces: recorded drives")


def _draw(options: argparse.Namespace) -> int:
    from tailgate.core.scenario import load_scenario
    from tailgate.envs.render.graph import draw_graph, edges

    scenario = load_scenario(options.graph)
    brief = scenario.brief()
    model, attacked = brief.model, [i for i in range(brief.model.agents) if brief.granted[i].any()]
    path = Path(options.out or f"{scenario.name}.png")
    title = f"{scenario.name}: double rings are open to attack" if model.agents > 1 else scenario.name
    draw_graph(model, path, attacked, title)
    facts = {
        "scenario": scenario.name, "agents": model.agents, "edges": len(edges(model.graph)), "attacked": attacked, "drawing": str(path),
    }  # fmt: skip
    if options.json:
        print_json(facts)
    else:
        whom = ", ".join(map(str, attacked))
        print(f"{scenario.name}: {model.agents} agents, {facts['edges']} edges, open to attack: {whom}; drawn in {path}")
    return 0
