"""Progress without a terminal: lines at each tenth, with the time so far and the time left; searches in other processes are followed."""

import io
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.progress import Progress as Bars

from tailgate.base import progress
from tailgate.ensemble import standard


@pytest.mark.parametrize(("seconds", "words"), [(0.4, "0.4 s"), (59.4, "59 s"), (200.0, "3.3 min"), (7500.0, "2.1 h")])
def test_times_in_words(seconds: float, words: str) -> None:
    assert progress.lasting(seconds) == words


def test_lines_have_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the pace since the first update: a resumed run did not do at once what it found."""
    out, now = io.StringIO(), iter([0.0, 30.0, 60.0, 61.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    with progress.progress(Console(file=out)) as update:
        update("searches", 40, 100, "")
        update("searches", 50, 100, "5 of 10")
        update("searches", 50, 100, "nothing new")
        update("searches", 100, 100, "10 of 10")
    assert out.getvalue().splitlines() == [
        "searches: 40 %", "searches: 50 % 5 of 10 (30 s, about 2.5 min left)", "searches: 100 % 10 of 10 (61 s)",
    ]  # fmt: skip


def test_a_label_that_is_used_again_begins_again() -> None:
    """As for the next defence of a board."""
    out = io.StringIO()
    with progress.progress(Console(file=out)) as update:
        for done in (0, 6, 0, 3, 3, 6):
            update("searches", done, 6, f"{done} of 6")
    assert out.getvalue().splitlines() == ["searches: 100 % 6 of 6", "searches: 50 % 3 of 6", "searches: 100 % 6 of 6"]


def test_a_terminal_keeps_the_last_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bars that are not finished stay too."""
    held: list[Any] = []
    monkeypatch.setattr(progress, "Progress", lambda *columns, console: held.append(Bars(*columns, console=console)) or held[0])
    with progress.progress(Console(file=io.StringIO(), force_terminal=True)) as update:
        for number in range(30):
            update(f"defence {number}", 3 if number == 5 else 6, 6, "")
    shown = [task.description for task in held[0].tasks if task.visible]
    assert shown == ["defence 5", *(f"defence {number}" for number in range(21, 30))]


def test_searches_in_other_processes_are_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search notes its percent in a file, which is read while it runs and removed in the end."""
    job: Any = type("Job", (), {"name": "one"})()
    note, seen, told = standard._note(job, tmp_path), [], []

    def search(_: Any, folder: Path, tell: Any) -> dict[str, Any]:
        tell(1, 4, "", 0.0)
        seen.append(note.read_bytes())
        while not told or told[-1] != 25:
            pass
        return {}

    monkeypatch.setattr(standard, "PAUSE", 0.01)
    with standard._followed([note, tmp_path / "none"], told.append):
        assert partial(standard._noted, search)(job, tmp_path) == {}
    assert seen == [b"25"] and 25 in told and not note.exists()


def test_a_folder_that_takes_no_notes_ends_no_search(tmp_path: Path) -> None:
    job: Any = type("Job", (), {"name": "one"})()
    (tmp_path / "searches").write_text("a file")
    assert standard._noted(lambda _, folder, tell: tell(1, 4, "", 0.0) or {}, job, tmp_path) == {}
