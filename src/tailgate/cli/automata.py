"""tailgate trust --automata: an architecture's exploits as a Markov chain."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.cli.prove import refuse
from tailgate.cli.shared import show, table, tell

_PLAYED = (
    "suite", "defence", "attack", "scenario", "dose", "threat", "property", "precision", "unsafe", "demand", "width", "test", "beacon",
    "out", "alpha", "confidence", "indifference",
)  # options of trust that a chain does not read


def add_automata(command: argparse.ArgumentParser) -> None:
    """Add --automata and what belongs to it."""
    group = command.add_argument_group("exploits of an architecture: docs/automata.md")
    group.add_argument("--automata", metavar="NAME", help="an architecture by name or YAML file with kind: ctmc, such as telematics")
    group.add_argument("--prism", metavar="FILE", help="write it for PRISM, and its properties next to it")


def run_automata(options: argparse.Namespace) -> int:
    """Print what is asked of an architecture: solved, or simulated with --runs."""
    from tailgate.trust.ctmc import load_architecture, play, solve
    from tailgate.trust.prism import write_prism

    refuse(options, _PLAYED, "--automata")
    made = load_architecture(options.automata)
    if options.prism is not None:
        if Path(options.prism).suffix == ".props":
            raise InputError("--prism", options.prism, "another ending than .props, which the properties have")
        for path in write_prism(made, Path(options.prism)):
            tell(str(path))
    show(options, solve(made) if options.runs is None else play(made, options.runs), _print)
    return 0


def _print(report: dict[str, Any]) -> None:
    solved = report["method"] == "uniformisation"
    how = f"{report['states']} states" if solved else f"{report['runs']} runs"
    if solved:
        rows = [("message", name, f"{100 * share:.4g} %") for name, share in report["messages"].items()]
        rows += [("node", name, f"{100 * share:.4g} %") for name, share in report["nodes"].items()]
        table(("", "name", "share of time exploited, in the long run"), rows, f"{report['name']}: {how}")
    lines = [
        (q["name"], q["message"], f"{q['within']:g} {report['unit']}", f"{100 * q['probability']:.4g} %",
         "" if solved else f"{100 * q['low']:.3g} to {100 * q['high']:.3g} %")
        for q in report["queries"]
    ]  # fmt: skip
    if lines:
        columns = ("query", "message", "broken within", "probability", *(() if solved else ("95 % interval",)))
        table(columns, [line if not solved else line[:4] for line in lines], f"{report['name']}: from the secure state, {how}")
