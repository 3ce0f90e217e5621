"""The page of one entry: its card, gates, flags, worst attacks, curves, robustness and the replay of its worst episode."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.board.attachments import Attachments, Clock
from tailgate.board.schema import LEVELS, CellLine, Data, Dose, Entry
from tailgate.board.words import names_of, percent
from tailgate.core.registry import Spec
from tailgate.play.metrics import ERRORS, METRICS, UNITS
from tailgate.replay.page import VERDICTS, outcome, write_page
from tailgate.replay.replay import Filter, play

from . import alarms, measures
from .cards import card_of
from .curves import curves_of, reached_of, stealth_of
from .index import compared_how, comparisons_of
from .suite import Suite, critical_of, dose_text, figure, interval_of, played, share_of, worse
from .timing import flags_of, timed_of
from .trust import trust_of, trust_page


@dataclass(frozen=True)
class Replayed:
    """The replay of the worst episode: a page, or why there is none."""

    page: str = ""
    outcome: str = ""
    check: str = ""
    tone: str = ""
    why: str = ""


def replay_of(row: Mapping[str, Any] | None, out: Path, source: str, named: str | None = None) -> Replayed:
    """Play the row and write its page to `out`.

    A board may come from anybody: its row may be of another version, incomplete, or name a file or a class that is not here. Then the
    reason is returned: one row must not cost the site. named: a defence that the user has named, whose class may be imported.
    """
    if row is None:
        return Replayed(why="The board holds no worst episode of this defence.")
    try:
        replay = play(dict(row), Filter(defence=named))
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
    """Return the cell of the attack that did most damage per scenario and shown dose, without computed optima and withdrawn attacks."""
    idle = {"none", *(a.attack for a in suite.board.attacks if a.withdrawn)}
    mine = [c for c in suite.board.cells_of(entry.defence) if not c.optimal and c.attack not in idle]
    out = []
    for scenario in suite.board.suite.scenarios:
        for dose in suite.shown:
            cell = worse(c for c in mine if c.scenario == scenario.name and c.dose == dose)
            if cell is not None:
                out.append({"cell": cell, "robustness": scenario.robustness} | interval_of(cell.damage))
    return out


def _every(suite: Suite, entry: Entry) -> list[Data]:
    """Return all cells of a defence: a row per scenario and attack, a column per dose."""
    rows: dict[tuple[str, str, str], dict[Dose, CellLine]] = {}
    for cell in suite.board.cells_of(entry.defence):
        rows.setdefault((cell.scenario, cell.attack, cell.knowledge), {})[cell.dose] = cell
    out = []
    for by_dose in rows.values():
        row = [by_dose.get(dose) for dose in suite.board.suite.doses]
        cells = [{"cell": cell} | interval_of(cell.damage) if cell else None for cell in row]
        out.append({"first": next(iter(by_dose.values())), "reason": next((c.reason for c in row if c and c.reason), ""), "cells": cells})
    return out


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
    curves, stealth = curves_of(suite, [entry], gap=7.0), stealth_of(suite, [entry])
    return {
        "name": suite.defences[entry.defence], "rank": _rank(suite, entry), "also": also, "card": card_of(suite, entry),
        "replayed": _replayed(entry), "checked": _checked(entry), "clocked": _clocked(measured.clock, entry.defence),
        "timed": timed_of(measured.timing, entry.defence), "imported": _imported(entry.defence),
        "typed": shlex.quote(entry.defence), "target": shlex.quote(Spec("defence", entry.defence).target),
        "flags": [*entry.flags, *flags_of(measured.timing, entry.defence), *alarms.drifts_of(suite, entry.defence)],
        "alarms": alarms.table_of(suite, entry.defence), "errata": measured.superseded(entry.defence),
        "critical": [(level, critical_of(suite, entry, level)) for level in LEVELS],
        "rates": _rates(suite, entry), "measures": measures.table_of(suite, entry, measured.gap),
        "worst": _worst(suite, entry), "cells": _every(suite, entry),
        "charts": curves[0]["charts"] if curves else [], "clean": _clean(suite, entry),
        "stealth": [reached_of(s) for s in entry.stealth or ()], "stealth_chart": stealth["chart"] if stealth else None,
        "detection": [(line, interval_of(line.detected)) for line in suite.board.detected(entry.defence)],
        "comparisons": comparisons_of(suite, entry.defence), "how": compared_how(suite),
        "about_trust": trust_of(suite), "trust": trust_page(suite, entry), "replay": replayed, "episode": _episode(suite, entry),
    }  # fmt: skip
