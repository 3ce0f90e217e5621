"""A measurement: a line with a name, a unit, and a function that runs for about the seconds that it is given."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

RATE, SECONDS, BYTES, SHARE, NUMBER = "1/s", "s", "bytes", "share", "number"


class Missing(Exception):
    """A line needs something that is not installed on this machine. The text says what, and how to get it."""


class Sample(NamedTuple):
    """One measurement is amount / per: steps and seconds for a rate, seconds and starts for a duration."""

    amount: float
    per: float

    @property
    def value(self) -> float:
        return self.amount / self.per


Go = Callable[[float], Sample]  # runs for about these seconds


@dataclass(frozen=True)
class Line:
    """One thing that is measured. `make` sets it up, and raises Missing where it cannot be had."""

    name: str
    what: str
    make: Callable[[], Go]
    unit: str = RATE
    of: str = "steps"  # what is counted
    ours: bool = True
    cores: int = 1
    most: int | None = None  # rounds, where one takes long or all give the same


def repeated(chunk: Callable[[], int]) -> Go:
    """Call `chunk`, which returns how much it did, until the seconds are over, at least once: how much in how much processor time.

    Of this process, all its threads together, so that others on the machine do not count, and nobody gains by a second core.
    """

    def go(seconds: float) -> Sample:
        done, spent, until = 0, time.process_time(), time.perf_counter() + seconds
        while True:
            done += chunk()
            if time.perf_counter() >= until:
                return Sample(done, max(time.process_time() - spent, 1e-9))

    return go
