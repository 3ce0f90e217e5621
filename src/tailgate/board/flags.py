"""Flags: what the rows of an entry say that a reader should know before believing its figures."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from tailgate.core import Array
from tailgate.evaluation.paired import apart, mcnemar
from tailgate.evaluation.rows import Row

from .damage import MISSING, PLAYED, Key, Table
from .worst import Worst

SPENT = 0.9  # of the budget, by the mean of the episodes without damage: those that end early leave some
LEVEL = 0.05
UNSPENT = "unspent budget: the worst attack"
TRANSFERRED = "transferred beats own"
BEATEN = "black box beats grey and white box: those who know more were not made to use it"
SPREAD = 0.2  # between the training seeds of one plan, of the share of damage


def flags(
    table: Table, defence: str, levels: dict[str, Worst], dose: int, origins: dict[str, Row], trained: dict[str, str]
) -> list[str]:  # fmt: skip
    """Return the flags of one entry.

    origins: how each learned attack was trained, as far as that is known; trained: the defence that an attack was made against.
    """
    return [*of_attacks(table, defence, levels, dose, trained), *_trainings(table, defence, dose, origins)]


def of_attacks(table: Table, defence: str, levels: dict[str, Worst], dose: int, trained: dict[str, str]) -> list[str]:
    """Return all flags but those of training; `trained`: the defence that each learned attack was trained on."""
    out = [*_failures(table, defence), *_unspent(table, levels, dose)]
    for knowledge in levels:
        out += _transferred(table, defence, levels[knowledge], dose, trained)
    return [*dict.fromkeys(out), *_weaker(levels, dose)]


def standing(told: Sequence[str], levels: dict[str, Worst], dose: int, added: Collection[str], own: bool) -> list[str]:
    """Return the flags of an entry that hold when it has met more attacks.

    Those of a worst attack hold where that is still the same one. Those that others do more than the entry's own attackers hold unless some
    of these are among the new ones (`own`).
    """
    worst = [one.named(one.at(dose)[0]) for one in levels.values() if one.complete]
    same = not any(one["attack"] in added for one in worst)
    kept = tuple(f"{UNSPENT}, {one['attack']} on {one['scenario']}," for one in worst)
    gone = (UNSPENT, *((TRANSFERRED,) if own else ()), *(() if same else (BEATEN,)))
    return [flag for flag in told if flag.startswith(kept) or not flag.startswith(gone)]


def _trainings(table: Table, defence: str, dose: int, origins: dict[str, Row]) -> list[str]:
    """Return flags of the trainings against this defence: unfinished, or a matter of the seed's luck."""
    index = table.defences.index(defence)
    met = [any((state[index, i] != MISSING).any() for state in table.state.values()) for i in range(len(table.attackers))]
    mine = [i for i, attacker in enumerate(table.attackers) if met[i] and origins.get(attacker.attack, {}).get("defence") == defence]
    rising = sum(bool(origins[table.attackers[i].attack].get("rising")) for i in mine)
    out = [f"still learning: the curves of {rising} of {len(mine)} attackers rose when training ended"] if rising else []
    plans = dict.fromkeys(origins[table.attackers[i].attack].get("plan") for i in mine)
    for name in table.nominal()[:1]:
        for plan in plans:
            state = table.state[name][index, :, dose]
            same = [i for i in mine if origins[table.attackers[i].attack].get("plan") == plan and state[i] == PLAYED]
            shares = [float(table.harm[name][index, i, dose].mean()) for i in same]
            if len(shares) > 1 and max(shares) - min(shares) > SPREAD:
                span = f"{100 * min(shares):.0f} to {100 * max(shares):.0f} %"
                level = table.attackers[same[0]].knowledge
                out.append(f"seeds differ: {len(shares)} trainings of one plan ({level} box) do {span} damage on {name}")
    return out


def _failures(table: Table, defence: str) -> list[str]:
    """Return flags of cells with failed rows: the reason says if a batch's rows depended on one another."""
    reasons: dict[str, int] = {}
    for key, rows in sorted(table.cells.items()):
        if key.defence == defence:
            for row in rows:
                if row["status"] == "error":
                    reasons[row["reason"]] = reasons.get(row["reason"], 0) + 1
    return [f"failed: {count} {'episode' if count == 1 else 'episodes'}: {reason}" for reason, count in reasons.items()]


def _unspent(table: Table, levels: dict[str, Worst], dose: int) -> list[str]:
    """Return a flag where the worst attack kept budget back in episodes that it did not win, as far as it has rows."""
    budget, out = table.doses[dose], []
    for worst in levels.values():
        if not budget or not worst.complete:
            continue
        pair, _ = worst.at(dose)
        name, i = worst.pairs[pair]
        rows = table.cells.get(Key(name, dose, worst.defence, table.attackers[i]), ())
        _, harm = worst.harm(pair, dose)
        left = [row["attack_steps"] for row, hit in zip(rows, harm, strict=bool(rows)) if not hit]
        if left and float(np.mean(left)) < SPENT * budget:
            spends = f"spends {np.mean(left):.1f} of {budget} steps where it does no damage"
            out.append(f"{UNSPENT}, {table.attackers[i].attack} on {name}, {spends}")
    return out


def _transferred(table: Table, defence: str, worst: Worst, dose: int, trained: dict[str, str]) -> list[str]:
    """Return flags of policies trained on another defence that surely do more damage than every own one that knows as much."""
    out = []
    index = table.defences.index(defence)
    for name in table.scenarios:
        mine: list[tuple[str, Array]] = []
        others: list[tuple[str, Array]] = []
        for i in (i for scenario, i in worst.pairs if scenario == name):
            attacker = table.attackers[i]
            if attacker.knowledge != worst.knowledge or attacker.attack not in trained or table.state[name][index, i, dose] != PLAYED:
                continue
            (mine if trained[attacker.attack] == defence else others).append((attacker.attack, table.harm[name][index, i, dose]))
        if not mine or not others:
            continue
        best, own = max(mine, key=lambda held: float(held[1].mean()))
        unknown = {k.attacker.attack for k in table.vague if (k.scenario, k.dose, k.defence) == (name, dose, defence)}
        vague = best in unknown
        for attack, harm in others:
            more, less = surely(harm, own, vague or attack in unknown)
            if more > less and mcnemar(more, less) * len(others) <= LEVEL:
                out.append(f"{TRANSFERRED}: {attack}, trained on {trained[attack]}, on {name} ({worst.knowledge} box)")
    return out


def surely(x: Array, y: Array, vague: bool) -> tuple[int, int]:
    """Return in how many episodes x alone and y alone show damage; as many as can be where only numbers are known."""
    more, less = apart(x, y[None], np.array([vague]))
    return int(more[0]), int(less[0])


def _weaker(levels: dict[str, Worst], dose: int) -> list[str]:
    """Return a flag where attackers that know more surely do less than black boxes alone: they were not looked for."""
    black, white = levels["black"], levels["white"]
    if not (black.complete and white.complete):
        return []
    more = [k for k, (_, i) in enumerate(white.pairs) if white.table.attackers[i].knowledge != "black"]
    if not more:
        return []
    best = max(more, key=lambda k: float(white.shares[k, dose]))
    pair, _ = black.at(dose)
    (seeds, x), (others, y) = black.harm(pair, dose), white.harm(best, dose)
    unknown = any(worst.vague(k, dose) for worst, k in ((black, pair), (white, best)))
    if seeds != others or mcnemar(*surely(x, y, unknown)) > LEVEL or x.mean() <= y.mean():
        return []
    return [BEATEN]
