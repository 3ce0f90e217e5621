"""tailgate fit: the production-like ACC fitted to recorded cars."""

from __future__ import annotations

import argparse
import math
from typing import Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, counted, picture, say, show, table, working, written


def add(commands: Commands) -> None:
    """Add `fit` to the commands."""
    command = commands.add_parser(
        "fit", help="fit the controller acc_production to recorded cars, and show it on windows that the fit did not see",
        description="Fit the parameters of acc_production to each recorded car behind the measured car ahead of it, and one law for all. "
        "Every other window is left out of the fit: errors are shown on both kinds, alone and in a string behind the measured leader.",
    )  # fmt: skip
    command.add_argument("--trace", action="append", metavar="NAME[:SECONDS]",
                         help="recording of a string (tailgate list traces), and how much is left out at its start (repeatable; "
                         "default asta-string:100 and asta-braking); the first begins at rest")  # fmt: skip
    command.add_argument("--window", type=float, default=50.0, metavar="S", help="length of a window [s] (default 50)")
    command.add_argument("--delay", action="append", type=float, metavar="S",
                         help="candidate of the delay [s] (repeatable; default 0, 0.2, 0.4, 0.6, 0.8)")  # fmt: skip
    command.add_argument("--out", metavar="FILE", help="write the result as JSON")
    command.add_argument("--plot", metavar="FILE", help="draw an unseen window: .png, .svg or .pdf (needs tailgate[viz])")
    command.add_argument("--json", action="store_true", help="print the result as JSON")
    command.set_defaults(run=_fit)


def _trace(text: str) -> tuple[str, float]:
    name, _, seconds = text.partition(":")
    try:
        begin = float(seconds or 0.0)
    except ValueError:
        begin = math.nan
    if not 0.0 <= begin < math.inf:
        raise InputError("--trace", text, "NAME or NAME:SECONDS, with seconds not below 0")
    return name, begin


def _fit(options: argparse.Namespace) -> int:
    from tailgate.base.files import write_atomic, write_json
    from tailgate.roads.fit import DELAYS, Settings, draw, fit

    plot, out = picture("--plot", options.plot), written("--out", options.out)
    given = {"window": options.window, "delays": tuple(options.delay or DELAYS)}
    settings = Settings(**given) if options.trace is None else Settings(tuple(map(_trace, options.trace)), **given)
    with working() as update:
        held = fit(settings, counted(update, "fitting", "fits"))
    if out is not None:
        write_json(out, held)
    if plot is not None:
        write_atomic(plot, draw(held, form=plot.suffix.lower()[1:]), "plot")
    show(options, held, _tables)
    return 0


def _tables(held: dict[str, Any]) -> None:
    heads = ("law, car", "standstill [m]", "time gap [s]", "k_g [1/s^2]", "k_v [1/s]", "lag [s]", "speed error [m/s]", "gap error [m]",
             "in the string: speed", "gap", "gain")  # fmt: skip
    rows = []
    for name, law in held["laws"].items():
        unseen = law["unseen"]
        for i, car in enumerate(law["cars"]):
            numbers = [car[key] for key in ("standstill", "headway", "gap_gain", "speed_gain", "tau")]
            numbers += [unseen[kind][what][i] for kind in ("alone", "string") for what in ("speed", "gap")] + [unseen["gain"][i]]
            label = f"one for all, car {car['car']}" if name == "one" else f"car {car['car']}"
            rows.append((label, *(f"{x:.3g}" for x in numbers)))
    measured = ", ".join(f"{x:.2f}" for x in held["measured"]["unseen"]["gain"])
    table(heads, rows, f"fit with a delay of {held['delay']:g} s; RMS errors on {held['windows']['unseen']} windows that it did not see",
          f"targets: {held['targets']['speed']:g} m/s and {held['targets']['gap']:g} m; measured gain of the string: {measured}",
          numbers=range(1, len(heads)))  # fmt: skip
    costs = ", ".join(f"{part['delay']:g} s {part['cost']:.0f}" for part in held["delays"])
    say(f"cost by delay: {costs}")
