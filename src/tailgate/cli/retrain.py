"""tailgate leaderboard retrain: policies trained again."""

from __future__ import annotations

import argparse
import json
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.progress import console, progress


def add(actions: Any) -> None:
    """Adds `retrain` to the actions of a command."""
    command = actions.add_parser(
        "retrain", help="train policies again and compare their weights",
        description="Train policies again, as their files say that they were trained, and compare the weights bit by bit. Exit code 1 when "
        "one differs, or when none could be checked. A file never makes this command import code.",
    )  # fmt: skip
    command.add_argument("policies", nargs="+", metavar="POLICY", help="JSON files of policies, or zoo:name=NAME")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=_retrain)


def _retrain(options: argparse.Namespace) -> int:
    from tailgate.studies.retrain import retrain
    from tailgate.training.train import figures

    found = []
    with progress(Console(stderr=True)) as update:
        for text in options.policies:

            def told(config: Any, now: Any, label: str = text) -> None:
                update(label, min(now.steps, config.steps), config.steps, figures(now))

            found.append(retrain(text, told))
    if options.json:
        print(json.dumps({"format": "tailgate-retrain-1", "policies": [again._asdict() for again in found]}, indent=1))
    else:
        table = Table(title=f"{sum(again.verdict == 'same' for again in found)} of {len(found)} policies have the same weights")
        for heading in ("policy", "verdict", "decisions", "why"):
            table.add_column(heading, overflow="fold")
        for again in found:
            table.add_row(escape(again.policy), again.verdict, f"{again.steps:,}" if again.steps else "", escape(again.why))
        console().print(table)
    verdicts = {again.verdict for again in found}
    return 1 if "differs" in verdicts or "same" not in verdicts else 0
