"""A board: every figure of a suite as JSON, a pure function of rows and the suite. docs/scoring.md says why each is made as it is."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

import tailgate
from tailgate.adaptive import Asked, asked_of
from tailgate.errors import InputError
from tailgate.registry import Entry, built_in, split_text
from tailgate.rounds import numbered
from tailgate.scenario import Suite
from tailgate.strength.dose import CRITICAL
from tailgate.threat import KNOWLEDGE

from .attacks import Admitted, standing, taken_back
from .beside import Beside, beside
from .cells import cells_of, ordered
from .damage import CLEAN, PLAYED, SKIPPED, Column, Key, Row, Table, doses_of, has_road, named, tabulate
from .doses import Worst
from .flags import flags
from .gates import failure, gates
from .ranks import class_of, compare

FORMAT = "tailgate-board-1"
CLEAN_METRICS = (
    "time_gap_inflation", "rms_jerk", "distance_travelled", "max_decel", "min_gap", "rmse_position", "rmse_velocity", "max_error",
    "alarm_rate", "alarm_onsets", "muted_steps",
)  # fmt: skip
Data = dict[str, Any]
Levels = dict[str, dict[str, Worst]]  # by defence and knowledge


def score(
    rows: Iterable[Row], suite: Suite, *, attacks: Sequence[Admitted] | None = None, alpha: float = 0.05, require_adaptive: bool = True,
    board: Data | None = None,
) -> Data:  # fmt: skip
    """The board of a suite from its rows, in the format of decision record 14. The order of the rows changes nothing.

    attacks: what joined the suite's attacks after it was published (`attacks.read`); every defence has to have met these too.
    require_adaptive: rank only defences that met an attack which was trained against them.
    board: of the same suite; what it says of other defences stands beside these rows (`beside`), and ranks are made of both.
    Raises InputError for rows that do not belong together, or not beside the board.
    """
    if not 0.0 < alpha < 1.0:
        raise InputError("alpha", alpha, "a number above 0 and below 1")
    lines, rows = standing(attacks or ()), list(rows)
    for row in rows:
        line = lines.get(row["attack"])
        if line is not None and row["attack_digest"] != line.digest:
            raise InputError(f"rows of {row['attack']}: attack_digest", row["attack_digest"], f"{line.digest}, as it was admitted")
    added = [text for text, line in lines.items() if line is not None]
    table = tabulate(rows, suite, added, taken_back(attacks or ()))
    digests = {text: line.digest for text, line in lines.items() if line is not None}
    slot = middle(suite)
    held = None if board is None else beside(table, board, suite, alpha, require_adaptive, digests)
    table = table if held is None else held.table
    kept = {} if held is None else held.entries
    origins = _origins(table)
    levels: Levels = {d: {k: Worst(table, d, k, alpha) for k in KNOWLEDGE} for d in table.defences}
    asked = asked_of(suite) if require_adaptive and suite.adaptive else [] if require_adaptive else None
    found = [dict(kept[d]) if d in kept else _entry(table, d, levels[d], slot, origins, asked) for d in table.defences]
    cells = ordered([*cells_of(table), *(held.cells if held else ())], table)
    return {
        "format": FORMAT, "suite": _suite(table, alpha) | {"require_adaptive": require_adaptive},
        "attacks": _attacks(table, lines, origins, cells, held), "entries": found, "cells": cells,
        "curves": [curve for d in table.defences for curve in (held.of("curves", d) if held and d in kept else curves(levels[d]))],
        "comparisons": _rank(found, levels, slot, alpha, held), "detection": None,
    } | ({"trust": board["trust"]} if board is not None and board.get("trust") else {})  # fmt: skip


def middle(suite: Suite) -> int:
    """Slot of the middle one of the doses that are shown; of all where none is named."""
    chosen = shown(suite)
    return chosen[len(chosen) // 2]


def shown(suite: Suite) -> list[int]:
    """Slots of the doses that rates are shown at."""
    doses = doses_of(suite)
    return [slot for slot, dose in enumerate(doses) if dose in suite.shown] or list(range(len(doses)))


def _suite(table: Table, alpha: float) -> Data:
    suite = table.suite
    return {
        "name": suite.name, "about": suite.about, "version": tailgate.__version__, "hash": suite.hash, "doses": list(table.doses),
        "shown": {str(dose): why for dose, why in suite.shown.items()}, "limit": CRITICAL, "bound": suite.bound, "alpha": alpha,
        "scenarios": [
            {"name": name, "about": place.about, "robustness": name in suite.robustness, "hash": place.config_hash}
            for name, place in table.scenarios.items()
        ],
        "episodes": max(len(seeds) for seeds in table.seeds.values()), "purpose": table.purpose, "beacon": table.beacon, "rows": table.rows,
    }  # fmt: skip


def _attacks(
    table: Table, lines: dict[str, Admitted | None], origins: dict[str, Row], cells: list[Data], held: Beside | None
) -> list[Data]:  # fmt: skip
    out = []
    told = {} if held is None else {attack["attack"]: attack for attack in held.board["attacks"]}
    files = {key.column.attack: rows[0]["attack_digest"] for key, rows in table.cells.items()}
    for i, column in enumerate(table.columns):
        line = lines.get(column.attack)
        left_out = [name for name in table.scenarios if (table.state[name][:, i] == SKIPPED).all()]
        notes = [f"left out on {', '.join(left_out)}: {_reason(cells, column)}"] if left_out else []
        notes += ["a computed optimum: shown, and not counted"] if table.optimal[column] else []
        notes += ["taken back by an erratum: not counted"] if column.attack in table.withdrawn else []
        out.append({
            "attack": column.attack, "knowledge": column.knowledge, "learned": table.learned[column], "optimal": table.optimal[column],
            "trained_on": origins.get(column.attack, {}).get("defence") or told.get(column.attack, {}).get("trained_on"),
            "digest": told.get(column.attack, {}).get("digest") or files.get(column.attack) or None,
            "admitted": None if line is None else line.as_data(), "note": "; ".join(notes), "withdrawn": column.attack in table.withdrawn,
        })  # fmt: skip
    return out


def _reason(cells: list[Data], column: Column) -> str:
    """Why an attack was left out."""
    mine = (c for c in cells if (c["attack"], c["knowledge"]) == column)
    return next((str(c["reason"]) for c in mine if c["reason"] and not c["failed"]), "")


def _origins(table: Table) -> dict[str, Row]:
    """How each learned attack of the table was trained: the rows' `trained`."""
    found = ((key.column.attack, table.cells[key][0].get("trained")) for key in sorted(table.cells))
    return {attack: origin for attack, origin in found if isinstance(origin, dict)}


def _entry(table: Table, defence: str, levels: dict[str, Worst], slot: int, origins: dict[str, Row], asked: list[Asked] | None) -> Data:
    rows = [row for key in sorted(table.cells) if key.defence == defence for row in table.cells[key]]
    uses = [str(use) for use in rows[0]["uses"]]
    card = _card(defence)
    found = gates(table, defence)
    why = _reference(defence, uses, card) or failure(found) or _incomplete(table, levels["black"])
    status = "unranked" if why else "ranked"
    if not why and asked is not None and (short := _draft(table)):
        status, why = "unranked", short
    if not why and card is None and (how := _claimed(rows)):
        status, why = "unranked", how
    if not why and asked is not None and (missing := _unmet(table, defence, origins, asked)):
        status, why = "unattacked", missing
    whole = {k: worst for k, worst in levels.items() if worst.complete}
    return {
        "defence": defence, "card": None if card is None else card.card(), "uses": uses, "class": class_of(uses),
        "status": status, "why": why, "gates": found, "rank": None, "clean": _clean(table, defence),
        "flags": flags(table, defence, levels, slot, origins), "worst_episode": _episode(table, whole, slot), "stealth": None,
    } | of_worst(table, levels, slot)  # fmt: skip


def of_worst(table: Table, levels: dict[str, Worst], slot: int) -> Data:
    """The figures of an entry that are shares of damage: critical doses, rates and robustness."""
    whole = {k: worst for k, worst in levels.items() if worst.complete}
    critical: dict[tuple[tuple[str, int], ...], Data | None] = {}
    for worst in whole.values():
        if tuple(worst.pairs) not in critical:  # of classes with the same attacks once
            critical[tuple(worst.pairs)] = worst.critical()
    return {
        "critical_dose": {k: critical[tuple(worst.pairs)] if k in whole else None for k, worst in levels.items()},
        "rates": [worst.rate(s) for s in shown(table.suite) for worst in whole.values()],
        "robustness": _robustness(table, whole.get("black"), slot),
    }


def curves(levels: dict[str, Worst]) -> list[Data]:
    """Dose-response curves of an entry, by knowledge."""
    return [worst.curve() for worst in levels.values() if worst.complete and worst.numbers]


def _card(defence: str) -> Entry | None:
    """The card of a built-in defence; a plug-in is somebody else's class like any other. A board must not import what a row names."""
    return _built_in().get(split_text(defence)[0])


@functools.cache
def _built_in() -> dict[str, Entry]:
    return built_in("defence")


def _reference(defence: str, uses: Sequence[str], card: Entry | None) -> str:
    """Why a defence takes no rank whatever it does; empty where it may."""
    if split_text(defence)[0] == CLEAN:
        return "baseline: no defence"
    if "truth" in uses:
        return "reference: is told what is attacked"
    return f"sentinel: useless by design ({card.sentinel})" if card is not None and card.sentinel else ""


def _incomplete(table: Table, worst: Worst) -> str:
    """Else a defence would gain by failing, or by not being attackable, where it is weak."""
    if worst.complete:
        return ""
    if not worst.pairs:
        return "incomplete: no attack was played"
    name, i = worst.lost[0]
    guard = table.defences.index(worst.defence)
    slot = int(np.argmax(table.state[name][guard, i] != PLAYED))
    key = Key(name, slot, worst.defence, table.columns[i])
    reason = next((row["reason"] for row in table.cells.get(key, ()) if row["status"] != "ok"), "not played")
    attacks = len({i for _, i in worst.lost})
    return f"incomplete: {attacks} {'attack' if attacks == 1 else 'attacks'} without full figures, first {named(key)}: {reason}"


def _draft(table: Table) -> str:
    """Why rows are too few, or of seeds that anybody may tune on; empty where they are not."""
    fewest = min(len(seeds) for seeds in table.seeds.values())
    if table.purpose != "report":
        return f"draft: seeds of the purpose {table.purpose}"
    if fewest < table.suite.seeds:
        return f"draft: {fewest} of {table.suite.seeds} episodes"
    for name, seeds in table.seeds.items():
        if set(seeds) != set(numbered(table.beacon, table.suite.name, table.purpose, 0, len(seeds))):
            whose = f"the beacon {table.beacon}" if table.beacon else "the suite, 0, 1, 2, ..."
            return f"draft: the episodes on {name} are not the first ones of {whose}"
    return ""


def _claimed(rows: list[Row]) -> str:
    """Why rows of somebody else's class stand for nothing yet: who made them could have tuned on the episodes, or have run free."""
    if not all((row.get("submission") or {}).get("sandbox") for row in rows):
        return "claimed: not played by leaderboard submit in a sandbox"
    return "" if all(row.get("beacon") for row in rows) else "claimed: played on public seeds"


def _unmet(table: Table, defence: str, origins: dict[str, Row], asked: list[Asked]) -> str:
    """What is missing of the attackers that the suite trains against a defence; empty where nothing is.

    asked: of a suite with a plan (`adaptive`) every scenario that is trained on, learner, knowledge and training seed, trained as the plan
    says, against these very files and this version of the defence, and played wherever the policy fits. Of a suite without one it is
    empty, and any policy will do that was trained against the defence and played everywhere. All this is what the policies' files say.
    """
    guard = table.defences.index(defence)
    row = next(rows[0] for key, rows in table.cells.items() if key.defence == defence)
    own = defence, row["defence_digest"], row.get("versions", {}).get("defence", 1)
    met = [
        (origins[column.attack], {name for name in table.scenarios if (table.state[name][guard, i] == PLAYED).all()})
        for i, column in enumerate(table.columns)
        if column.attack in origins and column.attack not in table.withdrawn
        and tuple(origins[column.attack].get(key, 1) for key in ("defence", "digest", "version")) == own
    ]  # fmt: skip
    if not asked:
        met = [(origin, played) for origin, played in met if played == set(table.scenarios)]
    if not any(played for _, played in met):
        return "no attack that was trained against this defence is among the rows"
    if not asked:
        return ""
    found = {(origin["plan"], origin["seed"]): played for origin, played in met}
    missing = [f"{name} seed {seed}" for name, plan, seed, where in asked if not found.get((plan, seed), set()) >= set(where)]
    return f"{len(missing)} of {len(asked)} of the suite's own trainings are missing, first {missing[0]}" if missing else ""


def _clean(table: Table, defence: str) -> dict[str, Data]:
    """Medians and quartiles of the clean runs, of all nominal scenarios together."""
    rows = [row for name in table.nominal() for row in table.clean.get((name, defence), ())]
    out = {}
    for metric in CLEAN_METRICS:
        values = [row[metric] for row in rows if row[metric] is not None]
        if values:
            low, mid, high = np.quantile(np.sort(values), [0.25, 0.5, 0.75])
            out[metric] = {"median": float(mid), "q25": float(low), "q75": float(high)}
    return out


def _episode(table: Table, whole: dict[str, Worst], slot: int) -> Row | None:
    """The worst episode: a damaged one of the worst attack at the middle dose, else at the smallest shown one at which there is damage,
    the least knowing attacker first. Where nothing is damaged, the one of all attacks and shown doses that came nearest to it."""
    for at in (slot, *shown(table.suite)):
        for worst in whole.values():
            pair, share = worst.at(at)
            if share > 0.0:
                hit = zip(worst.rows(pair, at), worst.harm(pair, at)[1], strict=True)
                return min((row for row, harm in hit if harm), key=_margin)
    most = list(whole.values())[-1:]  # who knows most may do all that the others do
    rows = (row for worst in most for pair in range(len(worst.pairs)) for at in shown(table.suite) for row in worst.rows(pair, at))
    return min(rows, key=_margin, default=None)


def _margin(row: Row) -> float:
    """How far an episode was from damage: its smallest gap; without a road the largest error counts."""
    return float(row["min_gap"] if has_road(row) else -row["max_error"])


def _robustness(table: Table, worst: Worst | None, slot: int) -> list[Data]:
    """The share of undamaged episodes where the plant is another one, and how it differs from the worst of the nominal scenarios."""
    if worst is None:
        return []
    base = worst.undamaged(worst.at(slot, table.nominal())[0], slot)
    out = []
    for name in table.suite.robustness:
        if any(scenario == name for scenario, _ in worst.pairs):
            pair, _ = worst.at(slot, [name])
            value, low = worst.undamaged(pair, slot), 1.0 - worst.bounds(slot, [name])[1]
            out.append({
                "scenario": name, "undamaged": {"value": value, "low": low}, "change": value - base, "worst": worst.named(pair),
            })  # fmt: skip
    return out


def _rank(found: list[Data], levels: Levels, slot: int, alpha: float, held: Beside | None) -> list[Data]:
    """Comparisons within each class; puts the rank sets into the entries that take one. Raises InputError where those that a board has of
    entries that stay do not fit their cells."""
    out: list[Data] = []
    ranked = [entry for entry in found if entry["status"] == "ranked"]
    told = [] if held is None else [duel for duel in held.board["comparisons"] if held.steady >= {duel["a"], duel["b"]}]
    for group in dict.fromkeys(entry["class"] for entry in ranked):
        mine = [entry["defence"] for entry in ranked if entry["class"] == group]
        duels, ranks = compare({name: levels[name]["black"].all_harm(slot) for name in mine}, group, alpha, told)
        made = {(duel["a"], duel["b"]): duel for duel in duels}
        for duel in (duel for duel in told if not duel.get("bound") and (duel["a"], duel["b"]) in made):
            here = made[duel["a"], duel["b"]]
            if not all(np.isclose(here[key], duel[key]) for key in ("only_a", "only_b", "p")):
                expected = f"{here['p']:.3g}, as follows from the cells"
                raise InputError(f"board: comparison of {duel['a']} and {duel['b']}", duel["p"], expected)
        out += duels
        for entry in (entry for entry in ranked if entry["defence"] in ranks):
            entry["rank"] = ranks[entry["defence"]]
    return out
