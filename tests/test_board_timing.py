"""What the timing of a board's trained attackers is worth: played on the board's own episodes, and said on its pages."""

import copy
import importlib.util
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate import draws
from tailgate.agents.policy import Yoked
from tailgate.cli import main
from tailgate.errors import InputError
from tailgate.leaderboard.measured import Measured
from tailgate.leaderboard.site import build_site
from tailgate.leaderboard.timing import Timing, measure_timing, read_timing, telling
from tailgate.registry import Spec
from tailgate.scenario import load_scenario, load_suite
from tailgate.scoring.cells import hits_of
from tailgate.trace import rollout

Data = dict[str, Any]
ROOT = Path(__file__).parents[1]
PLACE = ROOT / "results/quick-v0/board.json"
QUICK = load_suite("quick-v0")
MADE = sorted(ROOT.glob("results/*/timing.json"))


@pytest.fixture(autouse=True)
def at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """A board's paths begin in the root of a clone."""
    monkeypatch.chdir(ROOT)


@pytest.fixture
def board() -> Data:
    held: Data = json.loads(PLACE.read_text())
    return held


def test_own_times_are_those_of_the_board_and_yoked_ones_another_episodes(board: Data) -> None:
    """Written out here: who attacked when without an end, moved on by one episode, with values that are still the policy's own."""
    (entry,) = measure_timing(board, QUICK, ["chi2_kf_sparse"]).entries
    cell = telling(board, "chi2_kf_sparse")
    assert cell is not None and (entry.attack, entry.scenario, entry.dose) == (cell["attack"], cell["scenario"], 12)
    assert entry.own.value == hits_of(cell).mean() == cell["damage"]["value"]
    policy = Spec("attack", cell["attack"]).make()
    place = load_scenario(cell["scenario"]).with_threat(**QUICK.granted, budget=12, knowledge=cell["knowledge"])
    loop, keys = place.loop(Spec("defence", "chi2_kf_sparse").make()), draws.keys("report", range(100))
    times = rollout(loop, policy, keys, terminate=False).kind != 0
    moved = np.concatenate([times[:, -1:], times[:, :-1]], axis=1)
    twin = rollout(loop, Yoked(policy, moved), keys)
    harm = (twin.collided | twin.rear_collided)[np.minimum(twin.length, len(twin.kind)) - 1, np.arange(100)]
    assert entry.yoked.value == harm.mean() < entry.own.value and entry.advantage.value == pytest.approx(entry.own.value - harm.mean())
    assert entry.advantage.low > 0.0 and not entry.flagged and entry.periodic.value < 0.1


def test_the_cell_that_is_nearest_to_a_half_speaks_for_an_entry() -> None:
    """Of the worst attackers at each dose; not of somebody else's, of one that was taken back, or whose file is not here."""
    here = "results/quick-v0/policies/kf-jump/policy-{}.json"

    def cell(attack: str, dose: int, share: float, knowledge: str = "black") -> Data:
        return {"defence": "kf", "attack": attack, "dose": dose, "scenario": "s", "knowledge": knowledge, "failed": 0, "n": 10, "damage": {"value": share}}

    lines = [{"attack": here.format(i), "trained_on": "kf"} for i in range(2)]
    cells = [cell(here.format(0), 5, 0.2), cell(here.format(1), 5, 0.08), cell(here.format(0), 10, 0.5), cell(here.format(1), 10, 0.9), cell(here.format(0), 20, 1.0)]
    assert telling({"attacks": lines, "cells": cells}, "kf") == cells[0]
    assert telling({"attacks": [lines[0], lines[1] | {"withdrawn": True}], "cells": cells}, "kf") == cells[2]
    assert telling({"attacks": [lines[0] | {"trained_on": "rkf"}, lines[1]], "cells": cells}, "kf") == cells[3]
    gone = [line | {"attack": f"gone/{line['attack']}"} for line in lines]
    assert telling({"attacks": gone, "cells": [c | {"attack": f"gone/{c['attack']}"} for c in cells]}, "kf") is None
    even = [cell(here.format(0), 5, 0.2, "grey"), cell(here.format(1), 5, 0.2)]
    assert telling({"attacks": lines, "cells": even}, "kf") == even[1] and telling({"attacks": lines, "cells": [cell(here.format(0), 5, 0.0)]}, "kf") is None


def test_a_cell_that_says_something_else_is_not_believed(board: Data) -> None:
    """Nor is it where it does not say which episodes came to damage; a defence that is not on the board is refused."""
    changed = copy.deepcopy(board)
    cell = telling(changed, "chi2_kf_sparse")
    assert cell is not None
    cell["hits"] = cell["hits"][:-2] + ("00" if cell["hits"][-2:] != "00" else "10")
    made = measure_timing(changed, QUICK, ["chi2_kf_sparse"])
    assert not made.entries and "not what the board's cell says" in made.without[0].why
    cell["hits"] = None
    assert len(measure_timing(changed, QUICK, ["chi2_kf_sparse"]).entries) == 1
    cell["damage"]["value"] -= 0.01
    assert not measure_timing(changed, QUICK, ["chi2_kf_sparse"]).entries
    for defence in ("dkf", "nobody"):
        with pytest.raises(InputError, match="defence"):
            measure_timing(board, QUICK, [defence])
    with pytest.raises(InputError, match="suite"):
        measure_timing(board, load_suite("radar-v0"))


def test_the_command_writes_the_file_and_the_pages_show_it(board: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "quick-v0"
    folder.mkdir()
    ranked = ["rkf", "chi2_kf_sparse", "safe_state_brake"]
    for entry in board["entries"]:
        entry["rank"] = entry["rank"] if entry["defence"] in ranked else None
    (folder / "board.json").write_text(json.dumps(board))
    assert main(["leaderboard", "timing", "quick-v0", "--out", str(tmp_path), "--defence", "rkf"]) == 0
    assert not (folder / "timing.json").exists() and "*" in capsys.readouterr().out
    assert main(["leaderboard", "timing", "quick-v0", "--out", str(tmp_path), "--json"]) == 0
    held = json.loads(capsys.readouterr().out)
    made = read_timing(folder / "timing.json")
    assert made == Timing.model_validate_json(json.dumps(held)) and [e.defence for e in made.entries] == ranked[:2] and made.without[0].defence == ranked[2]
    assert main(["leaderboard", "page", str(folder / "board.json"), "--out", str(tmp_path / "page"), "--no-replays"]) == 0
    pages = {name: (tmp_path / f"page/quick-v0/{name}.html").read_text() for name in (*ranked, "kf")}
    assert "<b>61%</b>" in pages["chi2_kf_sparse"] and "<b>+24 points</b>" in pages["chi2_kf_sparse"] and "yoked equals own" not in pages["chi2_kf_sparse"]
    assert "yoked equals own" in pages["rkf"] and 'id="timing"' not in pages["kf"] and "No attacker that was trained against it" in pages["safe_state_brake"]
    assert "yoked equals own" in (tmp_path / "page/index.html").read_text()


def test_what_is_no_timing_of_the_board_is_refused(board: Data, tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("boards", Path(__file__).with_name("boards.py"))
    assert spec is not None and spec.loader is not None
    boards = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(boards)
    with pytest.raises(InputError, match="timing advantages: suite"):
        build_site([boards.make_board()], tmp_path / "page", measured=[Measured(timing=read_timing(ROOT / "results/quick-v0/timing.json"))])
    shutil.copy(PLACE, tmp_path / "board.json")
    for text in ("{", "{}", json.dumps({"format": "tailgate-step-time-1"})):
        (tmp_path / "timing.json").write_text(text)
        with pytest.raises(InputError, match=r"timing advantages.*timing\.json"):
            read_timing(tmp_path / "timing.json")
        assert main(["leaderboard", "page", str(tmp_path / "board.json"), "--out", str(tmp_path / "page")]) == 2 and not (tmp_path / "page").exists()


@pytest.mark.parametrize("path", MADE, ids=lambda path: path.parent.name)
def test_published_timings_are_of_their_boards(path: Path) -> None:
    """Every ranked entry is there once, its attacker's cell says the same share of damage, and it is the one that would be looked at today."""
    made, held = read_timing(path), json.loads(path.with_name("board.json").read_text())
    assert made.suite == held["suite"]["name"] == path.parent.name and made.hash == held["suite"]["hash"]
    assert sorted(entry.defence for entry in [*made.entries, *made.without]) == sorted(e["defence"] for e in held["entries"] if e["rank"])
    for entry in made.entries:
        cell = telling(held, entry.defence)
        assert cell is not None and cell["attack"] == entry.attack and cell["damage"]["value"] == entry.own.value


def test_every_board_is_published_with_it() -> None:
    assert len(MADE) == len([*ROOT.glob("results/*/board.json")])
