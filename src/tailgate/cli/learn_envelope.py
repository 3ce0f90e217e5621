"""tailgate learn-envelope: the invariants of clean runs, for the defence `envelope`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, counted, print_json, say, table, working, written_to


def add(commands: Commands) -> None:
    """Add `learn-envelope` to the commands."""
    command = commands.add_parser(
        "learn-envelope", help="learn bounds that clean runs do not leave, for the defence envelope",
        description="Learn invariants of readings, messages and known inputs from clean episodes, of scenarios or of a log (tailgate "
        "log). Those that other clean episodes leave too often are left out. The file is a parameter: --defence envelope:path=FILE.json.",
    )  # fmt: skip
    command.add_argument("--scenario", action="append", metavar="NAME",
                         help="a scenario that is played, or with --log one of the log (repeatable; with --log default: all)")  # fmt: skip
    command.add_argument("--log", metavar="DIR", help="read a log of `tailgate log`, and play nothing (needs tailgate[log])")
    command.add_argument("--episodes", type=int, default=200, metavar="N", help="training episodes of each scenario (default 200)")
    command.add_argument("--held-out", type=int, default=200, metavar="N", help="held-out episodes of each scenario (default 200)")
    command.add_argument("--margin", default="gpd", metavar="SHARE",
                         help="how bounds are widened: gpd, a generalised Pareto tail (default), or a share of the half width")  # fmt: skip
    command.add_argument("--tail", type=float, default=1e-7, metavar="P",
                         help="chance of a step beyond a bound that the tail gives (default 1e-7)")  # fmt: skip
    command.add_argument("--rate", type=float, metavar="P",
                         help="highest share of held-out episodes, or steps, that leave an invariant (default 0.05, or 1e-4)")  # fmt: skip
    command.add_argument("--unit", choices=("episode", "step"), default="episode",
                         help="what is counted: episodes (default), or steps as if they were independent")  # fmt: skip
    command.add_argument("--positions", action="store_true", help="learn bounds of places on the road too, which end a longer drive")
    command.add_argument("--out", required=True, metavar="FILE.json", help="file of the envelope")
    command.add_argument("--json", action="store_true", help="print the file's content as JSON")
    command.set_defaults(run=_learn)


def _learn(options: argparse.Namespace) -> int:
    from tailgate.studies.envelope import Settings, write_envelope
    from tailgate.studies.envelope_sources import from_log, from_scenarios

    rate = options.rate if options.rate is not None else 0.05 if options.unit == "episode" else 1e-4
    try:
        margin = options.margin if options.margin == "gpd" else float(options.margin)
    except ValueError:
        raise InputError("--margin", options.margin, "gpd, or a share of the half width, such as 0.1") from None
    settings, out = Settings(margin, options.tail, rate, options.unit, options.positions), Path(options.out)
    if out.suffix != ".json":
        raise InputError("--out", options.out, "a path that ends with .json")
    with written_to(out), working() as update:
        def shown(label: str, done: int, total: int) -> None:
            counted(update, label, "invariants" if label == "learning" else "episodes" if label == "playing" else "files")(done, total)

        if options.log:
            sheet = from_log(Path(options.log), options.scenario, settings, shown)
        else:
            sheet = from_scenarios(options.scenario or (), options.episodes, options.held_out, settings, shown)
    write_envelope(sheet, out)
    if options.json:
        print_json(sheet.model_dump(mode="json"))
        return 0
    kinds = list(dict.fromkeys(one.kind for one in sheet.invariants))
    rows = []
    for kind in kinds:
        some = [one for one in sheet.invariants if one.kind == kind]
        by_sign = sum(set(one.bounds) > {"any"} for one in some)
        rows.append((kind, str(len(some)), str(by_sign), f"{max(rate for one in some for rate in one.rates.values()):.2g}"))
    steps = {split: sum(sheet.made[split]["steps"]) for split in ("train", "dev")}
    caption = f"{steps['train']} training and {steps['dev']} held-out steps of {', '.join(sheet.made['from'])}"
    table(("kind", "invariants", "with bounds for a sign of the input", "limit of the rate"), rows, f"envelope {out.name}", caption)
    say(f"{out}: SHA-256 {sheet.sha256}", soft_wrap=True)
    return 0
