"""One suite on the first page of a board's site: headline table, heat map, detection and comparisons."""

from __future__ import annotations

from collections import Counter

from tailgate.board.attachments import Attachments
from tailgate.board.entry import PROVISIONAL
from tailgate.board.order import GROUPS, ordered
from tailgate.board.schema import LEVELS, CellLine, Data, Dose, Level
from tailgate.board.words import Name, at_least, percent
from tailgate.training import adaptive

from . import alarms, measures
from .cards import attack_cards, suite_of
from .curves import curves_of, stealth_of, together_of
from .searched import found_for, members_of
from .suite import Suite, cell_of, critical_of, dose_text, figure, gates_of, played, share_of, worse
from .timing import flags_of
from .trust import trust_cell, trust_of

OWN = ""  # in place of an attack: all that were trained against the row's defence
TRAINED = Name("made against it", ("the worst",))


def _lines(suite: Suite, measured: Attachments) -> list[Data]:
    ranked = [e for e in suite.board.entries if e.rank]
    out, columns = [], measures.columns_of(suite)
    for i, entry in enumerate(ordered(suite.board.entries)):
        rates = {(r.dose, r.knowledge): share_of(r.undamaged) for r in entry.rates}
        rank = {"text": "\N{EN DASH}", "sort": "", "of": 0}
        if entry.rank:
            best, worst = entry.rank.best, entry.rank.worst
            of = sum(e.class_ == entry.class_ for e in ranked)
            rank["text"] = "alone" if of == 1 else str(best) if best == worst else f"{best}\N{EN DASH}{worst}"
            rank |= {"sort": f"{best + worst / 1000:.3f}", "of": of}
        out.append({
            "index": i, "name": suite.defences[entry.defence], "page": suite.pages.get(entry.defence, ""),
            "class": entry.class_ or "not stated", "rank": rank,
            "critical": [critical_of(suite, entry, level) for level in ("black", "white")],
            "rates": [{level: rates.get((dose, level), share_of(None)) for level in LEVELS} for dose in suite.shown],
            "measures": measures.cells_of(suite, entry, columns), "trust": trust_cell(suite, entry), "gates": gates_of(entry),
            "flags": [*entry.flags, *flags_of(measured.timing, entry.defence), *alarms.drifts_of(suite, entry.defence)],
            "status": entry.status, "why": entry.why, "own": entry.why.startswith(PROVISIONAL),
        })  # fmt: skip
    return out


def heat_of(suite: Suite) -> Data | None:
    """Return the heat map: its heads and rows at the middle dose, and all figures for the menus."""
    board = suite.board
    if not board.cells:
        return None
    kept = {(c.scenario, c.dose, c.defence, c.attack, c.knowledge): c for c in board.cells}
    withdrawn = {a.attack for a in board.attacks if a.withdrawn}
    optimal = {(c.attack, c.knowledge) for c in board.cells if c.optimal}
    apart = optimal | {(c.attack, c.knowledge) for c in board.cells if c.attack in withdrawn}
    learned = {(c.attack, c.knowledge) for c in board.cells if c.learned}
    own = _trained_for(suite)
    scripts = {c.knowledge for c in board.cells if c.attack in own and not c.learned}  # searched attacks are learned in part
    columns = list(dict.fromkeys((OWN if c.attack in own else c.attack, c.knowledge) for c in board.cells))
    columns.sort(key=lambda c: (c in optimal, LEVELS.index(c[1]), c[0] != OWN))
    heads = [
        {"name": TRAINED if a == OWN else suite.attacks[a], "knowledge": k, "optimal": (a, k) in optimal,
         "learned": (k not in scripts) if a == OWN else (a, k) in learned or suite.attacks[a].policy}
        for a, k in columns
    ]  # fmt: skip
    scenarios = [s.name for s in board.suite.scenarios]
    entries = ordered(suite.board.entries)
    first = None if len(scenarios) > 1 else scenarios[0]  # None: the worst of all

    def look(where: list[str], dose: Dose, defence: str, column: tuple[str, Level]) -> CellLine | None:
        mine = [a for a, d in own.items() if d == defence and a not in withdrawn] if column[0] == OWN else [column[0]]
        return worse(kept.get((s, dose, defence, a, column[1])) for s in where for a in mine)

    rows = []
    for i, entry in enumerate(entries):
        parts = [look(scenarios if first is None else [first], suite.middle, entry.defence, column) for column in columns]
        counted = worse(p for p, column in zip(parts, columns, strict=True) if column not in apart)
        cells = [cell_of(p, board.suite.limit) for p in parts]
        rows.append({"index": i, "name": suite.defences[entry.defence], "page": suite.pages.get(entry.defence, ""), "cells": cells,
                     "worst": cell_of(counted, board.suite.limit), "status": entry.status})  # fmt: skip
    reasons: dict[str, int] = {"": 0}
    figures = []
    for scenario in scenarios:
        for dose in board.suite.doses:
            grid = [_packed(look([scenario], dose, e.defence, c), reasons) for e in entries for c in columns]
            figures.append(grid)
    data = {
        "scenarios": len(scenarios), "doses": len(board.suite.doses), "columns": len(columns), "limit": board.suite.limit,
        "apart": [int(c in apart) for c in columns], "reasons": list(reasons), "figures": figures,
    }  # fmt: skip
    doses = [{"text": dose_text(d), "chosen": d == suite.middle} for d in board.suite.doses]
    groups = [(title, [r for r in rows if r["status"] == status]) for status, title, _ in GROUPS]
    return {
        "heads": heads, "groups": [g for g in groups if g[1]], "data": data, "doses": doses, "scenarios": scenarios, "all": first is None,
        "apart": bool(apart),
    }  # fmt: skip


def _trained_for(suite: Suite) -> dict[str, str]:
    """Return learned attacks that only their own defence has met, and this defence: one column shows them all."""
    met: dict[str, set[str]] = {}
    for cell in suite.board.cells:
        met.setdefault(cell.attack, set()).add(cell.defence)
    return {a.attack: a.trained_on for a in suite.board.attacks if a.trained_on and met.get(a.attack) == {a.trained_on}}


def _packed(cell: CellLine | None, reasons: dict[str, int]) -> int | list[float | int | None]:
    """Return 0 for no cell, else [share, low, high, episodes, failed, index of the reason]; the share is null without figures."""
    if cell is None:
        return 0
    reason = reasons.setdefault(cell.reason, len(reasons))
    if cell.damage is None:
        return [None, 0, 0, cell.n, cell.failed, reason]
    return [cell.damage.value, round(cell.damage.low, 4), round(cell.damage.high, 4), cell.n, cell.failed, reason]


def detection_of(suite: Suite) -> Data | None:
    """Return the second board: the detected share of the attack that each defence detects least, by time between false alarms."""
    if suite.board.detection is None or not suite.board.detection.entries:
        return None
    hours, cases = suite.board.detection.hours, suite.board.detection.entries
    rows = []
    for defence in dict.fromkeys(c.defence for c in cases):
        cells = []
        for hour in hours:
            known = [c for c in cases if c.defence == defence and c.hours == hour and c.detected is not None]
            mean = sum(c.detected.value for c in known if c.detected) / max(len(known), 1)
            least = min(known, key=lambda c: c.detected.value if c.detected else 0.0, default=None)
            if least is None or least.detected is None:
                cells.append({"text": "\N{EN DASH}", "sort": "", "least": "", "low": "", "about": "", "delay": "", "rarer": False})
                continue
            cells.append({
                "text": percent(mean), "sort": f"{mean:.6g}", "least": percent(least.detected.value), "low": at_least(least.detected.low),
                "about": suite.where(least.scenario, least.attack), "delay": figure(least.delay, 3) if least.delay is not None else "",
                "rarer": any(c.rarer for c in known),
            })  # fmt: skip
        watched = any(c.watched for c in cases if c.defence == defence)
        rows.append({"name": suite.defences[defence], "page": suite.pages.get(defence, ""), "cells": cells, "watched": watched})
    some = {"watched": any(r["watched"] for r in rows), "rarer": any(case.rarer for case in cases)}
    each = _each_attack(suite, alarms.middle(suite))
    return {"hours": [figure(h) for h in hours], "rows": rows, **some, "alarms": alarms.together_of(suite), "each": each}


def _each_attack(suite: Suite, hour: float) -> Data:
    """Return the share of each attack that each defence detects, in its worst scenario, at one time between false alarms."""
    assert suite.board.detection is not None
    cases = [c for c in suite.board.detection.entries if c.hours == hour]
    names = list(dict.fromkeys(c.attack for c in cases))
    least: dict[tuple[str, str], float] = {}
    for case in cases:
        if case.detected is not None:
            key = case.defence, case.attack
            least[key] = min(least.get(key, 1.0), case.detected.value)
    defences = list(dict.fromkeys(c.defence for c in cases))
    rows = [
        {"name": suite.attacks[a], "cells": [percent(least[g, a]) if (g, a) in least else "\N{EN DASH}" for g in defences]} for a in names
    ]
    heads = [{"name": suite.defences[g], "page": suite.pages.get(g, "")} for g in defences]
    silent = any(suite.attacks[a].base == "dropout" for a in names)
    return {"hour": figure(hour), "heads": heads, "rows": rows, "silent": silent}


def comparisons_of(suite: Suite, defence: str | None = None) -> list[Data]:
    """Return pairs of a class, and which of the two is surely weaker; for one defence only its own pairs."""
    out = []
    wide = {duel.class_ for duel in suite.board.comparisons if duel.bound}  # whose corrected p are no smaller than of all that is known
    for duel in suite.board.comparisons:
        if defence in (None, duel.a, duel.b):
            weaker = duel.weaker or (duel.a if duel.only_a > duel.only_b else duel.b)
            sure = duel.adjusted <= suite.board.suite.alpha and (duel.weaker is not None or duel.only_a != duel.only_b)
            most = "≤ " if duel.bound and min(duel.only_a, duel.only_b) > 0 else ""  # as many on both sides could be fewer
            out.append({
                "class": duel.class_ or "not stated", "a": suite.defences[duel.a], "b": suite.defences[duel.b],
                "only_a": f"{most}{duel.only_a}", "only_b": f"{most}{duel.only_b}", "p": _small(duel.p, duel.bound),
                "adjusted": _small(duel.adjusted, duel.class_ in wide), "sort_a": duel.only_a, "sort_b": duel.only_b,
                "sort": f"{duel.p:.6g}", "sort_adjusted": f"{duel.adjusted:.6g}", "weaker": suite.defences[weaker] if sure else None,
            })  # fmt: skip
    return out


BOUND = (
    " ≤: the board knows how many episodes came to damage, but not which: the largest p that these numbers allow, and the largest number "
    "of episodes. In a class with such pairs the corrected p has the mark too."
)


def compared_how(suite: Suite) -> str:
    """Return the test of the comparisons in a sentence; boards that do not say who is weaker were made with a simpler one."""
    alpha = figure(suite.board.suite.alpha)
    if not any(duel.weaker for duel in suite.board.comparisons):
        return f"Each at its own worst case at the middle dose, on the same seeds: McNemar's exact test, corrected after Holm, at {alpha}."
    return (
        "One is surely weaker where its worst attack at the middle dose does more damage than every attack of the other does to that one, "
        "on the same seeds: McNemar's exact tests, the largest p of them (intersection-union), times the number of attacks that the worst "
        f"was chosen from (Bonferroni), two-sided, and corrected after Holm for the pairs of the class, at {alpha}."
        + (BOUND if any(duel.bound for duel in suite.board.comparisons) else "")
    )


def _small(p: float, bound: bool = False) -> str:
    if bound and 1e-4 <= p < 1.0:
        return f"≤ {_small(p)}"
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}" if p < 0.1 else f"{p:.2f}"


WHOLE = ({"ppo", "cem"}, {"black", "grey"}, 5)  # learners, knowledge and training seeds of the full plan


def ranked_against(suite: Suite) -> str:
    """Return which attackers a rank asks for; empty where nobody can tell."""
    own = suite_of(suite.board.suite.name, suite.board.suite.hash)
    if own is None or not own.adaptive:
        return ""
    plan = adaptive.plan_of(own)
    if plan.ensemble and not plan.learners:
        return f"the standard attack ensemble, budget {plan.ensemble}, which searches against each defence"
    learners = " and ".join(name.upper() for name in plan.learners)
    said = f"{learners}, {' and '.join(plan.knowledge)} box, {plan.seeds} training seeds of each"
    less = not ({*plan.learners} >= WHOLE[0] and {*plan.knowledge} >= WHOLE[1] and plan.seeds >= WHOLE[2])
    return said + (" (less than the full plan: PPO and CEM, black and grey box, 5 seeds)" if less else "")


def attacks_of(suite: Suite) -> list[Data]:
    """Return the lines of a board's attacks, for the table of the first page."""
    own, out = suite_of(suite.board.suite.name, suite.board.suite.hash), []
    apart = found_for(suite).keys() - set(own.attacks if own else ())  # they have a table for themselves
    for attack in (one for one in suite.board.attacks if one.attack not in apart):
        late = own is not None and attack.attack not in own.attacks and not attack.attack.endswith(".json")
        admitted = "met later, outside the suite" if late else "with the suite"
        admitted = admitted if attack.admitted is None else _admitted(attack.admitted)
        name = suite.attacks[attack.attack]
        on = suite.defences[attack.trained_on] if attack.trained_on else None
        out.append({"name": name, "knowledge": attack.knowledge, "learned": attack.learned or name.policy, "optimal": attack.optimal,
                    "trained_on": on, "admitted": admitted, "note": attack.note})  # fmt: skip
    return out


def _admitted(line: Data) -> str:
    """Return when, and by which test an attack was admitted: of those that it wins the one with the smallest p."""
    tests = [test for test in line.get("evidence", ()) if isinstance(test, dict) and isinstance(test.get("adjusted"), int | float)]
    won = [test for test in tests if (test.get("only_new") or 0) > (test.get("only_worst") or 0)]
    best = min(won, key=lambda test: test["adjusted"], default=None)
    if best is None:
        return "; ".join(f"{k} {v}" for k, v in line.items() if isinstance(v, str) and v)
    gain = f"{best.get('only_new')} of {best.get('episodes')} episodes of {best.get('defence')} that the worst before did not damage"
    asked = f"dose {best.get('dose')}; p {_small(best['adjusted'])}, adjusted for {len(tests)} tests, at level {best.get('level', 0.0):.2g}"
    return f"{line.get('date', '')}: {gain}, {best.get('only_worst')} the other way, {asked}"


def checked_of(suite: Suite) -> str:
    """Return how many entries' rows, and how many cells of the board alone, came out equal when played again; empty for none."""
    entries, said = suite.board.entries, []
    if checks := [entry.verified for entry in entries if entry.verified is not None]:
        equal, differs, unchecked = sum(v.verified for v in checks), sum(v.differs for v in checks), sum(v.unchecked for v in checks)
        rows = played(max(sum(v.rows for v in checks), suite.board.suite.rows or 0), equal, differs, unchecked, "rows")
        said.append(f"rows of {sum(v.sound for v in checks)} of {len(entries)} entries replayed without a difference: {rows}")
    if held := [entry.checked for entry in entries if entry.checked is not None]:
        equal, differs, unchecked = sum(c.equal for c in held), sum(c.differs for c in held), sum(c.unchecked for c in held)
        cells = played(len(suite.board.cells), equal, differs, unchecked, "cells")
        said.append(f"played again from the board alone, without rows: {cells}")
    return "; ".join(said)


def _group(title: str, about: str, rows: list[Data]) -> Data:
    """Return entries of one status. A reason that most of them share is given once, above them."""
    reasons = Counter(row["why"] for row in rows if row["why"])
    shared, n = reasons.most_common(1)[0] if reasons else ("", 0)
    if n < 2 or 2 * n <= len(rows):
        shared = ""
    return {"title": title, "about": about, "rows": rows, "shared": shared, "scope": "all" if n == len(rows) else "unless said otherwise"}


def section(suite: Suite, measured: Attachments) -> Data:
    """Return all that index.html shows of a suite."""
    board = suite.board
    rows = _lines(suite, measured)
    groups = [_group(t, about, [r for r in rows if r["status"] == s]) for s, t, about in GROUPS]
    doses = [{"text": dose_text(d), "why": board.suite.shown.get(str(d), "")} for d in suite.shown]
    return {
        "suite": board.suite, "round": suite.round, "checked": checked_of(suite),
        "trust": trust_of(suite), "damage": suite.damage, "folder": suite.folder,
        "count": len(rows), "several": len(board.suite.doses) > 1, "doses": doses, "measures": measures.columns_of(suite),
        "all_doses": ", ".join(dose_text(d) for d in board.suite.doses), "limit": percent(board.suite.limit),
        "level": percent(1.0 - board.suite.alpha),
        "groups": [g for g in groups if g["rows"]], "classes": sorted({r["class"] for r in rows}),
        "statuses": [s for s, *_ in GROUPS if any(r["status"] == s for r in rows)], "levels": LEVELS,
        "heat": heat_of(suite), "scale": suite.scale, "together": together_of(suite), "curves": curves_of(suite),
        "stealth": stealth_of(suite), "detection": detection_of(suite), "comparisons": comparisons_of(suite), "attacks": attacks_of(suite),
        "members": members_of(suite),
        "how": compared_how(suite), "attack_cards": attack_cards(suite), "errata": measured.superseded(),
        "ranked_against": ranked_against(suite),
        "run": measured.run.said(board.suite.rows) if measured.run is not None and board.suite.rows is not None else "",
    }  # fmt: skip
