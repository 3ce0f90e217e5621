"""Admission of an attack to the list of a suite (`tailgate.evaluation.attack_list`), and its withdrawal.

An attack is admitted when it surely does more damage than the worst of those that know as much, on the same select seeds.
Who tries often enough wins once by chance, so the j-th try of a list is tested at alpha / (j (j + 1)), which adds up to alpha.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, unknown
from tailgate.base.files import writable_directory, write_atomic
from tailgate.core import Array
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite
from tailgate.ensemble.search import FINAL
from tailgate.evaluation.attack_list import Admitted, append, attacks_of, list_of, next_level, published, read, standing
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.paired import mcnemar
from tailgate.evaluation.rows import CLEAN
from tailgate.evaluation.stats import holm

from .damage import order, tabulate
from .worst import Worst


def withdraw(attack: str, path: Path, date: str, reason: str) -> Admitted:
    """Take an attack back by an erratum: it no longer counts. Raises InputError for one that the list does not hold."""
    held = standing(read(path))
    line = held.get(attack)
    if line is None:
        raise unknown("attack", attack, [text for text, kept in held.items() if kept is not None])
    if not reason.strip():
        raise InputError("reason", reason, "a sentence")
    return append(path, dataclasses.replace(line, date=date, evidence=(), erratum=reason))


def knowledge_of(text: str, suite: Suite) -> str:
    """Return the knowledge that a suite grants an attack."""
    spec = Spec("attack", text)
    return suite.knowledge or str(getattr(spec.make(), "knowledge", spec.entry.knowledge))


def against_all(x: Array, listed: Sequence[Array]) -> tuple[int | None, dict[str, Any]]:
    """Return the listed attack that a new one, with damage x (episodes,), surpasses least surely, and the exact paired test.

    The largest p counts, because nobody knows which listed attack is the worst. Without any the test is against no damage, and None.
    """
    tests = []
    for i, y in enumerate(listed) if listed else [(None, np.zeros_like(x))]:
        new, old = int(np.sum(x > y)), int(np.sum(y > x))
        tests.append((i, {"only_new": new, "only_worst": old, "p": mcnemar(new, old) if new > old else 1.0}))
    return max(tests, key=lambda test: test[1]["p"])


def admit(
    attack: str, suite: Suite, defences: Sequence[str], path: Path, date: str, *, dose: int | None = None, alpha: float = 0.05,
    episodes: int | None = None, workers: int = 1, rows_file: Path | None = None, beacon: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Admitted | None, list[dict[str, Any]]]:  # fmt: skip
    """Play an attack and all that are listed and know as much, on select seeds; append it to the list if it wins.

    It wins if it does more damage in some scenario than the worst of the others in any, against at least one defence. The exact paired
    test decides, adjusted after Holm for all defences and scenarios, at `next_level` of alpha.

    Parameters
    ----------
    dose : int, optional
        The dose of all episodes; by default the middle one of those that the suite shows.
    beacon : str
        The beacon of the round that the seeds are from.

    Returns
    -------
    Admitted or None
        The new line of the list; None if the attack is refused.
    list of dict
        The tests, one for each defence and scenario.
    """
    asked, listed = next_level(list_of(suite, path), alpha), list(attacks_of(suite, path))
    spec = Spec("attack", attack)
    spec.refuse_imports("the list of attacks")  # it would run with the rights of the scoring process
    if attack in listed:
        raise InputError("attack", attack, "one that is not on the list")
    if spec.entry.optimal:
        raise InputError("attack", attack, "a rival: a computed optimum is a ceiling")
    at = suite.middle_dose if dose is None else dose
    if dose is not None and dose not in suite.doses:
        raise InputError("dose", dose, f"one of the doses of {suite.name}: {', '.join(map(str, suite.doses))}")
    level = knowledge_of(attack, suite)
    peers = [text for text in listed if text != CLEAN and not Spec("attack", text).entry.optimal]
    peers = [text for text in peers if order(knowledge_of(text, suite)) <= order(level)]
    part = dataclasses.replace(
        suite, doses=(at,), shown={}, defences=tuple(defences), seeds=episodes or suite.seeds,
        attacks=(*([] if suite.progress is None else [CLEAN]), *peers, attack),  # lost progress is measured against clean runs
    )  # fmt: skip
    work = cells_of(part, purpose="select", beacon=beacon, first_seed=FINAL)  # searches chose on the episodes before
    writable_directory(path.parent)  # before anything is played
    rows = run(work, rows_file, workers, progress)
    table = tabulate(rows, part)
    tests: list[dict[str, Any]] = []
    for defence in defences:
        worst = Worst(table, defence, level, alpha)
        played = [k for k, pair in enumerate(worst.pairs) if pair not in worst.lost]
        mine = [k for k in played if table.attackers[worst.pairs[k][1]].attack == attack]
        others = [k for k in played if k not in mine]
        for k in mine:
            seeds, x = worst.harm(k, 0)
            held = [worst.harm(other, 0) for other in others]
            if any(their != seeds for their, _ in held):
                raise InputError(f"scenarios of {suite.name}", "other seeds", "the same seeds in each")
            best, found = against_all(x, [y for _, y in held])
            tests.append({
                "defence": defence, "scenario": worst.pairs[k][0], "dose": at,
                "worst": None if best is None else worst.named(others[best]), "episodes": len(x), **found,
            })  # fmt: skip
    if not tests:
        raise InputError("attack", attack, "one that can be played against some of the defences")
    asked = min(asked, next_level(list_of(suite, path), alpha))  # others may have tried meanwhile
    for test, adjusted in zip(tests, holm([test["p"] for test in tests]), strict=True):
        test["adjusted"], test["level"] = adjusted, asked
    if not path.is_file() and (shipped := published(suite)) is not None:  # a folder's list goes on from the package's
        write_atomic(path, shipped.read_bytes())
    wins = any(test["only_new"] > test["only_worst"] and test["adjusted"] <= asked for test in tests)
    line = append(path, Admitted(attack, spec.digest, level, date, tuple(tests), refused=not wins, beacon=beacon))
    return line if wins else None, tests
