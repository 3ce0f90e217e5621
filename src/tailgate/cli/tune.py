"""tailgate tune: a search for a learner's hyper-parameters."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tailgate.base import sizes
from tailgate.base.progress import progress
from tailgate.cli.shared import Commands, add_options, show, table, tell

if TYPE_CHECKING:
    from tailgate.agents.learners.learning import Progress


def add(commands: Commands) -> None:
    """Add `tune` to the commands."""
    command = commands.add_parser(
        "tune", help="search a learner's hyper-parameters (needs tailgate[tune])",
        description="Train one policy per trial and keep the values whose policy does most damage on `tune` seeds. The same command goes "
        "on where an interrupted one stopped, and more --trials add to it. best.yaml is a configuration for `tailgate train`.",
    )  # fmt: skip
    command.add_argument("--config", metavar="FILE", help="preset by name, or YAML file (default: quickstart)")
    command.add_argument("--trials", type=int, required=True, metavar="N", help="trials in all")
    command.add_argument("--space", default="default", metavar="FILE", help="YAML file of the search space (default: the learner's own)")
    command.add_argument("--learner", metavar="NAME", help="learner instead of the preset's")
    command.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes that a trial is measured on (default 400)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the search itself (default 0)")
    command.add_argument("--workers", type=int, default=1, metavar="N", help="trials at a time (default 1); more change what is proposed")
    add_options(command, "--engine", "--address")
    add_options(command, "--json")
    command.add_argument("overrides", nargs="*", metavar="key=value", help="change a field of the configuration, as for `tailgate train`")
    command.set_defaults(run=_tune, kept="the same command goes on")


def _tune(options: argparse.Namespace) -> int:
    from tailgate.training import train, tuning

    search = tuning.make_search(
        options.config, options.overrides, options.trials, options.space, options.learner, options.episodes, options.seed
    )
    sizes.check("workers", options.workers)
    errors = Console(stderr=True)
    errors.print(f"[bold]{search.base.name}[/]: {search.trials} trials of {search.base.steps:,} decisions, files in {search.directory}")
    with progress(errors) as update:

        def trained(ordinal: int, now: Progress | None) -> None:
            if now is None:
                update(f"trial {ordinal}", 1, 1, "")
            else:
                update(f"trial {ordinal}", min(now.steps, search.base.steps), search.base.steps, train.figures(now))

        report = tuning.tune(search, options.workers, trained)
    show(options, report, _print)
    if report["best"] is None:
        tell("no trial succeeded; their reasons are above")
        return 1
    errors.print(f"train with it: tailgate train --config {report['config']}")
    return 0


def _print(report: dict[str, Any]) -> None:
    rows = []
    for entry in report["trials"]:
        values = ", ".join(f"{key.rpartition('.')[2]} {_short(value)}" for key, value in entry["parameters"].items())
        best = report["best"] is not None and entry["ordinal"] == report["best"]["ordinal"]
        outcome = "-" if entry["value"] is None else f"{entry['value']:.4g}"
        rows.append((str(entry["ordinal"]), outcome, values, "best" if best else entry["reason"]))
    title = f"{report['learner']} against {report['defence']} on {report['scenario']}, {report['outcome']} on tune seeds"
    table(("trial", "outcome", "values", "note"), rows, title)


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else json.dumps(value)
