"""The format `tailgate-board-1`: reading, checking and writing a board."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tailgate.base.errors import InputError, said, wanted
from tailgate.base.files import sweep, write_atomic
from tailgate.base.reading import load_json
from tailgate.evaluation.stats import mean_time

from .schema import AtThreshold, Board, Detection, EntryTrust

FORMAT = "tailgate-board-1"


def load(path: Path) -> Any:
    """The JSON data of a file, to be read by `read_board`; raises InputError for a file that is none."""
    try:
        return load_json(path)
    except (OSError, ValueError) as error:
        rows = "; rows are played again by `tailgate leaderboard verify`" if ".jsonl" in path.suffixes else ""
        raise InputError("board", str(path), f"a readable board.json ({said(error)}){rows}") from None


def save(board: dict[str, Any], path: Path) -> None:
    """Put a board, as JSON data, into a file, in one step, and remove what a killed writer of it left."""
    write_atomic(path, json.dumps(board, indent=1, allow_nan=False).encode() + b"\n")
    sweep(path)


def read_board(data: Any, where: str = "board") -> Board:
    """A board from JSON data; raises InputError that names the first field that is not of the format."""
    if not isinstance(data, dict):
        raise InputError(where, data, f"a mapping in the format {FORMAT}")
    if data.get("format") != FORMAT:
        raise InputError(f"{where}.format", data.get("format"), FORMAT)
    try:
        board = Board.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        missing = first["type"] == "missing"
        raise InputError(where + place, None if missing else first["input"], wanted(first)) from None
    _agree(board, where)
    return board


def _agree(board: Board, where: str) -> None:
    """What one part of a board says of another: names that are there, and each only once."""
    names = [entry.defence for entry in board.entries]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"{where}.entries[{i}].defence", name, "a defence that is named once")
    known = {s.name for s in board.suite.scenarios}
    for i, cell in enumerate(board.cells):
        if cell.defence not in names:
            raise InputError(f"{where}.cells[{i}].defence", cell.defence, "one of the entries' defences")
        if cell.scenario not in known:
            raise InputError(f"{where}.cells[{i}].scenario", cell.scenario, "one of the suite's scenarios")
        if cell.dose not in board.suite.doses:
            raise InputError(f"{where}.cells[{i}].dose", cell.dose, f"one of the suite's doses {board.suite.doses}")
        if cell.hits is not None and (len(cell.hits) != 2 * -(-cell.n // 8) or int(cell.hits or "0", 16) % (1 << -cell.n % 8)):
            wanted = f"{2 * -(-cell.n // 8)} hexadecimal digits, for {cell.n} episodes, and zeros after the last"
            raise InputError(f"{where}.cells[{i}].hits", cell.hits, wanted)
    for i, curve in enumerate(board.curves):
        if curve.defence not in names:
            raise InputError(f"{where}.curves[{i}].defence", curve.defence, "one of the entries' defences")
        if curve.fitted and len(curve.fitted) != len(curve.points):
            raise InputError(f"{where}.curves[{i}].fitted", curve.fitted, "a value per point, or none")
    for i, duel in enumerate(board.comparisons):
        for side in ("a", "b"):
            if getattr(duel, side) not in names:
                raise InputError(f"{where}.comparisons[{i}].{side}", getattr(duel, side), "one of the entries' defences")
        if duel.weaker not in (None, duel.a, duel.b):
            raise InputError(f"{where}.comparisons[{i}].weaker", duel.weaker, f"{duel.a} or {duel.b}")
    if board.detection is not None:
        _detected(board.detection, set(names), known, f"{where}.detection")
    for i, entry in enumerate(board.entries):
        if entry.trust is not None:
            _bounded(board, entry.trust, f"{where}.entries[{i}].trust")
    for key in board.suite.shown:
        if key not in {str(dose) for dose in board.suite.doses}:
            raise InputError(f"{where}.suite.shown", key, f"one of the suite's doses {board.suite.doses}")


def _detected(held: Detection, names: set[str], scenarios: set[str], where: str) -> None:
    """Figures are of entries and scenarios of the board, each there once, and false alarms and their mean times are of one another."""
    parts: dict[str, Sequence[AtThreshold]] = {"entries": held.entries, "alarms": held.alarms}
    for part, lines in parts.items():
        met = set[tuple[object, ...]]()
        for i, line in enumerate(lines):
            place = f"{where}.{part}[{i}]"
            if line.defence not in names:
                raise InputError(f"{place}.defence", line.defence, "one of the entries' defences")
            if line.scenario not in scenarios:
                raise InputError(f"{place}.scenario", line.scenario, "one of the suite's scenarios")
            if (key := (line.defence, line.scenario, line.hours, getattr(line, "attack", ""))) in met:
                raise InputError(place, " ".join(map(str, key)).strip(), "figures that are there once")
            met.add(key)
    for i, line in enumerate(held.alarms):
        low, high = mean_time(line.onsets, line.running, line.dispersion)
        follows = {"mean": line.running / line.onsets if line.onsets else None, "low": low, "high": high}
        for name, value in follows.items():
            given = getattr(line, name)
            if not (given is value is None or (given is not None and value is not None and math.isclose(given, value, rel_tol=1e-6))):
                raise InputError(f"{where}.alarms[{i}].{name}", given, f"{value}, which follows from onsets, running and dispersion")
        if line.first > line.onsets:
            raise InputError(f"{where}.alarms[{i}].first", line.first, f"at most {line.onsets}, the onsets")
        if line.early + line.late > line.onsets:
            raise InputError(f"{where}.alarms[{i}].early", line.early, f"at most {line.onsets} drives with late, as many as onsets")


def _bounded(board: Board, trust: EntryTrust, where: str) -> None:
    """Bounds are of attacks that the board names, and of no more successes than runs."""
    if board.trust is None:
        raise InputError(where, "bounds", "null, as the board has no field trust")
    known = {a.attack for a in board.trust.attacks}
    for name, held in (("all", trust.all), ("safety", trust.safety)):
        for level, bound in held.items():
            if bound is None:
                continue
            if bound.k > bound.n:
                raise InputError(f"{where}.{name}.{level}.k", bound.k, f"at most {bound.n}, the number of runs")
            if missing := {bound.attack, *bound.attacks} - known:
                raise InputError(f"{where}.{name}.{level}.attacks", min(missing), "one of the attacks in the board's trust")
