"""The list of attacks that were admitted after a suite was published: results/SUITE/attacks.jsonl, which only ever grows.

A line holds the hash of the line before it and its own, so that a line that was changed, moved or taken out between others is refused.
An attack is admitted when it does surely more damage than the worst of those that know as much, on the same select seeds. One that does
not is a line too: who tries often enough wins once by chance, so the j-th try of a list is tested at alpha / (j (j + 1)), which over any
number of tries adds up to alpha. One that turns out to be wrong stays, and a later line, an erratum, takes it back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date as day
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, said, unknown
from tailgate.base.files import writable_directory, write_atomic
from tailgate.base.reading import parse_json, read_bytes
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, config_path, list_suites, load_suite
from tailgate.core.schema import build
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.stats import holm

from .damage import CLEAN, order, tabulate
from .doses import Worst
from .ranks import mcnemar


@dataclass(frozen=True)
class Admitted:
    """A line of the list: an attack that was admitted, or was tried and refused, or, with a reason in `erratum`, is taken back."""

    attack: str
    digest: str  # of the file that it comes from; empty for a registered one
    knowledge: str
    date: str  # YYYY-MM-DD
    evidence: tuple[dict[str, Any], ...] = ()  # the paired tests: defence, scenario, dose, worst, only_new, only_worst, p, adjusted, level
    refused: bool = False
    erratum: str = ""
    before: str = ""  # hash of the line before
    hash: str = ""  # of this line
    beacon: str = ""  # the round of the seeds that it was tried on; empty: the public ones, on which it may have been tuned

    def as_data(self) -> dict[str, Any]:
        """JSON data of the line; lines of before there were beacons say none."""
        data = dataclasses.asdict(self) | {"evidence": list(self.evidence)}
        return data if self.beacon else {key: value for key, value in data.items() if key != "beacon"}

    def sealed(self, before: str) -> Admitted:
        """The same line behind another, with the hashes that it has there."""
        bare = dataclasses.replace(self, before=before, hash="")
        text = json.dumps(bare.as_data(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return dataclasses.replace(bare, hash=hashlib.blake2b(text.encode(), digest_size=16).hexdigest())


def read(path: Path) -> list[Admitted]:
    """The lines, checked; none where there is no file. Raises InputError that names the first line that is not as it was written."""
    if not path.is_file():
        return []
    out: list[Admitted] = []
    try:
        lines = read_bytes(path).splitlines()
    except OSError as error:
        raise InputError(path.name, str(path), f"a readable JSON Lines file ({said(error)})") from None
    for number, line in enumerate(lines, start=1):
        where, shown = f"{path.name}, line {number}", line[:60].decode("utf-8", "replace")
        try:
            data = parse_json(line)
        except ValueError as error:
            raise InputError(where, shown, f"a JSON object ({error})") from None
        if not isinstance(data, dict):
            raise InputError(where, shown, "a JSON object")
        held = build(Admitted, data, where)
        if held.sealed(out[-1].hash if out else "") != held:
            raise InputError(where, held.attack, "the line as it was written, behind the one that was before it")
        out.append(held)
    return out


def published(suite: Suite) -> Path | None:
    """The list of a suite of the package, which holds where no folder of boards has one of its own; None for a suite that has none."""
    if suite.name not in list_suites():
        return None
    path = config_path("suites", suite.name, "suite").with_suffix(".attacks.jsonl")
    return path if path.is_file() and load_suite(suite.name).hash == suite.hash else None


def list_of(suite: Suite, path: Path | None = None) -> list[Admitted]:
    """What has joined a suite's attacks: by a folder's list, else by that of the package."""
    if path is not None and path.is_file():
        return read(path)
    shipped = published(suite)
    return [] if shipped is None else read(shipped)


def attacks_of(suite: Suite, path: Path | None = None) -> tuple[str, ...]:
    """The attacks of a suite, and those that have joined them."""
    joined = (text for text, line in standing(list_of(suite, path)).items() if line is not None)
    return tuple(dict.fromkeys([*suite.attacks, *joined]))


def append(path: Path, line: Admitted) -> Admitted:
    """Put a line at the end; the others are not touched. Returns it with its hashes."""
    try:
        day.fromisoformat(line.date)
    except ValueError:
        raise InputError("date", line.date, "a date, YYYY-MM-DD") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path.parent):
        held = read(path)
        line = line.sealed(held[-1].hash if held else "")
        old = path.read_bytes() if held else b""
        write_atomic(path, old + (json.dumps(line.as_data(), allow_nan=False) + "\n").encode())
    return line


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two writers at a time would lose the line of one."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def standing(lines: Sequence[Admitted]) -> dict[str, Admitted | None]:
    """What holds of each attack that the list names: its line, or None where it was refused or the last word is an erratum."""
    return {line.attack: None if line.erratum or line.refused else line for line in lines}


def taken_back(lines: Sequence[Admitted]) -> list[str]:
    """Attacks whose last line is an erratum: they count nowhere. One that was refused is on no list, and counts where it was played."""
    last = {line.attack: line for line in lines}
    return [attack for attack, line in last.items() if line.erratum]


def next_level(lines: Sequence[Admitted], alpha: float) -> float:
    """At which the next try is tested."""
    tries = 1 + sum(not line.erratum for line in lines)
    return alpha / (tries * (tries + 1))


def withdraw(attack: str, path: Path, date: str, reason: str) -> Admitted:
    """An erratum: the attack counts no longer. Raises InputError for one that the list does not hold."""
    held = standing(read(path))
    line = held.get(attack)
    if line is None:
        raise unknown("attack", attack, [text for text, kept in held.items() if kept is not None])
    if not reason.strip():
        raise InputError("reason", reason, "a sentence")
    return append(path, dataclasses.replace(line, date=date, evidence=(), erratum=reason))


def knowledge_of(text: str, suite: Suite) -> str:
    """What an attack is granted in a suite."""
    spec = Spec("attack", text)
    return suite.knowledge or str(getattr(spec.make(), "knowledge", spec.entry.knowledge))


def admit(
    attack: str, suite: Suite, defences: Sequence[str], path: Path, date: str, *, dose: int | None = None, alpha: float = 0.05,
    episodes: int | None = None, workers: int = 1, rows_file: Path | None = None, beacon: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Admitted | None, list[dict[str, Any]]]:  # fmt: skip
    """Play an attack and all that are listed and know as much, on select seeds; append what came of it. -> line (None: refused), tests.

    It wins where it does more damage in some scenario than the worst of the others in any, against at least one defence, by the exact
    paired test, adjusted after Holm for all defences and scenarios, at `next_level` of alpha. dose: the middle one of those that the suite
    shows unless given. beacon: of whose round the seeds are.
    """
    asked, listed = next_level(list_of(suite, path), alpha), list(attacks_of(suite, path))
    spec = Spec("attack", attack)
    spec.refuse_imports("the list of attacks")  # it would run with the rights of whoever scores
    if attack in listed:
        raise InputError("attack", attack, "one that is not on the list")
    if spec.entry.optimal:
        raise InputError("attack", attack, "a rival: a computed optimum is a ceiling")
    at = suite.middle_dose if dose is None else dose
    if dose is not None and dose not in suite.doses:
        raise InputError("dose", dose, f"one of the doses of {suite.name}: {', '.join(map(str, suite.doses))}")
    level = knowledge_of(attack, suite)
    rivals = [text for text in listed if text != CLEAN and not Spec("attack", text).entry.optimal]
    rivals = [text for text in rivals if order(knowledge_of(text, suite)) <= order(level)]
    part = dataclasses.replace(
        suite, doses=(at,), shown={}, defences=tuple(defences), attacks=(*rivals, attack), seeds=episodes or suite.seeds
    )  # fmt: skip
    work = cells_of(part, purpose="select", beacon=beacon)
    writable_directory(path.parent)  # before anything is played
    rows = run(work, rows_file, workers, progress)
    table = tabulate(rows, part)
    tests: list[dict[str, Any]] = []
    for defence in defences:
        worst = Worst(table, defence, level, alpha)
        played = [k for k, pair in enumerate(worst.pairs) if pair not in worst.lost]
        mine = [k for k in played if table.columns[worst.pairs[k][1]].attack == attack]
        others = [k for k in played if k not in mine]
        best = max(others, key=lambda k: float(worst.shares[k, 0]), default=None)
        for k in mine:
            seeds, x = worst.harm(k, 0)
            held, y = worst.harm(best, 0) if best is not None else (seeds, np.zeros_like(x))
            if held != seeds:
                raise InputError(f"scenarios of {suite.name}", len(held), "the same seeds in each")
            new, old = int(np.sum(x > y)), int(np.sum(y > x))
            tests.append({
                "defence": defence, "scenario": worst.pairs[k][0], "dose": at, "worst": None if best is None else worst.named(best),
                "episodes": len(x), "only_new": new, "only_worst": old, "p": mcnemar(new, old),
            })  # fmt: skip
    if not tests:
        raise InputError("attack", attack, "one that can be played against some of the defences")
    for test, adjusted in zip(tests, holm([test["p"] for test in tests]), strict=True):
        test["adjusted"], test["level"] = adjusted, asked
    if not path.is_file() and (shipped := published(suite)) is not None:  # a folder's list goes on from the package's
        write_atomic(path, shipped.read_bytes())
    wins = any(test["only_new"] > test["only_worst"] and test["adjusted"] <= asked for test in tests)
    line = append(path, Admitted(attack, spec.digest, level, date, tuple(tests), refused=not wins, beacon=beacon))
    return line if wins else None, tests
