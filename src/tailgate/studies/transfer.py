"""Transfer: policies trained against one defence, played against others.

A row of the matrix is what was trained on, a column what is played on; an entry is the mean over training seeds. The diagonal has
what was trained against that very defence. Where a row from elsewhere does better than the diagonal, the attackers of that defence were
not trained to its worst: the entry is flagged.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.registry import Spec
from tailgate.core.registry import entries as registered
from tailgate.core.scenario import Suite, list_suites, load_scenario, load_suite
from tailgate.core.schema import as_data, canonical
from tailgate.estimators.per_episode import EpisodeByEpisode
from tailgate.evaluation.cells import Cell, cells_of, run
from tailgate.evaluation.stats import Interval, around, paired_difference
from tailgate.play.metrics import unit_in

from .policies import Trained, defence_of, distinct, is_share, mean, misfit, outcome_for, scenario_of

LEVEL = 0.95
T = TypeVar("T")
ALL = "all"  # the word for every registered defence


def difference(a: Array, b: Array, share: bool = False, level: float = LEVEL) -> Interval:
    """Return mean of a (runs, episodes) less that of b (other runs, the same episodes), with an interval.

    Episodes are paired, training seeds are not: their part is Welch's t over the runs' means, and missing where each side has one.
    """
    from scipy import special

    paired = paired_difference(a.mean(axis=0), b.mean(axis=0), level, share=share)
    parts = [(float(x.mean(axis=1).var(ddof=1)) / len(x), len(x) - 1) for x in (a, b) if len(x) > 1]
    variance, spread = sum(v for v, _ in parts), 0.0
    if variance > 0.0:
        freedom = variance**2 / sum(v**2 / n for v, n in parts)
        spread = float(special.stdtrit(freedom, (1 + level) / 2)) * variance**0.5
    low, high = paired.value - paired.low, paired.high - paired.value
    if not share:  # a bootstrap of few episodes is too narrow
        wider = float(special.stdtrit(max(1, a.shape[1] - 1), (1 + level) / 2) / special.ndtri((1 + level) / 2))
        low, high = wider * low, wider * high
    return around(paired.value, np.hypot(low, spread), np.hypot(high, spread), share)


def transfer(
    texts: Sequence[str], defences: Sequence[str] = (), *, scenario: str | None = None, threat: dict[str, Any] | None = None,
    dose: int | None = None, episodes: int = 400, outcome: str | None = None, purpose: str = "report", workers: int = 1,
    rows_file: Path | None = None, progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Play, and return the report. Without `defences` the policies are played on those that they were trained on.

    The word `all` adds every registered defence that has a meaning in the scenario. These are the defences of the suites with it; if none
    has it, those that the scenario admits. Sentinels, and defences that play one episode after the other, have to be named. `skipped` lists
    who is left out, with the reason.

    Scenario and threat model are those of the training, which have to agree where nothing else is given. A policy that does not fit them
    (another observation or action) is skipped, with the reason.
    """
    sizes.check("episodes", episodes)
    members = distinct(texts)
    if not members:
        raise InputError("policies", list(texts), "at least one")
    where = scenario or _common("scenario", {who.name: scenario_of(who) for who in members})
    changed = _common("threat", {who.name: who.threat for who in members}) if threat is None else dict(threat)
    counted = outcome_for(outcome or next((who.outcome for who in members if who.outcome), None), where)
    origins = {who.text: defence_of(who) for who in members}
    columns = tuple(dict.fromkeys(defences or origins.values()))
    good: list[Trained] = []
    skipped: list[dict[str, Any]] = []
    if ALL in columns:
        named = dict.fromkeys((*origins.values(), *(name for name in columns if name != ALL)))
        found, skipped = _registered(where, named)
        columns = (*named, *found)
    for who in members:
        reason = misfit(Cell("transfer", where, dose, columns[0], who.text, episodes, purpose, threat=changed))
        if reason:
            skipped.append({"policy": who.name, "trained_on": origins[who.text], "reason": reason})
        else:
            good.append(who)
    attacks = ("none", *(who.text for who in good))
    cells = cells_of(Suite("transfer", "", (where,), (dose,), columns, attacks, episodes, changed), purpose=purpose)
    rows = run(cells, rows_file, workers, progress)
    held: dict[tuple[str, str], Array] = {}
    for i, cell in enumerate(cells):
        mine = rows[i * episodes : (i + 1) * episodes]
        bad = next((row for row in mine if row["status"] != "ok" or row[counted] is None), None)
        if bad is None:
            held[cell.attack, cell.defence] = np.array([row[counted] for row in mine], np.float64)
        elif cell.attack == "none" or ("none", cell.defence) in held:
            reason = bad["reason"] or f"{counted} is undefined in some episodes"
            whose = ({"policy": one.name, "trained_on": origins[one.text]} for one in good if one.text == cell.attack)
            skipped.append({"defence": cell.defence} | next(whose, {}) | {"reason": reason})
    if ALL in defences:
        columns = tuple(column for column in columns if ("none", column) in held)
    origin_rows = dict.fromkeys(origins[who.text] for who in good)
    entries: list[dict[str, Any]] = []
    comparisons: list[tuple[dict[str, Any], Array, Array]] = []
    for column in columns:
        played = {
            origin: np.array([held[who.text, column] for who in good if origins[who.text] == origin and (who.text, column) in held])
            for origin in origin_rows
        }
        for origin, values in played.items():
            if not len(values):
                continue
            entry: dict[str, Any] = {
                "trained_on": origin, "played_on": column, "seeds": len(values), **mean(values, counted)._asdict(),
                "by_policy": {
                    who.name: float(held[who.text, column].mean()) for who in good
                    if origins[who.text] == origin and (who.text, column) in held
                },
            }  # fmt: skip
            own = played.get(column)
            if own is not None and len(own) and origin != column:
                entry |= {"over_own": difference(values, own, is_share(counted))._asdict(), "flags": []}
                comparisons.append((entry, values, own))
            entries.append(entry)
    for entry, values, own in comparisons:  # all of a report at once: Bonferroni
        if difference(values, own, is_share(counted), 1.0 - (1.0 - LEVEL) / len(comparisons)).low > 0.0:
            entry["flags"] = ["transferred beats own"]
    loaded = load_scenario(where).with_threat(**(changed | ({} if dose is None else {"budget": dose})))
    return {
        "measure": "transfer", "scenario": where, "purpose": purpose, "episodes": episodes, "outcome": counted,
        "unit": unit_in(counted, loaded.brief().model), "threat_model": as_data(loaded.threat_model),
        "trained_on": list(origin_rows), "played_on": list(columns),
        "no_attack": {column: float(held["none", column].mean()) for column in columns if ("none", column) in held},
        "entries": entries, "skipped": skipped,
    }  # fmt: skip


def _registered(scenario: str, named: Collection[str]) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the defences that have a meaning in a scenario besides the named ones, and the others with the reason."""
    listed = [name for suite in map(load_suite, list_suites()) if scenario in suite.scenarios for name in suite.defences]
    found, skipped = [], []
    for name in dict.fromkeys((*listed, *registered("defence"))):
        entry = Spec("defence", name).entry
        if name in named:
            continue
        if entry.sentinel:
            reason = f"a sentinel ({entry.sentinel})"
        elif issubclass(entry.cls, EpisodeByEpisode):
            reason = "it plays one episode after the other"
        elif listed and entry.built_in and name not in listed:
            reason = "no suite plays it in this scenario (docs/scoring.md)"
        else:
            found.append(name)
            continue
        skipped.append({"defence": name, "reason": f"{reason}; it can be named"})
    return found, skipped


def _common(field: str, values: dict[str, T]) -> T:
    """Return the value that all policies agree on, or an InputError that names the option."""
    different = {canonical(value) for value in values.values()}
    if len(different) > 1:
        raise InputError(field, " and ".join(sorted(different)), f"policies of one {field}, or --{field}")
    return next(iter(values.values()))
