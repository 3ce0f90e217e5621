"""Attackers of a suite's plan made against a defence, and played on it: what a board asks for before it ranks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tailgate.base.errors import InputError
from tailgate.base.progress import cells
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, name_of
from tailgate.evaluation.cells import evaluate
from tailgate.sandbox import play_submission
from tailgate.training.adaptive import configs_of, fitting, plan_of, policies_of, stem, train_against

from .searched import attacks_of, search

Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


class Attacked(NamedTuple):
    """The policies that were trained, and the files and number of the rows that were played."""

    policies: list[Path]
    files: list[Path]  # of rows: one, or one for each kind of system that was trained on
    rows: int


def attack(
    suite: Suite, defence: str, out: Path, *, seeds: int | None = None, episodes: int | None = None, beacon: str = "", workers: int = 1,
    changes: tuple[str, ...] = (), progress: Progress, counting: Callable[[Progress], Progress] = lambda told: told,
    announce: Callable[[float], None] | None = None,
) -> Attacked:  # fmt: skip
    """Make a suite's attackers against a defence, and play them on it. Finished work is neither made nor played again.

    Policies go to out/policies, rows to out/DEFENCE*.jsonl, what the ensemble found to out/found. seeds, episodes: instead of the suite's;
    beacon: the round; changes: key=value of the training; counting: of the cells that are played. `announce` is called with the seconds
    that searches will take, about. Raises InputError for a suite without a plan.
    """
    plan = plan_of(suite)
    if plan.ensemble and not plan.learners and (changes or seeds is not None):
        field, value = ("--set", changes[0]) if changes else ("--seeds", seeds)
        raise InputError(field, value, f"no such option, as {suite.name} asks for a search and for no training")
    changes = (*changes, f"workers={workers}")
    configs = configs_of(suite, defence, out / "policies", seeds=seeds, extra=changes) if plan.learners else []
    policies = train_against(configs, progress)
    places = {name_of(text): text for text in suite.scenarios}  # which may be files
    groups: dict[tuple[tuple[str, ...], str], list[str]] = {}  # a policy plays where the attacker sees and may do what it learned with
    for config in configs:
        groups.setdefault((fitting(suite, config), ""), []).extend(map(str, policies_of(config)))
    if plan.ensemble:
        found = search(suite, defence, out, beacon=beacon, workers=workers, progress=progress, announce=announce)
        for name, texts in attacks_of(found).items():
            groups[(places[name],), "-found" if configs else ""] = [text for text in texts if text not in suite.attacks]
        groups = {key: texts for key, texts in groups.items() if texts}
    files, count, counted = [], 0, counting(progress)
    for (scenarios, kind), attacks in groups.items():
        place = f"-{name_of(scenarios[0])}" if len(groups) > 1 else ""
        files.append(out / f"{stem(defence)}{place}{kind}.jsonl")
        part = dataclasses.replace(suite, scenarios=scenarios, attacks=tuple(attacks))

        def told(done: int, total: int) -> None:
            counted(f"playing {defence}", done, total, cells(done, total))

        if apart := Spec("defence", defence).sandboxed:
            rows = play_submission(
                apart[1], part, sandbox=apart[0], beacon=beacon, episodes=episodes, workers=workers, out=files[-1], progress=told,
            )  # fmt: skip
        else:
            rows = evaluate(part, defences=[defence], seeds=episodes, workers=workers, out=files[-1], beacon=beacon, progress=told)
        count += len(rows)
    return Attacked(policies, files, count)
