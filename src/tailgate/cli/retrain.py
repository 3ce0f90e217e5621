"""tailgate leaderboard retrain: policies trained again."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tailgate.cli.shared import Commands, add_options, show, table, working

if TYPE_CHECKING:
    from tailgate.agents.learners.learning import Progress
    from tailgate.training.train import TrainConfig


def add(actions: Commands) -> None:
    """Add `retrain` to the actions of a command."""
    command = actions.add_parser(
        "retrain", help="train policies again and compare their weights",
        description="Train policies again, as their files say that they were trained, and compare the weights bit by bit. Exit code 1 when "
        "one differs, or when none could be checked. A file never makes this command import code.",
    )  # fmt: skip
    command.add_argument("policies", nargs="+", metavar="POLICY", help="JSON files of policies, or zoo:name=NAME")
    add_options(command, "--json")
    command.set_defaults(run=_retrain)


def _retrain(options: argparse.Namespace) -> int:
    from tailgate.studies.retrain import retrain
    from tailgate.training.train import figures

    found = []
    with working() as update:
        for text in options.policies:

            def told(config: TrainConfig, now: Progress, label: str = text) -> None:
                update(label, min(now.steps, config.steps), config.steps, figures(now))

            found.append(retrain(text, told))
    rows = [(again.policy, again.verdict, f"{again.steps:,}" if again.steps else "", again.why) for again in found]
    title = f"{sum(again.verdict == 'same' for again in found)} of {len(found)} policies have the same weights"
    report = {"format": "tailgate-retrain-1", "policies": [again._asdict() for again in found]}
    show(options, report, lambda _: table(("policy", "verdict", "decisions", "why"), rows, title))
    verdicts = {again.verdict for again in found}
    return 1 if "differs" in verdicts or "same" not in verdicts else 0
