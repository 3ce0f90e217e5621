"""tailgate calibrate: the threshold for a wanted mean time between false alarms."""

from __future__ import annotations

import argparse
import shlex
from typing import Any

from tailgate.base.version import VERSION
from tailgate.cli.shared import Commands, own_classes, show, table, working


def add(commands: Commands) -> None:
    """Add `calibrate` to the commands."""
    command = commands.add_parser(
        "calibrate", help="find the threshold of a defence for a wanted mean time between false alarms",
        description="Play clean runs (no attack) and find the threshold at which the alarm goes on once in a wanted time. Alarms act on "
        "the filter while this is done; for a defence without a threshold it is one on its score, whose alarm acts on "
        "nothing. NAME: a registered defence, NAME:key=value,key=value, or module:Class.",
    )  # fmt: skip
    command.add_argument("--defence", action="append", metavar="NAME", required=True, help="a defence (repeatable)")
    command.add_argument("--hours", action="append", type=float, metavar="H", required=True, help="wanted mean time [h] (repeatable)")
    command.add_argument("--scenario", action="append", metavar="NAME",
                         help="a scenario of the clean mixture, equal shares (repeatable; default: the long ones at 0.1 s)")  # fmt: skip
    command.add_argument("--onsets", type=int, default=400, metavar="N", help="false alarms in a run (default 400: +-10 %%)")
    command.add_argument("--steps", type=int, default=20_000_000, metavar="N",
                         help="longest run (default 20 million steps): long mean times are then found on fewer alarms")  # fmt: skip
    command.add_argument("--batch", type=int, default=4096, metavar="N", help="episodes side by side (default 4096); changes no result")
    command.add_argument("--check", action="store_true", help="measure the mean time again on fresh seeds (purpose report)")
    command.add_argument("--json", action="store_true", help="print the record as JSON")
    command.set_defaults(run=_calibrate)


def _calibrate(options: argparse.Namespace) -> int:
    from tailgate.evaluation.calibrate import MIXTURE, calibrate

    own_classes()
    with working() as update:
        results = [
            calibrate(
                defence, hours, scenarios=options.scenario or MIXTURE, onsets=options.onsets, most_steps=options.steps,
                batch=options.batch, check=options.check, progress=update,
            ).as_data()
            for defence in options.defence for hours in options.hours
        ]  # fmt: skip
    show(options, {"command": _command(options), "version": VERSION, "results": results}, lambda _: _print_results(results))
    return 0


def _command(options: argparse.Namespace) -> str:
    """Return the command line of this record."""
    words = ["tailgate", "calibrate"]
    for name in ("defence", "scenario", "hours"):
        words += [word for value in getattr(options, name) or () for word in (f"--{name}", f"{value:g}" if name == "hours" else value)]
    words += ["--onsets", str(options.onsets), "--steps", str(options.steps), *(["--check"] if options.check else []), "--json"]
    return shlex.join(words)


def _print_results(results: list[dict[str, Any]]) -> None:
    caption = "mean times in hours; 95 % intervals (Poisson)" + _words(results)
    columns, rows = ("defence", "parameter", "threshold", "wanted", "measured", "interval", "alarms", "fresh runs"), []
    for result in results:
        measured, fresh = result["measured"], result["fresh"]
        note = "" if result["settled"] else " (rarer)" if result["rarer"] else " (not settled)"
        rows.append((
            result["defence"], result["field"] or "watched", f"{result['threshold']:g}{note}", f"{result['wanted_hours']:g}",
            _hours(measured["hours"]), _between(measured), str(measured["onsets"]),
            f"{_hours(fresh['hours'])} ({_between(fresh)})" if fresh else "-",
        ))  # fmt: skip
    table(columns, rows, f"Thresholds on {', '.join(results[0]['seeds'])}", caption)


def _words(results: list[dict[str, Any]]) -> str:
    watched, rarer = any(not result["field"] for result in results), any(result["rarer"] for result in results)
    said = "\nwatched: a threshold on the score of a defence that has none; nothing acts on its alarm" if watched else ""
    return said + ("\nrarer: its score jumps, and with every lower threshold it alarms more often than wanted" if rarer else "")


def _hours(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _between(count: dict[str, Any]) -> str:
    return f"{_hours(count['low'])} to {_hours(count['high'])}"
