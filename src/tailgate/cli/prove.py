"""tailgate trust --prove: what is proved of a scenario, without playing it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import counted, say, show, table, values, working
from tailgate.core.schema import scalar

_PLAYED = (
    "suite", "attack", "property", "runs", "precision", "unsafe", "demand", "width", "test", "beacon", "out", "alpha", "confidence",
    "indifference",
)  # options of trust that a proof does not read
_PROOFS = {
    "bound": None, "at_rest": False, "spread": 4.0, "gaussian": None, "lead_accel": None, "no_set_speed": False, "delays": False,
    "stale": False, "steps": None,
}  # options of proofs, and what they are if nobody gives them
_UNSAID = _PROOFS | {"alpha": 0.05, "confidence": 0.99, "indifference": 0.05}


def refuse(options: argparse.Namespace, names: Iterable[str], by: str) -> None:
    """Raise InputError for the first of these options that is given, as `by` does not read it."""
    for name in names:
        if (value := getattr(options, name)) not in (_UNSAID.get(name), None, [], ""):
            raise InputError(f"--{name.replace('_', '-')}", value, f"nothing: {by} does not read it")


def add_prove(command: argparse.ArgumentParser) -> None:
    """Add --prove and what belongs to it."""
    group = command.add_argument_group("proofs, without playing: docs/trust.md")
    group.add_argument("--prove", action="store_true", help="what is proved of a scenario under kf: reachable sets and a closed form")
    group.add_argument("--bound", type=float, metavar="E", help="size of an error that counts as damage, where nobody drives")
    group.add_argument("--at-rest", action="store_true", help="the loop has settled before the first step")
    spread = _PROOFS["spread"]
    group.add_argument("--spread", type=float, default=spread, metavar="S", help="largest noise, in standard deviations (default 4)")
    group.add_argument("--gaussian", type=float, metavar="A", help="Gaussian noise instead, and all ranges hold together with 1 - A")
    group.add_argument("--lead-accel", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of the leader's acceleration [m/s^2]")
    group.add_argument("--no-set-speed", action="store_true", help="take the set speed away, which makes the cruise control linear")
    group.add_argument("--delays", action="store_true", help="the largest delay of the leader's message, too")
    group.add_argument("--stale", action="store_true", help="late positions are taken as they are, not led on by the speed in them")
    group.add_argument("--steps", type=int, metavar="N", help="first steps of an episode alone")


def refuse_proofs(options: argparse.Namespace, by: str) -> None:
    """Raise InputError for an option of proofs that is given without --prove."""
    refuse(options, _PROOFS, by)


def run_prove(options: argparse.Namespace) -> int:
    """Print what is proved of the scenarios; 1 where a scenario has no part that applies."""
    from tailgate.trust.prove import prove

    refuse(options, ["automata", "prism", *_PLAYED], "--prove")
    if options.defence not in (None, ["kf"]):
        raise InputError("--defence", options.defence, "kf alone: another filter or a gate is not what is proved")
    if options.dose is not None and len(options.dose) > 1:
        raise InputError("--dose", options.dose, "one dose: a proof is about one budget")
    if not options.scenario:
        raise InputError("--scenario", None, "a scenario to prove something of")
    if options.steps is not None and options.steps < 1:
        raise InputError("--steps", options.steps, "a whole number of steps, at least 1")
    threat = values("--threat", options.threat)
    if options.dose is not None:
        threat["budget"] = scalar(options.dose[-1])
    found = []
    with working() as update:
        for name in options.scenario:
            found.append(prove(
                name, options.bound, options.gaussian, threat, not options.no_set_speed, options.delays,
                counted(update, name, "delays"), at_rest=options.at_rest, spread=options.spread, stale=options.stale, steps=options.steps,
                lead=None if options.lead_accel is None else (options.lead_accel[0], options.lead_accel[1]),
            ))  # fmt: skip
    show(options, found, _print)
    return 1 if any(all(report.get(part) is None for part in ("closed_form", "attack")) for report in found) else 0


def _number(value: float | None, most: float | None = None) -> str:
    if value is None:
        return "none"
    return f"at least {value:.4g}" if most is not None and value >= most else f"{value:.4g}"


def _print(found: list[dict[str, Any]]) -> None:
    for report in found:
        if (held := report["closed_form"]) is not None:
            rows = [
                (*(f"{row[name]:.4g}" for name in ("speed", "desired_gap", "least_gap")), f"{row['bias']:.4g}" if row["holds"] else "none")
                for row in held["speeds"]
            ]
            told = ", ".join(f"{key.replace('_', ' ')} {value:g}" for key, value in held["numbers"].items())
            columns = ("speed [m/s]", "desired gap [m]", "least gap [m]", "admissible bias [m]")
            table(columns, rows, f"{report['scenario']}: a car that reacts late", told, numbers={0, 1, 2, 3})
        if (held := report["attack"]) is not None:
            noise = held["noise"]
            within = "alpha" not in noise
            words = f"noise within {noise['spread']:g} sd" if within else f"random noise, all ranges together with {1.0 - noise['alpha']:g}"
            budget = "unlimited" if held["budget"] is None else str(held["budget"])
            sizes = (_number(held[name], held["most"]) for name in ("largest", "without_limits"))
            line = (", ".join(held["targets"]), budget, *sizes, f"{held['calm']['gap']:.4g}")
            heads = (
                "wires", "steps", "largest injection that is safe", "if the command had no limits", "least gap ahead without an attack",
            )  # fmt: skip
            table(heads, [line], f"{report['scenario']}, kf: reachable sets over {held['steps']} steps", words)
            if held["not_covered"]:
                rest = ", ".join(held["not_covered"])
                say(f"{report['scenario']}: injected values alone are covered, and nothing of: {rest}", soft_wrap=True)
        if (held := report.get("delay")) is not None:
            say(f"{report['scenario']}: a message may be late by {_number(held['largest'])} steps of {held['dt']:g} s (tried up to "
                f"{held['tried'][-1]['delay']}), the limits of the command aside")  # fmt: skip
        for part, reason in report["why"].items():
            say(f"{report['scenario']}: no {part.replace('_', ' ')}: {reason}", soft_wrap=True)
