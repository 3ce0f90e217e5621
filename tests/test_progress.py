"""Progress without a terminal: lines at each tenth, with the time so far and the time left; searches in other processes are followed."""

import contextlib
import io
import json
from pathlib import Path
from types import SimpleNamespace
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
    out, now = io.StringIO(), iter([0.0, 0.0, 30.0, 60.0, 61.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    with progress.progress(Console(file=out)) as update:
        update("searches", 40, 100, "")
        update("searches", 50, 100, "5 of 10")
        update("searches", 50, 100, "nothing new")
        update("searches", 100, 100, "10 of 10")
    assert out.getvalue().splitlines() == [
        "searches: 40 %", "searches: 50 % 5 of 10 (30 s, about 2.5 min left)", "searches: 100 % 10 of 10 (61 s)",
    ]  # fmt: skip


def test_a_minute_without_a_tenth_has_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    out, now = io.StringIO(), iter([0.0, 1.0, 50.0, 62.0, 90.0, 100.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    with progress.progress(Console(file=out)) as update:
        for done in (0, 20, 31, 45, 50):
            update("searches", done, 500, "")
    assert out.getvalue().splitlines() == ["searches: 6 % (61 s, about 15 min left)", "searches: 10 % (99 s, about 15 min left)"]


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
    """A search notes its percent and its best attack in a file, which is read while it runs and removed in the end."""
    job = _job(3)
    note, seen, told = standard._note(job, tmp_path), [], []

    def search(_: Any, folder: Path, tell: Any) -> dict[str, Any]:
        tell(1, 4, "a script", 0.0)
        seen.append(json.loads(note.read_bytes()))
        while not told or told[-1][0] != 25:
            pass
        return {}

    monkeypatch.setattr(standard, "PAUSE", 0.01)
    monkeypatch.setattr(standard, "search", search)
    with standard._followed([note, tmp_path / "none"], lambda *words: told.append(words)):
        assert standard._noted(job, tmp_path) == {}
    text = ", road, dose 3: a script"
    assert seen == [[25, text]] and (25, text) in told and not note.exists()


def _job(number: int) -> Any:
    place = SimpleNamespace(scenario="road", dose=number)
    return SimpleNamespace(name=str(number), arena=place)


def _found(*_: object) -> dict[str, Any]:
    return {"scenario": "road", "members": [], "listed": None}


def test_a_search_that_ends_takes_nothing_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The note of a search is gone before its result counts, and one of a killed run says nothing."""
    told: list[int] = []
    jobs = [_job(0), _job(1)]

    def each(*_: object) -> Any:
        assert not standard._note(jobs[1], tmp_path).exists()
        follow[0](150)
        follow[0](60)  # the first search has ended, and its result is on the way
        yield 0, _found()
        yield 1, _found()

    follow: list[Any] = []
    monkeypatch.setattr(standard, "_followed", lambda _, update: follow.append(update) or contextlib.nullcontext())
    monkeypatch.setattr(standard, "each", each)
    (tmp_path / "searches").mkdir()
    standard._note(jobs[1], tmp_path).write_bytes(b"90")
    standard.searched(jobs, tmp_path, 2, lambda _, done, total, text: told.append(done) or told.append(total))
    assert told == [0, 200, 150, 200, 150, 200, 150, 200, 200, 200]


def test_searches_in_turn_count_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = []

    def search(job: Any, _: Path, tell: Any) -> dict[str, Any]:
        tell(1, 4, "the best so far", 0.0)
        return _found()

    monkeypatch.setattr(standard, "search", search)
    standard.searched([_job(0), _job(1)], tmp_path, 1, lambda *words: told.append(words))
    assert told[1] == ("searches", 25, 200, "0 of 2, road, dose 0: the best so far")
    assert [words[1] for words in told] == [0, 25, 100, 125, 200]


def test_a_folder_that_takes_no_notes_ends_no_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "searches").write_text("a file")
    monkeypatch.setattr(standard, "search", lambda _, folder, tell: tell(1, 4, "", 0.0) or {})
    assert standard._noted(_job(1), tmp_path) == {}
