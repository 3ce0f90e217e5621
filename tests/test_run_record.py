"""What playing a board took is kept beside it, added up over interruptions, and moves no byte of the board."""

import json
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

from tailgate.base import sources
from tailgate.base.progress import lasting
from tailgate.base.provenance import cores, processor
from tailgate.board import run_record
from tailgate.board.attachments import Attachments, Run
from tailgate.board.files import load
from tailgate.board.run_record import Record, processor_time
from tailgate.cli import board as command
from tailgate.core.scenario import load_suite
from tailgate.evaluation import cells as evaluation
from tailgate.evaluation.attack_list import attacks_of
from tailgate.site.build import build_site

from .commands import ran

SUITE = "name: mine\nscenarios: [thesis-ch4-v0]\ndoses: [12]\ndefences: [none, kf]\nattacks: [none, dropout, 'fdi:value=5']\nseeds: 3\n"


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(SUITE)
    return path


def _run(suite: Path | str, out: Path, *more: str) -> Path:
    assert ran(command, "run", str(suite), "--out", str(out), "--no-replays", "--unattacked", "--workers", "1", *more) == 0
    return out / (Path(suite).stem if str(suite).endswith(".yaml") else str(suite))


def _held(folder: Path) -> dict[str, Any]:
    held: dict[str, Any] = json.loads((folder / Run.FILE).read_text())
    return held


@pytest.mark.long
def test_a_run_says_what_it_took(suite: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Clock, processor, rows; who plays nothing, or scores alone, changes neither record nor board."""
    began, used = time.perf_counter(), processor_time()
    folder = _run(suite, tmp_path / "out")
    held, board = _held(folder), (folder / "board.json").read_bytes()
    (mine,) = held["commands"]
    assert 0 < held["seconds"] == mine["seconds"] <= time.perf_counter() - began
    assert 0 < held["processor_seconds"] == mine["processor_seconds"] <= processor_time() - used
    assert held["rows"] == {"played": 18, "kept": 0} and mine["played"] == 18 and held["hash"] == load_suite(str(suite)).hash
    assert (mine["workers"], mine["processor"], mine["cores"]) == (1, processor(), cores())
    assert "run: 18 rows played, 0 kept; " in capsys.readouterr().err
    for more in ((), ("--score-only",)):
        _run(suite, tmp_path / "out", *more)
        assert "run: no new row was played" in capsys.readouterr().err
        assert _held(folder) == held and (folder / "board.json").read_bytes() == board
    (folder / "rows.jsonl.xz").unlink()
    played = load_suite(str(suite))
    assert [len(run_record.Record(played, folder, 1, keeps).before) for keeps in (True, False)] == [1, 0]
    assert len(_held(_run(suite, tmp_path / "out"))["commands"]) == 1  # begun anew: nothing was left of it
    assert (folder / "board.json").read_bytes() == board


@pytest.mark.long
def test_interrupted_runs_add_up(suite: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each command counts what it played itself; what lay there before any record is kept."""
    monkeypatch.setattr(run_record, "EVERY", 0.0)
    real, calls = evaluation.run_cell, 0

    def interrupted(cell: Any, *rest: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls in (3, 5):
            raise KeyboardInterrupt
        return real(cell, *rest)

    monkeypatch.setattr(evaluation, "run_cell", interrupted)
    folder, seen = tmp_path / "out/mine", []
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            _run(suite, tmp_path / "out")
        seen.append(_held(folder))
    assert [held["rows"] for held in seen] == [{"played": 6, "kept": None}, {"played": 9, "kept": None}]
    held = _held(_run(suite, tmp_path / "out"))
    assert held["rows"] == {"played": 18, "kept": 0} and [one["played"] for one in held["commands"]] == [6, 3, 9]
    for key in ("seconds", "processor_seconds"):
        assert held[key] == pytest.approx(sum(one[key] for one in held["commands"]), abs=0.02)
    assert held["commands"][:2] == seen[1]["commands"]
    monkeypatch.setattr(sources, "own", lambda: "newer")
    held = _held(_run(suite, tmp_path / "out"))
    assert held["rows"] == {"played": 36, "kept": 0, "again": 18}
    suite.write_text(SUITE.replace("fdi:value=5", "fdi:value=6"))
    held = _held(_run(suite, tmp_path / "out"))  # of another suite: a record of its own, in which what was played before is kept
    assert len(held["commands"]) == 1 and held["rows"]["played"] == 6


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "tailgate-run-1", "hash": "HASH", "commands": [{"seconds": "x"}]}'])
def test_a_damaged_record_stops_nothing(suite: Path, tmp_path: Path, text: str) -> None:
    """A record decides nothing: another begins."""
    played = load_suite(str(suite))
    (tmp_path / "rows.jsonl").touch()
    (tmp_path / Run.FILE).write_text(text.replace("HASH", played.hash))
    assert Record(played, tmp_path, 2).before == []
    good = _record("mine", played.hash)
    (tmp_path / Run.FILE).write_text(json.dumps(good))
    assert [command.model_dump() for command in Record(played, tmp_path, 2).before] == good["commands"]
    (tmp_path / Run.FILE).write_text(json.dumps(good | {"hash": "0" * 16}))
    assert Record(played, tmp_path, 2).before == []


def _record(suite: str, identity: str, count: int = 1) -> dict[str, Any]:
    commands = [
        {"seconds": 104.23, "processor_seconds": 181.5, "played": 30, "workers": 2, "processor": "A", "cores": 2, "version": "0.1.0", "commit": None}
    ] * count  # fmt: skip
    sums = {"seconds": 104.23 * count, "processor_seconds": 181.5 * count, "rows": {"played": 30 * count, "kept": 0}}
    return {"format": "tailgate-run-1", "suite": suite, "hash": identity, **sums, "commands": commands}


@pytest.mark.long
def test_a_page_says_what_playing_its_board_took(tmp_path: Path) -> None:
    """In a sentence, of the record beside the board; one of another suite, or another version of it, is left out."""
    once, twice = (Run.model_validate(_record("mine", "0" * 16, count)) for count in (1, 2))
    assert once.said(30) == "all 30 rows by one command in 104 s, 3 min of processor time (2 workers, A)"
    assert twice.said(90) == "60 of 90 rows by 2 commands in 3.5 min, 6 min of processor time (2 workers, A)"
    more = Run.model_validate(_record("mine", "0" * 16) | {"rows": {"played": 30, "kept": 0, "again": 12}})
    assert more.said(90) == "18 of 90 rows (12 played twice) by one command in 104 s, 3 min of processor time (2 workers, A)"
    assert [lasting(seconds) for seconds in (0.0, 1.5, 119.0, 120.0, 7199.0, 7200.0, 12_803.0, 720_000.0)] == [
        "0 s", "1.5 s", "119 s", "2 min", "120 min", "2 h", "3.6 h", "200 h",
    ]  # fmt: skip
    assert Run.of(tmp_path / "board.json") is None
    source = Path("results/quick-v0/board.json")
    board = tmp_path / "quick-v0" / source.name
    board.parent.mkdir()
    shutil.copy(source, board)
    identity = json.loads(board.read_bytes())["suite"]["hash"]
    for suite, mark, shown in (("quick-v0", identity, True), ("quick-v0", "0" * 16, False), ("radar-v0", identity, False)):
        (board.parent / Run.FILE).write_text(json.dumps(_record(suite, mark)))
        assert Run.of(board)
        page = build_site([load(board)], tmp_path / "page", replays=False, measured=[Attachments.of(board)]).read_text()
        assert ("rows by one command in 104 s" in page) == shown, (suite, mark)


@pytest.mark.long
def test_quick_is_played_in_five_minutes_on_two_cores(tmp_path: Path) -> None:
    """All built-in defences of quick-v0 against its scripts and what joined its list, scored and drawn: from one command, with two workers."""
    began = time.perf_counter()
    folder = _run("quick-v0", tmp_path, "--workers", "2")
    assert time.perf_counter() - began < 300.0
    suite = load_suite("quick-v0")
    cells = len(suite.scenarios) * len(suite.doses) * len(suite.defences) * len(attacks_of(suite))
    assert _held(folder)["rows"] == {"played": suite.seeds * cells, "kept": 0} and _held(folder)["commands"][0]["workers"] == 2
