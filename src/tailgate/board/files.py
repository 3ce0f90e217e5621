"""Reading, checking and writing a board in the format `tailgate-board-1` (`tailgate.board.schema`)."""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tailgate.base.errors import InputError, said, unknown, wanted
from tailgate.base.files import sweep, write_atomic
from tailgate.base.reading import load_json
from tailgate.base.version import VERSION, plays_as
from tailgate.core.scenario import Suite, list_suites, load_suite
from tailgate.evaluation.stats import mean_time

from .frame import BoardData
from .schema import FORMAT, AtThreshold, Board, Data, Detection, Entry, EntryTrust, Part

CLOSE = 1e-9  # to which shares agree
BOARD = "board.json"


def published() -> dict[str, Path]:
    """Return the files of the boards that come with the package, by the name of their suite."""
    folder = Path(str(files("tailgate.configs").joinpath("boards")))
    return {path.name.removesuffix(".json.xz"): path for path in sorted(folder.glob("*.json.xz"))}


def board_named(text: str) -> Path:
    """Return the file of a board from its path or, where no such file is, from the name of a published board."""
    known = published()
    if text in known and not Path(text).is_file():
        return known[text]
    if Path(text).exists() or "." in Path(text).name or len(Path(text).parts) > 1:  # the name of a file, which may be wrong
        return Path(text)
    raise unknown("board", text, known)


def load(path: Path | str) -> Any:
    """Return the JSON data of a board, a `BoardData`, to be read by `read_board`.

    Parameters
    ----------
    path
        The file, or the name of a board that comes with the package (quick-v1).

    Raises
    ------
    InputError
        For a file of another format, and for a name that no board has.
    """
    path = board_named(path) if isinstance(path, str) else path
    rows = "; rows are played again by `tailgate leaderboard verify`" if ".jsonl" in path.suffixes else ""
    return BoardData(_formatted(read_json(path, "board", "board.json", rows), f"board {path}"))


def _formatted(data: object, where: str) -> dict[str, Any]:
    """Return data of the format of boards. Raises InputError for others."""
    if not isinstance(data, dict):
        raise InputError(where, data, f"a mapping in the format {FORMAT}")
    if data.get("format") != FORMAT:
        raise InputError(f"{where}.format", data.get("format"), FORMAT)
    return data


def read_json(path: Path, where: str, what: str = "JSON file", hint: str = "") -> Any:
    """Return the JSON data of a file. Raises InputError for a file that is none."""
    try:
        return load_json(path)
    except (OSError, ValueError) as error:
        other = path.with_suffix("") if path.suffix == ".xz" else Path(f"{path}.xz")
        there = f"; {other} is there" if not path.exists() and other.is_file() else ""
        raise InputError(where, str(path), f"a readable {what} ({said(error)}){there}{hint}") from None


def board_in(folder: Path) -> Path:
    """Return the file of the board in a suite's folder: the packed one where there is one. Raises InputError for both."""
    plain, packed = folder / BOARD, folder / f"{BOARD}.xz"
    if plain.is_file() and packed.is_file():
        raise InputError("board", str(packed), f"one board in the folder: {plain.name} lies there too")
    return packed if packed.is_file() else plain


def save(board: Data, path: Path) -> None:
    """Put a board, as JSON data, into a file, in one step, packed if it is named *.xz; remove what a killed writer of it left."""
    content = json.dumps(board, indent=1, allow_nan=False).encode() + b"\n"
    write_atomic(path, lzma.compress(content) if path.suffix == ".xz" else content)
    sweep(path)


def amended(board: Data, fields: Mapping[str, Data], **parts: object) -> Data:
    """Return a board with these fields put into its entries, by defence, and these parts put into the board."""
    return board | {"entries": [entry | fields.get(entry["defence"], {}) for entry in board["entries"]]} | parts


def read_board(data: object, where: str = "board") -> Board:
    """Return a board from JSON data; raises InputError that names the first field that is not of the format."""
    try:
        board = Board.model_validate(_formatted(data, where))
    except ValidationError as error:
        first = error.errors()[0]
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        raise InputError(where + place, None if first["type"] == "missing" else first["input"], wanted(first)) from None
    _Agreement(board).check(where)
    return board


class _Agreement:
    """The checks of one part of a board against another."""

    def __init__(self, board: Board) -> None:
        self.board, doses = board, board.suite.doses
        self.defences = {entry.defence for entry in board.entries}
        self.known: dict[str, tuple[Iterable[object], str]] = {
            "defence": (self.defences, "one of the entries' defences"),
            "scenario": ({s.name for s in board.suite.scenarios}, "one of the suite's scenarios"),
            "dose": (doses, f"one of the suite's doses {doses}"),
        }

    def check(self, where: str) -> None:
        """Raise InputError that names the first field that does not agree with the rest of the board."""
        board, met = self.board, set[str]()
        for i, entry in enumerate(board.entries):
            if entry.defence in met:
                raise InputError(f"{where}.entries[{i}].defence", entry.defence, "a defence that is named once")
            met.add(entry.defence)
            self._rank(entry, f"{where}.entries[{i}]")
        played = set[tuple[object, ...]]()
        for i, cell in enumerate(board.cells):
            self._refer(f"{where}.cells[{i}]", cell, "defence", "scenario", "dose")
            place = cell.defence, cell.scenario, cell.dose, cell.attack, cell.knowledge
            if place in played:
                raise InputError(f"{where}.cells[{i}]", list(place), "a cell that is there once")
            played.add(place)
            if cell.hits is not None and (len(cell.hits) != 2 * -(-cell.n // 8) or int(cell.hits or "0", 16) % (1 << -cell.n % 8)):
                expected = f"{2 * -(-cell.n // 8)} hexadecimal digits, for {cell.n} episodes, and zeros after the last"
                raise InputError(f"{where}.cells[{i}].hits", cell.hits, expected)
            if (held := cell.damage) is not None:
                if not 0.0 <= held.low <= held.value + CLOSE or not held.value - CLOSE <= held.high <= 1.0:
                    raise InputError(f"{where}.cells[{i}].damage", held.model_dump(), "a share between its limits, from 0 to 1")
                if cell.hits and cell.n and abs((share := int(cell.hits, 16).bit_count() / cell.n) - held.value) > CLOSE:
                    raise InputError(f"{where}.cells[{i}].damage.value", held.value, f"{share:g}, as its hits say")
        for i, curve in enumerate(board.curves):
            self._refer(f"{where}.curves[{i}]", curve, "defence")
            if curve.fitted and len(curve.fitted) != len(curve.points):
                raise InputError(f"{where}.curves[{i}].fitted", curve.fitted, "a value per point, or none")
        for i, duel in enumerate(board.comparisons):
            for side, name in (("a", duel.a), ("b", duel.b)):
                if name not in self.defences:
                    raise InputError(f"{where}.comparisons[{i}].{side}", name, "one of the entries' defences")
            if duel.weaker not in (None, duel.a, duel.b):
                raise InputError(f"{where}.comparisons[{i}].weaker", duel.weaker, f"{duel.a} or {duel.b}")
        if board.detection is not None:
            self._detection(board.detection, f"{where}.detection")
        for i, entry in enumerate(board.entries):
            if entry.trust is not None:
                self._bounds(entry.trust, f"{where}.entries[{i}].trust")
        for key in board.suite.shown:
            if key not in map(str, board.suite.doses):
                raise InputError(f"{where}.suite.shown", key, self.known["dose"][1])

    def _rank(self, entry: Entry, where: str) -> None:
        """Raise InputError for a rank without the status, or in spite of a gate."""
        if (entry.rank is None) == (entry.status == "ranked"):
            raise InputError(f"{where}.rank", entry.rank and entry.rank.model_dump(), f"a rank exactly if ranked, and it is {entry.status}")
        if entry.rank is not None and entry.rank.best > entry.rank.worst:
            raise InputError(f"{where}.rank", entry.rank.model_dump(), "the best place first")
        if entry.rank is not None and (lost := [gate.gate for gate in entry.gates if not gate.passed]):
            raise InputError(f"{where}.gates", lost, "gates that a ranked entry passes")

    def _refer(self, where: str, line: Part, *fields: str) -> None:
        for name in fields:
            known, expected = self.known[name]
            if (value := getattr(line, name)) not in known:
                raise InputError(f"{where}.{name}", value, expected)

    def _detection(self, held: Detection, where: str) -> None:
        """Check that figures are there once each, and that false alarms and their mean times fit each other."""
        parts: dict[str, Sequence[AtThreshold]] = {"entries": held.entries, "alarms": held.alarms}
        for part, lines in parts.items():
            met = set[tuple[object, ...]]()
            for i, line in enumerate(lines):
                self._refer(f"{where}.{part}[{i}]", line, "defence", "scenario")
                if (key := (line.defence, line.scenario, line.hours, getattr(line, "attack", ""))) in met:
                    raise InputError(f"{where}.{part}[{i}]", " ".join(map(str, key)).strip(), "figures that are there once")
                met.add(key)
        for i, alarms in enumerate(held.alarms):
            place = f"{where}.alarms[{i}]"
            low, high = mean_time(alarms.onsets, alarms.running, alarms.dispersion)
            follows = {"mean": alarms.running / alarms.onsets if alarms.onsets else None, "low": low, "high": high}
            for name, value in follows.items():
                given = getattr(alarms, name)
                same = given is value if given is None or value is None else math.isclose(given, value, rel_tol=1e-6)
                if not same:
                    raise InputError(f"{place}.{name}", given, f"{value}, which follows from onsets, running and dispersion")
            if alarms.first > alarms.onsets:
                raise InputError(f"{place}.first", alarms.first, f"at most {alarms.onsets}, the onsets")
            if alarms.early + alarms.late > alarms.onsets:
                raise InputError(f"{place}.early", alarms.early, f"at most {alarms.onsets} drives with late, as many as onsets")

    def _bounds(self, trust: EntryTrust, where: str) -> None:
        """Check that bounds are of attacks that the board names, and of no more successes than runs."""
        if self.board.trust is None:
            raise InputError(where, "bounds", "null, as the board has no field trust")
        known = {a.attack for a in self.board.trust.attacks}
        for name, held in (("all", trust.all), ("safety", trust.safety)):
            for level, bound in held.items():
                if bound is not None and bound.k > bound.n:
                    raise InputError(f"{where}.{name}.{level}.k", bound.k, f"at most {bound.n}, the number of runs")
                if bound is not None and (missing := {bound.attack, *bound.attacks} - known):
                    raise InputError(f"{where}.{name}.{level}.attacks", min(missing), "one of the attacks in the board's trust")


def suite_of(board: Board) -> Suite:
    """Return the suite of the package that the board is of. Raises InputError where there is none."""
    if board.suite.name not in list_suites():
        raise unknown("board: suite.name", board.suite.name, list_suites())
    suite = load_suite(board.suite.name)
    agree(board, suite)
    return suite


def agree(board: Board, suite: Suite) -> None:
    """Raise InputError for a board of another suite or version than is here."""
    held = board.suite
    if plays_as(held.version) != VERSION:
        raise InputError("board: suite.version", held.version, f"{VERSION}, which is here, or one that plays the same")
    if held.hash != suite.hash:
        raise InputError("board: suite.hash", held.hash, f"{suite.hash}, which the suite {suite.name} has here")
    if held.episodes is None or not 1 <= held.episodes <= 4096:
        raise InputError("board: suite.episodes", held.episodes, "1 to 4096 episodes of a cell")


def known(names: Sequence[str], entries: Sequence[str]) -> None:
    """Raise InputError for a name that is none of the entries'."""
    for name in names:
        if name not in entries:
            raise unknown("defence", name, entries)
