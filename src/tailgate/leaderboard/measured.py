"""What lies beside a board and is not of its rows: step times, and what the timing of its attackers is worth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from tailgate.errors import InputError

from .clock import Clock, clock_of
from .timing import Timing, timing_of


class Measured(NamedTuple):
    """None of what nobody has measured."""

    clock: Clock | None = None
    timing: Timing | None = None

    def belongs(self, suite: str) -> None:
        """Raise InputError where something is of another suite than the board that it lies beside."""
        for what, held in (("step times", self.clock), ("timing advantages", self.timing)):
            if held is not None and held.suite != suite:
                raise InputError(f"{what}: suite", held.suite, f"{suite}, whose board they lie beside")


def measured_of(board: Path) -> Measured:
    """What lies beside a board's file."""
    return Measured(clock_of(board), timing_of(board))
