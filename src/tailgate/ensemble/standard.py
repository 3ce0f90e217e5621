"""The standard attack ensemble against a defence, in every scenario of a suite at every dose.

Each search has its own file, so that an interrupted run goes on. The report compares the best attack of every member with the
best one that the suite lists. All are chosen on select episodes, and played on report episodes.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from tailgate.base import sizes, sources
from tailgate.base.errors import InputError, NotApplicable, said, unknown
from tailgate.base.files import writable_directory, write_atomic, write_json
from tailgate.base.locks import alone
from tailgate.base.pool import apart, each
from tailgate.base.reading import load_json
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.core.schema import digest
from tailgate.core.spec_text import MARKS
from tailgate.core.veil import veiled
from tailgate.ensemble import journal
from tailgate.ensemble.gradient import gradient_masking
from tailgate.ensemble.members import BUDGETS, MEMBERS, Harvest, Hunt, harvest
from tailgate.ensemble.search import FINAL, Arena, Found
from tailgate.evaluation.cells import Cell, run
from tailgate.evaluation.rows import CLEAN
from tailgate.evaluation.stats import proportion

NAME = "standard-v3"
# ensembles whose searches count as well, and the members that they lack
EARLIER = {"standard-v1": ("feedback", "segments", "ghosts"), "standard-v2": ("segments", "ghosts")}
BLACK = tuple(member.name for member in MEMBERS if member.knowledge == "black")
UNLEARNED = tuple(member.name for member in MEMBERS if not member.learns)
ELSEWHERE = "it searches in the suite's main scenarios"
SHOWN = 3  # attacks of a member that are kept
REST = 2.5  # a whole search over its searched episodes: confirming, learning, white boxes and gradients take as long again, and more
PAUSE = 5.0  # between two looks at the progress of searches in other processes [s]
Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


class Job(NamedTuple):
    """One search."""

    arena: Arena
    budget: str
    seed: int
    listed: tuple[str, ...]  # the suite's attacks
    whole: bool = True  # all members search; else those that do not learn

    @property
    def name(self) -> str:
        """The name of its file."""
        one = self.arena
        played = load_scenario(one.scenario).config_hash  # another content under the same name is searched again
        code = [sources.own(), Spec("defence", one.defence).digest, played]
        if find_spec("torch") is None:  # some members have no meaning without it: later they have
            code.append("without torch")
        return f"{one.name}-{'own' if one.dose is None else one.dose}-{digest([NAME, *code, *map(str, self)])}"


def jobs_of(
    suite: Suite, defence: str, scenarios: Sequence[str], doses: Sequence[int | None], budget: str, seed: int, whole: Collection[str] = (),
) -> list[Job]:  # fmt: skip
    """Return the searches against a defence, checked. whole: the scenarios where all members search; empty: all.

    Raises
    ------
    InputError
        For an unknown budget, scenario or dose, and for a defence that has no meaning in any of the scenarios.
    """
    if budget not in BUDGETS:
        raise unknown("--budget", budget, BUDGETS)
    if not 0 <= seed < 2**32:
        raise InputError("--seed", seed, "a whole number from 0 to 4294967295")
    if "knowledge" in suite.granted:
        raise InputError(f"suite {suite.name}: threat.knowledge", suite.granted["knowledge"], "none: each member knows what its class says")
    for name in scenarios:
        if name not in suite.scenarios:
            raise unknown("--scenario", name, suite.scenarios)
    for dose in doses:
        if dose not in suite.doses:
            raise InputError("--dose", dose, f"one of the suite's: {', '.join(map(str, suite.doses))}")
    arenas = [
        Arena(suite.name, scenario, dose, defence, dict(suite.granted), suite.bound, suite.progress)
        for scenario in dict.fromkeys(scenarios or suite.scenarios) for dose in dict.fromkeys(doses or suite.doses)
    ]  # fmt: skip
    played, why = [], ""
    for arena in arenas:
        try:
            _ = arena.loop
        except NotApplicable as error:
            why = str(error)
        else:
            played.append(Job(arena, budget, seed, suite.attacks, not whole or arena.scenario in whole))
    if not played:
        raise InputError("defence", defence, f"one with a meaning in suite {suite.name} ({why})")
    return played


def expected(jobs: Sequence[Job], workers: int) -> float:
    """Return the seconds that searches take, about, from the speed of the first one's scripts."""
    arena = jobs[0].arena
    if not arena.space.families:
        return 0.0
    traced = arena.traced
    steps = sum(BUDGETS[job.budget].episodes(job.arena.loop.model.agents, job.whole, traced) * job.arena.loop.horizon for job in jobs)
    return REST * steps / (arena.speed() * arena.loop.horizon) / min(workers, len(jobs))


def search(job: Job, folder: Path, tell: Callable[[int, int, str, float], None] | None = None) -> dict[str, Any]:
    """Run one search; return what every member found, and the best attack that the suite lists, on the same select episodes.

    folder: where files of attacks are written, and a journal: an interrupted search goes on behind the last member that was done.
    A class in a sandbox sees neither the numbers of its episodes nor that they are searched.
    """
    with veiled() if Spec("defence", job.arena.defence).sandboxed else contextlib.nullcontext():
        return _search(job, folder, tell)


def _search(job: Job, folder: Path, tell: Callable[[int, int, str, float], None] | None) -> dict[str, Any]:
    arena = job.arena
    hunt = Hunt(arena, BUDGETS[job.budget], job.seed, folder / "attacks" / job.name, tell, () if job.whole else UNLEARNED)
    notes = _journal(job, folder)
    found = {one.member: one for one in harvest(hunt, journal.resume(notes, hunt), lambda out: journal.write(notes, hunt, out))}
    members = [found.get(one.name, Harvest(one.name, one.knowledge, [], ELSEWHERE)) for one in MEMBERS]
    return {
        "scenario": arena.name, "place": arena.scenario, "dose": arena.dose, "listed": _strongest(arena, job.listed),
        "members": [one._asdict() | {"found": [found._asdict() for found in one.found[:SHOWN]]} for one in members],
    }  # fmt: skip


def searched(
    jobs: Sequence[Job], folder: Path, workers: int = 1, progress: Progress | None = None,
    announce: Callable[[float], None] | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Run searches, and return their results in order (`search`). Those that the folder has are not run again.

    Parameters
    ----------
    folder
        Its `searches` has the results, its `attacks` the files of programs and policies.
    announce
        Called with the seconds that the searches will take, about, before they begin.

    Raises
    ------
    InputError
        For a damaged result.
    """
    update = progress or (lambda *_: None)
    done = {i: held for i, job in enumerate(jobs) if (held := _kept(job, folder)) is not None}
    left = [i for i in range(len(jobs)) if i not in done]
    if announce is not None and left:
        announce(expected([jobs[i] for i in left], workers))
    shown = 0

    def show(percent: int = 0, text: str = "") -> None:
        nonlocal shown  # a search that ends removes its note before it counts as done
        shown = max(shown, 100 * len(done) + percent)
        update("searches", shown, 100 * len(jobs), f"{len(done)} of {len(jobs)}{text}")

    def finish(number: int, result: dict[str, Any]) -> None:
        done[number] = result
        write_json(_file(jobs[number], folder), result)
        _journal(jobs[number], folder).unlink(missing_ok=True)
        best = _best(result)
        show(text=f", {result['scenario']}: {best['damage']:.0%} by {best['attack']}" if best else "")

    show()
    if apart(workers, len(left)):
        notes = [_note(jobs[i], folder) for i in left]
        for note in notes:
            note.unlink(missing_ok=True)  # of a run that was killed
        with _followed(notes, show):
            for number, result in each(_noted, [(jobs[i], folder) for i in left], workers):
                finish(left[number], result)
    else:
        for i in left:
            place = f", {jobs[i].arena.scenario}, dose {jobs[i].arena.dose}: "
            finish(i, search(jobs[i], folder, lambda n, of, text, mean, place=place: show(100 * n // of, place + text)))  # type: ignore[misc]
    return [done[i] for i in range(len(jobs))]


def _journal(job: Job, folder: Path) -> Path:
    """Return the file of what the members of a search have found so far."""
    return _file(job, folder).with_suffix(".journal")


def _note(job: Job, folder: Path) -> Path:
    """Return the file in which a search notes its progress."""
    return _file(job, folder).with_suffix(".progress")


def _noted(job: Job, folder: Path) -> dict[str, Any]:
    """Run one search in a process apart; while it runs, a file has its progress in percent and its best attack so far."""
    note = _note(job, folder)

    def tell(done: int, total: int, text: str, mean: float) -> None:
        with contextlib.suppress(InputError):  # progress is worth no search: the folder may be on another machine
            held = 100 * done // total, f", {job.arena.scenario}, dose {job.arena.dose}: {text}"
            write_atomic(note, json.dumps(held).encode())

    try:
        return search(job, folder, tell)
    finally:
        with contextlib.suppress(OSError):
            note.unlink()


@contextlib.contextmanager
def _followed(notes: Sequence[Path], update: Callable[[int, str], None]) -> Iterator[None]:
    """Read these files every few seconds within the block, and call update(sum of their percents, each one's text in turn)."""
    over = threading.Event()

    def follow() -> None:
        turn = 0
        while not over.wait(PAUSE):
            held, turn = [], turn + 1
            for note in notes:
                with contextlib.suppress(OSError, ValueError):  # none yet, or finished in between
                    held.append(load_json(note))
            update(sum(percent for percent, _ in held), held[turn % len(held)][1] if held else "")

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _strongest(arena: Arena, attacks: Sequence[str]) -> dict[str, Any] | None:
    """Return the attack that does most harm on select episodes: all are played on some, and the best of these on all."""
    played = {attack: arena.confirmed(attack, "select", 0, FINAL) for attack in arena.promising(attacks)}
    best = max(played, key=lambda attack: played[attack][1], default=None)
    return None if best is None else {"attack": best, "damage": played[best][0], "score": played[best][1]}


def attack(
    suite: Suite, defence: str, *, scenarios: Sequence[str] = (), doses: Sequence[int | None] = (), budget: str = "standard", seed: int = 0,
    episodes: int = 400, workers: int = 1, out: Path | None = None, progress: Progress | None = None,
    announce: Callable[[float], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Attack a defence with all members of the standard ensemble.

    Parameters
    ----------
    suite, defence, scenarios, doses
        What is attacked; all scenarios and doses of the suite unless given.
    budget
        Size of the searches: quick or standard.
    announce
        Called with the seconds that the searches will take, about, before they begin.
    episodes
        Report episodes of each comparison.
    workers
        Processes; they change no result.
    out
        Folder of finished searches, rows, and the files of programs and policies. The same call goes on after an interrupt. By default
        these files are removed in the end.

    Returns
    -------
    dict
        `cells`: for each scenario and dose the best listed attack and the best of each member, with damage and its 95 % interval.

    Raises
    ------
    InputError
        Before anything is played, for an argument that makes no sense.
    """
    sizes.check("workers", workers)
    sizes.check("episodes", episodes)
    update = progress or (lambda *_: None)
    if out is not None and set(str(out)) & set(MARKS):
        raise InputError("--out", str(out), f"a path without any of {MARKS}, as the texts of attacks hold it")
    jobs = jobs_of(suite, defence, scenarios, doses, budget, seed)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) if out is None else writable_directory(out, "--out")
        stack.enter_context(alone(folder))
        results = searched(jobs, folder, workers, progress, announce)
        cells = [
            Cell(suite.name, one["place"], one["dose"], defence, text, episodes, threat=dict(suite.granted))
            for one in results for text in dict.fromkeys([*_chosen(one), *([CLEAN] if suite.progress is not None else [])])
        ]  # fmt: skip
        rows = run(cells, out / "rows.jsonl" if out is not None else None, workers, lambda n, of: update("report", n, of, ""))
    report = {
        "ensemble": NAME, "suite": suite.name, "defence": defence, "budget": budget, "seed": seed, "episodes": episodes,
        "cells": [_compared(result, rows, suite) for result in results],
    }  # fmt: skip
    if out is not None:
        write_json(out / "attack.json", report)
    return report


def _file(job: Job, out: Path) -> Path:
    return out / "searches" / f"{job.name}.json"


def _best(result: dict[str, Any]) -> dict[str, Any] | None:
    """Return the attack of all members that did most harm on select episodes."""
    return max((one["found"][0] for one in result["members"] if one["found"]), key=lambda found: found["score"], default=None)


def _chosen(result: dict[str, Any]) -> list[str]:
    """Return the attacks that are reported: the best listed one, and the best of each member."""
    listed = [result["listed"]["attack"]] if result["listed"] else []
    return listed + [one["found"][0]["attack"] for one in result["members"] if one["found"]]


def _kept(job: Job, out: Path) -> dict[str, Any] | None:
    """Return the result of a search that an earlier run finished."""
    path = _file(job, out)
    if not path.is_file():
        return None
    try:
        held = load_json(path)
    except (OSError, ValueError) as error:
        raise InputError("--out", str(path), f"the result of a search; remove the file to search again ({error})") from None
    try:
        texts = [found["attack"] for one in held["members"] for found in one["found"]] + [one["attack"] for one in [held["listed"]] if one]
        for text in texts:
            Spec("attack", text).refuse_imports("searches")  # only a command line names code
        files = [Path(text.partition("path=")[2]) for text in texts if text.startswith(("program:", "policy:"))]
        return held if all(file.is_file() for file in files) else None  # a file that was removed is made again
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise InputError("--out", str(path), f"the result of a search; remove the file to search again ({said(error)})") from None


def _compared(result: dict[str, Any], rows: list[dict[str, Any]], suite: Suite) -> dict[str, Any]:
    """Return a line of the report: what each attack damaged on report episodes."""
    mine = [row for row in rows if (row["scenario"], row["dose"], row["status"]) == (result["scenario"], result["dose"], "ok")]
    reach = {row["seed"]: row["distance_travelled"] for row in mine if row["attack"] == CLEAN}

    def hit(row: dict[str, Any]) -> bool:
        way, share = row["distance_travelled"], suite.progress
        if share is not None and way is not None and row["seed"] not in reach:
            raise InputError(f"clean run of seed {row['seed']}", None, f"one that was played: {suite.name} counts lost progress")
        stalled = share is not None and way is not None and way < share * reach[row["seed"]]
        return bool(row["crashed"]) or stalled or (suite.bound is not None and row["max_error"] > suite.bound)

    def damage(text: str | None) -> dict[str, Any] | None:
        own = [row for row in mine if row["attack"] == text]
        if not own:
            return None
        share = proportion(sum(map(hit, own)), len(own))
        return {"attack": text, "damage": share.value, "low": share.low, "high": share.high, "episodes": len(own)}

    members = [
        {"member": one["member"], "knowledge": one["knowledge"], "why": one["why"]}
        | (damage(one["found"][0]["attack"] if one["found"] else None) or {"attack": None})
        for one in result["members"]
    ]  # fmt: skip
    best = _best(result)
    by_member = {one["member"]: Found(**one["found"][0]) for one in result["members"] if one["found"]}
    black = [found for name, found in by_member.items() if name in BLACK]
    masked = "gradient" in by_member and gradient_masking(by_member["gradient"], max(black, key=lambda one: one.damage, default=None))
    return {
        "scenario": result["scenario"], "dose": result["dose"], "listed": damage(result["listed"]["attack"] if result["listed"] else None),
        "found": damage(best["attack"] if best else None), "members": members,
        "flags": ["gradient masking"] if masked else [],
    }  # fmt: skip


def attacks_of(report: dict[str, Any]) -> list[str]:
    """Return the attacks that were found, each once, the most harmful first, as `tailgate evaluate --attack` takes them."""
    found = [one for cell in report["cells"] for one in cell["members"] if one["attack"]]
    return list(dict.fromkeys(one["attack"] for one in sorted(found, key=lambda one: -one["damage"])))
