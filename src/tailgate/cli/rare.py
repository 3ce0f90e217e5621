"""tailgate rare: how rarely an episode breaks a property, and the likeliest noise that does so."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tailgate.cli.falsify import add_case, case_of
from tailgate.cli.shared import Commands, add_options, own_classes, say, show, table, working


def add(commands: Commands) -> None:
    """Add `rare` to the commands."""
    command = commands.add_parser(
        "rare", help="estimate how rarely an episode breaks a property, by splitting",
        description="Estimate the probability that an episode breaks a property of the form G[a,b] of comparisons, without an attack or "
        "under one with random draws, by adaptive multilevel splitting over the loop's random numbers. docs/falsification.md explains it.",
    )  # fmt: skip
    add_case(command)
    command.add_argument("--attack", default="none", metavar="NAME", help="attack by name, such as dropout:chance=0.02 (default none)")
    command.add_argument("--particles", type=int, default=256, metavar="N", help="episodes of a run at a time (default 256)")
    command.add_argument("--runs", type=int, default=8, metavar="N", help="independent runs, for the interval (default 8)")
    command.add_argument("--confidence", type=float, default=0.95, metavar="C", help="of the interval (default 0.95)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the keys (default 0)")
    command.add_argument("--likeliest", action="store_true", help="search the likeliest noise that breaks the property, too: some minutes")
    command.add_argument("--out", metavar="DIR", help="write rare.json and finished runs here; resumes")
    add_options(command, "--json")
    command.set_defaults(run=_rare)


def _rare(options: argparse.Namespace) -> int:
    from tailgate.falsify.rare import Rare, estimate

    own_classes()
    options.kept = "the same command goes on" if options.out else "nothing is kept: --out DIR would"
    job = Rare(case_of(options, options.attack), options.particles, options.runs, options.seed, options.confidence)
    with working() as update:
        report = estimate(job, Path(options.out) if options.out else None, update, options.likeliest)
    show(options, report, _print)
    return 0


def _print(report: dict[str, Any]) -> None:
    name = f"{report['property']} breaks"
    plain = "-" if report["plain_episodes"] is None else f"{report['plain_episodes']:.3g}"
    table(
        ["probability", f"{100 * report['confidence']:g} % interval", "runs", "levels", "episodes", "plain episodes as sure", "s"],
        [[
            f"{report['probability']:.3g}", f"{report['low']:.3g} to {report['high']:.3g}", str(len(report["runs"])),
            str(max(report["levels"])), str(report["episodes"]), plain, f"{report['seconds']:g}",
        ]],
        name, f"{report['defence']} in {report['scenario']} under {report['attack']}; {report['particles']} particles",
    )  # fmt: skip
    lost = report["runs"].count(0.0)
    if lost:
        say(f"{lost} of {len(report['runs'])} runs did not arrive: the interval is that of plain episodes; more particles narrow it")
    if (found := report["likeliest"]) is None:
        return
    if not found["failed"]:
        say("no noise was found that breaks the property without other chance")
        return
    say(
        f"likeliest failure: noise of {found['distance']:.2f} standard deviations in all, log-likelihood {found['log_likelihood']:.2f} "
        f"over that of no noise; Phi(-distance) {found['first_order']:.2g}"
    )
    lines = [
        [one["role"], str(one["at"]), f"{min(one['noise']):.3g}", f"{max(one['noise']):.3g}", str(_largest(one["noise"]))]
        for one in found["channels"]
    ]  # fmt: skip
    table(["noise", "number", "least [sd]", "most [sd]", "largest at step"], lines, numbers={1, 2, 3, 4})


def _largest(noise: list[float]) -> int:
    return max(range(len(noise)), key=lambda k: abs(noise[k]))
