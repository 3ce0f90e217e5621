"""Submissions: rows equal to those of a defence that is played alone, mixed in secret, on seeds that nobody knew, and resumable."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tailgate.base.errors import InputError
from tailgate.cli import submit
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.engine.agreement import Untraced
from tailgate.evaluation.cells import Cell, cells_of, run_cell
from tailgate.evaluation.rounds import seeds_of
from tailgate.evaluation.rows import read_rows
from tailgate.play.commanded import commanded
from tailgate.sandbox import Isolated, digest_of, mixed, play, play_submission
from tailgate.sandbox.source import staged
from tailgate.sandbox.table import Seat

from .commands import ran

KALMAN = "tailgate.estimators:Kalman"
SCENARIO = """
plant: {name: car_following, dt: 0.1, process_var: [1.0e-4, 4.0e-4, 2.5e-3]%s}
sensor: {name: odometry, noise_var: [1.0, 1.0]}
controller: {name: acc}
manoeuvre: {name: stop_and_go}
horizon: 40
threat_model: {kinds: [fdi, dos_hold], fdi_bound: 500.0, onset: 5}
"""
ATTACKS = ("none", "fdi:start_step=10,value=-500", "dos_hold:start_step=5", "noise_jam:start_step=5", "stealth:start_step=5")


@pytest.fixture
def places(tmp_path: Path) -> tuple[str, str]:
    """Two small scenarios; in the first the cars soon meet."""
    for name, gap in (("near", ", gap: 3.0, speed: 32.0"), ("far", "")):
        (tmp_path / f"{name}.yaml").write_text(SCENARIO % gap, encoding="utf-8")
    return str(tmp_path / "near.yaml"), str(tmp_path / "far.yaml")


def _results(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: value for key, value in row.items() if key not in ("cell", "defence_digest", "submission")} for row in rows]


def _suite(*scenarios: str, attacks: tuple[str, ...] = ("none", "fdi:start_step=10,value=20"), seeds: int = 4) -> Suite:
    return Suite("small", "", scenarios, (30,), (), attacks, seeds)


def _alone(suite: Suite, defence: str) -> list[dict[str, Any]]:
    return [row for cell in cells_of(dataclasses.replace(suite, defences=(defence,))) for row in run_cell(cell)]


@pytest.mark.long
def test_mixed_rows_equal_those_of_a_cell_played_alone(places: tuple[str, str]) -> None:
    """To the bit, in every metric and hash, whatever ends early, is not applicable, or runs on beside it; white boxes are skipped."""
    suite = _suite(places[0], attacks=ATTACKS, seeds=7)
    rows, alone = play_submission(KALMAN, suite), _alone(suite, KALMAN)
    black = 4 * 7
    assert _results(rows[:black]) == _results(alone[:black])
    assert {row["status"] for row in rows[:21]} == {"ok"} and {row["status"] for row in rows[21:]} == {"skipped"}
    assert {row["collided"] for row in rows[:21]} == {0.0, 1.0}  # a cell that was over before another
    assert all("white-box" in row["reason"] for row in rows[black:]) and {row["knowledge"] for row in rows[black:]} == {"white"}


def test_a_module_that_lies_beside_the_submission_is_not_found_and_the_error_says_why(
    places: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "patient.py").write_text("from tailgate.estimators import Kalman as Patient\n", encoding="utf-8")
    (tmp_path / "hurried.py").write_text("from patient import Patient\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match=r"No module named 'patient'\); only the submitted file or folder can be imported$"):
        play_submission("hurried:Patient", _suite(places[1], seeds=1))


MUTING = """
from tailgate.estimators import Kalman

class Muting(Kalman):
    uses = ("measurements", "probe")

    def step(self, plan, state, received, known_u, draws):
        state, estimate = super().step(plan, state, received, known_u, draws)
        return state, estimate._replace(probe=draws.uniform((1,)) > 0.2, score=estimate.score + draws.normal((1,), tag=1))
"""


@pytest.mark.long
def test_draws_of_a_submission_are_those_of_the_defence_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A radar that mutes itself at random: its process has the keys of its own party, so its rows are the same."""
    (tmp_path / "muting_sub.py").write_text(MUTING, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    cells = [Cell("s", "radar-following-v0", 5, "muting_sub:Muting", attack, 2) for attack in ("none", "noise_jam:start_step=60")]
    with staged(cells[0].defence) as source, Isolated(source.text, source.path) as one:
        card = one.card
        rows = mixed.play_mixed(cells, mixed.Submission(source, card))
    alone = [row for cell in cells for row in run_cell(cell)]
    assert card["uses"] == ("measurements", "probe") and {row["status"] for row in alone} == {"ok"}
    assert _results(rows) == _results(alone)
    sys.modules.pop("muting_sub", None)


@pytest.mark.long
def test_other_companions_and_another_order_change_nothing(places: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows in batches of one row for each cell, and in other secret orders, are those of one batch; so the companions test is passed."""
    cells = [Cell("s", places[1], 30, KALMAN, attack, 2) for attack in ("none", "fdi:start_step=10,value=20")]
    with staged(KALMAN) as source:
        submission = mixed.Submission(source, {"uses": ("measurements",), "version": 1, "reference": ""})
        whole = mixed.play_mixed(cells, submission)
        monkeypatch.setattr(mixed, "ROWS", 2)
        monkeypatch.setattr(mixed, "FEWEST", 2)
        assert mixed.play_mixed(cells, submission) == whole
    assert {row["status"] for row in whole} == {"ok"}


def test_an_interrupted_run_resumes_after_the_scenarios_that_it_finished(
    places: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was finished is not played again, the file is the same as without the interruption, and nothing is left beside it."""
    out, suite = tmp_path / "rows" / "rows.jsonl", _suite(*places, seeds=1, attacks=("none",))
    real, played = mixed.play_mixed, list[str]()

    def counted(cells: Any, *rest: Any) -> Any:
        if played:
            raise KeyboardInterrupt
        played.append(Path(cells[0].scenario).stem)
        return real(cells, *rest)

    monkeypatch.setattr(play, "play_mixed", counted)
    with pytest.raises(KeyboardInterrupt):
        play_submission(KALMAN, suite, out=out)
    assert not out.exists() and played == ["near"]
    monkeypatch.setattr(play, "play_mixed", lambda cells, *rest: played.append(Path(cells[0].scenario).stem) or real(cells, *rest))
    rows = play_submission(KALMAN, suite, out=out)
    assert played == ["near", "far"] and read_rows(out) == rows
    assert [path.name for path in out.parent.iterdir()] == ["rows.jsonl"]
    assert _results(rows) == _results(_alone(suite, KALMAN))


@pytest.mark.long
def test_two_workers_give_the_rows_of_one_on_the_seeds_of_a_beacon(places: tuple[str, str], tmp_path: Path) -> None:
    """Each row's seed is one of the beacon's; playing it by itself gives the same trace."""
    suite, beacon = _suite(*places, seeds=1, attacks=("none",)), "0123456789abcdef"
    rows = play_submission(KALMAN, suite, beacon=beacon, workers=2, out=tmp_path / "rows.jsonl")
    assert [row["seed"] for row in rows] == 2 * seeds_of(beacon, "small", "report", 1)
    assert {row["beacon"] for row in rows} == {beacon}
    again = [run_cell(Cell("small", place, 30, KALMAN, "none", 1, first_seed=rows[0]["seed"])) for place in places]
    assert [row["trace_hash"] for row in rows] == [row["trace_hash"] for (row,) in again]


def test_a_class_that_asks_for_the_truth_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "seer.py").write_text(
        "from tailgate.estimators import Kalman\nclass Seer(Kalman):\n    uses = ('truth',)\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="submission: uses, version"):
        play_submission("seer:Seer", _suite("stop-and-go-v0"))


SPY = '''
import os, socket
from tailgate.estimators import Kalman

class Spy(Kalman):
    def prepare(self, model):
        for path in ("/etc/passwd", "/etc/hostname", "/home", "/var", "PRIVATE"):
            assert not os.path.exists(path), path
        assert len([name for name in os.listdir("/proc") if name.isdigit()]) <= 3
        try:
            socket.create_connection(("1.1.1.1", 53), 1.0)
            raise AssertionError("there is a network")
        except OSError:
            pass
        for path in (__file__, "/usr/x", os.__file__):
            try:
                open(path, "a").close()
                raise AssertionError(path)
            except OSError:
                pass
        open("mine", "w").close()
        return super().prepare(model)
'''


@pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
def test_in_bubblewrap_there_is_no_network_and_nothing_to_see(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, places: tuple[str, str]) -> None:
    """A class that looks for files, processes and a network finds none, and its rows are those without a sandbox."""
    (tmp_path / "private.txt").touch()
    (tmp_path / "spy.py").write_text(SPY.replace("PRIVATE", str(tmp_path / "private.txt")), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    suite = _suite(places[1], seeds=1)
    rows = play_submission("spy:Spy", suite, sandbox="bwrap")
    assert {row["submission"]["sandbox"] for row in rows} == {"bwrap"}
    assert [row["trace_hash"] for row in rows] == [row["trace_hash"] for row in _alone(suite, KALMAN)], rows[0]["reason"]


def test_the_command_writes_rows_and_prints_a_summary(
    places: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a class in the working directory to rows and JSON; --digest prints what fixes the submission."""
    (tmp_path / "own_sub.py").write_text("from tailgate.estimators import Kalman\nclass Own(Kalman):\n    pass\n", encoding="utf-8")
    (tmp_path / "suite.yaml").write_text("scenarios: [far.yaml]\ndoses: [6]\ndefences: [kf]\nattacks: [none]\nseeds: 9\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert ran(submit, "submit", "own_sub:Own", "--digest") == 0
    digest = capsys.readouterr().out.strip()
    line = ["submit", "own_sub:Own", "--suite", "suite.yaml", "--out", "rows.jsonl", "--episodes", "1", "--limit", "memory=3000000000", "--json"]
    assert ran(submit, *line) == 0
    printed = capsys.readouterr()
    told = json.loads(printed.out)
    assert told["digest"] == digest == digest_of("own_sub") and told["rows"] == 1 and told["failed"] == 0 and told["table"][0]["n"] == 1
    assert "public ones" in printed.err
    assert read_rows(tmp_path / "rows.jsonl")[0]["defence"] == "own_sub:Own"
    assert Spec("defence", "own_sub:Own").digest == digest  # rows of `evaluate` are of the same class
    (tmp_path / "other_sub.py").write_text("from own_sub import Own\n", encoding="utf-8")
    named = Spec("defence", "other_sub:Own").digest  # the class lies elsewhere: its file decides, as rows of an older one shall not be kept
    (tmp_path / "own_sub.py").write_text((tmp_path / "own_sub.py").read_text() + "# changed\n", encoding="utf-8")
    assert Spec("defence", "other_sub:Own").digest != named and Spec("defence", "own_sub:Own").digest != digest


@pytest.mark.long
def test_the_engine_leaves_seats_at_a_table_to_the_plain_loop() -> None:
    """Their steps wait for other rollouts, which would wait for the end of the tracing."""
    place = load_scenario("gusty-stop-and-go-v0")
    seat = Seat(place.brief().model, lambda seat: None)
    seat.play_on(None)
    for defence, why in ((seat, "its steps wait for other rollouts"), (Isolated(KALMAN), "another process plays it")):
        found = commanded(place.loop(defence, ("measurements",)))
        assert isinstance(found, Untraced) and why in found.why
    assert seat.done
