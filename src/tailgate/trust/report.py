"""From the rows of cells to what they say of each defence: a pure function of rows, in the format tailgate-trust-1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tailgate.base.version import VERSION
from tailgate.core.scenario import Suite, list_suites, load_suite
from tailgate.core.threat import KNOWLEDGE
from tailgate.evaluation.paired import Harm, class_of, compare
from tailgate.evaluation.rows import CLEAN

from .cells import Row, runs_of
from .false_alarms import DETECTS, Price, prices, unpaid
from .informs import informedness
from .properties import CONJUNCTIONS
from .statistics import interval, lower

FORMAT = "tailgate-trust-1"
Data = dict[str, Any]
Paid = Mapping[tuple[str, str], Price]  # by defence and scenario: what its clean run says of its alarms


def report(rows: Sequence[Row], suite: Suite, *, alpha: float, settings: Data, clean: Sequence[Row] = ()) -> Data:
    """Return what `check` returns. The rows are those of every defence, scenario, dose and attack of the suite, once each.

    clean: runs without an attack that are no part of the suite, by which alarms are judged.
    """
    formulas = [p["name"] for p in rows[0]["properties"]] if rows and _own(rows) else []
    names = ("trust",) if formulas else tuple(CONJUNCTIONS)
    fixed = settings["rule"]["name"] == "fixed"
    counted = _counted(rows, _whole(suite))
    paid = prices([*rows, *clean], settings["demands"]["false_alarms"], suite.nominal)
    entries = [_entry(defence, counted, rows, alpha, names, fixed, paid) for defence in suite.defences]
    return {
        "format": FORMAT, "suite": {"name": suite.name, "bound": suite.bound}, "version": VERSION, "alpha": alpha,
        "purpose": rows[0]["purpose"], "beacon": rows[0]["beacon"], **settings,
        "scenarios": list(suite.scenarios), "doses": list(suite.doses),
        "attacks": [{"attack": name, "knowledge": _knowledge(rows, name), "note": _note(rows, counted, name)} for name in suite.attacks],
        "formulas": formulas, "defences": entries, "cells": [_cell(row, alpha, names, paid) for row in rows],
        "comparisons": [duel for name in names for duel in _compared(entries, counted, name, alpha)] if fixed else [],
    }  # fmt: skip


def _own(rows: Sequence[Row]) -> bool:
    """Return whether the properties are a user's."""
    return not {p["name"] for row in rows for p in row["properties"]} <= set(CONJUNCTIONS["trust"])


def _whole(suite: Suite) -> bool:
    """Return whether all defences of the suite of this name are in it: what does not fit some of them may fit the others."""
    return suite.name not in list_suites() or set(load_suite(suite.name).defences) <= set(suite.defences)


def _counted(rows: Sequence[Row], whole: bool) -> list[Row]:
    """Return the rows that bounds are over.

    Optima are ceilings, and do not count. A report on the `whole` suite leaves an attack out in a scenario where it fits no defence.
    """
    fits = {(row["scenario"], row["attack"]) for row in rows if row["status"] != "skipped" or not whole}
    return [row for row in rows if not row["optimal"] and (row["scenario"], row["attack"]) in fits]


def _knowledge(rows: Sequence[Row], attack: str) -> str:
    return str(next(row["knowledge"] for row in rows if row["attack"] == attack))


def _note(rows: Sequence[Row], counted: Sequence[Row], attack: str) -> str:
    mine = [row for row in rows if row["attack"] == attack]
    if any(row["optimal"] for row in mine):
        return "a computed optimum: shown, and not counted"
    here = {row["scenario"] for row in counted if row["attack"] == attack}
    out = [row for row in mine if row["scenario"] not in here]
    return f"left out on {', '.join(dict.fromkeys(r['scenario'] for r in out))}: {out[0]['reason']}" if out else ""


def _place(row: Row) -> Data:
    return {"scenario": row["scenario"], "dose": row["dose"], "attack": row["attack"]}


def _entry(
    defence: str, counted: Sequence[Row], rows: Sequence[Row], alpha: float, names: Sequence[str], fixed: bool, paid: Paid
) -> Data:
    mine = [row for row in counted if row["defence"] == defence]
    uses = next(row["uses"] for row in rows if row["defence"] == defence)
    lost = [row for row in mine if row["status"] != "ok"]
    why = "" if fixed else "runs that a rule stopped: for exploring"
    out: Data = {"defence": defence, "uses": uses, "class": class_of(uses), "why": why}
    if lost:
        out["why"] = f"incomplete: {lost[0]['attack']} on {lost[0]['scenario']}: {lost[0]['reason']}"
    free = next(filter(None, (unpaid(row, paid) for row in mine)), "")
    out["why"] = "; ".join(filter(None, (out["why"], free)))
    for name in names:
        known = {level: [row for row in mine if KNOWLEDGE.index(row["knowledge"]) <= KNOWLEDGE.index(level)] for level in KNOWLEDGE}
        out[name] = {level: _bound(known[level], name, alpha, fixed, paid) for level in KNOWLEDGE}
    whole = [row for row in mine if row["status"] == "ok"]
    more = informedness(whole, alpha)
    properties = [*_properties(whole, alpha, paid), *([] if more is None else [more])]
    return out | {"properties": properties, "worst": _failure(whole, names)}


def _bound(rows: Sequence[Row], name: str, alpha: float, fixed: bool, paid: Paid) -> Data | None:
    """Return the least lower limit of a conjunction over cells, each at alpha over their number; None where a cell has no figure.

    Nor has one in which detection is asked for and does not count.
    """
    if not fixed or not rows or any(row["status"] != "ok" or name not in row["conjunctions"] for row in rows):
        return None
    if any(DETECTS in row["conjunctions"][name]["of"] and unpaid(row, paid) for row in rows):
        return None
    part = alpha / len(rows)
    worst = min(rows, key=lambda row: lower(row["conjunctions"][name]["k"], row["n"], part))
    k, n = worst["conjunctions"][name]["k"], worst["n"]
    attacks = list(dict.fromkeys(row["attack"] for row in rows if row["attack"] != CLEAN))
    return {
        "lower": lower(k, n, part), "k": k, "n": n, "of": worst["conjunctions"][name]["of"], **_place(worst), "cells": len(rows),
        "alpha": alpha, "alpha_cell": part, "attacks": attacks, "scenarios": list(dict.fromkeys(row["scenario"] for row in rows)),
    }  # fmt: skip


def _counts(known: Row) -> tuple[int, int]:
    """Return (k, n) of a property: of one with an antecedent, among the runs in which that held."""
    return (known["answered"], known["asked"]) if known["asked"] is not None else (known["k"], known["n"])


def _properties(rows: Sequence[Row], alpha: float, paid: Paid) -> list[Data]:
    """Return the worst cell of each property, with an interval that holds for all cells together; null where it is defined in none.

    Detection has the alarms of the clean runs with it, and is null where it does not count in a scenario.
    """
    out = []
    for name in dict.fromkeys(p["name"] for row in rows for p in row["properties"]):
        held = [(row, p) for row in rows for p in row["properties"] if p["name"] == name]
        asked = [(row, p) for row, p in held if p["formula"] is not None and _counts(p)[1] > 0]
        entry = {"name": name, "about": held[0][1]["about"], "share": None, "antecedent": None, "reason": _why_none(held)}
        free = ""
        if name == DETECTS:
            free = next(filter(None, (unpaid(row, paid) for row, _ in held)), "")
            judged = (paid.get((row["defence"], row["scenario"])) for row, _ in held)
            entry |= {"false_alarms": [price._asdict() for price in dict.fromkeys(judged) if price is not None]}
        if free:
            entry["reason"] = free
        elif asked:
            row, p = min(asked, key=lambda item: (_counts(item[1])[0] / _counts(item[1])[1], -_counts(item[1])[1]))
            k, n = _counts(p)
            share = interval(k, n, 1.0 - alpha / len(asked))._asdict() | {"k": k, "n": n, **_place(row)}
            entry |= {"share": share, "antecedent": _antecedent(row, p), "reason": ""}
        out.append(entry)
    return out


def _why_none(held: Sequence[tuple[Row, Row]]) -> str:
    return next((p["reason"] for _, p in held if p["reason"]), "the antecedent never held")


def _antecedent(row: Row, known: Row) -> Data | None:
    """Return how often the condition of a property held: in how many runs, and at what share of all steps."""
    return None if known["asked"] is None else {"runs": known["asked"], "of": row["n"], "instants": known["instants"]}


def _failure(rows: Sequence[Row], names: Sequence[str]) -> Data | None:
    """Return the worst failing run, of the cell that fails most often: for safety if any run fails it."""
    for name in reversed(names):
        failing = [row for row in rows if name in row["conjunctions"] and row["conjunctions"][name]["k"] < row["n"]]
        if failing:
            worst = min(failing, key=lambda row: row["conjunctions"][name]["k"] / row["n"])
            return {**_place(worst), **worst["worst"], "purpose": worst["purpose"], "cell": worst["cell"]}
    return None


def _cell(row: Row, alpha: float, names: Sequence[str], paid: Paid) -> Data:
    """Return a cell as the report shows it, each interval by itself. Detection that does not count keeps the share that was played."""
    out: Data = {key: row[key] for key in ("scenario", "dose", "defence", "attack", "knowledge", "status", "reason", "n", "verdict")}
    for name in names:
        held = row["conjunctions"].get(name)
        out[name] = None if held is None else {"k": held["k"], **interval(held["k"], row["n"], 1.0 - alpha)._asdict()}
    found = []
    for p in row["properties"]:
        k, n = _counts(p) if p["formula"] is not None else (0, 0)
        share = {"k": k, "n": n, **interval(k, n, 1.0 - alpha)._asdict()} if n else None
        reason = p["reason"] or (unpaid(row, paid) if p["name"] == DETECTS else "") or ("" if share else "the antecedent never held")
        kept = {key: p.get(key) for key in ("name", "formula", "least", "seed")}
        found.append({**kept, "share": share, "antecedent": _antecedent(row, p) if p["formula"] is not None else None, "reason": reason})
    return out | {"properties": found, "worst": row["worst"]}


def _compared(entries: Sequence[Data], counted: Sequence[Row], name: str, alpha: float) -> list[Data]:
    """Compare pairs of a class, each at its own worst black-box cell, on the same seeds (McNemar, exact); only_a: only a fails."""
    out: list[Data] = []
    ready = [entry for entry in entries if entry[name]["black"] is not None]
    for group in dict.fromkeys(entry["class"] for entry in ready):
        harm = {}
        for entry in (e for e in ready if e["class"] == group):
            mine = [row for row in counted if row["defence"] == entry["defence"] and row["knowledge"] == KNOWLEDGE[0]]
            seeds = tuple(range(mine[0]["n"]))  # numbers of the runs, of the same seeds for all
            fails = np.array([~runs_of(row, name) for row in mine], np.float64)
            harm[entry["defence"]] = Harm(seeds, fails, int(np.argmax(fails.sum(axis=1))), np.zeros(len(fails), bool))
        out += [{"of": name, **duel} for duel in compare(harm, group, alpha)[0]]
    return out
