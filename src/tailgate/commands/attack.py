"""tailgate leaderboard attack: train a suite's attackers against a defence, and play them on it."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from tailgate.errors import InputError
from tailgate.progress import cells, progress


def add(actions: Any) -> None:
    command = actions.add_parser(
        "attack", help="train a suite's attackers against a defence, and play them on it",
        description="Train the learners that the suite names against the defence itself, black and grey box, and play their policies at "
        "every dose and scenario. A defence without these rows takes no rank. Interrupted, the same command goes on.",
    )  # fmt: skip
    command.add_argument("defence", metavar="NAME", help="registered defence, or a class in a sandbox: bwrap/module:Class")
    command.add_argument("--suite", required=True, metavar="NAME", help="suite that says what is trained")
    command.add_argument("--out", required=True, metavar="DIR", help="policies go to DIR/policies, rows to DIR/NAME*.jsonl")
    command.add_argument("--seeds", type=int, metavar="N", help="training seeds instead of the suite's")
    command.add_argument("--episodes", type=int, metavar="N", help="report episodes per cell instead of the suite's")
    command.add_argument("--beacon", default="", metavar="TEXT", help="the round of the board: its seeds are played")
    command.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2); change no result")
    command.add_argument("--set", action="append", default=[], metavar="key=value", help="change the training (repeatable): steps=10000")
    command.set_defaults(run=_attack)


def _attack(options: argparse.Namespace) -> int:
    from tailgate.adaptive import configs_of, fitting, policies_of, stem, train_against
    from tailgate.evaluation import evaluate
    from tailgate.registry import Spec
    from tailgate.scenario import load_suite
    from tailgate.submission import play_submission

    sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `leaderboard submit` does

    if options.episodes is not None and options.episodes < 1:  # before anything is trained
        raise InputError("episodes", options.episodes, "a whole number not below 1")
    suite, out = load_suite(options.suite), Path(options.out)
    extra = (*options.set, f"workers={options.workers}")
    configs = configs_of(suite, options.defence, out / "policies", seeds=options.seeds, extra=extra)
    with progress(Console(stderr=True)) as update:
        policies = train_against(configs, update)
        groups: dict[tuple[str, ...], list[str]] = {}  # a policy plays where the attacker sees and may do what it learned with
        for config in configs:
            groups.setdefault(fitting(suite, config), []).extend(map(str, policies_of(config)))
        count = 0
        for scenarios, attacks in groups.items():
            file = out / f"{stem(options.defence)}{f'-{scenarios[0]}' if len(groups) > 1 else ''}.jsonl"
            part = dataclasses.replace(suite, scenarios=scenarios, attacks=tuple(attacks))

            def told(done: int, total: int) -> None:
                update("playing", done, total, cells(done, total))

            if apart := Spec("defence", options.defence).sandboxed:
                rows = play_submission(
                    apart[1], part, sandbox=apart[0], beacon=options.beacon, episodes=options.episodes, workers=options.workers, out=file,
                    progress=told,
                )  # fmt: skip
            else:
                rows = evaluate(
                    part, defences=[options.defence], seeds=options.episodes, workers=options.workers, out=file, beacon=options.beacon,
                    progress=told,
                )  # fmt: skip
            print(file)
            count += len(rows)
    print(f"{len(policies)} policies, {count} rows", file=sys.stderr)
    return 0
