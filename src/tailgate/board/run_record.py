"""What it took to play a board: run.json beside it. Of clocks and machines board.json, a pure function of rows, says nothing.

    {"format": "tailgate-run-1", "suite", "hash", "seconds", "processor_seconds", "rows": {"played", "kept"}, "commands": [..]}

Each command that played rows has its seconds (of the clock), processor_seconds (with those of its workers), played, workers, processor,
cores, version and commit. Resumed, a run adds up; where no rows are left it begins anew. `kept`: rows of the board that none of them
played; null while they are being played. Where more was played than the board has rows (`again`), newer sources played some of them once
more.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tailgate.base.files import sweep, write_atomic
from tailgate.base.provenance import commit, cores, processor
from tailgate.base.version import VERSION
from tailgate.core.scenario import Suite
from tailgate.sandbox.guard import TICK, descendants

from .run_time import FILE, RunTime, run_of

EVERY = 10.0  # [s] between two writes while rows are played: what a killed command loses


def processor_time() -> float:
    """Seconds of this process and of all below it, those that have ended among them."""
    ended = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    running = sum(int(fields[11]) + int(fields[12]) for fields in descendants().values())
    return sum(used.ru_utime + used.ru_stime for used in ended) + running * TICK


class Record:
    """The clock and the counts of one command that plays a suite into a folder; both begin when it is made."""

    def __init__(self, suite: Suite, folder: Path, workers: int) -> None:
        self.suite, self.path = suite, folder / FILE
        sweep(self.path)
        left = any(any(folder.glob(pattern)) for pattern in ("rows*.jsonl*", ".rows*.parts"))
        held = run_of(self.path) if left else None
        self.before = [command.model_dump() for command in held.commands] if held and held.hash == suite.hash else []
        self.began, self.used, self.written, self.played = time.perf_counter(), processor_time(), time.perf_counter(), 0
        self.about = {
            "workers": workers, "processor": processor(), "cores": cores(), "version": VERSION, "commit": commit(),
        }  # fmt: skip

    def counting(self, told: Callable[..., None]) -> Callable[..., None]:
        """A progress that is called after each cell that was played."""

        def counted(*now: Any) -> None:
            told(*now)
            self.played += self.suite.seeds
            if time.perf_counter() - self.written > EVERY:
                self._write(None)

        return counted

    def finish(self, rows: int) -> str:
        """The record written, and told in a line. rows: of the board. A command that played nothing changes no record."""
        if not self.played:
            return "run: no row was played anew"
        held = self._write(rows)
        counts, commands = held["rows"], len(held["commands"])
        return (
            f"run: {counts['played']} rows played, {counts['kept']} kept; {held['seconds']:.0f} s, {held['processor_seconds']:.0f} s of "
            f"processor time, {commands} command{'s' * (commands > 1)} ({self.path})"
        )

    def _write(self, rows: int | None) -> dict[str, Any]:
        now = {"seconds": time.perf_counter() - self.began, "processor_seconds": processor_time() - self.used}
        commands = [*self.before, {key: round(value, 2) for key, value in now.items()} | {"played": self.played} | self.about]
        sums = {key: round(sum(command[key] for command in commands), 2) for key in ("seconds", "processor_seconds", "played")}
        played = int(sums.pop("played"))
        held = {
            "format": RunTime.model_fields["format"].default, "suite": self.suite.name, "hash": self.suite.hash, **sums,
            "rows": {"played": played, "kept": None if rows is None else max(0, rows - played)}, "commands": commands,
        }  # fmt: skip
        if rows is not None and played > rows:
            held["rows"]["again"] = played - rows
        write_atomic(self.path, json.dumps(held, indent=1, allow_nan=False).encode() + b"\n")
        self.written = time.perf_counter()
        return held
