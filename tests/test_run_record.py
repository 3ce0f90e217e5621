"""What playing a board took is kept beside it, added up over interruptions, and moves no byte of the board."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import pytest

from tailgate import evaluation
from tailgate.commands import board as command
from tailgate.leaderboard import run_record
from tailgate.leaderboard.run_record import FILE, Record, processor_time
from tailgate.machine import cores, processor
from tailgate.scenario import load_suite
from tailgate.scoring.attacks import attacks_of

SUITE = "name: mine\nscenarios: [gusty-stop-and-go-v0]\ndoses: [12]\ndefences: [none, kf]\nattacks: [none, dropout, 'fdi:value=5']\nseeds: 3\n"


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(SUITE)
    return path


def _run(suite: Path | str, out: Path, *more: str) -> Path:
    parser = argparse.ArgumentParser()
    command.add(parser.add_subparsers())
    options = parser.parse_args(["run", str(suite), "--out", str(out), "--no-replays", "--unattacked", "--workers", "1", *more])
    assert options.run(options) == 0
    return out / (Path(suite).stem if str(suite).endswith(".yaml") else str(suite))


def _held(folder: Path) -> dict[str, Any]:
    held: dict[str, Any] = json.loads((folder / FILE).read_text())
    return held


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
        assert "run: no row was played anew" in capsys.readouterr().err
        assert _held(folder) == held and (folder / "board.json").read_bytes() == board
    (folder / "rows.jsonl.xz").unlink()
    assert len(_held(_run(suite, tmp_path / "out"))["commands"]) == 1  # begun anew: nothing was left of it
    assert (folder / "board.json").read_bytes() == board


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
    suite.write_text(SUITE.replace("fdi:value=5", "fdi:value=6"))
    held = _held(_run(suite, tmp_path / "out"))  # of another suite: a record of its own, in which what was played before is kept
    assert len(held["commands"]) == 1 and held["rows"]["played"] == 6


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "tailgate-run-1", "hash": "HASH", "commands": [{"seconds": "x"}]}'])
def test_a_damaged_record_stops_nothing(suite: Path, tmp_path: Path, text: str) -> None:
    """A record decides nothing: another begins."""
    played = load_suite(str(suite))
    (tmp_path / "rows.jsonl").touch()
    (tmp_path / FILE).write_text(text.replace("HASH", played.hash))
    assert Record(played, tmp_path, 2).before == []
    good = {"format": "tailgate-run-1", "hash": played.hash, "commands": [{"seconds": 1.0, "processor_seconds": 2.0, "played": 3}]}
    (tmp_path / FILE).write_text(json.dumps(good))
    assert Record(played, tmp_path, 2).before == good["commands"]


@pytest.mark.long
def test_quick_is_played_in_five_minutes_on_two_cores(tmp_path: Path) -> None:
    """All built-in defences of quick-v0 against its scripts and what joined its list, scored and drawn: from one command, with two workers."""
    began = time.perf_counter()
    folder = _run("quick-v0", tmp_path, "--workers", "2")
    assert time.perf_counter() - began < 300.0
    suite = load_suite("quick-v0")
    cells = len(suite.scenarios) * len(suite.doses) * len(suite.defences) * len(attacks_of(suite))
    assert _held(folder)["rows"] == {"played": suite.seeds * cells, "kept": 0} and _held(folder)["commands"][0]["workers"] == 2
