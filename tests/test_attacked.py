"""A whole board by one command: played, attacked by what was trained for it, scored, with its run time."""

import json
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.cli import board as command

from .commands import ran

TEXT = """about: s
scenarios: [gusty-stop-and-go-v0]
doses: [12]
defences: [none, kf, stand_still]
attacks: [none, 'dos_jam:start_step=100']
seeds: 6
threat: {kinds: [dos_jam, fdi], fdi_bound: 5.0}
adaptive:
  config: car-following
  dose: 12
  knowledge: [black]
  seeds: 2
  changes: [environment.interval=20, environment.frames=1, "rivals=[]"]
  learners:
    cem: [teacher=null, steps=600, "cem={population: 4, episodes: 5, hidden: []}"]
"""


def _run(*arguments: str) -> None:
    assert ran(command, "run", *arguments, "--no-replays", "--workers", "1") == 0


def test_one_command_makes_the_whole_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Who passes the gates is attacked, who fails one is not; once more it plays and trains nothing."""
    file, out = tmp_path / "small-v0.yaml", tmp_path / "out"
    file.write_text(TEXT)
    _run(str(file), "--out", str(out), "--train")
    made = json.loads((out / "small-v0" / "board.json").read_text())
    assert {e["defence"]: e["status"] for e in made["entries"]} == {"none": "unranked", "kf": "ranked", "stand_still": "unranked"}
    assert sorted(path.name for path in out.glob("small-v0/attacked/policies/*/policy-*.json")) == ["policy-0.json", "policy-1.json"]
    assert made["suite"]["rows"] == 6 * (3 * 2 + 2)
    record = json.loads((out / "small-v0" / "run.json").read_text())
    assert record["rows"] == {"played": 48, "kept": 0} and len(record["commands"]) == 1
    before = {path: path.read_bytes() for path in out.glob("**/*") if path.is_file()}
    _run(str(file), "--out", str(out), "--train")
    assert {path: path.read_bytes() for path in out.glob("**/*") if path.is_file()} == before
    assert "no new row was played" in capsys.readouterr().err


def test_rows_of_another_round_are_said_before_anything_is_played(tmp_path: Path) -> None:
    """A folder holds one round; which file is of another is named, and nothing is moved."""
    file, out = tmp_path / "small-v0.yaml", tmp_path / "out"
    file.write_text(TEXT)
    _run(str(file), "--out", str(out), "--unattacked")
    before = {path: path.read_bytes() for path in out.glob("**/*") if path.is_file()}
    with pytest.raises(InputError, match=r"beacon of .*rows\.jsonl\.xz.*another folder"):
        _run(str(file), "--out", str(out), "--beacon", "0123456789abcdef0123")
    assert {path: path.read_bytes() for path in out.glob("**/*") if path.is_file()} == before


def test_what_contradicts_itself_is_refused(tmp_path: Path) -> None:
    """Before anything is played."""
    for other in ("--unattacked", "--score-only"):
        with pytest.raises(InputError, match=f"--train.*{other}"):
            _run("quick-v0", "--out", str(tmp_path), "--train", other)
    assert not list(tmp_path.iterdir())
