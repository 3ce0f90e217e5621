"""Limits of sizes, estimates of memory, and an announcement before long work.

A size above its entry in LIMITS, or above the free memory, is refused before anything is allocated.
The limits are far above useful values; they stop typing errors, such as a million for a thousand.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from tailgate.base.errors import InputError

LIMITS = {
    "workers": 1024, "threads": 1024, "rounds": 100_000, "trials": 100_000, "particles": 1_000_000,
    "seeds": 10_000_000, "episodes": 10_000_000, "runs": 10_000_000, "sample": 1_000_000_000, "onsets": 10_000_000, "most": 1_000_000,
    "batch": 1_000_000, "num_envs": 10_000_000, "steps": 100_000_000_000,
}  # fmt: skip
Workers = Annotated[int, Field(ge=1, le=1024)]
Seeds = Annotated[int, Field(ge=1, le=100_000)]  # trainings, one policy each
Episodes = Annotated[int, Field(ge=1, le=10_000_000)]
Steps = Annotated[int, Field(ge=1, le=100_000_000_000)]  # decisions of a training
Rows = Annotated[int, Field(ge=1, le=10_000_000)]  # in parallel or in a sample: environments, rollouts, populations, batches
Passes = Annotated[int, Field(ge=1, le=100_000)]  # repetitions: epochs, rounds, gradient steps
Width = Annotated[int, Field(ge=1, le=100_000)]  # of a layer

WORKER = 150e6  # [bytes] per worker process
ROW = 9e3  # [bytes] per row in memory
ENVIRONMENT = 1.2e3  # [bytes] per environment of a batch, without its matrices
EPISODES_A_SECOND, DECISIONS_A_SECOND = 5_000, 2_000_000  # upper limits per process
LONG = 1800.0  # [s] beyond which work is announced

tell: Callable[[str], None] | None = None
"""Hook called with a sentence before long work begins; the command line prints it."""


def check(name: str, value: Any, field: str = "") -> int:
    """Return the size as an int; raise InputError unless it is a whole number from 1 to its limit.

    The error names `field`, or else `name`.
    """
    most = LIMITS[name]
    whole = not isinstance(value, bool) and hasattr(value, "__index__")
    if not whole or value < 1:
        raise InputError(field or name, value, "a whole number not below 1")
    if value > most:
        raise InputError(field or name, value, f"a whole number from 1 to {most:,}")
    if name == "workers":
        fits(value * WORKER, name, value, f"{value} processes")
    return int(value)


def free() -> float:
    """Return the free memory [bytes] within the limits of the system and the container; infinite if unknown."""
    found = [float("inf")]
    with contextlib.suppress(OSError, StopIteration, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(1024.0 * float(next(line for line in lines if line.startswith("MemAvailable")).split()[1]))
    with contextlib.suppress(OSError, ValueError):
        held = Path("/sys/fs/cgroup")
        found.append(float((held / "memory.max").read_text()) - float((held / "memory.current").read_text()))
    return max(min(found), 0.0)


def fits(needed: float, field: str, value: object, what: str) -> None:
    """Raise InputError if `needed` bytes are not free."""
    if needed > 1e8 and needed > (have := free()):
        raise InputError(field, value, f"less: {what} take about {needed / 1e9:,.1f} GB, and {have / 1e9:,.1f} GB of memory are free")


def announce(seconds: float, needed: float, what: str) -> None:
    """Announce long work before it begins."""
    if tell is not None and seconds > LONG:
        memory = f" and {needed / 1e9:,.1f} GB of memory" if needed > 1e9 else ""
        tell(f"{what} take at least {spoken(seconds)}{memory}, on a fast machine")


def spoken(seconds: float) -> str:
    """Return a duration [s] in words."""
    for unit, length in (("years", 31_557_600.0), ("days", 86_400.0), ("hours", 3600.0)):
        if seconds >= length:
            return f"{seconds / length:,.1f} {unit}"
    return f"{seconds / 60.0:,.0f} minutes"
