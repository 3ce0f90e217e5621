"""The nouns of the format `tailgate-board-1`: docs/decisions/0014-boards.md says what the fields mean.

`tailgate.board.files` reads, checks and writes them. Fields that are not named here are let through: a board may hold more than a page
shows.
"""

# ruff: noqa: RUF012  (pydantic copies defaults)

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from .part import LEVELS, Count, Data, Dose, Level, Number, Part, Share, Text
from .search_results import SearchedLine

__all__ = ["LEVELS", "Count", "Data", "Dose", "Level", "Number", "Part", "Share", "Text"]  # nouns of all formats, for those who read boards

FORMAT: Literal["tailgate-board-1"] = "tailgate-board-1"


class ScenarioLine(Part):
    name: Text
    about: Text = ""
    robustness: bool = False
    hash: Text = ""


class SuiteLine(Part):
    name: Text
    about: Text = ""
    version: Text | int = ""
    hash: Text = ""  # of all that the suite plays
    doses: Annotated[list[Dose], Field(min_length=1)]
    shown: dict[str, Text] = {}
    limit: Share = 0.1
    bound: Number | None = None
    alpha: Share = 0.05
    scenarios: list[ScenarioLine]
    episodes: Count | None = None
    purpose: Text = ""
    beacon: Text | None = None  # empty: public seeds; None: not stated
    rows: Count | None = None
    require_adaptive: bool = True  # only what met attackers that were trained against it is ranked
    progress: Share | None = None  # of its clean distance, below which an attacked car counts as damaged
    measures: bool = False  # entries have pointwise, under_attack and mean_gap


class AttackLine(Part):
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
        """Return if rows were played again and all of them came out equal."""
        return self.verified > 0 and self.differs == self.unchecked == 0


class Checked(Part):
    """How many cells there are, and what came of those that were played again from the board alone."""

    cells: Count
    equal: Count
    differs: Count
    unchecked: Count


class Pointwise(Part):
    """The share of episodes that no attack damaged, in the scenario where it is least; None: `reason` says why."""

    dose: Dose
    knowledge: Level
    undamaged: Interval | None
    scenario: Text = ""
    attacks: Count
    reason: Text = ""


class Severity(Part):
    collisions: Count
    measured: Count  # collisions with a closing speed: those in front [m/s]
    stops: Count  # episodes that are damaged by lost progress alone
    mean: Number | None
    median: Number | None
    q90: Number | None
    most: Number | None
    reason: Text = ""


class Least(Worst):
    value: Share


class UnderAttack(Part):
    """Severity and availability under the worst attack, and the attack that leaves the least availability."""

    dose: Dose
    knowledge: Level
    worst: Worst
    severity: Severity
    availability: Share | None
    least: Least | None


class MeanGap(Part):
    value: Number  # mean gap in clean runs over that of the undefended car, less one
    episodes: Count


class Entry(Part):
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
    pointwise: list[Pointwise] = []
    under_attack: list[UnderAttack] = []
    mean_gap: MeanGap | None = None
    stealth: list[Stealth] | None = None
    trust: EntryTrust | None = None
    verified: Verified | None = None
    checked: Checked | None = None


class CellLine(Part):
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
    hits: Annotated[str, Field(strict=True, pattern="^([0-9a-f]{2})*$")] | None = None  # a bit for each episode, by seed; None: not stated
    decisions: Text | None = None
    trace: Text | None = None


class Point(Part):
    dose: Dose
    value: Share
    low: Share | None = None
    high: Share | None = None
    scenario: Text = ""
    attack: Text = ""


class Curve(Part):
    defence: Text
    knowledge: Level
    points: list[Point]
    fitted: list[Number] = []


class Comparison(Part):
    """Two defences on the same seeds.

    only_a: episodes in which a alone came to damage; weaker: the side with more damage, which p is about. bound: p is the largest that the
    numbers of damaged episodes allow, and these numbers are the largest possible.
    """

    class_: Text = Field("", alias="class")
    a: Text
    b: Text
    only_a: Count
    only_b: Count
    p: Share
    adjusted: Share
    weaker: Text | None = None
    bound: bool = False


DETECTION = ("entries", "without", "alarms")  # lines of a detection board: figures, why there are none, and false alarms


class AtThreshold(Part):
    """A figure of an entry at its threshold for a wanted mean time between false alarms [h]."""

    defence: Text
    scenario: Text
    hours: Number


class Detected(AtThreshold):
    attack: Text
    threshold: Number | None = None
    watched: bool = False  # the threshold is held against the score of a defence that has none
    rarer: bool = False  # with every lower threshold the alarm is more frequent than wanted, with this one rarer
    detected: Interval | None
    delay: Number | None = None


class Alarms(AtThreshold):
    """False alarms on fresh clean runs of a scenario."""

    threshold: Number
    rarer: bool = False  # as in detection
    onsets: Count
    running: Annotated[Number, Field(gt=0.0)]  # [h]
    dispersion: Annotated[Number, Field(ge=0.0)]  # variance over mean of the onsets of a drive
    mean: Number | None  # time between them [h]; None without any
    low: Number
    high: Number | None
    first: Count  # onsets in the first half of the drive
    early: Count  # drives with more of them in the first half
    late: Count


class Detection(Part):
    hours: list[Number]
    plants: list[list[Text]] | None = None  # scenarios that share a threshold
    entries: list[Detected]
    alarms: list[Alarms] = []


class TrustAttack(Part):
    attack: Text
    knowledge: Level
    note: Text = ""


class TrustProperty(Part):
    name: Text
    about: Text = ""
    safety: bool


class Trust(Part):
    """The setting of all entries' bounds."""

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
    """A suite's ranked results. `entries` are its defences; `cells` are what their figures are made of."""

    format: Literal["tailgate-board-1"]
    suite: SuiteLine
    attacks: list[AttackLine] = []
    entries: list[Entry] = []
    cells: list[CellLine] = []
    curves: list[Curve] = []
    comparisons: list[Comparison] = []
    searches: list[SearchedLine] = []
    detection: Detection | None = None
    trust: Trust | None = None

    def cells_of(self, defence: str) -> list[CellLine]:
        """Return the cells of an entry."""
        return [cell for cell in self.cells if cell.defence == defence]

    def detected(self, defence: str | None = None) -> list[Detected]:
        """Return the figures of detection, of all entries or of one; none where nobody has played it."""
        lines = self.detection.entries if self.detection else []
        return [line for line in lines if defence in (None, line.defence)]

    def alarms(self, defence: str | None = None) -> list[Alarms]:
        """Return the false alarms at the thresholds of detection, of all entries or of one."""
        lines = self.detection.alarms if self.detection else []
        return [line for line in lines if defence in (None, line.defence)]
