"""What a board has beside the figures of its rows is still there when it is scored again."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from tailgate.base.errors import InputError
from tailgate.cli import board as command
from tailgate.core.scenario import load_suite
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.rows import encode

from .commands import ran

Data = dict[str, Any]
TEXT = "about: s\nscenarios: [thesis-ch4-v0]\ndoses: [5]\ndefences: [none, kf, chi2_kf]\nattacks: [none, 'fdi:value=5']\nseeds: 4\n"
DETECTED = {"scenario": "thesis-ch4-v0", "attack": "fdi:value=5", "hours": 1.0, "threshold": 9.0, "detected": None, "delay": None}
CHECKED = {"cells": 2, "equal": 2, "differs": 0, "unchecked": 0}


def _scored(suite: Path, out: Path) -> Data:
    assert ran(command, "run", str(suite), "--out", str(out), "--score-only", "--no-replays", "--unattacked") == 0
    held: Data = json.loads((out / "small-v0" / "board.json").read_text())
    return held


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[Data]:
    file = tmp_path_factory.mktemp("suite") / "small-v0.yaml"
    file.write_text(TEXT)
    return run(cells_of(load_suite(str(file))))


@pytest.fixture
def folder(tmp_path: Path, rows: list[Data]) -> Path:
    (tmp_path / "small-v0.yaml").write_text(TEXT)
    (tmp_path / "small-v0").mkdir()
    (tmp_path / "small-v0" / "rows.jsonl").write_bytes(encode(rows))
    return tmp_path


@pytest.fixture
def board(folder: Path) -> Data:
    """A board whose detection was played, and whose cells were checked."""
    made = _scored(folder / "small-v0.yaml", folder)
    for entry in made["entries"]:
        entry["checked"] = CHECKED
    made["entries"][2]["stealth"] = [{"hours": 1.0, "threshold": 9.0, "deviation": 2.0}]
    without = [{"defence": "kf", "plant": "CarFollowing", "hours": 1.0, "reason": "no threshold"}]
    made["detection"] = {"hours": [1.0], "entries": [{"defence": "chi2_kf"} | DETECTED], "without": without}
    (folder / "small-v0" / "board.json").write_text(json.dumps(made))
    return made


def test_scoring_again_keeps_what_rows_do_not_decide(folder: Path, board: Data) -> None:
    assert _scored(folder / "small-v0.yaml", folder) == board


@pytest.mark.long
def test_of_an_entry_whose_cells_changed_nothing_is_kept(folder: Path, board: Data, rows: list[Data]) -> None:
    """Of those whose cells only became more, all is, and the number of cells is told."""
    suite = load_suite(str(folder / "small-v0.yaml"))
    changed = [dict(row) for row in rows]
    for row in changed:
        if row["defence"] == "kf" and row["seed"] == 0:
            row["decision_hash"] = row["decision_hash"][::-1]
    more = run(cells_of(dataclasses.replace(suite, defences=("chi2_kf",), attacks=("dropout",))))
    (folder / "small-v0" / "rows.jsonl").write_bytes(encode([*changed, *more]))
    again = _scored(folder / "small-v0.yaml", folder)
    entries = {entry["defence"]: entry for entry in again["entries"]}
    assert "checked" not in entries["kf"] and entries["none"]["checked"] == CHECKED
    assert entries["chi2_kf"]["checked"] == CHECKED | {"cells": 3} and entries["chi2_kf"]["stealth"] == board["entries"][2]["stealth"]
    assert again["detection"] == board["detection"] | {"without": []}


@pytest.mark.thin(3)
@pytest.mark.parametrize("key", ["hash", "version", "beacon"])
def test_nothing_is_kept_of_a_board_of_something_else(folder: Path, board: Data, key: str) -> None:
    board["suite"][key] = "another"
    (folder / "small-v0" / "board.json").write_text(json.dumps(board))
    again = _scored(folder / "small-v0.yaml", folder)
    assert again["detection"] is None and not any(entry["stealth"] or "checked" in entry for entry in again["entries"])


def test_a_board_that_is_none_is_named_and_stays(folder: Path) -> None:
    for text in ("{", "[]"):
        (folder / "small-v0" / "board.json").write_text(text)
        with pytest.raises(InputError, match=r"board\.json"):
            _scored(folder / "small-v0.yaml", folder)
        assert (folder / "small-v0" / "board.json").read_text() == text
