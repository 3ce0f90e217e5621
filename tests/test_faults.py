"""Killed at every write, fsync, rename and remove: no finished cell is lost, nothing broken is read as good, a rerun gives the same bytes."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tailgate.base import files
from tailgate.board import read_attacks
from tailgate.core.scenario import Suite
from tailgate.evaluation import cells as evaluation
from tailgate.evaluation.attack_list import Admitted, append
from tailgate.evaluation.cells import Cell, cells_of, run, run_cell
from tailgate.evaluation.rows import encode, read_rows

from . import dying

SUITE = Suite("small", "", ("thesis-ch4-v0",), (5,), ("kf",), ("none", "fdi:value=5", "dos_hold"), 3)


class Killed(BaseException):
    """Not an Exception: nothing on the way may catch it."""


@pytest.fixture
def kill_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None], list[str]]:
    """Kills at the n-th call of the hook; returns the list of what the hook was called with."""

    def set_up(at: int | None) -> list[str]:
        seen: list[str] = []

        def step(what: str, path: Path) -> None:
            seen.append(f"{what} {path.name}")
            if len(seen) == at:
                raise Killed

        monkeypatch.setattr(files, "step", step)
        return seen

    return set_up


@pytest.fixture(scope="module")
def made() -> dict[str, list[dict[str, Any]]]:
    return {cell.attack: run_cell(cell) for cell in cells_of(SUITE)}


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch, made: dict[str, list[dict[str, Any]]]) -> list[str]:
    """The attacks of the cells that were played; their rows were made once."""
    names: list[str] = []

    def quick(cell: Cell) -> list[dict[str, Any]]:
        names.append(cell.attack)
        return [dict(row) for row in made[cell.attack]]

    monkeypatch.setattr(evaluation, "run_cell", quick)
    return names


def _finished(folder: Path) -> set[str]:
    """Attacks whose rows lie in the output or in a part."""
    found = [folder / "rows.jsonl", *(folder / ".rows.jsonl.parts").glob("*.jsonl")]
    return {row["attack"] for path in found if path.is_file() for row in read_rows(path)}  # reads each: a broken one raises


def test_a_run_that_is_killed_anywhere_goes_on_where_it_was(tmp_path: Path, kill_at: Any, played: list[str]) -> None:
    """At every call of the hook: cells that were renamed into their place are kept, and the rerun's bytes are those of a run in peace."""
    cells = cells_of(SUITE)
    (tmp_path / "whole").mkdir()
    calls = kill_at(None)
    run(cells, tmp_path / "whole/rows.jsonl")
    whole, calls = (tmp_path / "whole/rows.jsonl").read_bytes(), list(calls)
    assert {call.split()[0] for call in calls} == {"write", "fsync", "rename", "remove"}
    assert sum(call.startswith("write") for call in calls) == len(cells) + 1
    for at in range(1, len(calls) + 1):
        folder = tmp_path / str(at)
        folder.mkdir()
        kill_at(at)
        played.clear()
        with pytest.raises(Killed):
            run(cells, folder / "rows.jsonl")
        renamed = {call.split()[1] for call in calls[:at - 1] if call.startswith("rename")}
        kept, before = _finished(folder), list(played)
        assert len(kept) >= len(renamed - {"rows.jsonl"}), calls[at - 1]
        unfinished = [cell.attack for cell in cells if cell.attack not in kept]
        kill_at(None)
        played.clear()
        run(cells, folder / "rows.jsonl")
        assert (folder / "rows.jsonl").read_bytes() == whole, calls[at - 1]
        assert [path.name for path in folder.iterdir()] == ["rows.jsonl"], calls[at - 1]
        if not (renamed & {"rows.jsonl"}):  # else the parts of what is in the output may have gone
            assert played == unfinished, (calls[at - 1], before)


def test_a_run_that_is_killed_again_while_it_goes_on_loses_nothing(tmp_path: Path, kill_at: Any, played: list[str]) -> None:
    """Killed at its 1st, 2nd, 3rd ... call again and again, until it comes through."""
    cells, out = cells_of(SUITE), tmp_path / "rows.jsonl"
    kept: set[str] = set()
    for at in range(5, 60):
        kill_at(at)
        try:
            run(cells, out)
            break
        except Killed:
            assert kept <= _finished(tmp_path)
            kept = _finished(tmp_path)
    assert out.read_bytes() == encode([row for cell in cells for row in evaluation.run_cell(cell)])
    assert [path.name for path in tmp_path.iterdir()] == ["rows.jsonl"]


def test_somebody_elses_result_survives_every_kill(tmp_path: Path, kill_at: Any, played: list[str]) -> None:
    """Rows of other cells under the name of the output are there afterwards, under it or set aside, whenever it is killed."""
    cells = cells_of(SUITE)
    other = run_cell(Cell("s", "thesis-ch4-v0", None, "kf", "dropout", 2))
    for at in range(1, 40):
        folder = tmp_path / str(at)
        folder.mkdir()
        (folder / "rows.jsonl").write_bytes(encode(other))
        calls = kill_at(at)
        try:
            run(cells, folder / "rows.jsonl")
        except Killed:
            assert encode(other) in {(folder / name).read_bytes() for name in ("rows.jsonl", "rows.jsonl.1") if (folder / name).exists()}
            kill_at(None)
            run(cells, folder / "rows.jsonl")
        assert (folder / "rows.jsonl.1").read_bytes() == encode(other)
        if len(calls) < at:
            break
    assert at > 15


@pytest.mark.parametrize("damage", ["empty", "cut in a line", "cut after a line", "zeros", "another cell", "a failed row"])
def test_a_part_that_the_disk_damaged_is_played_again(tmp_path: Path, damage: str, kill_at: Any, played: list[str]) -> None:
    cells, out = cells_of(SUITE), tmp_path / "rows.jsonl"
    calls = kill_at(None)
    run(cells, tmp_path / "whole.jsonl")
    kill_at(next(i for i, call in enumerate(calls, 1) if call == "write whole.jsonl"))
    with pytest.raises(Killed):
        run(cells, out)
    kill_at(None)
    parts = {read_rows(path)[0]["attack"]: path for path in (tmp_path / ".rows.jsonl.parts").iterdir()}
    part, good = parts["none"], parts["none"].read_bytes()
    lines = good.splitlines(keepends=True)
    part.write_bytes(
        {
            "empty": b"", "cut in a line": good[:-40], "cut after a line": b"".join(lines[:-1]), "zeros": bytes(len(good)),
            "another cell": parts["dos_hold"].read_bytes(), "a failed row": good.replace(b'"status": "ok"', b'"status": "error"', 1),
        }[damage]
    )  # fmt: skip
    played.clear()
    run(cells, out)
    assert played == ["none"] and out.read_bytes() == (tmp_path / "whole.jsonl").read_bytes()


def test_an_interrupt_leaves_the_old_file_and_nothing_beside_it(tmp_path: Path, kill_at: Any) -> None:
    path = tmp_path / "file"
    files.write_atomic(path, b"old")
    for at, what in enumerate(("write file", "fsync file", "rename file"), 1):
        seen = kill_at(at)
        with pytest.raises(Killed):
            files.write_atomic(path, b"new")
        assert seen[-1] == what and path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"]
    kill_at(4)
    with pytest.raises(Killed):
        files.write_atomic(path, b"new")
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["file"]


def test_only_what_a_killed_writer_left_is_swept(tmp_path: Path) -> None:
    names = [".rows.jsonl.abc.tmp", ".other.jsonl.abc.tmp", ".rows.jsonl.parts", "rows.jsonl", "rows.tmp"]
    for name in names:
        (tmp_path / name).write_text("")
    files.sweep(tmp_path / "rows.jsonl")
    assert sorted(os.listdir(tmp_path)) == sorted(names[1:])


def _all_die(job: str, folder: Path, every: int = 1) -> int:
    """Processes that do a job die at calls of the hook, in a folder each; -> the number of the one that came to its end."""
    done = subprocess.run([sys.executable, dying.__file__ or "", job, str(folder), str(every)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    last, code = map(int, done.stdout.split())
    assert code == 0, done.stderr
    return last


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.long), 22])
def test_a_board_that_is_killed_at_any_step_is_made_whole_by_the_same_command(tmp_path: Path, every: int) -> None:
    """Packed rows, board.json and run.json: dead at a call of the hook, nothing broken lies there, and a rerun gives the same rows and board."""
    (tmp_path / dying.NAME).write_text(dying.FILE)
    last = _all_die("board", tmp_path, every)
    whole = tmp_path / str(last)
    assert last > 30 and sorted(os.listdir(whole)) == ["board.json", "rows.jsonl.xz", "run.json"]
    for folder in (tmp_path / str(at) for at in range(1, last, every)):
        for path in folder.glob("*.json"):
            json.loads(path.read_text())
        for path in folder.glob("**/rows*.jsonl*"):
            read_rows(path)
        dying.board(folder)
        assert all((folder / name).read_bytes() == (whole / name).read_bytes() for name in ("rows.jsonl.xz", "board.json")), folder
        assert {*os.listdir(folder)} - {"run.json"} == {"board.json", "rows.jsonl.xz"}, folder  # what played nothing records nothing


def test_a_list_of_attacks_survives_every_kill(tmp_path: Path, kill_at: Any) -> None:
    """It holds all lines that were there, and the new one or not."""
    path = tmp_path / "attacks.jsonl"
    kill_at(None)
    append(path, Admitted("fdi", "", "black", "2026-11-25"))
    for at in range(1, 20):
        calls = kill_at(at)
        with contextlib.suppress(Killed):
            append(path, Admitted(f"fdi:value={at}", "", "black", "2026-11-25"))
        held = [line.attack for line in read_attacks(path)]
        assert held[0] == "fdi" and len(held) - 1 <= at
        if len(calls) < at:
            break
    assert held[-1] == f"fdi:value={at}" and at > 3


@pytest.mark.long  # the board above dies in the same way
@pytest.mark.parametrize("every", [1, 5])
def test_a_process_that_dies_at_any_step_leaves_nothing_broken(tmp_path: Path, every: int) -> None:
    """os._exit at a call of the hook: nothing is tidied up, and the rerun still gives the same bytes and leaves no temporary file."""
    last = _all_die("rows", tmp_path, every)
    assert last > 12
    whole = (tmp_path / str(last) / "rows.jsonl").read_bytes()
    left = 0
    for at in range(1, last, every):
        folder = tmp_path / str(at)
        _finished(folder)
        left += len([*folder.glob(".*.tmp"), *folder.glob(".*/.*.tmp")])
        dying.rows(folder)
        assert (folder / "rows.jsonl").read_bytes() == whole
        assert [path.name for path in folder.iterdir()] == ["rows.jsonl"]
    assert left >= 6 // every  # of two cells and the output, killed before the fsync and before the rename


@pytest.mark.long
def test_a_run_that_is_killed_at_a_random_time_goes_on(tmp_path: Path) -> None:
    """SIGKILL at some time after the first cell: the smoke test of the command. Its two workers end with it, and the rerun is whole."""
    defences, attacks, out = ("kf", "chi2_kf"), ("none", "fdi:value=5", "dos_hold"), tmp_path / "rows.jsonl"
    command = [sys.executable, "-m", "tailgate", "evaluate", "--scenario", "thesis-ch4-v0", "--seeds", "3", "--workers", "2", "--out", str(out)]
    command += [word for name in defences for word in ("--defence", name)] + [word for name in attacks for word in ("--attack", name)]
    wait = random.random()
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    parts = tmp_path / ".rows.jsonl.parts"
    while running.poll() is None and not list(parts.glob("*.jsonl")):
        time.sleep(0.01)
    time.sleep(wait)
    workers = dying.children(running.pid) if running.poll() is None else []
    running.send_signal(signal.SIGKILL)
    running.wait()
    for path in parts.glob("*.jsonl"):
        assert len(read_rows(path)) == 3, f"killed {wait} s after the first cell"
    assert not dying.left(workers)
    suite = Suite("custom", "", ("thesis-ch4-v0",), (None,), defences, attacks, 3)
    rows = run(cells_of(suite), out)
    assert rows == run(cells_of(suite)) and out.read_bytes() == encode(rows)
    assert os.listdir(tmp_path) == ["rows.jsonl"]
