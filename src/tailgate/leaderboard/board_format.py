"""The format `tailgate-board-1`, as the page reads it: docs/decisions/0014-boards.md says what the fields mean.

Fields that are not named here are let through: a board may hold more than a page shows.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tailgate.errors import InputError, said, wanted
from tailgate.files import sweep, write_atomic

FORMAT = "tailgate-board-1"
Level = Literal["black", "grey", "white"]
LEVELS: tuple[Level, ...] = ("black", "grey", "white")  # what an attacker knows, from the least
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Share = Annotated[float, Field(strict=True, ge=0.0, le=1.0)]
Text = Annotated[str, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=0)]
Dose = Count | None  # None: the scenario's own budget


class Part(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)


class ScenarioPart(Part):
    name: Text
    about: Text = ""
    robustness: bool = False
    hash: Text = ""


class SuitePart(Part):
    name: Text
    about: Text = ""
    version: Text | int = ""
    hash: Text = ""  # of all that the suite plays
    doses: Annotated[list[Dose], Field(min_length=1)]
    shown: dict[str, Text] = {}
    limit: Share = 0.1
    bound: Number | None = None
    alpha: Share = 0.05
    scenarios: list[ScenarioPart]
    episodes: Count | None = None
    purpose: Text = ""
    beacon: Text | None = None  # empty: public seeds; None: not stated
    rows: Count | None = None
    require_adaptive: bool = True  # only what met attackers that were trained against it is ranked


class AttackPart(Part):
    attack: Text
    knowledge: Level
    learned: bool = False
    optimal: bool = False
    trained_on: Text | None = None
    digest: Text | None = None  # of the file that it was read from
    admitted: dict[str, Any] | None = None
    note: Text = ""
    withdrawn: bool = False
    shared: bool = False  # on no list, but met by all entries when somebody joined them
    card: dict[str, Any] | None = None


class Worst(Part):
    scenario: Text
    attack: Text


class Interval(Part):
    value: Number
    low: Number
    high: Number


class Limited(Part):
    """A share with its lower limit."""

    value: Share
    low: Share


class Gate(Part):
    gate: Text
    scenario: Text = ""
    value: Number | None
    limit: Number | None
    passed: bool


class Critical(Part):
    """A dose; None: beyond the largest of the suite."""

    value: Number | None
    low: Number | None = None
    high: Number | None = None
    worst: Worst | None = None


class Rate(Part):
    dose: Dose
    knowledge: Level
    undamaged: Limited | None
    worst: Worst | None = None
    attacks: Count | None = None


class Rank(Part):
    best: Count
    worst: Count


class Spread(Part):
    median: Number
    q25: Number
    q75: Number


class Robust(Part):
    scenario: Text
    undamaged: Limited | Number | None
    change: Number | None = None
    worst: Worst | None = None


class Stealth(Part):
    hours: Number
    threshold: Number | None = None
    rarer: bool = False  # as in detection
    deviation: Number | None
    low: Number | None = None
    high: Number | None = None
    reason: Text = ""  # why there is none


class Bound(Part):
    """A lower bound of the probability that a run keeps to properties, and the cell that it comes from."""

    lower: Share
    k: Count
    n: Count
    of: list[Text]
    scenario: Text
    dose: Dose
    attack: Text
    cells: Count
    alpha: Share
    attacks: list[Text]


class EntryTrust(Part):
    """Bounds of all properties together, and of those without detection; None where a cell has no figure, `why` says which."""

    all: dict[Level, Bound | None]
    safety: dict[Level, Bound | None]
    why: Text = ""


class Verified(Part):
    """How many rows there are, and what came of those that were played again."""

    rows: Count
    verified: Count
    differs: Count
    unchecked: Count

    @property
    def sound(self) -> bool:
        """Whether rows were played again and all of them came out equal."""
        return self.verified > 0 and self.differs == self.unchecked == 0


class Checked(Part):
    """How many cells there are, and what came of those that were played again from the board alone."""

    cells: Count
    equal: Count
    differs: Count
    unchecked: Count


class EntryPart(Part):
    defence: Text
    card: dict[str, Any] | None = None
    uses: list[Text] = []
    class_: Text = Field("", alias="class")
    status: Literal["ranked", "unattacked", "unranked"]
    why: Text = ""
    gates: list[Gate] = []
    critical_dose: dict[Level, Critical | None] = {}
    rates: list[Rate] = []
    rank: Rank | None = None
    clean: dict[str, Spread | None] = {}
    flags: list[Text] = []
    worst_episode: dict[str, Any] | None = None
    robustness: list[Robust] = []
    stealth: list[Stealth] | None = None
    trust: EntryTrust | None = None
    verified: Verified | None = None
    checked: Checked | None = None


class CellPart(Part):
    scenario: Text
    dose: Dose
    defence: Text
    attack: Text
    knowledge: Level
    learned: bool = False
    optimal: bool = False
    n: Count = 0
    failed: Count = 0
    reason: Text = ""
    damage: Interval | None
    hits: Annotated[str, Field(strict=True, pattern="^([0-9a-f]{2})*$")] | None = None  # a bit for each episode, by seed; None: not told
    decisions: Text | None = None
    trace: Text | None = None


class Point(Part):
    dose: Dose
    value: Share
    low: Share | None = None
    high: Share | None = None
    scenario: Text = ""
    attack: Text = ""


class CurvePart(Part):
    defence: Text
    knowledge: Level
    points: list[Point]
    fitted: list[Number] = []


class Comparison(Part):
    """Two defences on the same seeds; only_a: episodes in which a alone came to damage; weaker: the side that p speaks of; bound: whether
    p is the largest that the numbers of damaged episodes allow, and these are as many as can be."""

    class_: Text = Field("", alias="class")
    a: Text
    b: Text
    only_a: Count
    only_b: Count
    p: Share
    adjusted: Share
    weaker: Text | None = None
    bound: bool = False


class Detected(Part):
    defence: Text
    scenario: Text
    attack: Text
    hours: Number
    threshold: Number | None = None
    watched: bool = False  # the threshold is held against the score of a defence that has none
    rarer: bool = False  # with every lower threshold the alarm is more frequent than wanted, with this one rarer
    detected: Interval | None
    delay: Number | None = None


class Detection(Part):
    hours: list[Number]
    entries: list[Detected]


class TrustAttack(Part):
    attack: Text
    knowledge: Level
    note: Text = ""


class TrustProperty(Part):
    name: Text
    about: Text = ""
    safety: bool


class TrustPart(Part):
    """What the bounds of all entries are about."""

    alpha: Share
    runs: Count
    purpose: Text = ""
    beacon: Text = ""
    attacks: list[TrustAttack]
    scenarios: list[Text] = []
    doses: list[Dose] = []
    unsafe: dict[str, Number] = {}
    demands: dict[str, Number] = {}
    properties: list[TrustProperty] = []


class Board(Part):
    format: Literal["tailgate-board-1"]
    suite: SuitePart
    attacks: list[AttackPart] = []
    entries: list[EntryPart] = []
    cells: list[CellPart] = []
    curves: list[CurvePart] = []
    comparisons: list[Comparison] = []
    detection: Detection | None = None
    trust: TrustPart | None = None


def load(path: Path) -> Any:
    """The JSON data of a file, to be read by `read_board`; raises InputError for a file that is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
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
    for i, entry in enumerate(board.entries):
        if entry.trust is not None:
            _bounded(board, entry.trust, f"{where}.entries[{i}].trust")
    for key in board.suite.shown:
        if key not in {str(dose) for dose in board.suite.doses}:
            raise InputError(f"{where}.suite.shown", key, f"one of the suite's doses {board.suite.doses}")


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
