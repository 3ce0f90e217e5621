"""tailgate attack: the strongest attacks that a search finds against a defence."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from tailgate.base.progress import lasting
from tailgate.cli.shared import Commands, add_options, own_classes, say, show, table, tell, working
from tailgate.training.adaptive import SIZES


def add(commands: Commands) -> None:
    """Add the command."""
    command = commands.add_parser(
        "attack", help="find the attacks that do most harm to a defence, and compare them with a suite's",
        description="Attack a defence with the standard ensemble: searched scripts, programs and values, published and newly learned "
        "policies, and attacks that know the defence. In each scenario, at each dose, the best of every member is compared with the best "
        "attack that the suite lists, on fresh episodes.",
    )  # fmt: skip
    command.add_argument("defence", metavar="NAME", help="defence to attack; a class: module:Class, or bwrap/module:Class")
    command.add_argument("--suite", default="quick-v0", metavar="NAME", help="suite by name or YAML file (default: quick-v0)")
    add_options(command, "--scenario", "--dose")
    command.add_argument("--budget", default="standard", metavar="SIZE", help=f"{' or '.join(SIZES)} (default: standard)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the search (default 0)")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="report episodes per comparison (default 400)")
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2); change no result")
    add_options(command, "--engine", "--address")
    command.add_argument("--out", metavar="DIR", help="write attack.json, attacks.txt, programs, policies and rows here; resumes")
    add_options(command, "--json")
    command.set_defaults(run=_attack)


def _attack(options: argparse.Namespace) -> int:
    from tailgate.base.errors import InputError
    from tailgate.base.files import write_atomic
    from tailgate.core.scenario import load_suite
    from tailgate.core.schema import scalar
    from tailgate.ensemble.standard import attack, attacks_of

    own_classes()
    options.kept = "the same command goes on after the searches that are finished" if options.out else "nothing is kept: --out DIR would"
    doses = [scalar(text) for text in options.dose or ()]
    for dose in doses:
        if dose is not None and not isinstance(dose, int):
            raise InputError("--dose", dose, "a whole number of attack steps, or none")
    out = Path(options.out) if options.out else None
    with working() as update:
        report = attack(
            load_suite(options.suite), options.defence, scenarios=options.scenario or (), doses=doses, budget=options.budget,
            seed=options.seed, episodes=options.episodes, workers=options.workers, out=out, progress=update,
            announce=lambda seconds: tell(f"the searches take about {lasting(seconds)} where nothing else runs"),
        )  # fmt: skip
    if out is not None:
        write_atomic(out / "attacks.txt", "".join(f"{text}\n" for text in attacks_of(report)).encode())
    show(options, report, _print)
    if not options.json and (again := _again(report, options.suite, kept=out is not None)):
        say(again, soft_wrap=True)
    return 0


def _again(report: dict[str, Any], suite: str, kept: bool) -> str:
    """Return the command that plays the most harmful attack, or why there is none; empty where nothing was found."""
    found = [(one["damage"], cell, one["attack"]) for cell in report["cells"] for one in cell["members"] if one["attack"]]
    if not found:
        return ""
    damage, cell, attack = max(found, key=lambda one: (one[0], kept or "path=" not in one[2]))
    if not kept and "path=" in attack:
        where = f"{cell['scenario']}, dose {'own' if cell['dose'] is None else cell['dose']}"
        return f"the most harmful one ({damage:.1%} in {where}) is a file, and no file was kept: --out DIR keeps them"
    words = ["tailgate", "evaluate", "--suite", suite, "--scenario", cell["scenario"]]
    words += ["--dose", "none" if cell["dose"] is None else str(cell["dose"]), "--defence", report["defence"], "--attack", attack]
    words += ["--seeds", str(report["episodes"])]
    return f"to play the most harmful one again: {shlex.join([*words, '--out', 'rows.jsonl'])}"


def _print(report: dict[str, Any]) -> None:
    def figure(one: dict[str, Any] | None) -> str:
        return "-" if one is None or one["attack"] is None else f"{one['damage']:.1%} [{one['low']:.1%}, {one['high']:.1%}]"

    lines = []
    for cell in report["cells"]:
        name = f"{cell['scenario']}, dose {'own' if cell['dose'] is None else cell['dose']}"
        lines.append([name, "best of the suite", "", figure(cell["listed"]), (cell["listed"] or {}).get("attack", "")])
        lines += [["", one["member"], one["knowledge"], figure(one), one["attack"] or one["why"]] for one in cell["members"]]
    table(
        ["scenario", "member", "box", "damaged", "best attack"], lines,
        f"{report['defence']} in {report['suite']}: damaged episodes under {report['ensemble']}, budget {report['budget']}",
        f"{report['episodes']} report episodes; 95 % intervals",
    )  # fmt: skip
    for cell in report["cells"]:
        for flag in cell["flags"]:
            say(f"{cell['scenario']}: {flag}: a black box did more damage than the gradients")
    better = [c for c in report["cells"] if c["found"] and c["listed"] and c["found"]["low"] > c["listed"]["high"]]
    say(f"the ensemble did more harm than the strongest listed attack in {len(better)} of {len(report['cells'])} cells")
