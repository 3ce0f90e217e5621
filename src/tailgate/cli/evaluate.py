"""tailgate evaluate: defences against attacks, one row per episode."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tailgate.base.files import writable_directory
from tailgate.cli.shared import (
    Commands,
    add_options,
    counted,
    figures,
    own_classes,
    say,
    show,
    table,
    tell,
    telling_aside,
    threat_of,
    working,
)
from tailgate.core.schema import canonical, scalar

if TYPE_CHECKING:
    from tailgate.core.scenario import Suite

DEFAULT = "quick-v0"  # the suite if none is named
AGAIN = 3  # rows of a defence that are played again
MANY_REFUSED = 0.1  # share of an attack's commands that is worth a warning
REFUSED = "refused: the scenario does not grant it"


def add(commands: Commands) -> None:
    """Add `evaluate` to the commands."""
    command = commands.add_parser(
        "evaluate", help="play defences against attacks and write one row per episode",
        description="Play a suite, or the part of it that the options name. NAME: a registered component, NAME:key=value,key=value, "
        "module:Class, or (attacks) the JSON file of an exported policy or the YAML file of a program.",
    )  # fmt: skip
    add_options(command, "--suite", "--defence", "--attack")
    command.add_argument("--scenario", action="append", metavar="NAME",
                         help="a scenario (repeatable); with --suite: at its doses and with what it grants")  # fmt: skip
    add_options(command, "--dose", "--threat")
    command.add_argument("--seeds", type=int, metavar="N", help="episodes per cell instead of the suite's")
    command.add_argument("--metric", action="append", metavar="NAME",
                         help="a metric of your own (repeatable): module:function, or an entry point; a column of rows")  # fmt: skip
    add_options(command, "--purpose")
    command.add_argument("--batch", type=int, default=256, metavar="N", help="episodes side by side (default 256); changes no result")
    add_options(command, "--workers", "--device", "--engine", "--address")
    command.add_argument("--out", metavar="FILE", help="write rows here (JSON Lines); an interrupted run resumes, other rows are set aside")
    command.add_argument("--plot", metavar="DIR", help="draw defences x attacks: error, smallest gap, collisions (needs tailgate[viz])")
    add_options(command, "--picture")
    command.add_argument("--json", action="store_true", help="print the table as JSON")
    command.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    from tailgate.core.scenario import load_suite
    from tailgate.evaluation.cells import evaluate
    from tailgate.evaluation.summary import summarise

    own_classes()
    threat = threat_of(options)
    doses = None if options.dose is None else [scalar(d) for d in options.dose]
    suite: Suite | str = options.suite or DEFAULT
    if options.suite is None and options.scenario:  # a scenario by itself: what is not named is quick-v0's, but for the dose
        suite = dataclasses.replace(load_suite(DEFAULT), name="custom", doses=(None,))
    if options.plot:
        figures()
        writable_directory(Path(options.plot), "plot")
    options.kept = f"the same command goes on with the rows of {options.out}" if options.out else "nothing is kept: --out FILE would"
    with telling_aside(options.out, "something else than these rows"), working() as update:
        rows = evaluate(
            suite, defences=options.defence, attacks=options.attack, scenarios=options.scenario, doses=doses,
            seeds=options.seeds, purpose=options.purpose, batch=options.batch, workers=options.workers,
            out=options.out, threat=threat, progress=counted(update, "playing"), metrics=options.metric or (),
        )  # fmt: skip
    table = summarise(rows)
    own = rows[0].get("metrics", []) if rows else []
    show(options, table, partial(_print_summary, own=own))
    alone = options.suite is None and options.scenario and doses is None and "budget" not in threat
    if alone and not options.json and any(row["attack"] != "none" for row in rows):
        lasting = " (unlimited: attacks may last the whole episode)" if any(entry["dose"] is None for entry in table) else ""
        say(f"no --dose: the scenario's own budget{lasting}")
    if options.plot:
        from tailgate.base.plots import write_overview

        for path in write_overview(table, Path(options.plot), options.picture):
            print(f"picture: {path}", file=sys.stderr)
    failed = sum(entry["failed"] for entry in table)
    if failed:
        tell(f"{failed} of {len(rows)} rows failed; their reasons are in the rows")
    attacked = [row for row in rows if row["attack"] != "none" and row["status"] == "ok"]
    if attacked and not any(row["attack_steps"] for row in attacked):
        tell("no attack took place in any episode: --attack names others, --threat grants more")
    for warning in (*_above(rows, options.attack or ()), *_refused(rows), *_dependent(rows)):
        tell(f"warning: {warning}")
    idle = bool(rows) and all(entry["crash"] is None for entry in table)
    if idle and not failed:
        tell(f"nothing was played: {table[0]['reason']}")
    return 1 if failed or idle else 0


def _above(rows: list[dict[str, Any]], named: Sequence[str]) -> list[str]:
    """Return warnings on values of these attacks that the threat models of their rows cut."""
    from tailgate.core.registry import Spec

    out = []
    for attack in named:
        granted = {canonical(row["threat_model"]): row["threat_model"] for row in rows if row["attack"] == attack and row["status"] == "ok"}
        made = Spec("attack", attack).make() if granted else None
        for field in getattr(made, "__dataclass_fields__", {}).values():
            cut = field.metadata.get("cut")
            bounds = [threat.get(cut) for threat in granted.values() if cut]  # a threat model does not write every bound that is none
            for bound in sorted({tuple(bound) if isinstance(bound, list) else (-bound, bound) for bound in bounds if bound is not None}):
                if not bound[0] <= getattr(made, field.name) <= bound[1]:
                    out.append(f"{attack}: {field.name} is cut at {cut}, {bound[0]:g} to {bound[1]:g}")
    return out


def _refused(rows: list[dict[str, Any]]) -> list[str]:
    """Return warnings on attacks that act, but often ask for what the threat model does not grant, or no longer."""
    tried: dict[tuple[str, str], Counter[str]] = {}
    for row in rows:
        if row["status"] == "ok":
            tried.setdefault((row["attack"], row["scenario"]), Counter()).update({
                "steps": row["attack_steps"], "refused": row["refused_commands"],
            })  # fmt: skip
    return [
        f"{attack} in {scenario}: {count['refused'] / count.total():.0%} of its commands are refused: "
        "the threat model does not grant them, or no longer"
        for (attack, scenario), count in tried.items()
        if count["steps"] and count["refused"] > MANY_REFUSED * count.total()
    ]


def _dependent(rows: list[dict[str, Any]]) -> list[str]:
    """Return warnings on somebody's own defences, whose rows are played again: alone if they had companions, else with companions."""
    from tailgate.core.registry import Spec
    from tailgate.evaluation.verify import verify

    out = []
    for defence in dict.fromkeys(row["defence"] for row in rows if row["status"] == "ok"):
        spec = Spec("defence", defence)
        if not spec.imports and spec.sandboxed is None:
            continue
        mine = [row for row in rows if row["defence"] == defence and row["status"] == "ok"]
        some = [row for row in mine if row["cell"] == mine[0]["cell"]][:AGAIN]
        if len(some) < 2:  # it had no companion
            continue
        differ = verify(some, batch=AGAIN if some[0]["batch"] == 1 else 1, trust_code=True)["counts"]["differs"]
        if differ:
            out.append(
                f"rows of {defence} depend on one another, or on chance that is none of their draws, so that they cannot be made again: "
                f"{differ} of {len(some)} came out otherwise in another batch"
            )
    return out


def _print_summary(summary: list[dict[str, Any]], own: Sequence[str] = ()) -> None:
    for place in dict.fromkeys((e["scenario"], e["dose"]) for e in summary):
        scenario, dose = place
        here = [entry for entry in summary if (entry["scenario"], entry["dose"]) == place]
        road = any(entry["crash"] and entry["min_gap"] for entry in here)  # else nothing drives, and an error has no unit
        errors = ("min gap [m], median", "max error [m], median") if road else ("RMS error", "max error")
        measures = ("n", *(("collisions", "95 % interval") if road else ()), *errors, "alarm onsets", *own)
        why = any(entry["crash"] is None or entry["refused_all"] for entry in here)
        rows = []
        for entry in here:
            head, crash = [entry["defence"], entry["attack"], entry["knowledge"], str(entry["n"])], entry["crash"]
            if crash is None or entry["refused_all"]:
                rows.append([*head, *["-"] * (len(measures) - 1), entry["reason"] if crash is None else REFUSED])
                continue
            figures = [f"{100 * crash['value']:.1f} %", f"{100 * crash['low']:.1f} to {100 * crash['high']:.1f} %"] if road else []
            keys = ("min_gap" if road else "rmse_position", "max_error", "alarm_onsets", *own)
            rows.append([*head, *figures, *(f"{entry[k]['median']:.2f}" if entry[k] else "-" for k in keys)])
        columns = ("defence", "attack", "knowledge", *measures, *(("why not",) if why else ()))
        table(columns, rows, f"{scenario}, budget {'unlimited' if dose is None else f'{dose} steps'}")
