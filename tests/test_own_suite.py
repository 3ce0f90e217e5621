"""A user's suite whose scenarios are files: its rows and boards have the names of the scenarios, not the paths."""

import json
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.board.files import load, read_board
from tailgate.cli import main
from tailgate.core.scenario import load_suite

SUITE = """
scenarios: [short.yaml, loaded.yaml]
robustness: [loaded.yaml]
doses: [10]
defences: [none, chi2_kf]
attacks: [none, 'fdi:start_step=20,value=-30']
seeds: 4
progress: 0.5
"""
FEW = ("--hours", "0.02", "--onsets", "4", "--steps", "4000", "--episodes", "4")


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of the suite, in the working directory."""
    monkeypatch.chdir(tmp_path)
    for name, base in (("short", "gusty-stop-and-go-v0"), ("loaded", "car-following-heavy-v0")):
        Path(f"{name}.yaml").write_text(f"base: {base}\nhorizon: 80\n", encoding="utf-8")
    Path("mine.yaml").write_text(SUITE, encoding="utf-8")
    return Path("mine.yaml")


def test_its_board_is_played_scored_and_detected(mine: Path) -> None:
    """A gate, a share for robustness or a line of detection would be looked for under the path of a file."""
    run = ["leaderboard", "run", str(mine), "--out", "out", "--no-replays", "--workers", "1"]
    assert main(run) == 0
    assert main(["leaderboard", "detect", str(mine), "--out", "out", "--workers", "1", *FEW]) == 0
    board = load(Path("out/mine/board.json"))
    read_board(board)
    assert [(s["name"], s["robustness"]) for s in board["suite"]["scenarios"]] == [("short", False), ("loaded", True)]
    assert {cell["scenario"] for cell in board["cells"]} == {"short", "loaded"}
    (entry,) = (entry for entry in board["entries"] if entry["defence"] == "chi2_kf")
    assert [line["scenario"] for line in entry["robustness"]] == ["loaded"]
    assert board["detection"]["plants"] == [["short"]] and {line["scenario"] for line in board["detection"]["entries"]} == {"short"}
    assert main([*run, "--score-only"]) == 0
    assert json.dumps(load(Path("out/mine/board.json"))["detection"]) == json.dumps(board["detection"])


def test_two_scenarios_of_one_name_are_refused(mine: Path) -> None:
    Path("other").mkdir()
    Path("other/short.yaml").write_text("base: braking-v0\n", encoding="utf-8")
    mine.write_text(SUITE.replace("loaded.yaml]\nrob", "loaded.yaml, other/short.yaml]\nrob"), encoding="utf-8")
    with pytest.raises(InputError, match=r"scenarios: got 'other/short\.yaml'; expected another name than short, which is that of short\.yaml"):
        load_suite(str(mine))
