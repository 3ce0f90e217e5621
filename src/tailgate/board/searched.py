"""Attacks that the standard ensemble finds against a defence: a board asks for them before it ranks.

The suite's plan names a budget. Every scenario is searched, at the plan's doses; those who learn leave out scenarios for robustness.
Of each search the best attack of every class of knowledge is played, in that scenario at all doses (`attacks_of`). The results lie with
the rows, and the board holds them, so that it can be scored without them.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tailgate.base.errors import InputError, wanted
from tailgate.base.files import writable_directory, write_atomic, write_json
from tailgate.base.locks import alone
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite
from tailgate.core.spec_text import MARKS
from tailgate.core.threat import KNOWLEDGE
from tailgate.ensemble import standard
from tailgate.ensemble.members import MEMBERS
from tailgate.ensemble.standard import EARLIER, NAME, Progress, jobs_of, searched
from tailgate.evaluation.rows import Row
from tailgate.training.adaptive import Adaptive, plan_of, stem

from .damage import PLAYED, SKIPPED, Table
from .files import read_json
from .part import Data
from .search_results import SearchedLine

ENDING = ".search.json"
FILES = ("policy:path=", "program:path=")  # attacks that lie in files


def search(
    suite: Suite, defence: str, out: Path, *, beacon: str = "", workers: int = 1, progress: Progress | None = None,
    announce: Callable[[float], None] | None = None,
) -> Data:  # fmt: skip
    """Search attacks against a defence as a suite's plan says; a finished search is not run again.

    beacon: the round, which decides the seed. A class in a sandbox does not see that it is searched. Searches go to out/searches, the
    files of attacks that are played to out/found, and the results to out/DEFENCE.search.json.

    Returns
    -------
    dict
        A line of the field `searches` of a board.

    Raises
    ------
    InputError
        For a suite whose plan asks for no ensemble, without PyTorch, and for a path that cannot be part of an attack's text.
    """
    plan = plan_of(suite)
    if importlib.util.find_spec("torch") is None:
        raise InputError("torch", None, "PyTorch, which a member of the ensemble needs: pip install 'tailgate[train]'")
    if set(str(out)) & set(MARKS):
        raise InputError("--out", str(out), f"a path without any of {MARKS}, as the texts of attacks hold it")
    jobs = jobs_of(suite, defence, (), plan.searched(suite), plan.ensemble, seed_of(beacon), suite.nominal)
    spec = Spec("defence", defence)
    folder = writable_directory(out / "searches" / stem(defence))
    with alone(folder):
        results = searched(jobs, folder, workers, progress, announce)
    line: Data = {
        "defence": spec.target, "digest": spec.digest, "version": spec.entry.version, "ensemble": NAME, "budget": plan.ensemble,
        "seed": seed_of(beacon), "cells": [_cell(result, out / "found") for result in results],
    }  # fmt: skip
    write_json(out / f"{stem(defence)}{ENDING}", line)
    return line


def seed_of(beacon: str) -> int:
    """Return the seed of the searches of a round: nobody knows it before the beacon. It is 0 on public seeds."""
    return int.from_bytes(hashlib.blake2b(beacon.encode(), digest_size=4).digest(), "big") if beacon else 0


def _cell(result: Data, folder: Path) -> Data:
    """Return what every member found in one search; the files of what is played are copied to a folder."""
    best = {one["member"]: one["found"][0] for one in result["members"] if one["found"]}
    looked = {one["member"]: one["knowledge"] for one in result["members"]}
    plays = {member: Spec("attack", found["attack"]).entry.knowledge for member, found in best.items()}  # a gradient's program: black
    chosen = {
        max(mine, key=lambda member: best[member]["score"])
        for classes in (looked, plays) for level in KNOWLEDGE if (mine := [member for member in best if classes[member] == level])
    }  # fmt: skip
    return {
        "scenario": result["scenario"], "dose": result["dose"], "listed": (result["listed"] or {}).get("damage"),
        "members": [
            {
                "member": one["member"], "knowledge": one["knowledge"], "why": one["why"],
                "damage": best[one["member"]]["damage"] if one["member"] in best else None,
                "attack": _placed(best[one["member"]]["attack"], folder) if one["member"] in chosen else None,
            }
            for one in result["members"]
        ],
    }  # fmt: skip


def _placed(text: str, folder: Path) -> str:
    """Copy the files of an attack to a folder; return its text there. Attacks without files stay as they are."""
    head = next((head for head in FILES if text.startswith(head)), None)
    if head is None:
        return text
    source = Path(text.removeprefix(head))
    writable_directory(folder)
    weights = source.with_suffix(".safetensors")
    for file in (source, *([weights] if weights.is_file() else [])):
        write_atomic(folder / file.name, file.read_bytes())
    return f"{head}{folder / source.name}"


def attacks_of(line: Data) -> dict[str, list[str]]:
    """Return the attacks of a line that are played, by scenario: where they were found, and where not all members searched."""
    out: dict[str, list[str]] = {cell["scenario"]: [] for cell in line["cells"]}
    light = {cell["scenario"] for cell in line["cells"] for one in cell["members"] if one["why"] == standard.ELSEWHERE}
    for cell in line["cells"]:
        found, origin = [one["attack"] for one in cell["members"] if one["attack"] is not None], cell["scenario"]
        for name in out:
            if name == origin or (name in light and origin not in light):
                out[name] += [attack for attack in found if attack not in out[name]]
    return out


def searches_in(folder: Path) -> list[Data]:
    """Return the results of all searches in a suite's folder, by defence. Raises InputError for a damaged file."""
    out: dict[str, Data] = {}
    for path in sorted(folder.glob(f"**/*{ENDING}")):
        if any(part.startswith(".") or part in ("searches", "policies", "trust") for part in path.relative_to(folder).parts[:-1]):
            continue
        data = read_json(path, "search")
        try:
            line = SearchedLine.model_validate(data)
        except ValidationError as error:
            first = error.errors()[0]
            raise InputError(f"{path.name}: {'.'.join(map(str, first['loc']))}", first["input"], wanted(first)) from None
        for attack in (one.attack for cell in line.cells for one in cell.members if one.attack is not None):
            Spec("attack", attack).refuse_imports(path.name)  # only a command line names code
        out[line.defence] = data
    return [out[name] for name in sorted(out)]


def found_for(searches: Iterable[Data], listed: Collection[str] = ()) -> dict[str, str]:
    """Return the defence that each attack was found against, of an attack that was found twice the first; without those on a list."""
    out: dict[str, str] = {}
    for line in searches:
        for attack in (attack for mine in attacks_of(line).values() for attack in mine if attack not in listed):
            out.setdefault(attack, line["defence"])
    return out


def unsearched(table: Table, row: Row, searches: Sequence[Data], plan: Adaptive) -> str:
    """Return what is missing of the searches that a suite asks for against a defence; empty where nothing is.

    row: one of the defence, which says its digest and version.
    """
    line, suite = next((one for one in searches if one["defence"] == row["defence"]), None), table.suite
    if line is None:
        return f"the standard ensemble (budget {plan.ensemble}) has not attacked this defence"
    own = {"digest": row["defence_digest"], "version": row.get("versions", {}).get("defence", 1), "ensemble": NAME, "budget": plan.ensemble}
    own |= {"seed": seed_of(table.beacon)}
    line = dict[str, Any](seed=0, **line) if "seed" not in line else line  # older ones have none
    if line["ensemble"] in EARLIER:
        own["ensemble"] = line["ensemble"]
    for name, value in own.items():
        if line[name] != value:
            return f"the ensemble attacked another {name}: {line[name] or 'none'}, not {value or 'none'}"
    cells, asked = {(cell["scenario"], cell["dose"]): cell for cell in line["cells"]}, attacks_of(line)
    index = table.defences.index(row["defence"])
    for name in table.scenarios:
        for dose in plan.searched(suite):
            cell = cells.get((name, dose))
            if cell is None:
                return f"the ensemble has not attacked it on {name} at dose {dose}"
            if lacks := _lacking(cell, name in table.nominal(), EARLIER.get(line["ensemble"], ())):
                return f"the search on {name} at dose {dose} is not whole: {lacks}"
        here = {attack for cell in line["cells"] if cell["scenario"] == name for one in cell["members"] if (attack := one["attack"])}
        left = set(asked[name]) - table.withdrawn
        for one, state in zip(table.attackers, table.state[name][index], strict=True):
            meaningless = one.attack not in here and (state == SKIPPED).all()  # found in another scenario
            if meaningless or (state == PLAYED).all():
                left.discard(one.attack)
        if left:
            return f"what the ensemble found was not played on {name}: {min(left)}"
    return ""


def _lacking(cell: Data, whole: bool, spared: Collection[str]) -> str:
    """Return what a search has and a cell has not: every member with damage or a reason, and an attack of each knowledge.

    whole: all members search here, so that none may leave it to another scenario. spared: members that it need not have.
    """
    members = {one["member"]: one for one in cell["members"]}
    if left := [one.name for one in MEMBERS if one.name not in members and one.name not in spared]:
        return f"no member {left[0]}"
    for name, one in members.items():
        if one["damage"] is None and not one["why"]:
            return f"neither damage nor a reason of {name}"
        if whole and one["why"] == standard.ELSEWHERE:
            return f"{name} did not search"
    if all(one["damage"] is None for one in members.values()):
        return "no member found an attack"
    for level in KNOWLEDGE:
        mine = [one for one in members.values() if one["knowledge"] == level and one["damage"] is not None]
        if mine and not any(one["attack"] is not None for one in mine):
            return f"no attack of a {level} box"
    return ""


def worth(searches: Sequence[Data]) -> list[dict[str, Any]]:
    """Return what each member of the ensemble adds, over all cells of all defences.

    Returns
    -------
    list of dict
        For each member: its knowledge, the cells where it has a meaning, its mean damage there, the cells where nobody who knows as little
        does as much (`alone`), and by how much the mean of the best black or wider box falls without it (`adds`).
    """
    cells = [cell for line in searches for cell in line["cells"]]
    names = dict.fromkeys((one["member"], one["knowledge"]) for cell in cells for one in cell["members"])
    out = []
    for name, knowledge in names:
        allowed = KNOWLEDGE[: KNOWLEDGE.index(knowledge) + 1]
        mine, without = [], []
        for cell in cells:
            held = {one["member"]: one["damage"] for one in cell["members"] if one["damage"] is not None and one["knowledge"] in allowed}
            if name in held:
                mine.append(held[name])
                without.append(max([cell["listed"] or 0.0, *(x for other, x in held.items() if other != name)]))
        gains = [max(own - other, 0.0) for own, other in zip(mine, without, strict=True)]
        out.append({
            "member": name, "knowledge": knowledge, "cells": len(mine), "damage": sum(mine) / len(mine) if mine else None,
            "alone": sum(gain > 0.0 for gain in gains), "adds": sum(gains) / len(gains) if gains else None,
        })  # fmt: skip
    return out
