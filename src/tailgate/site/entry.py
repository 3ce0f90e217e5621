"""The page of one entry: its card, gates, flags, worst attacks, curves, robustness and the replay of its worst episode."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.board.attachments import Attachments, Clock
from tailgate.board.schema import LEVELS, CellLine, Data, Entry, Robust
from tailgate.board.words import names_of, percent
from tailgate.core.registry import Spec
from tailgate.play.metrics import ERRORS, METRICS, UNITS
from tailgate.replay.page import VERDICTS, outcome, write_page
from tailgate.replay.replay import play

from . import alarms
from .cards import card_of
from .curves import curves_of, reached_of, stealth_of
from .index import compared_how, comparisons_of
from .suite import Suite, critical_of, dose_text, figure, played, share_of, worse
from .timing import flags_of, timed_of
from .trust import trust_of, trust_page

LEAST = ("progress", "every episode")  # gates whose limit is one from below
WAYS = ("\N{LESS-THAN OR EQUAL TO}", "\N{GREATER-THAN OR EQUAL TO}")


@dataclass(frozen=True)
class Replayed:
    """The replay of the worst episode: a page, or why there is none."""

    page: str = ""
    outcome: str = ""
    check: str = ""
    tone: str = ""
    why: str = ""


def replay_of(row: Mapping[str, Any] | None, out: Path, source: str) -> Replayed:
    """Play the row and write its page to `out`.

    A board may come from anybody: its row may be of another version, incomplete, or name a file or a class that is not here. Then the
    reason is returned: one row must not cost the site.
    """
    if row is None:
        return Replayed(why="The board holds no worst episode of this defence.")
    try:
        replay = play(dict(row))
        page = write_page(replay, out, source)
    except Exception as error:
        return Replayed(why=_reason(error, row))
    tone, title, why = VERDICTS[replay.verdict]
    return Replayed(page.name, outcome(replay), f"{title}: {why}.", tone)


def _reason(error: Exception, row: Mapping[str, Any]) -> str:
    """Return the error in words, without the places of files on somebody's machine."""
    if isinstance(error, KeyError):
        return f"The row lacks the field {error}."
    text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    for key in ("attack", "defence", "scenario_file"):
        value = row.get(key)
        if isinstance(value, str) and "/" in value:
            text = text.replace(value, names_of([value])[value].label)
    return text[:1].upper() + text[1:] + "."


def _episode(suite: Suite, entry: Entry) -> str:
    """Return which episode is the worst one, in words; empty where the board does not say."""
    row = entry.worst_episode or {}
    scenario, attack, dose = (row.get(key) for key in ("scenario", "attack", "dose"))
    if not (isinstance(scenario, str) and isinstance(attack, str) and isinstance(dose, int)):
        return ""
    spared = all(rate.undamaged is not None and rate.undamaged.value == 1.0 for rate in entry.rates)
    near = " No episode at the doses that are shown came to damage; this one came nearest." if spared else ""
    return f"{suite.where(scenario, attack)}, at a dose of {dose} steps.{near}"


def _rates(suite: Suite, entry: Entry) -> list[Data]:
    kept = {(r.dose, r.knowledge): r for r in entry.rates}
    out = []
    for dose in dict.fromkeys(r.dose for r in entry.rates):
        cells = []
        for level in LEVELS:
            rate = kept.get((dose, level))
            spared = rate is not None and rate.undamaged is not None and rate.undamaged.value == 1.0
            worst = "none did damage" if spared else suite.where(rate.worst.scenario, rate.worst.attack) if rate and rate.worst else ""
            cells.append(share_of(rate.undamaged if rate else None) | {"worst": worst, "attacks": rate.attacks if rate else None})
        out.append({"dose": dose_text(dose), "cells": cells})
    return out


def _worst(suite: Suite, entry: Entry) -> list[Data]:
    """Return the attack that did most damage per scenario and shown dose; computed optima do not count."""
    mine = [c for c in suite.board.cells if c.defence == entry.defence and not c.optimal and c.attack != "none"]
    out = []
    for scenario in suite.board.suite.scenarios:
        for dose in suite.shown:
            cell = worse(c for c in mine if c.scenario == scenario.name and c.dose == dose)
            if cell is not None:
                out.append(_cell(suite, cell) | {"robustness": scenario.robustness})
    return out


def _cell(suite: Suite, cell: CellLine) -> Data:
    damage = cell.damage
    return {
        "scenario": cell.scenario, "dose": dose_text(cell.dose), "dose_sort": "" if cell.dose is None else cell.dose,
        "attack": suite.attacks[cell.attack], "knowledge": cell.knowledge, "n": cell.n, "failed": cell.failed, "reason": cell.reason,
        "learned": cell.learned, "optimal": cell.optimal, "robustness": False,
        "text": percent(damage.value) if damage else "n/a", "sort": f"{damage.value:.6g}" if damage else "",
        "span": f"{percent(damage.low)} to {percent(damage.high)}" if damage else "",
    }  # fmt: skip


def _every(suite: Suite, mine: Sequence[CellLine]) -> list[Data]:
    """Return all cells of a defence: a row per scenario and attack, a column per dose."""
    rows: dict[tuple[str, str, str], dict[Any, CellLine]] = {}
    for cell in mine:
        rows.setdefault((cell.scenario, cell.attack, cell.knowledge), {})[cell.dose] = cell
    out = []
    for (scenario, attack, knowledge), by_dose in rows.items():
        first = next(iter(by_dose.values()))
        cells = [_cell(suite, by_dose[dose]) if dose in by_dose else None for dose in suite.board.suite.doses]
        reason = next((c.reason for c in by_dose.values() if c.reason), "")
        row = {"scenario": scenario, "attack": suite.attacks[attack], "knowledge": knowledge, "reason": reason, "cells": cells}
        out.append(row | {"learned": first.learned, "optimal": first.optimal})
    return out


def _robust(suite: Suite, item: Robust) -> Data:
    if isinstance(item.undamaged, float | int):
        share: Data = {"text": percent(item.undamaged), "low": "", "sort": item.undamaged}
    else:
        share = share_of(item.undamaged)
    change = "\N{EN DASH}" if item.change is None else f"{100 * item.change:+.0f}".replace("-", "\N{MINUS SIGN}")
    worst = suite.where("", item.worst.attack) if item.worst else ""
    return {"scenario": item.scenario, "undamaged": share, "change": change, "worst": worst}


def _clean(suite: Suite, entry: Entry) -> list[Data]:
    road, out = suite.board.suite.bound is None, []
    for name, spread in entry.clean.items():
        about = " ".join((METRICS[name].__doc__ or "").split()) if name in METRICS else ""
        unit = UNITS.get(name, "") if road or name not in ERRORS else "-"
        numbers = [figure(x) for x in (spread.median, spread.q25, spread.q75)] if spread else ["\N{EN DASH}"] * 3
        out.append({"name": name.replace("_", " "), "about": about, "unit": unit, "numbers": numbers})
    return out


def _replayed(entry: Entry) -> str:
    """Return the result of playing rows again; empty where nobody has said anything of them."""
    held = entry.verified
    if held is None:
        return ""
    asked = held.verified + held.differs + held.unchecked
    which = f"{asked} of {held.rows} rows, drawn at random, were" if asked < held.rows else f"all {held.rows} rows were"
    if held.sound:
        most = f" At most {percent(1.0 - 0.05 ** (1.0 / asked))} of them differ, at 95%." if asked < held.rows else ""
        return f"Replayed: {which} played again and came out equal.{most}"
    parts = [f"{n} {word}" for n, word in ((held.differs, "differ"), (held.unchecked, "could not be checked")) if n]
    return f"Replayed: {which} played again; {' and '.join(parts)}." if asked else "Not replayed: no row was played again."


def _checked(entry: Entry) -> str:
    """Return the result of playing cells again from the board alone; empty where none was."""
    held = entry.checked
    if held is None:
        return ""
    said = played(held.cells, held.equal, held.differs, held.unchecked, "cells")
    return f"Played again from this board alone, without its rows: {said}."


def _rank(suite: Suite, entry: Entry) -> str:
    if entry.rank is None:
        return ""
    of = sum(e.class_ == entry.class_ and e.rank is not None for e in suite.board.entries)
    best, worst = entry.rank.best, entry.rank.worst
    if of == 1:
        return "alone"
    return f"{best if best == worst else f'{best} to {worst}'} of {of}"


def _imported(defence: str) -> bool:
    """Return if a check of the board would have to import it, and so does not."""
    try:
        spec = Spec("defence", defence)
        return spec.foreign or bool(spec.sandboxed)
    except InputError:  # nothing that is known here
        return True


def _clocked(clock: Clock | None, defence: str) -> str:
    """Return the cost of a step; empty where nobody has measured it."""
    found = next((entry for entry in clock.entries if entry.defence == defence), None) if clock else None
    if clock is None or found is None:
        return ""
    who = "one car" if clock.agents == 1 else f"{clock.agents} agents"
    spread = f"{figure(found.low)} to {figure(found.high)} in {clock.rounds} rounds, {clock.processor}"
    return f"A step takes {figure(found.median)} \N{MICRO SIGN}s for one episode of {who} ({spread})."


def entry_page(
    suite: Suite, entry: Entry, replayed: Replayed | None, also: list[tuple[str, str]], measured: Attachments
) -> Data:
    """Return all that an entry's page shows. also: names of other suites with an entry of the same text, and their pages."""
    curves = curves_of(suite, [entry], gap=7.0)
    mine = [c for c in suite.board.cells if c.defence == entry.defence]
    stealth = stealth_of(suite, [entry])
    found = [d for d in (suite.board.detection.entries if suite.board.detection else ()) if d.defence == entry.defence]
    detection = [
        {"attack": suite.attacks[d.attack], "scenario": d.scenario, "hours": figure(d.hours), "threshold": figure(d.threshold),
         "rarer": d.rarer,
         "text": percent(d.detected.value) if d.detected else "n/a", "sort": f"{d.detected.value:.6g}" if d.detected else "",
         "span": f"{percent(d.detected.low)} to {percent(d.detected.high)}" if d.detected else "", "delay": figure(d.delay, 3)}
        for d in found
    ]  # fmt: skip
    return {
        "suite": suite.board.suite, "damage": suite.damage, "limit": percent(suite.board.suite.limit), "scale": suite.scale,
        "name": suite.defences[entry.defence], "status": entry.status, "why": entry.why,
        "replayed": _replayed(entry), "checked": _checked(entry), "clocked": _clocked(measured.clock, entry.defence),
        "timed": timed_of(measured.timing, entry.defence),
        "typed": shlex.quote(entry.defence), "target": shlex.quote(Spec("defence", entry.defence).target),
        "board": f"OUT/{suite.folder}/board.json", "road": suite.board.suite.bound is None,
        "imported": _imported(entry.defence),
        "class": entry.class_ or "not stated",
        "rank": _rank(suite, entry), "also": also, "card": card_of(suite, entry), "levels": LEVELS,
        "flags": [*entry.flags, *flags_of(measured.timing, entry.defence), *alarms.drifts_of(suite, entry.defence)],
        "alarms": alarms.table_of(suite, entry.defence), "errata": measured.superseded(entry.defence),
        "critical": [(level, critical_of(suite, entry, level)) for level in LEVELS],
        "rates": _rates(suite, entry), "worst": _worst(suite, entry), "cells": _every(suite, mine),
        "doses": [dose_text(d) for d in suite.board.suite.doses],
        "gates": [{"gate": g.gate.replace("_", " "), "scenario": g.scenario, "value": figure(g.value), "limit": figure(g.limit),
                   "way": WAYS[g.gate in LEAST],
                   "passed": g.passed} for g in entry.gates],
        "charts": curves[0]["charts"] if curves else [], "clean": _clean(suite, entry),
        "robustness": [_robust(suite, r) for r in entry.robustness],
        "stealth": [reached_of(s) for s in entry.stealth or ()], "stealth_chart": stealth["chart"] if stealth else None,
        "detection": detection, "watched": any(d.watched for d in found), "rarer": any(d.rarer for d in found),
        "comparisons": comparisons_of(suite, entry.defence), "how": compared_how(suite),
        "round": suite.round, "about_trust": trust_of(suite), "trust": trust_page(suite, entry), "replay": replayed,
        "episode": _episode(suite, entry),
    }  # fmt: skip
