"""Attachments of a board: files in its folder with facts that rows do not hold. One class is one format.

A board is a pure function of rows, so clocks, machines, fresh episodes and past mistakes are kept apart from it:

    step_time.json  time of a step of each defence
    timing.json     worth of the timing of trained attackers
    gap.json        the plain filter at the mean gap of entries that keep a longer one
    errata.json     superseded figures
    run.json        effort of playing the board
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic
from tailgate.base.progress import lasting
from tailgate.core.schema import read_model

from .schema import Board, Dose, Interval, Limited, Part, Share

ALPHA = 0.05  # of all entries of a board together
LITTLE = 0.1  # an advantage that surely stays below this is as good as none
Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
Time = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Said = Annotated[str, Field(min_length=1)]


class Attachment(BaseModel):
    """A file in a board's folder. A subclass declares its fields, its name, and the words that messages use."""

    model_config = ConfigDict(strict=True)
    FILE: ClassVar[str]
    WHAT: ClassVar[str]
    MADE_BY: ClassVar[str]
    format: str
    suite: str

    @classmethod
    def read(cls, path: Path) -> Self:
        """Raise InputError that names the file and the field for anything else than this format."""
        return read_model(cls, path, cls.WHAT, cls.MADE_BY)

    @classmethod
    def of(cls, board: Path) -> Self | None:
        """Return the attachment of a board's file; None where there is none."""
        path = board.parent / cls.FILE
        return cls.read(path) if path.is_file() else None

    def text(self) -> str:
        """Return what the file holds."""
        return self.model_dump_json(indent=1) + "\n"

    def write(self, folder: Path) -> Path:
        """Write the file, in one step, and return its path."""
        write_atomic(folder / self.FILE, self.text().encode())
        return folder / self.FILE

    def belongs(self, board: Board) -> Self | None:
        """Return what is of this board. Raises InputError for an attachment of another suite."""
        if self.suite != board.suite.name:
            raise InputError(f"{self.WHAT}: suite", self.suite, f"{board.suite.name}, the suite of the board in the same folder")
        return self


class StepTime(BaseModel):
    """One defence: the median of its rounds, the least and the largest of them [us]."""

    model_config = ConfigDict(strict=True)
    defence: str
    median: Time
    low: Time
    high: Time


class Clock(Attachment):
    """Step times (`tailgate.board.clock` measures them)."""

    FILE, WHAT, MADE_BY = "step_time.json", "step times", "leaderboard clock"
    format: Literal["tailgate-step-time-1"] = "tailgate-step-time-1"
    scenario: str
    agents: Positive
    rounds: Positive
    processor: str
    version: str
    commit: str | None
    entries: list[StepTime]


class Shown(Limited):
    """A share of damaged episodes with its exact limits, 95 %."""

    high: Share


class Gain(Interval):
    """Own over yoked: the difference with limits, 95 %, the episodes that only one of them damages, and McNemar's exact two-sided p."""

    only_own: Count
    only_yoked: Count
    p: Share
    adjusted: Share = 1.0  # after Holm, for all entries


class Timed(Part):
    """A trained attacker of an entry, and its twins."""

    defence: str
    attack: str
    scenario: str
    dose: Dose
    knowledge: str
    board: Share  # its damage on the board
    most: Share  # that of all attackers that were trained against the entry, at this dose
    episodes: Annotated[int, Field(ge=2)]  # fresh ones
    schedules: Positive  # different ones in them
    own: Shown
    yoked: Shown
    shuffled: Shown
    periodic: Shown
    advantage: Gain

    @property
    def verdict(self) -> Literal["more", "equal", "unknown"]:
        """Return if its own times surely do more than another episode's, surely no more than a little, or neither can be said.

        Nothing can where it attacks at the same times in every episode: its yoked twin is itself.
        """
        gain = self.advantage
        if gain.adjusted <= ALPHA and gain.only_own > gain.only_yoked:
            return "more"
        saturated = max(self.own.value, self.yoked.value) <= LITTLE or min(self.own.value, self.yoked.value) >= 1.0 - LITTLE
        return "equal" if gain.high < LITTLE and self.schedules > 1 and not saturated else "unknown"

    @property
    def outdone(self) -> bool:
        """Return if as many steps at random, or evenly spread, surely do more."""
        return max(self.shuffled.low, self.periodic.low) > self.own.high


class Untimed(Part):
    """An entry of which nothing can be said, and why."""

    defence: str
    why: str


class Timing(Attachment):
    """Timing advantages (`tailgate.board.timing` measures them)."""

    model_config = ConfigDict(strict=True, extra="allow")
    FILE, WHAT, MADE_BY = "timing.json", "timing advantages", "leaderboard timing"
    format: Literal["tailgate-board-timing-1"] = "tailgate-board-timing-1"
    hash: str
    beacon: str
    version: str
    entries: list[Timed]
    without: list[Untimed]

    def belongs(self, board: Board) -> Self:
        """Return the advantages of attackers whose cells still say the same."""
        mine = board.suite
        for name, wanted in (("suite", mine.name), ("hash", mine.hash), ("beacon", mine.beacon or "")):
            if (held := getattr(self, name)) != wanted:
                raise InputError(f"{self.WHAT}: {name}", held, f"{wanted!r}, as in the board in the same folder")
        damage = {(c.defence, c.attack, c.scenario, c.dose): c.damage.value for c in board.cells if c.damage}
        kept = [e for e in self.entries if damage.get((e.defence, e.attack, e.scenario, e.dose)) == e.board]
        return self.model_copy(update={"entries": kept})


class SameGap(Part):
    """An entry, and the reference behind a controller with a longer headway, which makes the mean gaps equal."""

    defence: str
    gap: Time  # mean gap without an attack over that of the undefended car, less one
    reference: str
    factor: Time  # times the scenario's headway
    kept: float  # mean gap of the reference with it
    dose: Dose
    undamaged: Limited  # of the reference, under its worst attack
    attacks: Positive
    scenario: str
    attack: str


class EqualGap(Attachment):
    """Comparisons at equal mean gap (`tailgate.board.equal_gap` measures them)."""

    FILE, WHAT, MADE_BY = "gap.json", "comparisons at equal gap", "leaderboard gap"
    format: Literal["tailgate-equal-gap-1"] = "tailgate-equal-gap-1"
    hash: str
    beacon: str
    version: str
    entries: list[SameGap]
    without: list[Untimed]

    def belongs(self, board: Board) -> Self:
        """Return the comparisons of entries whose mean gap is still the same."""
        for name, wanted in (("suite", board.suite.name), ("hash", board.suite.hash), ("beacon", board.suite.beacon or "")):
            if (held := getattr(self, name)) != wanted:
                raise InputError(f"{self.WHAT}: {name}", held, f"{wanted!r}, as in the board in the same folder")
        gaps = {entry.defence: entry.mean_gap.value for entry in board.entries if entry.mean_gap is not None}
        return self.model_copy(update={"entries": [entry for entry in self.entries if gaps.get(entry.defence) == entry.gap]})


def _day(text: str) -> str:
    if date.fromisoformat(text).isoformat() != text:
        raise ValueError("expected a date, YYYY-MM-DD")
    return text


class Erratum(BaseModel):
    """Figures that were superseded: the day of the right ones, what was wrong, what moved, and the last commit of the board as it was.

    A wrong attack has an erratum on the list of attacks instead, which takes its damage out of every figure.
    """

    model_config = ConfigDict(strict=True, extra="forbid")
    date: Annotated[str, AfterValidator(_day)]
    part: Literal["rows", "detection", "timing"]
    entries: list[Said] = []  # none named: all
    what: Said
    moved: Said
    until: Annotated[str, Field(pattern="^[0-9a-f]{7,40}$")]

    def about(self, defence: str) -> bool:
        return not self.entries or defence in self.entries


class Errata(Attachment):
    """Errata, the oldest first."""

    model_config = ConfigDict(strict=True, extra="forbid")
    FILE, WHAT, MADE_BY = "errata.json", "errata", "the maintainers (docs/governance.md)"
    format: Literal["tailgate-errata-1"] = "tailgate-errata-1"
    errata: list[Erratum]


class Command(BaseModel):
    """One command that played rows; processor_seconds with those of its workers."""

    model_config = ConfigDict(strict=True)
    seconds: Time
    processor_seconds: Time
    played: Count
    workers: Positive
    processor: str
    cores: Positive
    version: str
    commit: str | None


class Rows(BaseModel):
    """Rows that the commands played, and rows of the board that none of them did; null while they are being played.

    again: how many of those that were played stand for nothing, as they were played once more, by newer sources for instance.
    """

    model_config = ConfigDict(strict=True)
    played: Count
    kept: Count | None
    again: Count = 0


class Run(Attachment):
    """The record of playing a board: commands that add up (`tailgate.board.run_record` writes them)."""

    FILE, WHAT, MADE_BY = "run.json", "run", "`tailgate leaderboard run`"
    format: Literal["tailgate-run-1"] = "tailgate-run-1"
    hash: str
    seconds: Time
    processor_seconds: Time
    rows: Rows
    commands: Annotated[list[Command], Field(min_length=1)]

    def text(self) -> str:
        """Return what the file holds: `again` only where it says something."""
        return self.model_dump_json(indent=1, exclude=None if self.rows.again else {"rows": {"again"}}) + "\n"

    @classmethod
    def of(cls, board: Path) -> Self | None:
        """Return the record of a board's file; None where there is none or no such one, as a record decides nothing."""
        try:
            return super().of(board)
        except InputError:
            return None

    def belongs(self, board: Board) -> Self | None:
        """Return a record of this version of the suite, else None."""
        return self if (self.suite, self.hash) == (board.suite.name, board.suite.hash) else None

    def said(self, rows: int) -> str:
        """Return a sentence. rows: of the board, which may have met more attacks since."""
        count, machines = len(self.commands), dict.fromkeys((c.workers, c.processor) for c in self.commands)
        how = "one command" if count == 1 else f"{count} commands"
        where = ", ".join(f"{workers} worker{'s' * (workers > 1)}, {name}" for workers, name in machines)
        stand, again = self.rows.played - self.rows.again, f" ({self.rows.again} played twice)" * bool(self.rows.again)
        share = f"all {rows}" if stand >= rows else f"{stand} of {rows}"
        return f"{share} rows{again} by {how} in {lasting(self.seconds)}, {lasting(self.processor_seconds)} of processor time ({where})"


class Attachments(NamedTuple):
    """All attachments of a board; None of what nobody has made."""

    clock: Clock | None = None
    timing: Timing | None = None
    errata: Errata | None = None
    run: Run | None = None
    gap: EqualGap | None = None

    @classmethod
    def of(cls, board: Path) -> Attachments:
        """Return the attachments of a board's file."""
        return cls(Clock.of(board), Timing.of(board), Errata.of(board), Run.of(board), EqualGap.of(board))

    def belonging(self, board: Board) -> Attachments:
        """Return what is of this board. Raises InputError for one of another suite, and for some of another hash."""
        errata = self.errata and self.errata.belongs(board)
        return Attachments(
            self.clock and self.clock.belongs(board), self.timing and self.timing.belongs(board), errata,
            self.run and self.run.belongs(board), self.gap and self.gap.belongs(board),
        )  # fmt: skip

    def superseded(self, defence: str | None = None) -> list[Erratum]:
        """Return the errata of all entries or of one, the latest first."""
        every = self.errata.errata if self.errata is not None else []
        return [one for one in reversed(every) if defence is None or one.about(defence)]
