"""Progress of long work on standard error: a bar on a terminal, elsewhere a line per tenth, or a minute after the last one."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

SILENCE = 60.0  # [s]; the longest without a line, where anything is done meanwhile
KEPT = 8  # finished bars that stay on a terminal
Update = Callable[[str, int, int, str], None]  # label, done, total, figures
_silent: ContextVar[bool] = ContextVar("silent", default=False)


@contextmanager
def silent() -> Iterator[None]:
    """Show no progress within a block."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)


@contextmanager
def progress(shown_on: Console) -> Iterator[Update]:
    """Yield a function update(label, done, total, figures); each label has one bar.

    Lines have the time since the label's first update, and from a minute on the time left at the pace since then. A label begins again
    where less is done than before.
    """
    if _silent.get():
        yield lambda *_: None
        return
    if not shown_on.is_terminal or shown_on.is_dumb_terminal:
        shown: dict[str, int] = {}
        begun: dict[str, tuple[float, int]] = {}
        said = time.monotonic()

        def line(label: str, done: int, total: int, figures: str = "") -> None:
            nonlocal said
            now, tenth = time.monotonic(), 10 * done // max(total, 1)
            if tenth < shown.get(label, 0):
                del shown[label], begun[label]
            since, before = begun.setdefault(label, (now, done))
            if tenth > shown.get(label, 0) or now - said >= SILENCE:
                percent = 10 * tenth if tenth > shown.get(label, 0) else 100 * done // max(total, 1)
                shown[label], said = tenth, now
                took = now - since
                left = took * (total - done) / (done - before) if done > before else 0.0
                times = f" ({lasting(took)}{f', about {lasting(left)} left' if left >= 60.0 else ''})" if took >= 1.0 else ""
                with contextlib.suppress(OSError):  # nobody reads it, or the disk is full: progress is worth no run
                    shown_on.print(f"{label}: {percent} % {figures}".rstrip() + times, highlight=False, soft_wrap=True, markup=False)

        yield line
        return
    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[figures]}", markup=False), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=shown_on) as bars:
        tasks: dict[str, object] = {}

        def bar(label: str, done: int, total: int, figures: str = "") -> None:
            if label not in tasks:
                for old in bars.tasks[:-KEPT]:  # a terminal has no room for the bars of a whole board
                    bars.update(old.id, visible=not old.finished)
                tasks[label] = bars.add_task(label, total=total, figures="")
            bars.update(tasks[label], completed=done, total=total, figures=figures)  # type: ignore[arg-type]

        yield bar


def lasting(seconds: float) -> str:
    """Return a time as people say it."""
    unit, name = next((u, n) for u, n in ((3600.0, "h"), (60.0, "min"), (1.0, "s")) if seconds >= 2 * u or u == 1.0)
    return f"{seconds / unit:.2g} {name}" if seconds < 99.5 * unit else f"{seconds / unit:.0f} {name}"


def cells(done: int, total: int) -> str:
    """Return the words next to the bar of an evaluation."""
    return f"{done} of {total} cells"


def console() -> Console:
    """Return the console of standard output: as wide as the terminal, or 160 columns without one."""
    return Console(width=None if sys.stdout.isatty() else 160)
