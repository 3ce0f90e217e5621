"""What lies beside a board and is not of its rows: step times, what timing is worth, what was wrong before, and what playing it took."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from tailgate.base.errors import InputError

from .clock import Clock, clock_of
from .errata import Errata, Erratum, errata_of
from .run_time import RunTime, run_of
from .schema import Board
from .timing import Timing, timing_of


class Measured(NamedTuple):
    """None of what nobody has measured."""

    clock: Clock | None = None
    timing: Timing | None = None
    errata: Errata | None = None
    run: RunTime | None = None

    def belongs(self, board: Board) -> Measured:
        """What is of this board: a run of this version of its suite, an attacker's timing as long as its cell says the same.

        Raises InputError for what else is of another suite.
        """
        mine, clock, timing, errata = board.suite, self.clock, self.timing, self.errata
        run = self.run if self.run is not None and (self.run.suite, self.run.hash) == (mine.name, mine.hash) else None
        if errata is not None and errata.suite != mine.name:
            raise InputError("errata: suite", errata.suite, f"{mine.name}, whose board they lie beside")
        if clock is not None and clock.suite != mine.name:
            raise InputError("step times: suite", clock.suite, f"{mine.name}, whose board they lie beside")
        if timing is None:
            return self._replace(run=run)
        for name, wanted in (("suite", mine.name), ("hash", mine.hash), ("beacon", mine.beacon or "")):
            if (told := getattr(timing, name)) != wanted:
                raise InputError(f"timing advantages: {name}", told, f"{wanted!r}, as of the board that they lie beside")
        held = {(c.defence, c.attack, c.scenario, c.dose): c.damage.value for c in board.cells if c.damage}
        kept = [e for e in timing.entries if held.get((e.defence, e.attack, e.scenario, e.dose)) == e.board]
        return self._replace(run=run, timing=timing.model_copy(update={"entries": kept}))

    def superseded(self, defence: str | None = None) -> list[Erratum]:
        """What was wrong, of all entries or of one, the latest first."""
        told = self.errata.errata if self.errata is not None else []
        return [one for one in reversed(told) if defence is None or one.about(defence)]


def measured_of(board: Path) -> Measured:
    """What lies beside a board's file."""
    return Measured(clock_of(board), timing_of(board), errata_of(board), run_of(board))
