"""A board's figures can be checked by who has none of its rows."""

import copy
import dataclasses
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.base.version import plays_as
from tailgate.board.check import check, with_check
from tailgate.board.consistency import strays, undue
from tailgate.board.files import board_in, load
from tailgate.board.score import score
from tailgate.cli import check as command
from tailgate.core.scenario import load_suite
from tailgate.evaluation.attack_list import Admitted, append
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.rows import encode
from tailgate.site.build import build_site

from .commands import ran

ROOT = Path(__file__).parents[1]
SUITE = dataclasses.replace(
    load_suite("quick-v0"), scenarios=("gusty-stop-and-go-v0",), defences=("none", "kf"), attacks=("none", "dos_jam:start_step=100"), seeds=6
)
Data = dict[str, Any]


pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(scope="module")
def rows(compiled: None) -> list[Data]:
    return run(cells_of(SUITE))


@pytest.fixture(scope="module")
def original(rows: list[Data]) -> Data:
    return score(rows, load_suite("quick-v0"), require_adaptive=False)


@pytest.fixture
def board(original: Data) -> Data:
    return copy.deepcopy(original)


def test_an_honest_board_comes_out_equal(board: Data) -> None:
    assert len(board["cells"]) == 4 and len({cell["trace"] for cell in board["cells"]}) == 4
    report = check(board)
    assert report["counts"] == {"equal": 4, "differs": 0, "unchecked": 0} and report["findings"] == report["reasons"] == []
    assert report["entries"] == [{"defence": name, "cells": 2, "equal": 2, "differs": 0, "unchecked": 0} for name in ("none", "kf")]
    assert report["prints"] == {str(i): {name: cell[name] for name in ("hits", "decisions", "trace")} for i, cell in enumerate(board["cells"])}


@pytest.mark.long
def test_workers_change_no_report(board: Data) -> None:
    assert check(board, workers=2) == check(board)


def test_seeds_of_a_round_come_out_equal_too(tmp_path: Path) -> None:
    """They do not ascend, and a board's rows are by seed."""
    beacon = "a beacon of sixteen letters or more"
    board = score(run(cells_of(SUITE, beacon=beacon)), load_suite("quick-v0"), require_adaptive=False)
    assert board["suite"]["beacon"] == beacon and check(board)["counts"] == {"equal": 4, "differs": 0, "unchecked": 0}


@pytest.fixture
def published() -> Data:
    board: Data = json.loads((ROOT / "results/quick-v0/board.json").read_text(encoding="utf-8"))
    return board


@pytest.mark.parametrize("name", sorted(path.parent.name for path in ROOT.glob("results/*/board.json*")))
@pytest.mark.thin(22)
def test_what_is_published_follows_from_its_cells(name: str) -> None:
    board = load(board_in(ROOT / f"results/{name}"))
    assert strays(board, load_suite(name)) == [] == undue(board, load_suite(name))


def test_a_board_does_not_decide_which_attacks_count(published: Data, tmp_path: Path) -> None:
    """Computed optima alone do not, and what an erratum took back; nor does it choose its limit or level."""
    suite, listed = load_suite("quick-v0"), tmp_path / "attacks.jsonl"
    one, other = dict.fromkeys(cell["attack"] for cell in published["cells"] if cell["attack"] != "none").keys() & set(suite.attacks[:3])
    for cell in published["cells"]:
        cell["optimal"] = cell["attack"] == one
    next(attack for attack in published["attacks"] if attack["attack"] == other)["withdrawn"] = True
    published["suite"] |= {"limit": 0.6, "alpha": 0.9}
    wanted = ["suite.limit", "suite.alpha", f"attacks: {one}: optimal"]
    assert [line["field"] for line in undue(published, suite, listed)] == [*wanted, f"attacks: {other}: withdrawn"]
    append(listed, Admitted(other, "", "black", "2026-01-01", erratum="it was mistaken"))
    assert [line["field"] for line in undue(published, suite, listed)] == wanted
    assert set(wanted) <= {line["field"] for line in check(published, sample=1, listed=listed)["strays"]}


@pytest.mark.long
@pytest.mark.parametrize("field", ["rates", "critical_dose"])
def test_figures_of_another_entry_are_named(published: Data, field: str) -> None:
    entries = {entry["defence"]: entry for entry in published["entries"]}
    entries["kf"][field] = entries["rkf"][field]
    report = check(published, sample=1)
    assert [(line["defence"], line["field"]) for line in report["strays"]] == [("kf", field)] and not report["scored"]


@pytest.mark.long
def test_limits_doses_and_curves_follow_too(published: Data) -> None:
    changed = [copy.deepcopy(published) for _ in range(4)]
    changed[0]["cells"][1]["damage"]["high"] = 0.5
    changed[1]["suite"]["shown"] = {}
    changed[2]["curves"][0]["points"][-1]["value"] = 0.5
    changed[3]["entries"][5]["rates"][0]["undamaged"]["low"] += 0.01
    fields = [[line["field"] for line in strays(board, load_suite("quick-v0"))] for board in changed]
    assert fields == [["cells[1].damage"], ["suite.shown"], ["curves"], ["rates"]]


def test_cells_that_were_taken_out_are_missed(published: Data) -> None:
    entries = {entry["defence"]: entry for entry in published["entries"]}
    worst = entries["kf"]["rates"][0]["worst"]["attack"]
    published["cells"] = [cell for cell in published["cells"] if cell["defence"] != "kf" or cell["attack"] != worst]
    found = strays(published, load_suite("quick-v0"))
    assert {"critical_dose", "rates"} <= {line["field"] for line in found if line["defence"] == "kf"}
    assert {line["field"] for line in found if line["defence"] != "kf"} == {"comparisons"}
    listed = next(cell["attack"] for cell in published["cells"] if cell["defence"] == "rkf" and not cell["learned"] and cell["attack"] != "none")
    published["cells"] = [cell for cell in published["cells"] if cell["defence"] != "rkf" or cell["attack"] != listed]
    assert ("rkf", "status") in {(line["defence"], line["field"]) for line in strays(published, load_suite("quick-v0"))}
    published["cells"] = [cell for cell in published["cells"] if cell["defence"] not in ("kf", "rkf")]
    assert [(line["defence"], line["field"]) for line in strays(published, load_suite("quick-v0"))] == [("kf", "cells"), ("rkf", "cells")]


def test_a_cell_that_is_there_twice_is_refused(published: Data) -> None:
    published["cells"].append(published["cells"][7])
    with pytest.raises(InputError, match="once"):
        check(published, sample=1)


@pytest.mark.thin(2)
@pytest.mark.parametrize(("field", "value"), [("status", "unattacked"), ("why", ""), ("flags", ["a flag"]), ("gates", 99.0)])
def test_ranks_gates_and_flags_are_made_again_where_all_cells_are_played(board: Data, field: str, value: Any) -> None:
    entry = board["entries"][1]
    entry[field] = [gate | {"limit": value} for gate in entry["gates"]] if field == "gates" else value
    assert [(line["defence"], line["field"]) for line in check(board)["strays"]] == [("kf", field)]
    less = check(board, sample=3)
    assert bool(less["strays"]) == (field == "status") and not less["scored"]  # which cells are there decides on the status


def test_some_cells_are_drawn_or_named(board: Data) -> None:
    drawn = [check(board, sample=2, sample_seed=seed) for seed in range(4)]
    assert all(report["asked"] == 2 and report["sample_seed"] == seed for seed, report in enumerate(drawn))
    assert len({tuple(report["prints"]) for report in drawn}) > 1
    named = check(board, defences=["kf"])
    assert [entry["defence"] for entry in named["entries"]] == ["kf"] and named["asked"] == 2 and named["cells"] == 4
    with pytest.raises(InputError, match="rkf"):
        check(board, defences=["rkf"])
    with pytest.raises(InputError, match="sample"):
        check(board, sample=0)


@pytest.mark.parametrize(("field", "value"), [("n", 5), ("failed", 1), ("decisions", "0" * 16), ("trace", "0" * 16)])
def test_a_changed_figure_differs_and_is_named(board: Data, field: str, value: Any) -> None:
    board["cells"][3][field] = value
    report = check(board)
    assert report["counts"] == {"equal": 3, "differs": 1, "unchecked": 0}
    [finding] = report["findings"]
    assert finding["why"].startswith("trace only" if field == "trace" else f"{field}: board") and finding["defence"] == board["cells"][3]["defence"]
    assert "3" not in report["prints"]


def test_of_a_share_the_limit_that_differs_is_named(board: Data) -> None:
    board["cells"][3]["damage"] |= {"high": 0.875}
    [finding] = check(board)["findings"]
    assert finding["why"].startswith("damage.high: board 0.875, here ") and "damage.low" not in finding["why"]


def test_a_board_of_before_the_fingerprints_gets_them(board: Data, rows: list[Data]) -> None:
    held = [(cell.pop("decisions"), cell.pop("trace")) for cell in board["cells"]]
    checked = with_check(board, check(board))
    assert [(cell["decisions"], cell["trace"]) for cell in checked["cells"]] == held
    assert [entry["checked"] for entry in checked["entries"]] == [{"cells": 2, "equal": 2, "differs": 0, "unchecked": 0}] * 2
    away = check(board) | {"entries": [{"defence": e["defence"], "cells": 2, "equal": 1, "differs": 0, "unchecked": 1} for e in checked["entries"]]}
    assert with_check(checked, away)["entries"] == checked["entries"]  # some files were not there
    less = with_check(checked, check(board, sample=1))
    assert less["entries"] == checked["entries"]  # of two checks the one that looked into more stays
    off = check(board, sample=1) | {"entries": [{"defence": e["defence"], "cells": 2, "equal": 0, "differs": 1, "unchecked": 1} for e in checked["entries"]]}
    assert [entry["checked"]["differs"] for entry in with_check(checked, off)["entries"]] == [1, 1]  # a difference counts, however few cells
    assert with_check(with_check(checked, off), check(board, sample=1))["entries"][0]["checked"]["differs"] == 1
    assert with_check(with_check(checked, off), check(board))["entries"] == checked["entries"]  # until all cells came out equal
    for entry in checked["entries"]:
        entry["checked"] = {"cells": 9, "equal": 8, "differs": 0, "unchecked": 1}  # of the board when it had more cells
    assert {entry["checked"]["cells"] for entry in with_check(checked, check(board))["entries"]} == {2}


@pytest.mark.parametrize("name", sorted(path.parent.name for path in (ROOT / "results").glob("*-v0/board.json")))
def test_what_a_published_board_says_of_checks_is_of_its_cells(name: str) -> None:
    published = json.loads((ROOT / "results" / name / "board.json").read_text(encoding="utf-8"))
    there = Counter(cell["defence"] for cell in published["cells"])
    for entry in published["entries"]:
        held = entry.get("checked") or {"cells": there[entry["defence"]], "equal": 0, "differs": 0, "unchecked": 0}
        assert held["cells"] == there[entry["defence"]] >= held["equal"] + held["differs"] + held["unchecked"], entry["defence"]


def test_a_change_of_one_episode_changes_a_fingerprint(board: Data, rows: list[Data]) -> None:
    other = [dict(row) for row in rows]
    for hashed, printed in (("decision_hash", "decisions"), ("trace_hash", "trace")):
        other[0][hashed] = other[0][hashed][::-1]
        cells = score(other, load_suite("quick-v0"), require_adaptive=False)["cells"]
        assert [a[printed] == b[printed] for a, b in zip(cells, board["cells"], strict=True)].count(False) == 1


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [("attack", "never_made:Attack", "code to import"), ("attack", "gone/policy-0.json", "is not here"), ("attack", "dos_jam:start=1", "start"),
     ("knowledge", "white", "knowledge"), ("attack", "bwrap/never_made:Attack", "")],
)  # fmt: skip
def test_what_cannot_be_played_is_unchecked(board: Data, field: str, value: str, words: str) -> None:
    board["cells"][1][field] = value
    report = check(board)
    assert report["counts"] == {"equal": 3, "differs": 0, "unchecked": 1} and words in report["reasons"][0]["why"]
    assert "never_made" not in sys.modules


def test_code_that_is_a_defence_is_not_imported(board: Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "guard_of_a_board.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    board["entries"][1]["defence"] = "guard_of_a_board:Guard"
    for cell in board["cells"]:
        cell["defence"] = {"kf": "guard_of_a_board:Guard"}.get(cell["defence"], cell["defence"])
    board["curves"], board["comparisons"] = [], []
    assert check(board)["counts"] == {"equal": 2, "differs": 0, "unchecked": 2}


@pytest.mark.parametrize(("field", "value"), [("name", "slow-v0"), ("hash", "0" * 16), ("version", "0.0.1"), ("episodes", 0), ("episodes", 10**9)])
def test_a_board_of_something_else_is_refused(board: Data, field: str, value: Any) -> None:
    board["suite"][field] = value
    with pytest.raises(InputError, match=field):
        check(board)


def _command(*arguments: str) -> int:
    return ran(command, "check", *arguments)


def test_the_command(board: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It leaves the board alone, unless told to write; and its exit code says that a cell differs."""
    path = tmp_path / "board.json"
    for cell in board["cells"]:
        del cell["decisions"], cell["trace"]
    path.write_text(json.dumps(board))
    assert _command(str(path)) == 0 and json.loads(path.read_text()) == board
    assert "4 of 4 cells played again, 4 asked for" in " ".join(capsys.readouterr().out.split())
    assert _command(str(path), "--write", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    held = json.loads(path.read_text())
    assert held == with_check(board, report) and all(cell["decisions"] for cell in held["cells"])
    held["cells"][0]["decisions"] = "1" * 16
    held["cells"][1]["attack"] = "gone/policy-0.json"
    path.write_text(json.dumps(held))
    assert _command(str(path)) == 1
    out = capsys.readouterr().out
    assert "decisions: board 1111111111111111" in out and "1 cell unchecked: the attack's file is not here" in out
    path.write_text("[]")
    with pytest.raises(InputError, match="board"):
        _command(str(path))
    with pytest.raises(InputError, match="readable"):
        _command(str(tmp_path / "none.json"))


def test_attackers_that_are_not_published_are_named_with_the_command_that_trains_them(
    board: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where the paths do not begin here, that they begin elsewhere."""
    for i, seed in ((0, 3), (1, 4), (2, 3)):
        board["cells"][i]["attack"] = f"held/attacked/policies/run/policy-{seed}.json"
    names = [board["cells"][i]["defence"] for i in range(3)]
    (tmp_path / "board.json").write_text(json.dumps(board))
    assert _command(str(tmp_path / "board.json"), "--json") == 0
    untrained = json.loads(capsys.readouterr().out)["untrained"]
    assert untrained == [
        {"defence": name, "folder": "held/attacked", "policies": names.count(name), "cells": names.count(name)} for name in dict.fromkeys(names)
    ]
    _command(str(tmp_path / "board.json"))
    said = capsys.readouterr().out
    assert f"tailgate leaderboard attack {names[0]} --suite quick-v0 --out held/attacked " in said and "Paths begin elsewhere" in said
    monkeypatch.chdir(tmp_path)
    (tmp_path / "held/attacked").mkdir(parents=True)
    _command("board.json")
    assert "Paths begin elsewhere" not in capsys.readouterr().out


def test_an_attack_whose_file_is_another_one_is_told_apart(tmp_path: Path) -> None:
    """That its cells differ is then no wonder; a file that says the same in other words plays the same."""
    path = tmp_path / "own.yaml"
    phase = "about: Holds.\nphases:\n  - kind: dos_hold\n    trigger: {name: chance, probability: 0.02, latch: true}\n"
    path.write_text(phase)
    own = dataclasses.replace(SUITE, attacks=("none", f"program:path={path}"))
    made = score(run(cells_of(own)), load_suite("quick-v0"), require_adaptive=False)
    digests = {attack["attack"]: attack["digest"] for attack in made["attacks"]}
    assert len(str(digests[own.attacks[1]])) == 64 and set(digests.values()) == {None, digests[own.attacks[1]]}
    for text, differs in ((phase.replace("Holds.", "Holds a sample."), 0), (phase.replace("0.02", "0.9"), 2)):
        path.write_text(text)
        report = check(made)
        assert report["counts"] == {"equal": 4 - differs, "differs": differs, "unchecked": 0}
        assert all("file here is another one" in finding["why"] for finding in report["findings"])


def test_the_page_tells(board: Data, tmp_path: Path) -> None:
    page = build_site([with_check(board, check(board, defences=["kf"]))], tmp_path / "page", replays=False)
    assert "played again from the board alone, without rows: 2 of 4 cells, all equal" in page.read_text()
    [entry] = page.parent.glob("*/kf.html")
    assert "Played again from this board alone, without its rows: all 2 cells, all equal." in entry.read_text()


def test_a_published_board_comes_out_equal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some cells of it, here, from the repository alone; the fingerprints are the same on every platform."""
    monkeypatch.chdir(ROOT)
    board = json.loads((ROOT / "results/quick-v0/board.json").read_text(encoding="utf-8"))
    assert plays_as(board["suite"]["version"]) == tailgate.__version__
    report = check(board, sample=4, sample_seed=1)
    assert report["counts"]["unchecked"] == 0 and all(finding["why"].startswith("trace only") for finding in report["findings"])


def test_rows_on_disk_give_the_same_fingerprints(rows: list[Data], board: Data) -> None:
    held = [json.loads(line) for line in encode(rows).splitlines()]
    assert score(held[::-1], load_suite("quick-v0"), require_adaptive=False)["cells"] == board["cells"]


def test_what_differs_is_named_down_to_the_number() -> None:
    """A list may be long, and the difference at its end."""
    held: Any = [{"defence": "none", "points": [0.1, 0.2, {"value": 0.3}]}]
    other = copy.deepcopy(held)
    other[0]["points"][2]["value"] = 0.4
    assert command._first(held, other) == ("[0].points[2].value", 0.3, 0.4)
    assert command._first([1], [1, 2]) == ("", [1], [1, 2]) and command._first({"a": None}, {"a": {"b": 1}}) == (".a", None, {"b": 1})
