"""The rows of a suite for one submission."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.pool import apart, each
from tailgate.core.scenario import Suite, load_suite
from tailgate.evaluation.attack_list import attacks_of
from tailgate.evaluation.cells import Cell, cells_of
from tailgate.evaluation.resume import Parts, complete
from tailgate.sandbox.limits import Limits, Lost
from tailgate.sandbox.mixed import Submission, part_of, play_mixed
from tailgate.sandbox.process import Process
from tailgate.sandbox.sandbox import Sandbox, sandbox_of
from tailgate.sandbox.source import staged

Rows = list[dict[str, Any]]


def play_submission(
    text: str,
    suite: str | Suite,
    *,
    limits: Limits | None = None,
    sandbox: str | Sandbox | None = None,
    beacon: str = "",
    workers: int = 1,
    out: Path | str | None = None,
    progress: Callable[[int, int], None] | None = None,
    scenarios: Sequence[str] | None = None,
    episodes: int | None = None,
    purpose: str = "report",
) -> Rows:
    """Play a suite with one submission, "module:Class:key=value"; return a row for each scenario, dose, attack and episode.

    The attacks are the suite's, and those that joined it by its published list.
    The class is imported only in separate processes, from a copy of its files.
    With a `beacon`, the seeds are those of its round (`tailgate.evaluation.rounds`); without one they are public: 0, 1, ...
    A failure costs rows and gives them a reason: a wrong number those of its cell, a lost process those of its scenario.
    With `out`, an interrupted run resumes after the scenarios that it finished without an error.

    Raises
    ------
    InputError
        An argument is invalid; nothing is played then.
    """
    base = load_suite(suite) if isinstance(suite, str) else suite
    sandbox = sandbox_of(sandbox) if isinstance(sandbox, str) else sandbox
    count = base.seeds if episodes is None else episodes
    for name, value in (("episodes", count), ("workers", workers)):
        sizes.check(name, value)
    places = tuple(base.scenarios if scenarios is None else scenarios)
    named = dataclasses.replace(base, attacks=attacks_of(base), defences=("none",), seeds=count, scenarios=places)
    with staged(text) as source:
        cells = [dataclasses.replace(cell, defence=source.text) for cell in cells_of(named, purpose=purpose, beacon=beacon)]
        if not cells:
            raise InputError("suite", base.name, "one with scenarios, doses and attacks")
        seeds = list(cells[0].episodes)
        held, lost = limits or Limits(), None
        card: dict[str, Any] = {"uses": ("measurements",), "version": 1, "reference": ""}
        try:
            with Process(source.text, source.path, held, sandbox) as process:
                card = process.card
        except Lost as error:
            lost = error
        submission = Submission(source, card, held, sandbox)
        jobs = [[cell for cell in cells if cell.scenario == name] for name in dict.fromkeys(named.scenarios)]
        if lost is not None:
            rows = [row for cell in cells for row in part_of(cell, submission, seeds).failed(seeds, lost)]
            if out is not None:
                with Parts(Path(out)) as parts:
                    parts.finish(rows, {"all": [(str(row["cell"]), row["seed"]) for row in rows]})
            return rows
        return _run(jobs, submission, seeds, Path(out) if out is not None else None, workers, progress)


def _run(
    jobs: Sequence[Sequence[Cell]], submission: Submission, seeds: list[int], out: Path | None, workers: int,
    progress: Callable[[int, int], None] | None,
) -> Rows:  # fmt: skip
    """Play all jobs, one scenario each; return their rows in order."""
    ids = [[str(part_of(cell, submission, seeds).head["cell"]) for cell in job] for job in jobs]
    names = [hashlib.blake2b("".join(each).encode(), digest_size=12).hexdigest() for each in ids]
    pieces = {name: [(cell, seed) for cell in cells for seed in seeds] for name, cells in zip(names, ids, strict=True)}
    return complete(names, pieces, out, lambda missing: _play([jobs[i] for i in missing], submission, seeds, workers), progress)


def _play(jobs: Sequence[Sequence[Cell]], submission: Submission, seeds: list[int], workers: int) -> Generator[tuple[int, Rows]]:
    if not apart(workers, len(jobs)):
        for i, job in enumerate(jobs):
            yield i, play_mixed(job, submission, seeds)
        return
    yield from each(play_mixed, [(job, submission, seeds) for job in jobs], workers)  # the guard ends a submission whose worker has died
