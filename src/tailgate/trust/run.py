"""Statistical model checking of a suite: cells to rows, and rows to what they say of each defence.

The trust of a defence is a lower bound. A run satisfies all properties together with at least this probability, in the worst of a closed
list of scenarios, doses and attacks. One boolean a run makes no assumption on how properties depend on each other. A product of their
probabilities would be wrong; they allow no more than Frechet's bound. alpha is split over the cells.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
from collections.abc import Callable, Generator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.files import remove, set_aside, sweep, writable_directory, write_atomic, write_json
from tailgate.base.locks import alone
from tailgate.base.pool import apart, each
from tailgate.base.reading import lines_of, parse_json
from tailgate.base.version import plays_as
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.core.schema import as_data
from tailgate.engine.cards import device
from tailgate.evaluation.cells import cells_of, run_cell
from tailgate.evaluation.devices import check_cells
from tailgate.evaluation.rows import CLEAN, encode

from .cells import Job, Row, check_cell, failed, single
from .properties import CONJUNCTIONS, Demands, own
from .report import FORMAT, report
from .signals import SafeDistance
from .statistics import Rule

ROWS, FAILURES, REPORT = "cells.jsonl", "failures.jsonl", "trust.json"
BATCH = 2048
Progress = Callable[[int, int], None]


def jobs_of(
    suite: Suite, *, runs: int, formulas: Sequence[str] = (), purpose: str = "report", beacon: str = "",
    batch: int = BATCH, threat: dict[str, Any] | None = None, safe: SafeDistance | None = None, asked: Demands | None = None,
    rule: Rule | None = None,
) -> list[Job]:  # fmt: skip
    """Return every cell of a suite with what is asked of it. Raises InputError for anything that does not exist or cannot be read."""
    for name, value in (("runs", runs), ("batch", batch)):
        sizes.check(name, value)
    for name, held in (("scenarios", suite.scenarios), ("defences", suite.defences), ("attacks", suite.attacks)):
        if not held:
            raise InputError(name, list(held), "at least one")
    for dose in suite.doses:
        if dose is not None and (isinstance(dose, bool) or not isinstance(dose, int) or dose < 0):
            raise InputError("dose", dose, "a whole number of attack steps, not below 0")
    for name in suite.scenarios:
        own(load_scenario(name), formulas)
    cells = cells_of(dataclasses.replace(suite, seeds=runs), batch=batch, purpose=purpose, threat=threat, beacon=beacon)
    return [Job(cell, tuple(formulas), suite.bound, safe or SafeDistance(), asked or Demands(), rule) for cell in cells]


def play(jobs: Sequence[Job], folder: Path | None = None, workers: int = 1, progress: Progress | None = None) -> list[Row]:
    """Play the jobs, and return a row for each.

    With `folder` finished cells are kept there: an interrupted run resumes, and other rows are set aside.
    """
    ids = [job.identity for job in jobs]
    done: dict[str, Row] = {}
    parts = out = None
    if folder is not None:
        out, parts = writable_directory(folder) / ROWS, folder / f".{ROWS}.parts"
        if parts.is_symlink():
            raise InputError("out", str(parts), "a folder that is no link")
        writable_directory(parts)
        for place in (out, parts):
            sweep(place)
        kept = [row for path in (out, *sorted(parts.glob("*.json"))) for row in _read(path)]
        done = {row["cell"]: row for row in kept if row.get("cell") in ids and row.get("status") != "error"}
    missing = [job for job, i in zip(jobs, ids, strict=True) if i not in done]
    if progress is not None and done:  # of an earlier run
        progress(len(done), len(set(ids)))
    with contextlib.closing(_played(missing, workers)) as played:
        for row in played:
            done[row["cell"]] = row
            if parts is not None:
                write_atomic(parts / f"{row['cell']}.json", encode([row]))
            if progress is not None:
                progress(len(done), len(set(ids)))
    rows = [done[i] for i in ids]
    if out is not None and parts is not None:
        if out.is_file() and (_damaged(out) or any(row["cell"] not in ids for row in _read(out))):  # somebody's result
            for other in (out, out.with_name(FAILURES), out.with_name(REPORT)):
                if other.is_file():
                    set_aside(other)
        write_atomic(out, encode(rows))
        for i in ids:
            remove(parts / f"{i}.json")
        if not any(parts.iterdir()):
            parts.rmdir()
    return rows


def _damaged(path: Path) -> bool:
    """Return True for a file that is not all rows of such a run."""
    try:
        return len(_read(path)) < len(list(lines_of(path)))
    except (OSError, ValueError):
        return True


def _read(path: Path) -> list[Row]:
    """Return the rows of a file that an earlier run wrote; none of a damaged one: its cells are played again."""
    try:
        rows = [parse_json(line) for line in lines_of(path)]
    except (OSError, ValueError):
        return []
    return [row for row in rows if isinstance(row, dict) and {"cell", "status", "properties", "conjunctions"} <= set(row)]


def _played(jobs: Sequence[Job], workers: int) -> Generator[Row]:
    """Play, and yield rows as they are finished. Imported code plays in a separate process."""
    foreign = any(Spec("defence", job.cell.defence).imports or Spec("attack", job.cell.attack).imports for job in jobs)
    if device() != "cpu" or not (foreign or apart(workers, len(jobs))):
        yield from map(check_cell, jobs)
        return
    died = "the process that played this cell died"
    for _, row in each(check_cell, [(job,) for job in jobs], workers, lambda i: failed(jobs[i], died)):
        yield row


def check(
    suite: Suite, *, runs: int | None = None, formulas: Sequence[str] = (), alpha: float = 0.05, purpose: str = "report",
    beacon: str = "", batch: int = BATCH, workers: int = 1, folder: Path | None = None, threat: dict[str, Any] | None = None,
    safe: SafeDistance | None = None, asked: Demands | None = None, rule: Rule | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Play, and return the report on a suite's defences, in the format tailgate-trust-1; docs/trust.md says what its fields mean.

    runs: of each cell, the suite's number of seeds unless given; with a rule the most that it may take. formulas: in place of the built-in
    properties. With `folder` it is also written there as trust.json, next to the rows of cells. The worst failing episodes of the
    defences are written as rows for `tailgate replay`. Raises InputError before anything is played.
    """
    if not 0.0 < alpha < 1.0:
        raise InputError("alpha", alpha, "a number above 0 and below 1")
    sizes.check("workers", workers)
    most = suite.seeds if runs is None else runs
    of = partial(
        jobs_of, runs=most, formulas=formulas, purpose=purpose, beacon=beacon, batch=batch, threat=threat, safe=safe, asked=asked, rule=rule
    )
    jobs, clean = of(suite), dataclasses.replace(suite, attacks=(CLEAN,), doses=suite.doses[:1])
    judging = [] if CLEAN in suite.attacks or formulas else of(clean)  # runs without an attack say whether detection counts
    check_cells([job.cell for job in (*jobs, *judging)], workers)
    count = (len(jobs) + len(judging)) * most
    sizes.announce(count / sizes.EPISODES_A_SECOND / workers, 0.0, f"{count:,} runs")
    settings = {"runs": most, "rule": rule_data(rule), "unsafe": _plain(safe or SafeDistance()), "demands": _plain(asked or Demands())}
    with contextlib.nullcontext() if folder is None else alone(folder):
        rows = play([*jobs, *judging], folder, workers, progress)
        found = report(rows[: len(jobs)], suite, alpha=alpha, settings=settings, clean=rows[len(jobs) :])
        if folder is not None:
            _keep_failures(found, jobs, folder)
            write_json(folder / REPORT, found)
    return found


def rule_data(rule: Rule | None) -> dict[str, Any]:
    """Return a rule as JSON data."""
    return {"name": "fixed"} if rule is None else {"name": type(rule).__name__.lower(), **_plain(rule)}


def _plain(value: object) -> dict[str, Any]:
    return {key: held for key, held in as_data(value).items() if key != "class"}


def _keep_failures(found: dict[str, Any], jobs: Sequence[Job], folder: Path) -> None:
    """Write the row of each defence's worst failing run, and puts its line into the report."""
    rows: list[Row] = []
    by_identity = {job.identity: job for job in jobs}
    for entry in found["defences"]:
        worst = entry["worst"]
        if worst is not None:
            job = by_identity[worst["cell"]]
            rows += [row | {"failed": _failed(job, worst["property"])} for row in run_cell(single(job, worst["run"]))]
            worst["replay"] = replay_command(entry["defence"], worst["attack"], folder, len(rows))
    path = folder / FAILURES
    if rows:
        write_atomic(path, encode(rows))
    else:
        remove(path)


def _failed(job: Job, name: str) -> dict[str, str]:
    """Return the property of this name in words and as a formula, for who replays a run that fails it."""
    spec = Spec("attack", job.cell.attack)
    known = job.properties(job.cell.place(spec.make(), spec.entry.knowledge))
    return next({"property": p.name, "about": p.about, "formula": str(p.formula)} for p in known if p.name == name)


def _foreign(spec: Spec) -> bool:
    return spec.imports or spec.sandboxed is not None


def replay_command(defence: str, attack: str, folder: Path, line: int) -> str:
    """Return what plays a line of the failures again. A row must not import code: who wants it names the class."""
    named = [(family, text) for family, text in (("defence", defence), ("attack", attack)) if _foreign(Spec(family, text))]  # type: ignore[arg-type]
    words = ["tailgate", "replay", str(folder / FAILURES), "--line", str(line), "--out", str(folder / f"failure-{line}.html")]
    return shlex.join(words + [word for family, text in named for word in (f"--{family}", text)])


def with_trust(board: dict[str, Any], found: object, where: str = "trust", suite: Suite | None = None) -> dict[str, Any]:
    """Return a board with the field `trust`: what the bounds are about, and the bounds of each entry.

    An entry has bounds by what the attacker knows, on `all` properties together and on `safety`, those without detection. An entry that
    the report does not know has null. So has one that is not built in: its rows are not mixed with others, and its batch would tell it
    who is attacked.

    Raises InputError for anything but a report, and for a report of another suite, version or round. The same goes for a report of own
    formulas, or of runs that a rule stopped.
    """
    if not isinstance(found, Mapping) or found.get("format") != FORMAT:
        raise InputError(f"{where}: format", found.get("format") if isinstance(found, Mapping) else found, FORMAT)
    try:
        for name, mine, other in (
            ("suite", found["suite"]["name"], board["suite"]["name"]),
            ("version", plays_as(found["version"]), plays_as(board["suite"]["version"])),
            ("beacon", found["beacon"], board["suite"].get("beacon", "")),
            ("formulas", found["formulas"], []), ("rule", found["rule"]["name"], "fixed"),
        ):  # fmt: skip
            if mine != other:
                raise InputError(f"{where}: {name}", mine, repr(other))
        if suite is not None:
            _of_suite(found, suite, _listed(suite, board), board["suite"]["alpha"], where)
        head = {key: found[key] for key in ("alpha", "runs", "purpose", "attacks", "scenarios", "doses", "unsafe", "demands")}
        head |= {"beacon": found["beacon"], "properties": _asked(found)}
        bounds = {e["defence"]: {"all": e["trust"], "safety": e["safety"], "why": e["why"]} for e in found["defences"]}
    except (KeyError, TypeError) as error:
        raise InputError(where, f"{type(error).__name__}: {error}", "a whole report of `tailgate trust`") from None
    known = {entry["defence"] for entry in board["entries"] if entry.get("card") is not None}
    return board | {
        "trust": head,
        "entries": [e | {"trust": bounds.get(e["defence"]) if e["defence"] in known else None} for e in board["entries"]],
    }  # fmt: skip


def _listed(suite: Suite, board: Mapping[str, Any]) -> list[str]:
    """Return the attacks of a suite, and those that joined it by the list of a board."""
    joined = (a["attack"] for a in board.get("attacks", ()) if a.get("admitted") and not a.get("withdrawn"))
    return list(dict.fromkeys([*suite.attacks, *joined]))


def _of_suite(found: Mapping[str, Any], suite: Suite, asked: Sequence[str], alpha: float, where: str) -> None:
    """Raise InputError unless a report is of all that the suite asks for, these attacks among it, and of nothing easier."""
    for name, mine, other in (
        ("purpose", found["purpose"], "report"), ("alpha", found["alpha"], alpha), ("demands", found["demands"], _plain(Demands())),
        ("unsafe", found["unsafe"], _plain(SafeDistance())), ("scenarios", found["scenarios"], list(suite.scenarios)),
        ("doses", found["doses"], list(suite.doses)), ("attacks", [a["attack"] for a in found["attacks"]], list(asked)),
    ):  # fmt: skip
        if mine != other:
            raise InputError(f"{where}: {name}", mine, repr(other))
    if found["runs"] < suite.seeds:
        raise InputError(f"{where}: runs", found["runs"], f"at least {suite.seeds}")


def _asked(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the properties that have a meaning in some scenario of a report, and which of them are of safety."""
    asked = {p["name"] for cell in found["cells"] for p in cell["properties"] if p["formula"] is not None}
    about = {p["name"]: p["about"] for entry in found["defences"] for p in entry["properties"]}
    return [{"name": name, "about": text, "safety": name in CONJUNCTIONS["safety"]} for name, text in about.items() if name in asked]
