"""Step times: what is measured is the defence's own step, and a page says it."""

import copy
import dataclasses
import json
import time
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.board.attachments import Clock, StepTime
from tailgate.board.clock import Timed, _round, measure
from tailgate.board.run import board_of
from tailgate.cli import main
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.rows import encode
from tailgate.site.build import build_site

SUITE = Suite("small", "", ("thesis-ch4-v0",), (5,), ("none", "kf"), ("none",), 4)


class Late:
    """A controller or a defence whose step takes two milliseconds more."""

    def __init__(self, inner) -> None:
        self.inner = inner

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def step(self, *arguments):
        time.sleep(0.002)
        return self.inner.step(*arguments)


@pytest.mark.long
def test_what_is_timed_is_the_step_of_the_defence_alone() -> None:
    """Two milliseconds more in its step count, and in the controller beside it they do not."""
    place = load_scenario("thesis-ch4-v0")
    loops = {
        "kf": (place.loop(kf := Timed(Spec("defence", "kf").make())), kf), "slow": (place.loop(slow := Timed(Late(Spec("defence", "kf").make()))), slow),
        "beside": (dataclasses.replace(place.loop(one := Timed(Spec("defence", "kf").make())), controller=Late(place.controller)), one),
    }  # fmt: skip
    taken = {name: min(_round(loop, timed, seed) for seed in range(2)) for name, (loop, timed) in loops.items()}
    assert taken["slow"] > 2000 > taken["beside"] and taken["kf"] < 2000 and len(kf.taken) == min(place.horizon, 200)
    assert copy.copy(kf).taken == kf.taken


@pytest.mark.long
def test_the_defences_of_a_suite_are_timed_in_turn() -> None:
    """Each has a median between its least and its largest round; who means nothing in the scenario is left out, and refused by name."""
    told: list[tuple[int, int]] = []
    clock = measure(SUITE, rounds=3, progress=lambda done, total: told.append((done, total)))
    assert [entry.defence for entry in clock.entries] == ["none", "kf"] and told == [(i, 6) for i in range(1, 7)]
    assert all(0 < entry.low <= entry.median <= entry.high for entry in clock.entries)
    mixed = Suite("mixed", "", ("thesis-ch4-v0",), (5,), ("none", "cra"), ("none",), 4)
    assert [entry.defence for entry in measure(mixed, rounds=1).entries] == ["none"]
    with pytest.raises(InputError):
        measure(mixed, ["cra"])
    with pytest.raises(InputError, match="rounds"):
        measure(SUITE, rounds=0)
    with pytest.raises(InputError, match="step times"):
        measure(SUITE, ["mine:Mine"])


@pytest.mark.long
def test_a_page_says_what_a_step_costs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the file that the command writes beside the board; without one it says nothing."""
    (tmp_path / "rows.jsonl").write_bytes(encode(run(cells_of(SUITE))))
    board_of(SUITE, tmp_path, require_adaptive=False)
    board, path = tmp_path / "board.json", tmp_path / "step_time.json"
    assert Clock.of(board) is None
    assert main(["leaderboard", "page", str(board), "--out", str(tmp_path / "page"), "--no-replays"]) == 0
    assert "A step takes" not in (tmp_path / "page/small/kf.html").read_text()
    held = Clock(suite="small", scenario="thesis-ch4-v0", agents=1, rounds=3, processor="A <chip>", version="1", commit=None,
                 entries=[StepTime(defence="kf", median=12.5, low=12.0, high=13.0)])  # fmt: skip
    path.write_text(held.model_dump_json())
    assert main(["leaderboard", "page", str(board), "--out", str(tmp_path / "page"), "--no-replays"]) == 0
    said = (tmp_path / "page/small/kf.html").read_text()
    assert "A step takes 12.5 \N{MICRO SIGN}s for one episode of one car (12 to 13 in 3 rounds, A &lt;chip&gt;)." in said
    assert "A step takes" not in (tmp_path / "page/small/none.html").read_text()
    path.write_text(held.model_copy(update={"suite": "other"}).model_dump_json())
    assert main(["leaderboard", "page", str(board), "--out", str(tmp_path / "page")]) == 2
    assert "step times: suite: got 'other'; expected small" in capsys.readouterr().err
    assert main(["leaderboard", "page", str(board), str(board), "--out", str(tmp_path / "page")]) == 2
    assert "no other board" in capsys.readouterr().err
    assert build_site([json.loads(board.read_text())], tmp_path / "page", replays=False).is_file()


@pytest.mark.parametrize(("change", "field"), [
    ({"format": "other"}, "format"), ({"agents": 0}, "agents"), ({"entries": [{"defence": "kf"}]}, "entries.0.median"),
    ({"entries": [{"defence": "kf", "median": -1.0, "low": 0.0, "high": 0.0}]}, "entries.0.median"),
])  # fmt: skip
def test_anything_else_than_step_times_is_refused(tmp_path: Path, change: dict, field: str) -> None:
    """It names the file and the field."""
    good = {"format": "tailgate-step-time-1", "suite": "s", "scenario": "x", "agents": 1, "rounds": 1, "processor": "", "version": "",
            "commit": None, "entries": []}  # fmt: skip
    path = tmp_path / "step_time.json"
    path.write_text(json.dumps(good))
    assert Clock.read(path).suite == "s"
    path.write_text(json.dumps(good | change))
    with pytest.raises(InputError, match=f"step_time.json: {field}"):
        Clock.read(path)
    path.write_text("{")
    with pytest.raises(InputError, match="which is a JSON object"):
        Clock.read(path)


@pytest.mark.long
def test_the_command_writes_a_table_and_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The fastest first; --json prints the file. Of some defences alone it prints the figures, and leaves the file as it is."""
    monkeypatch.setattr("tailgate.core.scenario.load_suite", lambda name: SUITE)
    words = ["leaderboard", "clock", "small", "--out", str(tmp_path), "--rounds", "1"]
    assert main(words) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("\N{BOX DRAWINGS LIGHT VERTICAL}")]
    assert ["none" in lines[0], "kf" in lines[1], len(lines)] == [True, True, 2]
    assert main([*words, "--json"]) == 0
    held = (tmp_path / "small/step_time.json").read_text()
    assert json.loads(capsys.readouterr().out) == json.loads(held)
    assert main([*words, "--defence", "chi2_kf"]) == 0 and (tmp_path / "small/step_time.json").read_text() == held
    assert "chi2_kf" in capsys.readouterr().out
    assert main([*words, "--defence", "kff"]) == 2
    assert "did you mean 'kf'" in capsys.readouterr().err


def test_a_defence_that_fails_is_not_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what means nothing in the scenario is; a failure is said."""

    def broken(*arguments):
        raise InputError("defence output x", "NaN or infinity", "finite numbers")

    monkeypatch.setattr("tailgate.board.clock._round", broken)
    with pytest.raises(InputError, match="defence output x"):
        measure(SUITE, rounds=1)
