"""tailgate trust: statistical model checking of the closed loop."""

from __future__ import annotations

import argparse
import dataclasses
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tailgate.base.errors import InputError
from tailgate.cli.automata import add_automata, run_automata
from tailgate.cli.prove import add_prove, refuse, refuse_proofs, run_prove
from tailgate.cli.shared import Commands, add_options, counted, own_classes, say, show, table, tell, telling_aside, values, working
from tailgate.core.schema import scalar

if TYPE_CHECKING:
    from tailgate.core.scenario import Suite
    from tailgate.trust.statistics import Sequential, Sprt


def add(commands: Commands) -> None:
    """Add `trust` to the commands."""
    command = commands.add_parser(
        "trust", help="how surely a defence keeps to temporal properties: statistical model checking",
        description="Play a suite, or the part of it that the options name, and decide temporal properties of every run. Of each defence a "
        "lower bound is shown of the probability that a run satisfies them together, in the worst of these scenarios, doses and attacks. "
        "docs/trust.md lists the built-in properties, the signals and the language of formulas.",
    )  # fmt: skip
    add_options(command, "--suite", "--defence", "--attack", "--scenario", "--dose", "--threat")
    command.add_argument(
        "--property", action="append", metavar="FORMULA", default=[],
        help="a formula instead of the built-in properties, such as 'G[0,60] gap > 2' (repeatable)",
    )  # fmt: skip
    number = command.add_mutually_exclusive_group()
    number.add_argument("--runs", type=int, metavar="N", help="runs of each cell (default: the suite's seeds)")
    number.add_argument("--precision", type=float, metavar="E", help="as many runs as put every share within E of its probability")
    command.add_argument("--confidence", type=float, default=0.99, metavar="C", help="of --precision (default 0.99)")
    command.add_argument("--alpha", type=float, default=0.05, metavar="A", help="chance that a bound is wrong (default 0.05)")
    command.add_argument("--unsafe", action="append", metavar="key=value", default=[], help="a parameter of the safe distance (repeatable)")
    command.add_argument("--demand", action="append", metavar="key=value", default=[], help="a number of the properties (repeatable)")
    early = command.add_mutually_exclusive_group()
    early.add_argument("--width", type=float, metavar="W", help="explore: stop a cell when its 95 %% interval is no wider than W")
    early.add_argument("--test", type=float, metavar="P", help="explore: stop a cell when a sequential test of P >= this is decided")
    command.add_argument("--indifference", type=float, default=0.05, metavar="D", help="the test's other hypothesis lies so far below")
    command.add_argument("--beacon", default="", metavar="TEXT", help="the round of a board: its seeds are played")
    add_options(command, "--purpose")
    command.add_argument("--batch", type=int, default=2048, metavar="N", help="episodes side by side (default 2048); changes no result")
    add_options(command, "--workers", "--device", "--engine", "--address")
    command.add_argument("--out", metavar="DIR", help="write cells.jsonl, trust.json and the worst failing runs here; resumes")
    add_options(command, "--json")
    add_prove(command)
    add_automata(command)
    command.set_defaults(run=_trust)


def _suite(options: argparse.Namespace) -> Suite:
    """Return the suite, or the part of it that the options name."""
    from tailgate.core.scenario import load_suite
    from tailgate.evaluation.attack_list import attacks_of

    suite = load_suite(options.suite or "quick-v0")
    suite = dataclasses.replace(suite, attacks=attacks_of(suite))
    if options.suite is None and options.scenario:  # a scenario by itself: what is not named is quick-v0's, but for the dose
        suite = dataclasses.replace(suite, name="custom", doses=(None,))
    parts = {"defences": options.defence, "attacks": options.attack, "scenarios": options.scenario}
    changes: dict[str, Any] = {name: tuple(dict.fromkeys(held)) for name, held in parts.items() if held is not None}
    if options.dose is not None:
        changes["doses"] = tuple(dict.fromkeys(scalar(dose) for dose in options.dose))
    if options.threat or {"attacks", "scenarios", "doses"} & set(changes):  # no longer what a board of the suite is about
        changes["name"] = "custom"
    return dataclasses.replace(suite, **changes)


def _rule(options: argparse.Namespace) -> Sequential | Sprt | None:
    from tailgate.trust.statistics import Sequential, Sprt

    for name in ("width", "test"):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < 1.0:
            raise InputError(f"--{name}", value, "a number above 0 and below 1")
    if options.width is not None:
        return Sequential(options.width, 1.0 - options.alpha)
    if options.test is not None:
        if not 0.0 < options.indifference < options.test:
            raise InputError("--indifference", options.indifference, f"a number above 0 and below --test, {options.test:g}")
        return Sprt(options.test - options.indifference, options.test, options.alpha, options.alpha)
    return None


def _trust(options: argparse.Namespace) -> int:
    from tailgate.core.schema import build
    from tailgate.trust.properties import Demands
    from tailgate.trust.run import ROWS, check
    from tailgate.trust.signals import SafeDistance
    from tailgate.trust.statistics import runs_for

    if options.prove:
        return run_prove(options)
    refuse_proofs(options, "a command without --prove")
    if options.automata is not None:
        return run_automata(options)
    refuse(options, ["prism"], "a command without --automata")
    own_classes()
    suite, rule = _suite(options), _rule(options)
    runs = runs_for(options.precision, options.confidence) if options.precision is not None else options.runs
    if runs is None and rule is not None:
        runs = 10_000
    place = Path(options.out) / ROWS if options.out else None
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    with telling_aside(place, "other cells"), working() as update:
        found = check(
            suite, runs=runs, formulas=options.property, alpha=options.alpha, purpose=options.purpose, beacon=options.beacon,
            batch=options.batch,
            workers=options.workers, folder=Path(options.out) if options.out else None, threat=values("--threat", options.threat),
            safe=build(SafeDistance, values("--unsafe", options.unsafe), "--unsafe"),
            asked=build(Demands, values("--demand", options.demand), "--demand"), rule=rule,
            progress=counted(update, "model checking"),
        )  # fmt: skip
    show(options, found, partial(_print, folder=options.out) if rule is None else _print_cells)
    lost = [cell for cell in found["cells"] if cell["status"] == "error"]
    for cell in lost:
        tell(f"{cell['defence']} against {cell['attack']} on {cell['scenario']} failed: {cell['reason']}")
    idle = not any(cell["trust"] for cell in found["cells"])
    if idle and not lost:
        tell(f"nothing was decided: {_why_nothing(found)}")
    return 1 if lost or idle else 0


def _why_nothing(found: dict[str, Any]) -> str:
    reasons = [cell["reason"] for cell in found["cells"]] + [p["reason"] for entry in found["defences"] for p in entry["properties"]]
    return next(filter(None, reasons), "no property has a meaning here")


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _place(held: dict[str, Any]) -> str:
    dose = "" if held["dose"] is None else f", dose {held['dose']}"
    return f"{held['attack']} on {held['scenario']}{dose}"


def _print(found: dict[str, Any], folder: str | None) -> None:
    _print_bounds(found)
    _print_properties(found)
    _print_failures(found, folder)


def _print_bounds(found: dict[str, Any]) -> None:
    """Print the lower bounds of every defence, at the least and at the most knowledge of the attackers."""
    from tailgate.board.words import at_least

    names = [name for name in ("safety", "trust") if any(name in entry for entry in found["defences"])]
    attacks = [a for a in found["attacks"] if a["attack"] != "none"]
    rows = []
    for entry in found["defences"]:
        for level in ("black", "white"):
            if level == "white" and not any(a["knowledge"] != "black" for a in attacks):
                continue
            figures: list[str] = []
            for name in names:
                held = entry[name][level]
                told = [] if held is None else [at_least(held["lower"], 1), f"{held['k']} of {held['n']}", _place(held)]
                figures += told or ["-", "-", "-"]
            rows.append((entry["defence"], level, *figures, entry["why"] if "-" in figures else ""))
    columns = ("defence", "attackers", *(heading for name in names for heading in (name, "runs", "worst")), "why not")
    title = f"{found['suite']['name']}: lower bounds against these {len(attacks)} attacks, {found['runs']} runs a cell"
    table(columns, rows, title, f"one-sided, alpha {found['alpha']:g} over all cells of a line together")
    for name in names:
        members = sorted({p for entry in found["defences"] for held in entry[name].values() if held for p in held["of"]})
        parts = " and ".join(map(_bracketed, members)) or "nothing is defined here"
        say(f"{name}: {parts}, in one run")
    against = ", ".join(f"{a['attack']} ({a['knowledge']}{'; ' + a['note'] if a['note'] else ''})" for a in attacks)
    say(f"attacks: {against or 'none'}")
    say(f"scenarios: {', '.join(found['scenarios'])}")


def _print_properties(found: dict[str, Any]) -> None:
    rows = []
    why = any(p["share"] is None for entry in found["defences"] for p in entry["properties"])
    for entry in found["defences"]:
        for p in entry["properties"]:
            share, when = p["share"], p["antecedent"]
            if share is None:
                rows.append((entry["defence"], p["name"], *["-"] * 5, p["reason"]))
                continue
            often = _told(p) if when is None else f"in {when['runs']} of {when['of']} runs, {_percent(when['instants'])} of the steps"
            often += _alarms(p.get("false_alarms", []))
            span = f"{_percent(share['low'])} to {_percent(share['high'])}"
            figures = _percent(share["value"]), f"{share['k']} of {share['n']}", span, _place(share), often
            rows.append((entry["defence"], p["name"], *figures))
    columns = ("defence", "property", "share", "runs", "interval", "worst", "antecedent", *(("why not",) if why else ()))
    table(columns, rows, "each property in its worst cell", "intervals hold for all cells of a property together")


def _told(known: dict[str, Any]) -> str:
    """Say in how many runs the alarm is on with the attack alone, and without it alone; a dash for other properties."""
    if "earned" not in known:
        return "-"
    share = known["share"]
    return f"alarm in {share['attacked']} attacked runs alone, in {share['clean']} twins alone; earned {_percent(known['earned'])}"


def _alarms(prices: list[dict[str, Any]]) -> str:
    """Say how often the alarm goes on without an attack, where it does so most often."""
    if not prices:
        return ""
    worst = min(prices, key=lambda price: float("inf") if price["hours"] is None else price["hours"])
    if worst["hours"] is None:
        return f"; no false alarm in {min(price['running_hours'] for price in prices):.3g} h"
    return f"; a false alarm in {worst['hours']:.3g} h on {worst['scenario']}"


def _print_failures(found: dict[str, Any], folder: str | None) -> None:
    failing = [entry for entry in found["defences"] if entry["worst"]]
    for entry in failing:
        worst = entry["worst"]
        words = f"{entry['defence']} fails {worst['property']} against {worst['attack']} on {worst['scenario']}, seed {worst['seed']}"
        say(f"{words}: {worst['replay']}" if "replay" in worst else words, soft_wrap=True)
    if failing and folder is None:
        say("with --out DIR these runs are kept for tailgate replay")


def _print_cells(found: dict[str, Any]) -> None:
    """Print the findings of a rule that stops early."""
    rule = found["rule"]
    why, rows = any(cell["trust"] is None for cell in found["cells"]), []
    for cell in found["cells"]:
        head, held = (cell["defence"], cell["attack"], cell["scenario"]), cell["trust"]
        if held is None:
            rows.append((*head, *["-"] * 4, cell["reason"]))
            continue
        verdict = {None: "-", True: f"P >= {rule.get('high', 0):g}", False: f"P <= {rule.get('low', 0):g}"}[cell["verdict"]]
        rows.append((*head, str(cell["n"]), str(held["k"]), f"{_percent(held['low'])} to {_percent(held['high'])}", verdict))
    title = f"{found['suite']['name']}: rule {rule['name']}, for exploring: these intervals miss more often than they say"
    table(("defence", "attack", "scenario", "runs", "hold", "interval", "verdict", *(("why not",) if why else ())), rows, title)


def _bracketed(formula: str) -> str:
    """Return a part of a conjunction; names of properties need no brackets."""
    return f"({formula})" if " " in formula else formula
