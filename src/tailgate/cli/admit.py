"""tailgate leaderboard admit: the list of attacks of a suite, which only grows."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tailgate.cli.shared import Commands, add_options, counted, own_classes, print_json, say, show, table, tell, working


def add(actions: Commands) -> None:
    """Add `admit` to the actions of a command."""
    command = actions.add_parser(
        "admit", help="put an attack on a suite's list if it beats the worst that is there",
        description="Play an attack on select seeds against the worst of its knowledge, and append it to OUT/SUITE/attacks.jsonl if a "
        "paired test says that it does more damage to at least one defence; a try that fails is a line too. Nothing is ever removed from "
        "the list; --erratum takes an attack back. Exit code 1 when it is refused.",
    )  # fmt: skip
    command.add_argument("attack", metavar="ATTACK", help="attack, as on any command line")
    command.add_argument("--suite", required=True, metavar="NAME", help="suite by name or YAML file")
    add_options(command, "--out")
    command.add_argument("--defence", action="append", metavar="NAME", help="only these defences (repeatable; default: the suite's)")
    command.add_argument("--dose", type=int, metavar="N", help="one of the suite's doses (default: its middle one)")
    command.add_argument("--beacon", default="", metavar="TEXT", help="random text of after the attack was handed in: its seeds are played")
    command.add_argument("--date", metavar="YYYY-MM-DD", help="date of the line (default: today)")
    command.add_argument("--erratum", metavar="REASON", help="take the attack back, for this reason")
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2); change no result")
    command.add_argument("--json", action="store_true", help="print the tests as JSON")
    command.set_defaults(run=_admit)


def _admit(options: argparse.Namespace) -> int:
    from tailgate.board.admission import admit, withdraw
    from tailgate.board.run import LIST
    from tailgate.core.scenario import load_suite

    own_classes()
    suite = load_suite(options.suite)
    path = Path(options.out) / suite.name / LIST
    date = options.date or datetime.now(UTC).date().isoformat()
    if options.erratum is not None:
        line = withdraw(options.attack, path, date, options.erratum)
        show(options, line.as_data(), lambda _: print(f"{path}: {options.attack} is taken back"))
        return 0
    if not options.beacon:
        tell("without --beacon the select seeds are public ones, on which the attack may have been tuned")
    with working() as update:
        admitted, tests = admit(
            options.attack, suite, options.defence or suite.defences, path, date, dose=options.dose, beacon=options.beacon,
            workers=options.workers, progress=counted(update, "playing"),
        )  # fmt: skip
    if options.json:
        print_json({"admitted": admitted is not None, "evidence": tests})
    else:
        _print(options.attack, admitted is not None, tests)
        print(path)
    return 0 if admitted is not None else 1


def _print(attack: str, admitted: bool, tests: list[dict[str, Any]]) -> None:
    """Print a line for each defence and scenario where the attack did more than the worst in some episode, the most telling first."""
    telling, rows = [test for test in tests if test["only_new"] > 0], []
    for test in sorted(telling, key=lambda test: (test["only_new"] <= test["only_worst"], test["adjusted"])):
        does_more = test["only_new"] > test["only_worst"]
        counts = (str(test[key]) for key in ("only_new", "only_worst", "episodes"))
        p = f"{test['adjusted']:.2g}" if does_more else "-"  # two-sided: of one that does less it says nothing
        sure = "yes" if does_more and test["adjusted"] <= test["level"] else ""
        rows.append((test["defence"], test["scenario"], test["worst"]["attack"] if test["worst"] else "-", *counts, p, sure))
    if telling:
        columns = ("defence", "scenario", "worst so far", "this alone", "that alone", "of", "p (Holm)", "more")
        title = f"{attack} against the worst on the list, at dose {tests[0]['dose']}: episodes that only one of them damages"
        table(columns, rows, title)
    if silent := len(tests) - len(telling):
        pairs = f"in {silent} of {len(tests)} pairs of a defence and a scenario"
        say(f"{attack} damages no episode that the worst does not {pairs} (--json has them)")
    verdict = "admitted: it does surely more to at least one defence" if admitted else "refused: it does surely more to no defence"
    say(f"{verdict} (level {tests[0]['level']:.2g})")
