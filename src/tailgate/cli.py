"""The command line: tailgate train | evaluate | leaderboard | list.

Results go to standard output (tables for people, --json for machines), progress and errors to standard error.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import tailgate
from tailgate.errors import InputError
from tailgate.progress import progress
from tailgate.schema import scalar

EXIT_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 done, 1 a component failed, 2 bad input, 130 interrupted."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    try:
        return int(chosen.run(chosen))
    except InputError as error:
        print(f"tailgate: error: {error}", file=sys.stderr)
        return EXIT_INPUT
    except ImportError as error:
        if "tailgate[" not in str(error):
            raise
        print(f"tailgate: error: {error}", file=sys.stderr)
        return EXIT_INPUT
    except KeyboardInterrupt:
        print("tailgate: interrupted; what was finished is kept", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone
        sys.stderr.close()
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="tailgate", description=(tailgate.__doc__ or "").split("\n")[0])
    parser.add_argument("--version", action="version", version=f"tailgate {tailgate.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _train_parser(commands)
    _evaluate_parser(commands)
    _leaderboard_parser(commands)
    _list_parser(commands)
    return parser


# -- train


def _train_parser(commands: Any) -> None:
    from tailgate.train import parameters

    fields = "\n".join(f"  {p['name']:<18} {p['doc']} (default: {json.dumps(p['default'])})" for p in parameters())
    command = commands.add_parser(
        "train", help="train an adversary, compare it with scripted attacks on fresh seeds, write a page",
        description="Train an adversary. Without --config, the preset `quickstart`.",
        epilog=f"keys (dotted below environment, threat and ppo, for example ppo.epochs=4):\n{fields}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    command.add_argument("--config", metavar="FILE", help="preset by name, or YAML file")
    command.add_argument("--seed", type=int, help="first training seed (the same as first_seed=N)")
    command.add_argument("--resume", action="store_true", help="continue from the run's checkpoints")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.add_argument("overrides", nargs="*", metavar="key=value", help="change a field of the configuration")
    command.set_defaults(run=_train)


def _train(options: argparse.Namespace) -> int:
    from tailgate import train

    overrides = list(options.overrides) + ([f"first_seed={options.seed}"] if options.seed is not None else [])
    config = train.load_config(options.config, overrides)
    console = Console(stderr=True)
    console.print(f"[bold]{config.name}[/]: training against [bold]{config.defence}[/] on {config.scenario}, files in {config.directory}")
    with progress(console) as update:

        def trained(seed: int, now: Any) -> None:
            update(f"training, seed {seed}", now.steps, config.steps, train.figures(now))

        policies = train.train(config, trained, resume=options.resume)
        report = train.compare(config, policies, lambda done, total: update("comparing on fresh seeds", done, total, _cells(done, total)))
    page = train.make_page(config, report)
    if options.json:
        print(json.dumps(report | {"page": str(page)}, indent=1))
    else:
        _print_report(report)
    console.print(f"policy: {', '.join(str(p) for p in policies)}\npage:   {page}")
    return 0


def _print_report(report: dict[str, Any]) -> None:
    threat = report["threat"]
    table = Table(title=f"{report['episodes']} fresh episodes, {report['defence']}, {report['scenario']}, budget {threat['budget']} steps")
    for heading in ("attack", "collisions", "95 % interval", "note"):
        table.add_column(heading, overflow="fold")
    for row in report["crash"]:
        table.add_row(row["label"], f"{100 * row['value']:.1f} %", f"{100 * row['low']:.1f} to {100 * row['high']:.1f} %", row["note"])
    console = _console()
    console.print(table)
    for name, gain in report["advantage"].items():
        low, high = 100 * gain["low"], 100 * gain["high"]
        verdict = "wins" if low > 0 else "loses" if high < 0 else "undecided"
        console.print(f"learned against {name}: {100 * gain['value']:+.1f} points, 95 % interval {low:+.1f} to {high:+.1f} ({verdict})")


# -- evaluate


def _evaluate_parser(commands: Any) -> None:
    command = commands.add_parser(
        "evaluate", help="play defences against attacks and write one row per episode",
        description="Play a suite, or the part of it that the options name. NAME: a registered component, NAME:key=value,key=value, "
        "module:Class, or (attacks) the JSON file of an exported policy.",
    )  # fmt: skip
    command.add_argument("--suite", default="quick-v0", metavar="NAME", help="suite by name or YAML file (default: quick-v0)")
    command.add_argument("--defence", action="append", metavar="NAME", help="a defence instead of the suite's (repeatable)")
    command.add_argument("--attack", action="append", metavar="NAME", help="an attack instead of the suite's (repeatable)")
    command.add_argument("--scenario", action="append", metavar="NAME", help="a scenario instead of the suite's (repeatable)")
    command.add_argument("--dose", action="append", metavar="STEPS", help="attack budget instead of the suite's, or none (repeatable)")
    command.add_argument("--threat", action="append", metavar="key=value", default=[], help="change the threat model (repeatable)")
    command.add_argument("--seeds", type=int, metavar="N", help="episodes per cell instead of the suite's")
    command.add_argument("--purpose", default="report", help="which seeds: train, tune, calibrate, select or report (default)")
    command.add_argument("--batch", type=int, default=256, metavar="N", help="episodes side by side (default 256); changes no result")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1); changes no result")
    command.add_argument("--engine", default="local", choices=["local"], help="where workers run")
    command.add_argument("--out", metavar="FILE", help="write the rows to this JSON Lines file; an interrupted run resumes")
    command.add_argument("--json", action="store_true", help="print the table as JSON")
    command.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    from tailgate.evaluation import evaluate
    from tailgate.summary import summarise

    sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `python -m` does
    threat = {}
    for text in options.threat:
        key, sep, value = text.partition("=")
        if not sep:
            raise InputError("--threat", text, "key=value, for example fdi_bound=10")
        threat[key] = scalar(value)
    doses = None if options.dose is None else [scalar(d) for d in options.dose]
    with progress(Console(stderr=True)) as update:
        rows = evaluate(
            options.suite, defences=options.defence, attacks=options.attack, scenarios=options.scenario, doses=doses,
            seeds=options.seeds, purpose=options.purpose, batch=options.batch, workers=options.workers,
            out=options.out, threat=threat, progress=lambda done, total: update("playing", done, total, _cells(done, total)),
        )  # fmt: skip
    table = summarise(rows)
    if options.json:
        print(json.dumps(table, indent=1, allow_nan=False))
    else:
        _print_summary(table)
    failed = sum(entry["failed"] for entry in table)
    if failed:
        print(f"tailgate: {failed} of {len(rows)} rows failed; their reasons are in the rows", file=sys.stderr)
    return 1 if failed else 0


def _print_summary(table: list[dict[str, Any]]) -> None:
    console = _console()
    for place in dict.fromkeys((e["scenario"], e["dose"]) for e in table):
        scenario, dose = place
        shown = Table(title=f"{scenario}, budget {'unlimited' if dose is None else f'{dose} steps'}")
        measures = ("n", "collisions", "95 % interval", "min gap [m]", "max error [m]", "alarm onsets")
        for heading in ("defence", "attack", "knowledge", *measures):
            shown.add_column(heading, overflow="fold")
        for entry in table:
            if (entry["scenario"], entry["dose"]) != place:
                continue
            head = [entry["defence"], entry["attack"], entry["knowledge"], str(entry["n"])]
            crash = entry["crash"]
            if crash is None:
                shown.add_row(*head, "-", entry["reason"])
                continue
            figures = [f"{100 * crash['value']:.1f} %", f"{100 * crash['low']:.1f} to {100 * crash['high']:.1f} %"]
            figures += [f"{entry[k]['median']:.2f}" if entry[k] else "-" for k in ("min_gap", "max_error", "alarm_onsets")]
            shown.add_row(*head, *figures)
        console.print(shown)


# -- leaderboard


def _leaderboard_parser(commands: Any) -> None:
    command = commands.add_parser("leaderboard", help="build the static page from rows")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    build = actions.add_parser("build", help="one self-contained HTML page from rows files")
    build.add_argument("--rows", nargs="+", required=True, metavar="FILE", help="JSON Lines files of `tailgate evaluate`")
    build.add_argument("--out", required=True, metavar="DIR", help="directory of the page")
    build.add_argument("--title", help="title of the page")
    build.set_defaults(run=_build)


def _build(options: argparse.Namespace) -> int:
    from tailgate.leaderboard.build import build
    from tailgate.rows import read_rows

    rows = [row for name in options.rows for row in read_rows(Path(name))]
    print(build(rows, Path(options.out), title=options.title))
    return 0


# -- list


def _list_parser(commands: Any) -> None:
    command = commands.add_parser("list", help="what there is: defences, attacks, scenarios, suites")
    command.add_argument("what", nargs="?", choices=["defences", "attacks", "scenarios", "suites"], help="only these")
    command.add_argument("--json", action="store_true", help="print cards with every parameter as JSON")
    command.set_defaults(run=_list)


def _list(options: argparse.Namespace) -> int:
    from tailgate.registry import entries
    from tailgate.scenario import list_scenarios, list_suites, load_scenario, load_suite

    cards: dict[str, list[dict[str, Any]]] = {
        "defences": [entry.card() for entry in entries("defence").values()],
        "attacks": [entry.card() for entry in entries("attack").values()],
        "scenarios": [{"name": name, "summary": load_scenario(name).about} for name in list_scenarios()],
        "suites": [{"name": name, "summary": load_suite(name).about} for name in list_suites()],
    }
    chosen = {key: value for key, value in cards.items() if options.what in (None, key)}
    if options.json:
        print(json.dumps(chosen, indent=1))
        return 0
    console = _console()
    for title, group in chosen.items():
        table = Table("name", "what it is", "parameters (default)", title=title)
        for card in group:
            fields = ", ".join(f"{k} ({json.dumps(p['default'])})" for k, p in card.get("parameters", {}).items())
            table.add_row(card["name"], card["summary"], fields)
        console.print(table)
    return 0


def _cells(done: int, total: int) -> str:
    return f"{done} of {total} cells"


def _console() -> Console:
    """Standard output: as wide as the terminal, and wide enough for whole cells where there is none."""
    return Console(width=None if sys.stdout.isatty() else 160)


if __name__ == "__main__":
    raise SystemExit(main())
