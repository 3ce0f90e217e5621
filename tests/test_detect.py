"""Detection and stealth impact of a board that has no rows: played entry by entry, and played again to be checked."""

import copy
import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tailgate.base.errors import InputError
from tailgate.board import detect as module
from tailgate.board.detect import check_detection, detect
from tailgate.board.detection import Effort
from tailgate.board.files import read_board
from tailgate.board.score import score
from tailgate.cli import main
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.evaluation.cells import cells_of, run

Data = dict[str, Any]
QUICK = load_suite("quick-v0")
FEW = ["--hours", "0.02", "--hours", "0.05", "--onsets", "20", "--steps", "60000", "--episodes", "8"]
EFFORT = Effort((0.02, 0.05), 8, 20, 60_000)
ATTACKS = ("dos_jam:trigger=near,threshold=40", "fdi:trigger=near,threshold=30,value=-4")


pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(scope="module")
def bare(compiled: None) -> Data:
    part = dataclasses.replace(QUICK, scenarios=QUICK.scenarios[:1], defences=("none", "kf", "chi2_kf", "cusum_kf"), attacks=("none", *ATTACKS), seeds=2)
    board = score(run(cells_of(part)), QUICK, require_adaptive=False)
    return board | {"attacks": [attack for attack in board["attacks"] if attack["attack"] in ATTACKS]}


def _written(board: Data, folder: Path) -> Path:
    path = folder / "quick-v0" / "board.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(board))
    return path


@pytest.fixture(scope="module")
def detected(bare: Data, tmp_path_factory: pytest.TempPathFactory) -> Data:
    folder = tmp_path_factory.mktemp("boards")
    path = _written(bare, folder)
    assert main(["leaderboard", "detect", "quick-v0", "--out", str(folder), "--workers", "1", *FEW]) == 0
    held: Data = json.loads(path.read_text())
    return held


@pytest.fixture
def board(detected: Data) -> Data:
    return copy.deepcopy(detected)


@pytest.mark.long
def test_a_board_without_rows_gets_its_detection(bare: Data, detected: Data) -> None:
    """All else stays; a plain filter is watched, and a looser threshold lets more through."""
    read_board(detected)
    found = detected["detection"]
    names = [(line["defence"], line["hours"], line["scenario"], line["attack"]) for line in found["entries"]]
    assert names == [(d, h, s, a) for d in ("kf", "chi2_kf", "cusum_kf") for h in (0.02, 0.05) for s in QUICK.nominal for a in ATTACKS]
    assert not found["without"] and {line["defence"] for line in found["entries"] if line.get("watched")} == {"kf"}
    stealth = {entry["defence"]: entry["stealth"] for entry in detected["entries"]}
    assert stealth["none"] is None and all(0.0 < item["low"] <= item["deviation"] <= item["high"] for name in ("kf", "chi2_kf") for item in stealth[name])
    rest = [entry | {"stealth": None} for entry in detected["entries"]]
    assert detected | {"detection": None, "entries": rest} == bare


@pytest.mark.long
def test_a_finished_entry_is_kept_and_an_interrupted_one_costs_only_itself(
    bare: Data, detected: Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, played, make = _written(bare, tmp_path), [], module.figures
    command = ["leaderboard", "detect", "quick-v0", "--out", str(tmp_path), "--workers", "1", *FEW]

    def interrupted(suite: Any, guard: str, *rest: Any) -> Data:
        played.append(guard)
        if guard == "cusum_kf" and played.count(guard) == 1:
            raise KeyboardInterrupt
        return make(suite, guard, *rest)

    monkeypatch.setattr(module, "figures", interrupted)
    assert main([*command, "--defence", "chi2_kf"]) == 0 and played == ["chi2_kf"]
    assert main(command) == 130 and played == ["chi2_kf", "kf", "cusum_kf"]
    half = json.loads(path.read_text())
    assert {line["defence"] for line in half["detection"]["entries"]} == {"kf", "chi2_kf"} and half["entries"][3]["stealth"] is None
    assert main(command) == 0 and played[3:] == ["cusum_kf"] and json.loads(path.read_text()) == detected
    assert main(command) == 0 and len(played) == 4


@pytest.mark.long
def test_what_an_older_version_could_not_have_is_played(bare: Data, detected: Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A filter that was left out for want of a threshold; a sentinel's line goes."""
    old = copy.deepcopy(detected)
    old["detection"]["entries"] = [line for line in old["detection"]["entries"] if line["defence"] != "kf"]
    why = "defence: got 'kf'; expected a defence that alarms at a threshold"
    old["detection"]["without"] = [{"defence": d, "plant": "CarFollowing", "hours": h, "reason": why} for d in ("kf", "none") for h in (0.02, 0.05)]
    old["entries"][1]["stealth"] = None
    path, played, make = _written(old, tmp_path), [], module.figures
    monkeypatch.setattr(module, "figures", lambda suite, guard, *rest: played.append(guard) or make(suite, guard, *rest))
    assert detect(path, QUICK, effort=EFFORT) == detected and played == ["kf"]
    assert check_detection(old, defences=["chi2_kf"])["counts"]["differs"] == 0
    with pytest.raises(InputError, match="none"):
        check_detection(old, defences=["none"])


@pytest.mark.long
def test_false_alarms_alone_are_added_where_a_board_lacks_them(detected: Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of thresholds that stand there; nothing is calibrated again, and a check asks an older board for none."""
    old = copy.deepcopy(detected)
    del old["detection"]["alarms"], old["detection"]["checked"]
    path = _written(old, tmp_path)
    assert check_detection(old, defences=["kf"])["counts"] == {"equal": 10, "differs": 0, "unchecked": 0}
    monkeypatch.setattr(module, "detection", None)
    monkeypatch.setattr(module, "stealth_impact", None)
    more = dataclasses.replace(EFFORT, checked=30)
    assert detect(_written(old, tmp_path / "more"), QUICK, effort=more, defences=["kf"])["detection"]["checked"] == 30
    with pytest.raises(InputError, match=r"checked: got 20; expected 30"):
        detect(path.parent.parent / "more" / "quick-v0" / "board.json", QUICK, effort=EFFORT)
    assert detect(path, QUICK, effort=EFFORT, defences=["kf"])["detection"]["alarms"] == detected["detection"]["alarms"][:4]
    assert detect(path, QUICK, effort=EFFORT, workers=2) == detected == json.loads(path.read_text())


@pytest.mark.long
def test_a_threshold_is_checked_for_a_quarter_of_the_longest_run_at_most(detected: Data) -> None:
    place = load_scenario(QUICK.scenarios[0])
    seconds = {line["hours"]: line["running"] * 3600.0 for line in detected["detection"]["alarms"] if line["defence"] == "kf" and line["scenario"] == place.name}
    drive = place.horizon * (dt := place.brief().model.dt)
    assert seconds == pytest.approx({0.02: drive * math.ceil(20 * 0.02 * 3600.0 / drive), 0.05: drive * math.ceil(15_000 * dt / drive)})


@pytest.mark.long
def test_thresholds_of_other_plants_are_played_again_only_when_asked_for(detected: Data, tmp_path: Path) -> None:
    """Figures of a threshold that two networks of other shapes shared would otherwise stay as if it was that of each."""
    assert detected["detection"]["plants"] == [list(QUICK.nominal)]
    other = copy.deepcopy(detected)
    other["detection"]["plants"] = [[name] for name in QUICK.nominal]
    with pytest.raises(InputError, match=r"detection: plants.*without its field"):
        detect(_written(other, tmp_path / "other"), QUICK, effort=EFFORT)
    del other["detection"]["plants"]
    with pytest.raises(InputError, match=r"detection: plants.*without its field"):
        detect(_written(other, tmp_path / "silent"), QUICK, effort=EFFORT)
    assert len(module._shared(load_suite("network-v0"))) == 2


@pytest.mark.thin(3)
@pytest.mark.parametrize(("part", "field"), [("entries", "watched"), ("alarms", "watched"), ("entries", "delay")])
def test_a_field_that_was_taken_out_is_found(board: Data, part: str, field: str) -> None:
    next(line for line in board["detection"][part] if line["defence"] == "kf").pop(field)
    report = check_detection(board, defences=["kf"])
    assert [(line["of"], line["field"], line["board"]) for line in report["findings"]] == [(part, field, None)]


@pytest.mark.long
def test_a_class_of_somebody_s_own_is_played_where_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only then: without its name it is passed over, as a board runs no code by itself."""
    (tmp_path / "mine_detected.py").write_text("from tailgate.estimators import GatedKalman\nclass Mine(GatedKalman):\n    pass\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    part = dataclasses.replace(QUICK, scenarios=QUICK.scenarios[:1], defences=("none", "mine_detected:Mine", "chi2_kf"), attacks=("none", *ATTACKS), seeds=2)
    board = score(rows := run(cells_of(part)), QUICK, require_adaptive=False)
    for entry in board["entries"]:
        entry["worst_episode"] = next(row for row in rows if row["defence"] == entry["defence"])
    path = _written(board | {"attacks": [attack for attack in board["attacks"] if attack["attack"] in ATTACKS]}, tmp_path)
    few = dataclasses.replace(EFFORT, hours=(0.02,))
    assert {line["defence"] for line in detect(path, QUICK, effort=few)["detection"]["entries"]} == {"chi2_kf"}
    (tmp_path / "boards").mkdir()
    (tmp_path / "quick-v0").rename(tmp_path / "boards" / "quick-v0")
    command = [sys.executable, "-m", "tailgate", "leaderboard", "detect", "quick-v0", "--out", "boards", "--workers", "1", "--defence", "mine_detected:Mine"]
    command += [*FEW[:2], *FEW[4:]]  # one mean time
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = json.loads((tmp_path / "boards" / "quick-v0" / "board.json").read_text())["detection"]["entries"]
    mine, built_in = ([line | {"defence": ""} for line in lines if line["defence"] == name] for name in ("mine_detected:Mine", "chi2_kf"))
    assert mine == built_in != []
    (tmp_path / "mine_detected.py").write_text("from tailgate.estimators import GatedKalman\nclass Mine(GatedKalman):\n    version = 1\n", encoding="utf-8")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "mine_detected:Mine: digest" in done.stderr


@pytest.mark.long
def test_workers_change_no_figure(bare: Data, detected: Data, tmp_path: Path) -> None:
    path = _written(bare, tmp_path)
    assert detect(path, QUICK, effort=EFFORT, workers=2) == detected == json.loads(path.read_text())


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [({}, ["--defence", "rkf"], "defence"), ({}, ["--defence", "none"], "defence"), ({}, ["--onsets", "30"], "detection"), ({}, ["--hours", "0"], "hours"),
     ({}, ["--episodes", "0"], "episodes"), ({"hash": "0"}, [], r"suite\.hash"), ({"version": "0"}, [], r"suite\.version")],
)  # fmt: skip
def test_what_does_not_fit_is_refused(board: Data, tmp_path: Path, change: Data, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    board["suite"] |= change
    path = _written(board, tmp_path)
    assert main(["leaderboard", "detect", "quick-v0", "--out", str(tmp_path), *FEW, *arguments]) == 2
    assert words.replace("\\", "") in capsys.readouterr().err and json.loads(path.read_text()) == board


def test_a_board_that_has_its_figures_is_left_alone_with_a_word(board: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _written(board, tmp_path)
    assert main(["leaderboard", "detect", "quick-v0", "--out", str(tmp_path), *FEW]) == 0
    assert "the board is as it was" in capsys.readouterr().err and json.loads(path.read_text()) == board


@pytest.mark.long
def test_an_honest_detection_board_comes_out_equal(board: Data) -> None:
    """Figures of fields that a board of before lacks are not asked for."""
    for entry in board["entries"]:
        for item in entry["stealth"] or ():
            del item["low"], item["high"]
    report = check_detection(board, defences=["chi2_kf", "kf"])
    assert report["counts"] == {"equal": 2 * (2 * 2 * 2 + 2 + 2 * 2), "differs": 0, "unchecked": 0} and report["findings"] == report["reasons"] == []
    drawn = [check_detection(board, sample=1, sample_seed=seed)["entries"][0]["defence"] for seed in (0, 1)]
    assert len(set(drawn)) == 2


@pytest.mark.long
def test_an_altered_figure_is_found(board: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By its name, through the command; one that was taken out as well."""
    lines = [line for line in board["detection"]["entries"] if line["defence"] == "chi2_kf"]
    lines[0]["detected"]["value"] += 0.01
    lines[1]["threshold"] += 0.01
    board["detection"]["entries"].remove(lines[2])
    stealth = next(entry["stealth"] for entry in board["entries"] if entry["defence"] == "chi2_kf")
    stealth[1]["high"] += 0.01
    line = next(line for line in board["detection"]["alarms"] if line["defence"] == "chi2_kf")
    line["early"] += 1 if line["early"] + line["late"] < line["onsets"] else -1
    path = _written(board, tmp_path)
    assert main(["leaderboard", "check", str(path), "--detection", "--defence", "chi2_kf", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert [(line["of"], line["hours"], line["field"]) for line in report["findings"]] == [
        ("entries", 0.02, "detected"), ("entries", 0.02, "threshold"), ("alarms", 0.02, "early"), ("stealth", 0.05, "high"),
        ("entries", 0.02, ""),
    ]  # fmt: skip
    assert report["counts"] == {"equal": 9, "differs": 5, "unchecked": 0}
    assert main(["leaderboard", "check", str(path), "--detection", "--defence", "chi2_kf"]) == 1
    said = capsys.readouterr().out
    assert f"chi2_kf: entries, {QUICK.scenarios[0]}, {lines[1]['attack']}, 0.02 h, threshold: board {lines[1]['threshold']}" in said
    assert "figures" in said and path.read_text() == json.dumps(board)


def test_what_a_board_names_is_not_imported(board: Data, bare: Data) -> None:
    board["detection"]["entries"][0]["attack"] = "never_made:Attack"
    report = check_detection(board, defences=["chi2_kf"])
    assert report["counts"] == {"equal": 0, "differs": 0, "unchecked": 14} and "code to import" in report["reasons"][0]["why"]
    with pytest.raises(InputError, match="detection"):
        check_detection(bare)
