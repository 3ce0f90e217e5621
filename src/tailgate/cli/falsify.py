"""tailgate falsify: the episode that breaks a property, found by a search and shrunk."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, add_options, own_classes, say, show, table, threat_of, working
from tailgate.core.schema import scalar

if TYPE_CHECKING:
    from tailgate.falsify.case import Case

SHOWN = 12  # commands that are listed


def add(commands: Commands) -> None:
    """Add `falsify` to the commands."""
    command = commands.add_parser(
        "falsify", help="search an episode that breaks a temporal property, and shrink its attack",
        description="Minimise the robustness of a property over scripts of attack, and over the start of the road and the leader's "
        "manoeuvre within the scenario's distribution. The attack found is shrunk to the fewest steps and the smallest values that still "
        "break the property, and played again by the plain engine. docs/falsification.md explains it.",
    )  # fmt: skip
    add_case(command)
    command.add_argument("--attack", default="searched", metavar="NAME", help="play this attack and search the road alone; none: no attack")
    command.add_argument("--sampler", default="tpe", metavar="NAME", help="tpe or cmaes (default tpe)")
    command.add_argument("--trials", type=int, default=1024, metavar="N", help="trials, of 8 episodes each (default 1024)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the search (default 0)")
    command.add_argument("--counterexample", metavar="FILE", help="no search: play this counterexample again, against the defence")
    command.add_argument("--out", metavar="DIR", help="write falsify.json, counterexample.json and generations here; resumes")
    add_options(command, "--json")
    command.set_defaults(run=_falsify)


def add_case(command: argparse.ArgumentParser) -> None:
    """Add the options that say what is to be broken."""
    command.add_argument("defence", metavar="DEFENCE", help="defence by name; a class: module:Class, or bwrap/module:Class")
    command.add_argument("--property", metavar="FORMULA", help="what must hold, such as 'G[0,60] gap > 2'")
    command.add_argument("--scenario", metavar="NAME", help="scenario by name or YAML file")
    command.add_argument("--suite", default="", metavar="NAME", help="take the threat model of this suite (default: the scenario's)")
    command.add_argument("--dose", default=None, metavar="STEPS", help="attack budget; none: the scenario's own (default)")
    add_options(command, "--threat")


def case_of(options: argparse.Namespace, attack: str) -> Case:
    """Return the case that the options describe.

    Raises
    ------
    InputError
        For an option that is missing or cannot be read.
    """
    from tailgate.falsify.case import Case

    for name in ("property", "scenario"):
        if not getattr(options, name):
            raise InputError(f"--{name}", getattr(options, name), "a value; the option is needed")
    dose = None if options.dose is None else scalar(options.dose)
    return Case(options.suite, options.scenario, dose, options.defence, tuple(threat_of(options).items()), options.property, attack)


def _falsify(options: argparse.Namespace) -> int:
    from tailgate.falsify.counterexample import replayed
    from tailgate.falsify.run import falsify
    from tailgate.falsify.search import Search

    own_classes()
    if options.counterexample is not None:
        held = replayed(Path(options.counterexample), options.defence, options.scenario, options.suite)
        show(options, held, _print_replay)
        return 0 if held["same"] else 1
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    job = Search(case_of(options, "" if options.attack == "searched" else options.attack), options.sampler, options.trials, options.seed)
    with working() as update:
        report = falsify(job, Path(options.out) if options.out else None, update)
    show(options, report, _print)
    return 0


def _print_replay(held: dict[str, Any]) -> None:
    _print_formulas(held)
    say("the same episode, to the last bit" if held["same"] else "another episode than that of the file: another defence, or changed code")


def _print(report: dict[str, Any]) -> None:
    found = report["counterexample"]
    say(
        f"{report['property']}: least robustness {report['least']:.4g} in {report['trials']} trials, {report['episodes']} episodes, "
        f"{report['seconds']:g} s; {report['violations']} episodes broke it"
    )
    if not report["violated"]:
        say("no counterexample was found: that is no proof that there is none")
    say(
        f"attack found: {found['found']['attack']}, {found['found']['steps']} attacked steps, robustness {found['found']['robustness']:.4g}"
    )
    if report["violated"]:
        say(f"shrunk: {found['steps']} attacked steps, robustness {found['robustness']:.4g}{', a collision' if found['collided'] else ''}")
    say(f"road: {', '.join(f'{name} {value:.2f}' for name, value in found['road'].items())}; seed {found['seed']} ({found['purpose']})")
    for one in found["commands"][:SHOWN]:
        hits = ", ".join(f"{hit['wire']} of agent {hit['agent']} by {hit['value']:.3g}" for hit in one["hits"])
        say(f"  step {one['k']}: {one['kind']}, {hits}")
    if len(found["commands"]) > SHOWN:
        say(f"  and {len(found['commands']) - SHOWN} more")
    _print_formulas(found)


def _print_formulas(held: dict[str, Any]) -> None:
    lines = []
    for one in held["formulas"]:
        values = [(value, i) for i, value in enumerate(one["along"]) if value is not None]
        least, at = min(values, default=(float("inf"), 0))
        first = one["along"][0]
        lines.append([one["formula"], "-" if first is None else f"{first:.4g}", f"{least:.4g}", f"{(at + 1) * held['dt']:.1f}"])
    table(["formula", "robustness at the start", "least", "at [s]"], lines, numbers={1, 2, 3})
