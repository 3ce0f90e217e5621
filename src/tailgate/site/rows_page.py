"""The page of rows, without gates and limits of a board: index.html, and its figures in summary.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic, write_html
from tailgate.board.damage import has_road
from tailgate.board.entry import reference
from tailgate.board.schema import Data
from tailgate.board.words import Name, names_of, percent, shade, spans, steps, ticks
from tailgate.core.registry import Entry, entries
from tailgate.evaluation.rows import IF_ANY, KEYS
from tailgate.evaluation.summary import summarise
from tailgate.play.metrics import METRICS

from .pages import TITLE, encoded, render

COLUMNS = (  # of the table of every cell, after the crash share: key of the summary, heading
    ("min_gap", "Min. gap [m]"), ("max_error", "Max. error [m]"), ("alarm_onsets", "Alarm onsets"),
    ("attack_steps", "Attack steps"),
)  # fmt: skip
STYLES = 8  # line styles of the learning curve


@dataclass(frozen=True)
class _Words:
    """Names of components in the rows, and the cards of registered ones."""

    defence: dict[str, Name]
    attack: dict[str, Name]
    defences: dict[str, Entry]
    attacks: dict[str, Entry]


def _cell(entry: Data, words: _Words, most: float | None) -> Data:
    """Return a cell with its figure: the share of collisions, or the median of the largest error, which is shaded up to `most`."""
    attack = words.attack[entry["attack"]]
    out = entry | {"defence": words.defence[entry["defence"]], "attack": attack, "learned": entry["learned"] or attack.policy}
    crash, failed, reason = entry["crash"], entry["failed"], entry["reason"]
    if crash is None:
        what = "not played" if not reason and not failed else "failed" if failed else "skipped"
        why = ": ".join(filter(None, (what, reason)))
        return out | {"text": "n/a", "shade": "na", "label": why, "why": why, "lost": True}
    why = f"{failed} more failed: {reason}" if failed else ""
    if most is None:
        low, high = percent(crash["low"]), percent(crash["high"])
        label = f"95% interval {low} to {high}, {entry['n']} episodes"
        out |= {"value": crash["value"], "low": low, "high": high, "text": percent(crash["value"]), "shade": shade(crash["value"])}
    else:
        value, low, high = (entry["max_error"][key] for key in ("median", "q25", "q75"))
        label = f"quartiles {low:.4g} to {high:.4g}, {entry['n']} episodes"
        out |= {"value": value, "text": f"{value:.4g}", "shade": shade(value / most if most > 0.0 else 0.0)}
    out |= {"why": why, "lost": failed > 0}
    return out | {"label": "; ".join(filter(None, (label, why)))}


def _line(text: str, cells: list[Data], uses: set[str], words: _Words) -> Data:
    """Return a defence's row of the heat map. Its worst case is over attacks that do not know the best answer beforehand."""
    name = words.defence[text]
    against = [c for c in cells if not c["optimal"]]
    known = [c for c in against if c["crash"]]
    lost = sum(c["lost"] for c in against)
    why = reference(text, uses, words.defences.get(name.base))
    if not why and lost:  # else a defence would gain by failing, or by not being attackable, where it is weak
        why = f"incomplete: {lost} {'attack' if lost == 1 else 'attacks'} without full figures"
    if not why and not known:
        why = "no figures"
    values = [c["value"] for c in known]
    worst = max(known, key=lambda c: c["value"], default=None)
    order = (bool(why), max(values, default=math.inf), sum(values) / max(len(values), 1))
    return {"name": name, "cells": cells, "why": why, "worst": worst, "known": len(known), "of": len(against), "order": order}


def _section(key: tuple[Any, ...], group: Sequence[Data], rows: Sequence[Data], words: _Words) -> Data:
    """Return one suite, scenario and dose: a row per defence; a column per attack, twice where its knowledge differs."""
    kept: dict[tuple[str, str, str], Data] = {}
    for e in group:
        before = kept.setdefault((e["defence"], e["attack"], e["knowledge"]), e)
        if differs := [name for name in (*KEYS, *IF_ANY) if e[name] != before[name]]:
            where = f"rows of {e['scenario']}, {e['defence']}, {e['attack']}: {differs[0]}"
            raise InputError(where, [before[differs[0]], e[differs[0]]], "one: a cell of a page has one figure, so build a page of each")
    columns = list(dict.fromkeys((e["attack"], e["knowledge"]) for e in group))
    marks = {c: {k: any(e[k] for e in group if e["attack"] == c[0]) for k in ("learned", "optimal")} for c in columns}
    road = any(has_road(row) for row in rows if row["status"] == "ok") or not any(row["status"] == "ok" for row in rows)
    most = None if road else max((e["max_error"]["median"] for e in group if e["crash"]), default=0.0)
    lines = []
    for text in dict.fromkeys(e["defence"] for e in group):
        cells = []
        for column in columns:
            place = {"defence": text, "attack": column[0], "knowledge": column[1]}
            missing = place | {"n": 0, "failed": 0, "reason": "", "crash": None} | marks[column]
            cells.append(_cell(kept.get((text, *column), missing), words, most))
        uses = {use for row in rows if row["defence"] == text for use in row.get("uses", ())}
        lines.append(_line(text, cells, uses, words))
    lines.sort(key=lambda line: line["order"])
    ranked = [line for line in lines if not line["why"]]
    for line in ranked:  # equal worst cases share a rank
        line["rank"] = 1 + sum(other["order"][1] < line["order"][1] for other in ranked)
    heads = []
    for column in columns:
        name = words.attack[column[0]]
        card = words.attacks.get(name.base)
        learned = marks[column]["learned"] or name.policy
        about = card.summary if card else ""
        heads.append({"name": name, "knowledge": column[1], "about": about, **marks[column], "learned": learned})
    bodies = [("", ranked), ("Unranked, for comparison", [line for line in lines if line["why"]])]
    return {
        "suite": key[0], "scenario": key[1], "dose": key[2], "heads": heads, "lines": lines, "road": road,
        "bodies": [(title, body) for title, body in bodies if body],
        "n": spans(e["n"] for e in group if e["n"]), "hashes": _distinct(rows, "config_hash"),
    }  # fmt: skip


def _cards(words: _Words, family: str) -> list[Data]:
    """Return one card per component in the rows, with the variants that were played."""
    used, known = (words.defence, words.defences) if family == "defence" else (words.attack, words.attacks)
    out: dict[str, Data] = {}
    for name in used.values():
        title, entry = name.base or name.label, known.get(name.base)
        card = out.setdefault(title, {"title": title, "card": {"sentinel": ""} | entry.card() if entry else None, "played": []})
        if name.policy or name.params:
            card["played"].append(name.full if name.policy else ", ".join(name.params))
    return list(out.values())


def _distinct(rows: Sequence[Data], key: str) -> list[str]:
    return sorted({str(row[key]) for row in rows if row.get(key) not in (None, "")})


def _numbers(where: str, item: object, keys: Sequence[str]) -> list[float]:
    if not isinstance(item, Mapping):
        raise InputError(where, item, f"a mapping with {', '.join(keys)}")
    out = []
    for key in keys:
        value = item.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{where}.{key}", value, "a finite number")
        out.append(float(value))
    return out


def _headline(data: Data | None) -> Data | None:
    """Return dots and intervals as places on an axis in percent; the axis has a negative half where a value needs it."""
    if data is None:
        return None
    points = []
    for i, item in enumerate(data.get("items", [])):
        value, low, high = _numbers(f"headline.items[{i}]", item, ("value", "low", "high"))
        if not -1 <= low <= value <= high <= 1:
            raise InputError(f"headline.items[{i}]", (low, value, high), "low <= value <= high within -1 to 1")
        points.append((str(item.get("label", "")), str(item.get("note", "")), value, low, high))
    start = -1.0 if any(low < 0 for *_, low, _ in points) else 0.0

    def at(x: float) -> float:
        return round(100 * (x - start) / (1 - start), 2)

    items = [
        {
            "label": label, "note": note, "x": at(v), "low": at(a), "high": at(b),
            "value": percent(v), "span": f"{percent(a)} to {percent(b)}",
        }
        for label, note, v, a, b in points
    ]  # fmt: skip
    ticks = [{"x": at(t), "text": percent(t)} for t in (start, (start + 1) / 2, 1.0)]
    return {"text": str(data.get("text", "")), "items": items, "ticks": ticks, "zero": at(0.0)}


def _curve(data: Sequence[Data] | None) -> Data | None:
    """Return one polyline per seed on a 1000 x 1000 field, and its figures in words."""
    runs: dict[int, list[tuple[float, float]]] = {}
    for i, point in enumerate(data or ()):
        seed, at, crash = _numbers(f"curve[{i}]", point, ("seed", "steps", "crash"))
        if at < 0 or not 0 <= crash <= 1:
            raise InputError(f"curve[{i}]", (at, crash), "steps not below 0, and a share of crashed episodes")
        runs.setdefault(int(seed), []).append((at, crash))
    if not runs:
        return None
    end = max(x for run in runs.values() for x, _ in run) or 1.0
    lines = []
    for i, (seed, run) in enumerate(sorted(runs.items())):
        run.sort()
        lines.append({
            "seed": seed, "style": i % STYLES, "first": percent(run[0][1]), "last": percent(run[-1][1]),
            "peak": percent(max(y for _, y in run)), "steps": steps(run[-1][0]),
            "points": " ".join(f"{1000 * x / end:.1f},{1000 - 1000 * y:.1f}" for x, y in run),
        })  # fmt: skip
    return {"lines": lines, "ticks": ticks(end)}


def build(
    rows: Sequence[Data], out: Path, *, title: str | None = None, curve: list[Data] | None = None, headline: Data | None = None,
    learned: Data | None = None,
) -> Path:  # fmt: skip
    """Write out/index.html and out/summary.json from evaluation rows, and return the path of the page.

    curve: [{steps, seed, crash}] of a training run; headline: {text, items: [{label, value, low, high, note}]}; shares are 0 to 1.
    learned: what `learned.learned` returns.
    Raises InputError for no rows, and for a curve or headline that cannot be drawn.
    """
    if not rows:
        raise InputError("rows", list(rows), "at least one row of an evaluation")
    cells = summarise(rows)
    words = _Words(names_of(c["defence"] for c in cells), names_of(c["attack"] for c in cells), entries("defence"), entries("attack"))
    groups: dict[tuple[Any, ...], tuple[list[Data], list[Data]]] = {}
    for i, kind in enumerate((cells, rows)):
        for item in kind:
            groups.setdefault((item["suite"], item["scenario"], item["dose"]), ([], []))[i].append(item)
    facts = {
        "rows": len(rows), "played": sum(row["status"] == "ok" for row in rows), "seeds": spans(row["seed"] for row in rows),
        "purposes": _distinct(rows, "purpose"), "versions": _distinct(rows, "version"), "engines": _distinct(rows, "engine"),
    }  # fmt: skip
    title = title or TITLE
    columns = [(key, text, METRICS[key].__doc__ or "") for key, text in COLUMNS]
    page = render(
        "rows_page.html", title=title, columns=columns, facts=facts, headline=_headline(headline), curve=_curve(curve), learned=learned,
        sections=[_section(key, *group, words) for key, group in groups.items()],
        families=[("Defences", _cards(words, "defence")), ("Attacks", _cards(words, "attack"))],
    )  # fmt: skip
    summary = {"title": title, **facts, "cells": cells, "curve": curve, "headline": headline}
    folder = writable_directory(Path(out))
    write_atomic(folder / "summary.json", encoded(summary, "summary"))
    write_html(folder / "index.html", page)
    return folder / "index.html"
