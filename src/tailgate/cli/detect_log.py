"""tailgate detect-log: defences over recorded readings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, counted, own_classes, picture, say, show, table, tell, threat_of, working, written


def add(commands: Commands) -> None:
    """Add `detect-log` to the commands."""
    command = commands.add_parser(
        "detect-log", help="replay recorded readings of a real car under defences, with an attack on top if asked",
        description="Run detectors and estimators over recorded readings in the open loop: alarms an hour, errors against a smoother, "
        "and under an attack the delay of its detection. Reads OpenACC, ULTra-AV and any other CSV, comma2k19 folders, SUMO's FCD XML, "
        "VeReMi's JSON Lines, and the traces of the package.",
    )  # fmt: skip
    command.add_argument("file", metavar="FILE", help="file, folder, or trace of the package (tailgate list traces)")
    command.add_argument("--defence", action="append", required=True, metavar="NAME", help="a defence (repeatable)")
    command.add_argument("--attack", action="append", default=[], metavar="NAME", help="an attack laid on top, next to none (repeatable)")
    command.add_argument("--format", metavar="NAME",
                         help="openacc, ultra-av, comma2k19, sumo-fcd, veremi, csv or trace (default: by the content)")  # fmt: skip
    command.add_argument("--map", action="append", default=[], metavar="WHAT=COLUMN[:UNIT]",
                         help="column of any CSV: t, gap, speed, and relative_speed or lead_speed (repeatable). "
                         "UNIT: m, km, ft, s, ms, us, ns, m/s, km/h, mph, ft/s (default: s, m and m/s)")  # fmt: skip
    command.add_argument("--vehicle", metavar="NAME", help="which car, trajectory, track or id (default: all, or the longest)")
    command.add_argument("--lead", metavar="ID", help="id of the car ahead (SUMO, VeReMi)")
    command.add_argument("--length", type=float, default=5.0, metavar="M", help="length of the car ahead (SUMO, VeReMi; default 5)")
    command.add_argument("--hours", type=float, metavar="H",
                         help="take thresholds of one false alarm in H hours on a synthetic road (default: as given)")  # fmt: skip
    command.add_argument("--range-sd", type=float, default=0.15, metavar="M", help="noise of the range in the model (default 0.15)")
    command.add_argument("--speed-sd", type=float, default=0.1, metavar="M/S", help="noise of the range rate (default 0.1)")
    command.add_argument("--window", type=float, default=60.0, metavar="S", help="pieces in which an attack is played (default 60)")
    command.add_argument("--dose", type=float, default=4.0, metavar="S", help="seconds of attack in a piece (default 4)")
    command.add_argument("--threat", action="append", default=[], metavar="key=value", help="change the threat model (repeatable)")
    command.add_argument("--plot", metavar="FILE", help="draw the last replay: .png, .svg or .pdf (needs tailgate[viz])")
    command.add_argument("--parquet", metavar="FILE", help="write every step as Parquet (needs tailgate[log])")
    command.add_argument("--json", action="store_true", help="print the figures as JSON")
    command.set_defaults(run=_detect)


def _detect(options: argparse.Namespace) -> int:
    from tailgate.base.files import write_atomic
    from tailgate.roads.detect_log import Settings, detect, draw, write_parquet
    from tailgate.roads.readers import Choice, mapping_of, read
    from tailgate.roads.recording import HURRIED
    from tailgate.roads.replayed import Noise

    own_classes()
    if options.hours is not None and not 0.001 <= options.hours <= 1000.0:
        raise InputError("--hours", options.hours, "a number from 0.001 to 1000")
    if not 0.0 <= options.length <= 100.0:
        raise InputError("--length", options.length, "a number from 0 to 100 m")
    plot, parquet = picture("--plot", options.plot), written("--parquet", options.parquet)
    choice = Choice(options.vehicle, options.lead, options.length, mapping_of(options.map))
    for option, path in (("--parquet", parquet), ("--plot", plot)):
        if path is not None and path.exists() and Path(options.file).exists() and path.samefile(options.file):
            raise InputError(option, str(path), "another file than the recording")
    if parquet is not None and parquet.suffix != ".parquet":
        raise InputError("--parquet", str(parquet), "a file name that ends in .parquet")
    recordings = read(options.file, options.format, choice)
    if bare := [f"{what}={column}" for what, column, unit in choice.mapping if not unit and what != "t"]:
        tell(f"no unit is named in {', '.join(bare)}: m or m/s is taken. A unit follows a colon, as in gap=dist:ft")
    for found in recordings:
        if (speed := found.typical_speed) > HURRIED:
            tell(f"{found.name}: a typical own speed of {speed:.0f} m/s is {3.6 * speed:.0f} km/h; is the unit m/s?")
    noise = Noise(options.range_sd, options.speed_sd)
    settings = Settings(noise, options.window, options.dose, tuple(threat_of(options).items()), options.hours)
    with working() as update:
        rows, replays = detect(recordings, options.defence, options.attack, settings, counted(update, "replaying", "replays"))
    if parquet is not None and replays:
        write_parquet(parquet, replays)
    if plot is not None and replays:
        write_atomic(plot, draw(replays[-1], plot.suffix.lower()[1:]), "plot")
    show(options, rows, _tables)
    return 0


def _text(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _tables(rows: list[dict[str, Any]]) -> None:
    good = [row for row in rows if row["status"] == "ok"]
    heads = ("recording", "defence", "attack", "hours", "false alarms an hour", "95 % interval", "alarm on", "gap error [m]",
             "speed error [m/s]", "detected", "delay [s]")  # fmt: skip
    lines = []
    for row in good:
        interval = f"{_text(row['alarms_per_hour_low'])} to {_text(row['alarms_per_hour_high'])}"
        alarms = (_text(row["alarms_per_hour"]), interval) if row["attack"] == "none" else ("", "")  # under attack they are not false
        detected = f"{row['detected']} of {row['attacked']}" if "detected" in row else ""
        detected += f", {early} on before" if (early := row.get("alarmed_before")) else ""
        lines.append((
            row["recording"], row["defence"], row["attack"], _text(row["hours"], 3), *alarms,
            f"{100 * row['alarm_share']:.1f} %", _text(row["gap_error"], 3), _text(row["speed_error"], 3), detected,
            _text(row["delay"]) if "delay" in row else "",
        ))  # fmt: skip
    table(heads, lines, "replayed in the open loop; alarms within 5 s count once; errors against a smoother", numbers=(3, 4, 6, 7, 8, 10))
    for row in good:
        for what, count in row["repairs"].items() if row["attack"] == "none" else ():
            say(f"{row['recording']}: {count} {what}")
    silent = {row["recording"]: row["missing_share"] for row in good if row["attack"] == "none" and row["missing_share"] >= 0.01}
    for name, share in silent.items():
        say(f"{name}: {100 * share:.0f} % of the steps have no reading; they count neither as time nor in the errors")
    for row in rows:
        if row["status"] == "skipped":
            say(f"{row['recording']}: {row['defence']} against {row['attack']} is left out: {row['reason']}")
