"""The writer of run.json (`tailgate.board.attachments.Run`): what it took to play a board.

A resumed run adds up its commands, and so does one that keeps a board's entries. Without rows any other begins again. `kept` is null while
rows are being played. More rows played than the board has (`again`) means that newer sources played some of them once more.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tailgate.base.files import sweep
from tailgate.base.provenance import commit, cores, processor
from tailgate.base.version import VERSION
from tailgate.core.scenario import Suite
from tailgate.sandbox.guard import TICK, descendants

from .attachments import Command, Rows, Run

EVERY = 10.0  # [s] between two writes while rows are played: what a killed command loses


def processor_time() -> float:
    """Return seconds of this process and of all below it, those that have ended among them."""
    ended = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    running = sum(int(fields[11]) + int(fields[12]) for fields in descendants().values())
    return sum(used.ru_utime + used.ru_stime for used in ended) + running * TICK


class Record:
    """The clock and the counts of one command that plays a suite into a folder; both begin when it is made."""

    def __init__(self, suite: Suite, folder: Path, workers: int, keeps: bool = False) -> None:
        self.suite, self.path = suite, folder / Run.FILE
        sweep(self.path)
        left = keeps or any(any(folder.glob(pattern)) for pattern in ("rows*.jsonl*", ".rows*.parts"))
        held = Run.of(self.path) if left else None
        self.before = held.commands if held is not None and held.hash == suite.hash else []
        self.began, self.used, self.written, self.played = time.perf_counter(), processor_time(), time.perf_counter(), 0
        self.about: dict[str, Any] = {
            "workers": workers, "processor": processor(), "cores": cores(), "version": VERSION, "commit": commit(),
        }  # fmt: skip

    def counting(self, progress: Callable[..., None]) -> Callable[..., None]:
        """Return a progress that is called after each cell that was played."""

        def counted(*now: object) -> None:
            progress(*now)
            self.played += self.suite.seeds
            if time.perf_counter() - self.written > EVERY:
                self._write(None)

        return counted

    def finish(self, rows: int) -> str:
        """Write the record and return a line that says it. rows: of the board. A command that played nothing changes no record."""
        if not self.played:
            return "run: no new row was played"
        held = self._write(rows)
        commands = len(held.commands)
        return (
            f"run: {held.rows.played} rows played, {held.rows.kept} kept; {held.seconds:.0f} s, {held.processor_seconds:.0f} s of "
            f"processor time, {commands} command{'s' * (commands > 1)} ({self.path})"
        )

    def _write(self, rows: int | None) -> Run:
        seconds, used = time.perf_counter() - self.began, processor_time() - self.used
        this = Command(seconds=round(seconds, 2), processor_seconds=round(used, 2), played=self.played, **self.about)
        commands = [*self.before, this]
        played = sum(command.played for command in commands)
        counts = Rows(played=played, kept=None if rows is None else max(0, rows - played))
        if rows is not None and played > rows:
            counts.again = played - rows
        held = Run(
            suite=self.suite.name, hash=self.suite.hash, seconds=round(sum(c.seconds for c in commands), 2),
            processor_seconds=round(sum(c.processor_seconds for c in commands), 2), rows=counts, commands=commands,
        )  # fmt: skip
        held.write(self.path.parent)
        self.written = time.perf_counter()
        return held
