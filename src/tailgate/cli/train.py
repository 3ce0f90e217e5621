"""tailgate train: an adversary from a preset."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tailgate.base.errors import InputError
from tailgate.base.locks import alone
from tailgate.base.progress import cells, progress
from tailgate.cli.keys import listed
from tailgate.cli.shared import Commands, add_options, own_classes, played_by, print_json, say, table, tell, telling_aside

if TYPE_CHECKING:
    from tailgate.agents.learners.learning import Progress
    from tailgate.training.train import TrainConfig


def add(commands: Commands) -> None:
    """Add `train` to the commands."""
    command = commands.add_parser(
        "train", help="train an adversary, compare it with scripted attacks on fresh seeds, write a page",
        description="Train an adversary. Without --config, the preset `quickstart`: its values are the defaults below.",
        keys=_keys,
    )  # fmt: skip
    command.add_argument("--config", metavar="FILE", help="preset by name, or YAML file")
    command.add_argument("--seed", type=int, help="first training seed (the same as first_seed=N)")
    command.add_argument("--resume", action="store_true", help="continue, with the run's own configuration; steps may change")
    add_options(command, "--json", "overrides")
    command.set_defaults(run=_train, kept="what was finished is kept")


def _keys() -> str:
    from tailgate.training.keys import train_keys

    return listed(train_keys())


def _train(options: argparse.Namespace) -> int:
    from tailgate.agents.learners.learning import LEARNERS
    from tailgate.training import comparison, train

    own_classes()
    overrides = list(options.overrides) + ([f"first_seed={options.seed}"] if options.seed is not None else [])
    config = train.load_config(options.config, overrides, options.resume)
    train.check(config)  # before a word of what is done
    for name in {text.partition(".")[0] for text in overrides} & (set(LEARNERS) - {config.learner}):
        tell(f"{name}: its settings are not used, the learner is {config.learner} (learner={name})")
    train.long(config)
    if options.resume:
        train.same_run(config)
    errors = Console(stderr=True)
    said = f"{config.name}: training against {config.defence} on {config.scenario}, files in {config.directory}"
    errors.print(said, markup=False, highlight=False, soft_wrap=True)
    place = f" {shlex.quote(f'out={config.out}')}" if config.out != type(config)().out else ""
    options.kept = f"what was finished is kept, go on with: tailgate train --resume {shlex.quote(f'name={config.name}')}{place}"
    with telling_aside(config.directory, "an earlier run"), alone(config.directory), progress(errors) as update:

        decisions: dict[int, int] = {}

        def trained(seed: int, now: Progress) -> None:
            decisions[seed] = now.steps
            update(f"training, seed {seed}", min(now.steps, config.steps), config.steps, train.figures(now))

        policies = train.train(config, trained, resume=options.resume)

        if (most := max(decisions.values(), default=0)) > config.steps:
            errors.print(f"{most:,} decisions a seed ({config.steps:,} asked for): learners play whole rounds", highlight=False)

        def played(done: int, total: int) -> None:
            update("comparing on fresh seeds", done, total, cells(done, total))

        report = comparison.finished(config, policies) if options.resume else None
        if report is not None:
            errors.print("the comparison of these policies is there", highlight=False)
        else:
            report = comparison.compare(config, policies, played)
        page = _page(config, report)
    if options.json:
        print_json(report | {"page": str(page)})
    else:
        _print_report(report)
    if report["advantage"]["no attack"]["value"] <= 0.0:
        tell(_harmless(config, max(report["decisions"])))
    errors.print(f"policy: {', '.join(str(p) for p in policies)}\npage:   {page}")
    again = played_by(config.scenario, config.defence, str(policies[0]), config.threat)
    errors.print(f"play:   {again}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _harmless(config: TrainConfig, decisions: int) -> str:
    """Return what may be tried where no policy did any damage."""
    from tailgate.training import train

    who = "this policy" if config.seeds == 1 else "these policies"
    text = f"{who} did no damage: try more steps than {decisions:,}"
    try:
        train.check(dataclasses.replace(config, teacher="best"))
    except InputError:
        return text
    return text if config.teacher else f"{text}, or teacher=best"


def _print_report(report: dict[str, Any]) -> None:
    from tailgate.training.comparison import SHARE, shown

    threat = report["threat"]
    budget = "unlimited budget" if threat["budget"] is None else f"budget {threat['budget']} steps"
    what = {"crashed": "collisions"}.get(report["outcome"], f"mean {report['outcome']}")
    rows = []
    for row in report["attacks"]:
        value, low, high = (shown(report, row[key]) for key in ("value", "low", "high"))
        rows.append((row["label"], value, f"{low} to {high}", row["note"]))
    title = f"{report['episodes']} fresh episodes, {report['defence']}, {report['scenario']}, {budget}"
    table(("attack", what, "95 % interval", "note"), rows, title)
    for name, why in report["left_out"].items():
        say(f"left out: {name} ({why})")
    for name, gain in report["advantage"].items():
        verdict = "wins" if gain["low"] > 0 else "loses" if gain["high"] < 0 else "undecided"
        scale, points = (100.0, " points") if report["unit"] == SHARE else (1.0, "")
        value, low, high = (f"{scale * gain[key]:+.{1 if points else 3}f}" for key in ("value", "low", "high"))
        say(f"learned against {name}: {value}{points}, 95 % interval {low} to {high} ({verdict})")


def _page(config: TrainConfig, report: dict[str, Any]) -> Path:
    """Write the page of a finished run."""
    from tailgate.evaluation.rows import read_rows
    from tailgate.site.rows_page import build as build_page
    from tailgate.training.comparison import ROWS, headline
    from tailgate.training.train import training_seeds
    from tailgate.training.trainings import curve_of

    curve = [
        point for seed in training_seeds(config)
        for point in curve_of(config.directory / f"curve-{seed}.json")["curve"]
    ]  # fmt: skip
    rows, folder = read_rows(config.directory / ROWS), config.directory / "page"
    title = f"{config.name}: {config.defence} under attack"
    drawn = curve if all(point["crash"] is not None for point in curve) else None
    return build_page(rows, folder, title=title, curve=drawn, headline=headline(report), learned=_learned(config, report, rows))


def _learned(config: TrainConfig, report: dict[str, Any], rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return what the page shows of the first policy, and write a replay of its worst episode."""
    from tailgate.replay.page import write_page
    from tailgate.replay.replay import Filter, choose, play
    from tailgate.site.learned import learned

    policy = report["policies"][0]
    own = [row for row in rows if row["attack"] == policy and row["defence"] == config.defence]
    found = learned(Path(policy), config.scenario, config.defence, dict(config.threat), own, config.directory)
    if found is None:
        return None
    if found["without"]:
        Console(stderr=True).print(f"no rules are made of the policy: {found['without']}", markup=False, highlight=False, soft_wrap=True)
    wanted = Filter(defence=config.defence, attack=policy, scenario=config.scenario)
    page = write_page(play(choose(own, wanted).row, wanted), config.directory / "page" / "replay.html", policy)
    return found | {"replay": page.name}
