"""The standard attack ensemble against a defence: searched scripts, in every scenario of a suite at every dose.

Each search is kept in a file of its own, so that an interrupted run goes on. The report compares the best script found with the best
attack that the suite lists, both chosen on select episodes, and both played on report episodes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tailgate.base import sizes, sources
from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.base.files import write_atomic
from tailgate.base.pool import each
from tailgate.base.reading import load_json
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite
from tailgate.core.schema import digest
from tailgate.ensemble.search import EFFORTS, FINAL, Arena, search
from tailgate.evaluation.cells import Cell, run
from tailgate.evaluation.stats import proportion

NAME = "standard-v0"
SHOWN = 3  # scripts of a search that are reported
TRIED, LISTED = 128, 4  # select episodes of every listed attack; listed attacks that are played on as many as the scripts found
Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


class Job(NamedTuple):
    """One search."""

    arena: Arena
    budget: str
    seed: int
    listed: tuple[str, ...]  # the suite's attacks

    @property
    def name(self) -> str:
        """The name of its file."""
        one = self.arena
        code = [sources.own(), Spec("defence", one.defence).digest]  # another defence or search under the same name is searched again
        return f"{one.scenario}-{'own' if one.dose is None else one.dose}-{digest([NAME, *code, *map(str, self)])}"


def jobs_of(suite: Suite, defence: str, scenarios: Sequence[str], doses: Sequence[int | None], budget: str, seed: int) -> list[Job]:
    """Return the searches against a defence, checked.

    Raises
    ------
    InputError
        For an unknown budget, scenario or dose, and for a defence that has no meaning in any of the scenarios.
    """
    if budget not in EFFORTS:
        raise unknown("--budget", budget, EFFORTS)
    if seed < 0:
        raise InputError("--seed", seed, "a whole number, not below 0")
    for name in scenarios:
        if name not in suite.scenarios:
            raise unknown("--scenario", name, suite.scenarios)
    for dose in doses:
        if dose not in suite.doses:
            raise InputError("--dose", dose, f"one of the suite's: {', '.join(map(str, suite.doses))}")
    arenas = [
        Arena(suite.name, scenario, dose, defence, dict(suite.granted), suite.bound)
        for scenario in scenarios or suite.scenarios for dose in doses or suite.doses
    ]  # fmt: skip
    played, why = [], ""
    for arena in arenas:
        try:
            _ = arena.loop
        except NotApplicable as error:
            why = str(error)
        else:
            played.append(Job(arena, budget, seed, suite.attacks))
    if not played:
        raise InputError("defence", defence, f"one with a meaning in suite {suite.name} ({why})")
    return played


def searched(job: Job, tell: Callable[[int, int, str, float], None] | None = None) -> dict[str, Any]:
    """Run one search; return its best scripts, and the best attack that the suite lists, on the same select episodes."""
    arena = job.arena
    found = search(arena, EFFORTS[job.budget], job.seed, tell)
    best = _strongest(arena, job.listed)
    families = [family.name for family in arena.space.families]
    return {
        "scenario": arena.scenario, "dose": arena.dose, "families": list(dict.fromkeys(families)), "listed": best,
        "found": [one._asdict() for one in found[:SHOWN]],
    }  # fmt: skip


def _strongest(arena: Arena, attacks: Sequence[str]) -> dict[str, Any] | None:
    """Return the attack that does most harm on select episodes: all are played on some, and the best of these on all."""
    tried = {}
    for attack in attacks:
        try:
            tried[attack] = arena.confirmed(attack, "select", 0, min(TRIED, FINAL))[1]
        except NotApplicable:
            continue
    played = {attack: arena.confirmed(attack, "select", 0, FINAL) for attack in sorted(tried, key=lambda one: -tried[one])[:LISTED]}
    best = max(played, key=lambda attack: played[attack][1], default=None)
    return None if best is None else {"attack": best, "damage": played[best][0], "score": played[best][1]}


def attack(
    suite: Suite, defence: str, *, scenarios: Sequence[str] = (), doses: Sequence[int | None] = (), budget: str = "standard", seed: int = 0,
    episodes: int = 400, workers: int = 1, out: Path | None = None, progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Attack a defence with the standard ensemble.

    Parameters
    ----------
    suite, defence, scenarios, doses
        What is attacked; all scenarios and doses of the suite unless given.
    budget
        Size of the searches: quick or standard.
    episodes
        Report episodes of each comparison.
    workers
        Processes; they change no result.
    out
        Folder of finished searches and rows. The same call goes on after an interrupt.

    Returns
    -------
    dict
        `cells`: for each scenario and dose the best listed attack and the best script found, with damage and its 95 % interval.

    Raises
    ------
    InputError
        Before anything is played, for an argument that makes no sense.
    """
    sizes.check("workers", workers)
    sizes.check("episodes", episodes)
    update = progress or (lambda *_: None)
    jobs = jobs_of(suite, defence, scenarios, doses, budget, seed)
    done = {i: held for i, job in enumerate(jobs) if (held := _kept(job, out)) is not None}
    left = [i for i in range(len(jobs)) if i not in done]
    update("searches", len(done), len(jobs), "")

    def finish(number: int, result: dict[str, Any]) -> None:
        done[number] = result
        if out is not None:
            write_atomic(out / "searches" / f"{jobs[number].name}.json", json.dumps(result, indent=1).encode() + b"\n")
        best = result["found"][0] if result["found"] else None
        update("searches", len(done), len(jobs), f"{result['scenario']}: {best['damage']:.0%} by {best['script']}" if best else "")

    if workers > 1 and len(left) > 1:
        for number, result in each(searched, [(jobs[i],) for i in left], workers):
            finish(left[number], result)
    else:
        for i in left:
            label = f"{jobs[i].arena.scenario}, dose {jobs[i].arena.dose}"
            finish(i, searched(jobs[i], lambda n, of, script, mean, label=label: update(label, n, of, script)))  # type: ignore[misc]
    cells = [
        Cell(suite.name, one["scenario"], one["dose"], defence, text, episodes, threat=dict(suite.granted))
        for one in (done[i] for i in range(len(jobs)))
        for text in dict.fromkeys([*([one["listed"]["attack"]] if one["listed"] else []), *(f["script"] for f in one["found"][:1])])
    ]  # fmt: skip
    rows = run(cells, out / "rows.jsonl" if out is not None else None, workers, lambda n, of: update("report", n, of, ""))
    report = {
        "ensemble": NAME, "suite": suite.name, "defence": defence, "budget": budget, "seed": seed, "episodes": episodes,
        "cells": [_compared(done[i], rows, suite.bound) for i in range(len(jobs))],
    }  # fmt: skip
    if out is not None:
        write_atomic(out / "attack.json", json.dumps(report, indent=1).encode() + b"\n")
    return report


def _kept(job: Job, out: Path | None) -> dict[str, Any] | None:
    """Return the result of a search that an earlier run finished."""
    path = None if out is None else out / "searches" / f"{job.name}.json"
    if path is None or not path.is_file():
        return None
    try:
        held = load_json(path)
    except (OSError, ValueError) as error:
        raise InputError("--out", str(path), f"the result of a search; remove the file to search again ({error})") from None
    return held if isinstance(held, dict) else None


def _compared(result: dict[str, Any], rows: list[dict[str, Any]], bound: float | None) -> dict[str, Any]:
    """Return a line of the report: what each attack damaged on report episodes."""

    def damage(text: str | None) -> dict[str, Any] | None:
        own = [r for r in rows if (r["scenario"], r["dose"], r["attack"]) == (result["scenario"], result["dose"], text)] if text else []
        own = [row for row in own if row["status"] == "ok"]
        if not own:
            return None
        hits = sum(bool(row["crashed"]) or (bound is not None and row["max_error"] > bound) for row in own)
        share = proportion(hits, len(own))
        return {"attack": text, "damage": share.value, "low": share.low, "high": share.high, "episodes": len(own)}

    listed, found = result["listed"], result["found"]
    return {
        "scenario": result["scenario"], "dose": result["dose"], "families": result["families"],
        "listed": damage(listed and listed["attack"]), "found": damage(found[0]["script"] if found else None), "others": found[1:],
    }  # fmt: skip


def attacks_of(report: dict[str, Any]) -> list[str]:
    """Return the scripts that were found, each once, as `tailgate evaluate --attack` takes them."""
    return list(dict.fromkeys(cell["found"]["attack"] for cell in report["cells"] if cell["found"]))

