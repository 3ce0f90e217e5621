"""Consistency of a board: the figures that follow from its cells, without any row.

Shares of damage decide its rates, critical doses, curves and robustness. Damaged episodes decide its comparisons and ranks.
"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

from tailgate.base.errors import InputError
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite
from tailgate.core.threat import KNOWLEDGE
from tailgate.evaluation.attack_list import list_of, taken_back
from tailgate.evaluation.paired import CLOSE, class_of, compare, settled
from tailgate.studies.dose import CRITICAL

from .cells import hits_of, share, table_of, vague
from .damage import doses_of
from .entry import Levels, curves, middle, of_worst, shown
from .files import amended
from .schema import Data
from .worst import Worst

ALPHA = 0.05  # of every board that the commands make


def strays(board: Data, suite: Suite) -> list[Data]:
    """Return figures that do not follow from the board's cells: `defence` (empty: of the board), `field`, the `board`'s value, and `here`.

    A cell that is missing is one that was not played: an entry with figures or a rank needs all. The board has been read by `read_board`;
    raises InputError for a cell that is there twice.
    """
    table, out = table_of(board, suite), []
    held, doses = board["suite"], shown(suite)
    told = {"doses": list(table.doses), "shown": [str(table.doses[dose]) for dose in doses] if suite.shown else [], "bound": suite.bound,
            "progress": suite.progress, "measures": suite.measures}  # fmt: skip
    said = {"doses": held["doses"], "shown": list(held.get("shown", {})), "bound": held.get("bound"), "progress": held.get("progress"),
            "measures": held.get("measures", False)}  # fmt: skip
    out += [_stray("", f"suite.{key}", said[key], told[key]) for key in told if not same(said[key], told[key])]
    for i, cell in enumerate(board["cells"]):
        here = share(int(hits_of(cell).sum()), cell["n"])._asdict() if cell["n"] else None
        if not same(cell["damage"], here):
            out.append(_stray(cell["defence"], f"cells[{i}].damage", cell["damage"], here))
    dose, alpha = middle(suite), held.get("alpha", ALPHA)
    levels: Levels = {name: {k: Worst(table, name, k, alpha) for k in KNOWLEDGE} for name in table.defences}
    for entry in board["entries"]:
        name = entry["defence"]
        if name not in table.defences:
            out.append(_stray(name, "cells", 0, "cells of every attack, scenario and dose"))
            continue
        here = of_worst(table, levels[name], dose) | {"curves": curves(levels[name])}
        mine = entry | {"curves": [curve for curve in board["curves"] if curve["defence"] == name]}
        out += [_stray(name, key, mine.get(key), here[key]) for key in here if not same(mine.get(key), here[key])]
        if entry["status"] != "unranked" and (lost := levels[name]["black"].lost):
            where, attacker = lost[0][0], table.attackers[lost[0][1]]
            out.append(_stray(name, "status", entry["status"], f"unranked: not all cells of {attacker.attack} on {where} are there"))
    return out + _ranks(board, levels, dose, alpha)


def undue(board: Data, suite: Suite, listed: Path | None = None) -> list[Data]:
    """Return what a board decides by itself though the rules do: its limit and level, and attacks that it does not count.

    A computed optimum does not count, nor an attack that an erratum took back: in the list at `listed`, or else in the package's.
    """
    held, out = board["suite"], []
    for key, here in (("limit", CRITICAL), ("alpha", ALPHA)):
        if not same(held.get(key, here), here):
            out.append(_stray("", f"suite.{key}", held[key], here))
    for text in dict.fromkeys(cell["attack"] for cell in board["cells"] if cell.get("optimal")):
        spec = Spec("attack", text)
        with contextlib.suppress(InputError):  # a name that is not known here: its cells cannot be played either
            if spec.imports or not spec.entry.optimal:
                out.append(_stray("", f"attacks: {text}: optimal", True, False))
    marked = {attack["attack"] for attack in board["attacks"] if attack.get("withdrawn")}
    left = sorted(marked.difference(taken_back(list_of(suite, listed))))
    return out + [_stray("", f"attacks: {text}: withdrawn", True, False) for text in left]


def untold(board: Data, suite: Suite) -> list[str]:
    """Return ranked entries whose cells at the dose of the ranks do not all say which episodes came to damage: their p has limits only."""
    withdrawn = {attack["attack"] for attack in board["attacks"] if attack.get("withdrawn")}
    dose = doses_of(suite)[middle(suite)]
    asked = (c for c in board["cells"] if c["dose"] == dose and c["knowledge"] == "black" and not c.get("optimal"))
    unknown = {c["defence"] for c in asked if c["attack"] not in withdrawn and vague(c)}
    return [entry["defence"] for entry in board["entries"] if entry["status"] == "ranked" and entry["defence"] in unknown]


def _ranks(board: Data, levels: Levels, dose: int, alpha: float) -> list[Data]:
    """Return strays among the classes of entries, the comparisons of their pairs, and the ranks that follow."""
    out: list[Data] = []
    groups: dict[str, dict[str, Data]] = {}
    for entry in board["entries"]:
        name, group = entry["defence"], entry.get("class", "")
        if group != (own := class_of(entry.get("uses", ()))):
            out.append(_stray(name, "class", group, own))
        if entry["status"] == "ranked":
            groups.setdefault(group, {})[name] = entry
        elif entry.get("rank") is not None:
            out.append(_stray(name, "rank", entry["rank"], None))
    told = [{key: value for key, value in duel.items() if key != "bound" or value} for duel in board.get("comparisons", ())]
    duels_of = {group: [duel for duel in told if duel.get("class", "") == group] for group in groups}
    if others := len(told) - sum(map(len, duels_of.values())):
        out.append(_stray("", "comparisons", f"{others} of classes that nobody is ranked in", None))
    for group, mine in groups.items():
        if any(name not in levels or not levels[name]["black"].complete for name in mine):
            continue
        said = duels_of[group]
        made, ranks = compare({name: levels[name]["black"].all_harm(dose) for name in mine}, group, alpha, said)
        if not same(said, made):
            pairs = {(duel["a"], duel["b"]): duel for duel in said}
            off = [f"{one['a']} and {one['b']}" for one in made if not same(pairs.get((one["a"], one["b"])), one)]
            here = f"others of {', '.join(off[:2])}" if off else f"{len(made)} of them"
            out.append(_stray("", "comparisons", f"{len(said)} of the class {group}", here))
        out += [_stray(name, "rank", e.get("rank"), ranks[name]) for name, e in mine.items() if not same(e.get("rank"), ranks[name])]
    return out


def sharpened(board: Data, suite: Suite) -> Data:
    """Return the board with its bounds made again of its cells, which may tell more by now, and with the ranks that follow."""
    before = board.get("comparisons", [])
    if not any(duel.get("bound") for duel in before):
        return board
    table, dose, alpha = table_of(board, suite), middle(suite), board["suite"].get("alpha", ALPHA)
    duels: list[Data] = []
    ranks: dict[str, Data] = {}
    for group in dict.fromkeys(duel.get("class", "") for duel in before):
        told = [duel for duel in before if duel.get("class", "") == group]
        names = list(dict.fromkeys(name for duel in told for name in (duel["a"], duel["b"])))
        harm = {name: Worst(table, name, KNOWLEDGE[0], alpha).all_harm(dose) for name in names}
        again = {(duel["a"], duel["b"]): duel for duel in compare(harm, group, alpha, told)[0]}
        made = [again[d["a"], d["b"]] if d.get("bound") else d for d in told]
        new, places = settled(made, names, alpha)
        duels, ranks = duels + new, ranks | places
    return amended(board, {name: {"rank": rank} for name, rank in ranks.items()}, comparisons=duels)


def same(a: object, b: object) -> bool:
    """Return if two pieces of JSON say the same, numbers to six digits."""
    if isinstance(a, dict) and isinstance(b, dict):
        return all(same(a.get(key), b.get(key)) for key in {*a, *b})
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, int | float) and isinstance(b, int | float) and not isinstance(a, bool) and not isinstance(b, bool):
        return math.isclose(a, b, rel_tol=CLOSE, abs_tol=CLOSE)
    return bool(a == b)


def _stray(defence: str, field: str, board: object, here: object) -> Data:
    return {"defence": defence, "field": field, "board": board, "here": here}
