"""tailgate leaderboard submit: the rows of a suite for a defence that somebody else wrote."""

from __future__ import annotations

import argparse
import dataclasses

from tailgate.cli.shared import Commands, add_options, counted, own_classes, show, tell, values, working
from tailgate.core.schema import build


def add(actions: Commands) -> None:
    """Add `submit` to the actions of a command."""
    command = actions.add_parser(
        "submit", help="play a stranger's defence in separate processes and write one row per episode",
        description="Play one class on a suite: in a separate process, under limits, its rows mixed in secret with those of other "
        "attacks. This guards against accidents and greed; for code that you do not trust give --sandbox (see SECURITY.md).",
    )  # fmt: skip
    command.add_argument("defence", metavar="module:Class", help="class to play, module:Class:key=value, or the name of an entry point")
    command.add_argument("--suite", metavar="NAME", help="suite by name or YAML file (default: quick-v0)")
    command.add_argument("--out", metavar="FILE", help="write rows here (JSON Lines); an interrupted run resumes after a finished scenario")
    add_options(command, "--scenario")
    command.add_argument("--episodes", type=int, metavar="N", help="episodes per cell instead of the suite's")
    command.add_argument("--sandbox", metavar="PROGRAM", help="bwrap, docker or docker:IMAGE: what a row needs to count as verified")
    command.add_argument("--beacon", default="", metavar="TEXT", help="random text of after the submission, of which the seeds are made")
    add_options(command, "--purpose")
    command.add_argument("--limit", action="append", metavar="key=value", default=[], help="change a limit, such as memory or step_time")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="scenarios side by side (default 1); changes no result")
    command.add_argument("--digest", action="store_true", help="print the submission's digest, which fixes it, and play nothing")
    command.add_argument("--json", action="store_true", help="print the summary as JSON")
    command.set_defaults(run=_submit)


def _submit(options: argparse.Namespace) -> int:
    from tailgate.cli.evaluate import _print_summary
    from tailgate.evaluation.summary import summarise
    from tailgate.sandbox import Limits, play_submission
    from tailgate.sandbox.source import staged

    own_classes()
    if options.digest:
        with staged(options.defence) as source:
            print(source.digest or f"{source.text} is built in: its version identifies it")
        return 0
    changes = values("--limit", options.limit, ", for example memory=1e9")
    limits = build(Limits, dataclasses.asdict(Limits()) | changes, "limit")
    if not options.beacon:
        tell("without --beacon the seeds are public ones: for development, not for a board")
    goes_on = "the same command goes on after the scenarios that are finished"
    options.kept = goes_on if options.out else "nothing is kept: --out FILE would"
    with working() as update:
        rows = play_submission(
            options.defence, options.suite or "quick-v0", limits=limits, sandbox=options.sandbox, beacon=options.beacon,
            workers=options.workers, out=options.out, scenarios=options.scenario, episodes=options.episodes, purpose=options.purpose,
            progress=counted(update, "playing", "scenarios"),
        )  # fmt: skip
    table = summarise(rows)
    failed = [row for row in rows if row["status"] == "error"]
    reasons = list(dict.fromkeys(row["reason"] for row in failed))
    first = rows[0]
    head = {key: first[key] for key in ("defence", "uses", "beacon")} | {"digest": first["defence_digest"], **first["submission"]}
    report = head | {"rows": len(rows), "failed": len(failed), "reasons": reasons, "table": table}
    show(options, report, lambda _: _print_summary(table))
    for reason in reasons:
        tell(f"{sum(row['reason'] == reason for row in failed)} of {len(rows)} rows failed: {reason}")
    return 1 if failed else 0
