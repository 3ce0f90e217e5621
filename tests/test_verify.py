"""A row is the same whoever plays it again, and what somebody changed in it is found."""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import pytest

import tailgate
from tailgate.base.version import ALIKE, plays_as
from tailgate.cli import verify as command
from tailgate.core.scenario import Suite, load_suite
from tailgate.evaluation import cells as evaluation
from tailgate.evaluation.cells import Cell, cells_of, episodes_at_once, run, run_cell
from tailgate.evaluation.rows import encode
from tailgate.evaluation.verify import verify

from .commands import ran

ATTACKS = ("none", "fdi:value=5", "dropout:probability=0.5")
SUITE = Suite("small", "", ("thesis-ch4-v0", "thesis-ch4-literal-v0"), (5,), ("kf",), ATTACKS, 3)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return run(cells_of(SUITE))


def _one(rows: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """The report on the second row of an attack, changed."""
    row = next(row for row in rows if row["attack"] == "fdi:value=5" and row["seed"] == 1)
    return verify([row | changes])


def test_honest_rows_are_verified(rows: list[dict[str, Any]]) -> None:
    report = verify(rows)
    assert report["status"] == "verified" and report["counts"] == {"verified": 18, "differs": 0, "unchecked": 0}
    assert report["entries"] == [{"defence": "kf", "status": "verified", "verified": 18, "differs": 0, "unchecked": 0}]
    assert report["findings"] == [] == report["left_out"] and json.loads(json.dumps(report)) == report
    assert _one(rows, metrics=["mine"], mine=0.5)["left_out"] == ["mine"]


@pytest.mark.long
def test_rows_of_a_version_that_plays_the_same_are_verified_and_scored_with_others(rows: list[dict[str, Any]]) -> None:
    older = [row | {"version": ALIKE[-1]} for row in rows[:9]]
    assert verify(older)["counts"] == {"verified": 9, "differs": 0, "unchecked": 0}
    assert _one(rows, version=ALIKE[-1], min_gap=1.0)["counts"]["differs"] == 1
    assert plays_as(ALIKE[-1]) == tailgate.__version__ and plays_as("0.0.1") == "0.0.1"


@pytest.mark.long
def test_a_row_is_the_same_with_other_workers_batches_and_companions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """40 episodes: one process and two, 24 at once, each by itself, backwards, and after an interruption."""
    (cell,) = cells_of(dataclasses.replace(SUITE, scenarios=("thesis-ch4-v0",), doses=(5,), attacks=("fdi:value=5",), seeds=40))
    held = run([cell])
    for workers in (1, 2):
        report = verify(held, workers=workers, batch=24)
        assert report["counts"] == {"verified": 40, "differs": 0, "unchecked": 0}, workers
    assert verify(held[::-1][:4], batch=1)["counts"]["verified"] == 4
    assert verify(held, sample=4, batch=4)["counts"] == {"verified": 4, "differs": 0, "unchecked": 0}
    other = Cell(**(dataclasses.asdict(cell) | {"attack": "none", "seeds": 2}))
    real, calls = run_cell, []

    def interrupted(played: Cell) -> list[dict[str, Any]]:
        calls.append(played)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(played)

    monkeypatch.setattr(evaluation, "run_cell", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run([cell, other], tmp_path / "rows.jsonl")
    again = run([cell, other], tmp_path / "rows.jsonl")
    assert len(calls) == 3 and [row["trace_hash"] for row in again[:40]] == [row["trace_hash"] for row in held]


@pytest.mark.long
def test_a_row_is_the_same_in_a_batch_of_4096() -> None:
    """4100 episodes that were played 256 at once, again as a full batch and four that are left."""
    (cell,) = cells_of(dataclasses.replace(SUITE, scenarios=("thesis-ch4-v0",), doses=(5,), attacks=("fdi:value=5",), seeds=4100))
    loop = cell.place(tailgate.make_attack("fdi"), "black").loop(tailgate.make_defence("kf"))
    assert episodes_at_once(loop.model, loop.horizon, 4096) == 4096
    assert verify(run([cell]), batch=4096)["counts"] == {"verified": 4100, "differs": 0, "unchecked": 0}


@pytest.mark.long
@pytest.mark.parametrize(("suite", "scenario", "dose", "defence", "attack", "seeds"), [
    ("car-following-v0", "car-following-noisy-v0", 10, "chi2_kf", "stealth:trigger=near,threshold=40", 60),
    pytest.param("car-following-v0", "car-following-noisy-v0", 10, "chi2_kf", "stealth:trigger=near,threshold=40", 300, marks=pytest.mark.long),
    ("car-following-v0", "car-following-lossy-v0", 10, "imm", "zoo:name=car-following-chi2_kf-0", 40),
    ("radar-v0", "radar-following-v0", 4, "cra", "zoo:name=radar-following-cra-0", 40),
    ("thesis-v0", "thesis-ch3-v0", 10, "cra", "noise_jam:start_step=182", 40),
    ("network-v0", "network-restless-v0", 5, "chi2_dkf", "ghost:size=20,grow=20", 10),
    ("platoon-v0", "platoon-lossy-v0", 20, "chi2_dkf", "zoo:name=platoon-chi2_dkf-0", 10),
])  # fmt: skip
def test_rows_of_boards_are_the_same_in_any_batch_company_and_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suite: str, scenario: str, dose: int, defence: str, attack: str, seeds: int
) -> None:
    """A cell and 4096 at once, one process and two, few of them alone, and where the second half of a run was stopped and played later."""
    cells = [
        Cell(suite, scenario, dose, defence, text, seeds, first_seed=first, threat=load_suite(suite).granted)
        for text, first in ((attack, 0), ("none", 0), (attack, seeds))
    ]  # fmt: skip
    real, calls = run_cell, []

    def stopped(played: Cell) -> list[dict[str, Any]]:
        calls.append(played)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(played)

    with monkeypatch.context() as context:
        context.setattr(evaluation, "run_cell", stopped)
        with pytest.raises(KeyboardInterrupt):
            run(cells, tmp_path / "rows.jsonl")
    held = run(cells, tmp_path / "rows.jsonl")
    assert {row["status"] for row in held} == {"ok"} and any(row["attack_steps"] for row in held)
    assert verify(held, batch=4096)["counts"] == {"verified": 3 * seeds, "differs": 0, "unchecked": 0}
    some = held[:: max(1, seeds // 3)]
    assert verify(some, workers=2, batch=7)["counts"] == {"verified": len(some), "differs": 0, "unchecked": 0}


@pytest.mark.long
def test_rows_of_a_radar_a_platoon_and_a_network_are_the_same_too() -> None:
    """Filters of one car and of many agents, over the air and on wires: side by side, three at once in two processes, and each by itself."""
    cells = [
        Cell("s", "radar-braking-v0", 4, "chi2_kf", "noise_jam:trigger=leader_braking,threshold=0.3", 40),
        Cell("s", "platoon-gusty-v0", 20, "dkf", "fdi:value=5", 8), Cell("s", "network-restless-v0", 5, "dkf", "fdi:value=5", 8),
    ]  # fmt: skip
    held = run(cells)
    assert {row["status"] for row in held} == {"ok"} and all(row["attack_steps"] == row["dose"] for row in held)
    assert verify(held, batch=3, workers=2)["counts"] == {"verified": 56, "differs": 0, "unchecked": 0}
    assert verify(held[::-7], batch=1)["counts"] == {"verified": 8, "differs": 0, "unchecked": 0}


@pytest.mark.thin(3)
@pytest.mark.parametrize(
    ("name", "value", "where"),
    [
        ("max_error", 0.25, "max_error"), ("max_error", None, "max_error"), ("crashed", 0.0, "crashed"), ("trace_hash", "0" * 32, "trace_hash"),
        ("decision_hash", "0" * 32, "decision_hash"), ("dose", 9, "dose"), ("knowledge", "white", "knowledge"), ("seed", 2, "trace_hash"),
        ("uses", ["truth"], "uses"), ("optimal", True, "optimal"), ("learned", True, "learned"), ("config_hash", "0" * 16, "config_hash"),
        ("status", "skipped", "status"), ("purpose", "tune", "trace_hash"), ("attack", "fdi:value=4", "trace_hash"), ("defence", "none", "trace_hash"),
    ],
)  # fmt: skip
def test_a_changed_row_is_found(rows: list[dict[str, Any]], name: str, value: Any, where: str) -> None:
    report = _one(rows, **{name: value})
    assert report["status"] == "claimed" and report["counts"]["differs"] == 1
    (finding,) = report["findings"]
    assert finding["line"] == 1 and where in [entry["field"] for entry in finding["differences"]]
    held = next(entry for entry in finding["differences"] if entry["field"] == where)
    assert held["row"] != held["here"]


def test_a_dose_that_is_changed_everywhere_is_found(rows: list[dict[str, Any]]) -> None:
    """Also where the threat model says the same: the configuration's hash, and the episode, are those of the other dose."""
    row = next(row for row in rows if row["attack"] == "fdi:value=5" and row["dose"] == 5)
    (finding,) = verify([row | {"dose": 9, "threat_model": row["threat_model"] | {"budget": 9}}])["findings"]
    assert finding["verdict"] == "differs" and {"config_hash", "trace_hash", "attack_steps"} <= {entry["field"] for entry in finding["differences"]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": "9.9"}, "tailgate 9.9"), ({"engine": "quick"}, "engine 'quick'"), ({"purpose": "mine"}, "'mine'"),
        ({"defence": "os:system"}, "code to import"), ({"attack": "os:system:command=ls"}, "code to import"),
        ({"defence": "composed:detector=os:system"}, "code to import"), ({"defence": "composed:detector={name: 'os:system'}"}, "code to import"),
        ({"attack": "/nowhere/policy.json"}, "not here"), ({"attack": "policy:path=/nowhere/policy.json"}, "not here"),
        ({"defence": "steered:policy=/nowhere/p.json"}, "not here"), ({"attack": "zoo:name=nobody"}, "nobody"), ({"attack": "fdy"}, "fdy"),
        ({"scenario": "mine-v0"}, "not built in"), ({"scenario_file": "/nowhere/mine.yaml"}, "not here"), ({"threat_model": None}, "threat model"),
        ({"threat_model": {"budget": -1}}, "budget"), ({"versions": {"defence": 2, "attack": 1}}, "version 1 here and 2"), ({"versions": 3}, "versions"),
        ({"attack": "zoo:name=car-following-kf-0"}, "digest none"), ({"attack_digest": "f" * 64}, "here none"), ({"defence": "kf:gain=7"}, "gain"),
    ],
)  # fmt: skip
def test_what_cannot_be_checked_is_said_with_the_reason(rows: list[dict[str, Any]], changes: dict[str, Any], words: str) -> None:
    report = _one(rows, **changes)
    assert report["status"] == "claimed" and report["counts"] == {"verified": 0, "differs": 0, "unchecked": 1}
    assert words in report["findings"][0]["why"], report["findings"][0]["why"]


def test_a_row_without_its_hash_cannot_be_checked(rows: list[dict[str, Any]]) -> None:
    row = {name: value for name, value in rows[0].items() if name != "trace_hash"}
    assert "trace_hash" in verify([row])["findings"][0]["why"]


def test_a_class_is_imported_only_when_it_is_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a class whose file changed since is not played even then."""
    module = tmp_path / "verified_mine.py"
    module.write_text("from tailgate.estimators import Kalman\n\nclass Mine(Kalman):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    held = run_cell(Cell("s", "thesis-ch4-v0", 5, "verified_mine:Mine", "none", 2))
    sys.modules.pop("verified_mine")
    assert verify(held)["counts"]["unchecked"] == 2 and "verified_mine" not in sys.modules
    assert verify(held, trust_code=True)["status"] == "verified"
    module.write_text(module.read_text() + "\n")
    assert "other files" in verify(held, trust_code=True)["findings"][0]["why"]
    sys.modules.pop("verified_mine", None)


def test_files_are_played_when_they_are_those_of_the_row(tmp_path: Path) -> None:
    """A scenario and a program of one's own; after a change they cannot be checked."""
    root = Path(tailgate.__file__).parent / "configs"
    scenario, program = tmp_path / "mine.yaml", tmp_path / "burst.yaml"
    scenario.write_text((root / "scenarios/thesis-ch4-v0.yaml").read_text())
    program.write_text((root / "attacks/burst_jamming.yaml").read_text())
    held = run_cell(Cell("s", str(scenario), None, "kf", str(program), 2))
    assert held[0]["attack_digest"] == hashlib.sha256(program.read_bytes()).hexdigest()
    assert verify(held)["status"] == "verified"
    original = program.read_text()
    program.write_text(original + "# changed\n")
    assert "other files" in verify(held)["findings"][0]["why"]
    program.write_text(original)
    scenario.write_text(scenario.read_text().replace("horizon: 150", "horizon: 140"))
    assert "another scenario" in verify(held)["findings"][0]["why"]


def test_a_policy_of_the_zoo_is_played() -> None:
    held = run_cell(Cell("s", "gusty-stop-and-go-v0", 20, "chi2_kf", "zoo:name=car-following-chi2_kf-0", 2))
    assert held[0]["status"] in ("ok", "skipped") and verify(held)["status"] == "verified"


def test_a_skipped_pairing_is_checked_too(rows: list[dict[str, Any]]) -> None:
    """A row that hides an episode behind `skipped` differs; a pairing that has no meaning here either is verified."""
    held = run_cell(Cell("s", "gusty-stop-and-go-v0", None, "none", "stealth", 2))
    assert {row["status"] for row in held} == {"skipped"} and verify(held)["status"] == "verified"
    hidden = rows[0] | dict.fromkeys(("max_error", "trace_hash", "decision_hash")) | {"status": "skipped"}
    assert verify([hidden])["counts"]["differs"] == 1
    failed = rows[0] | {"status": "error", "reason": "MemoryError: "}
    assert verify([failed])["counts"]["unchecked"] == 1


@pytest.mark.long
def test_the_sample_is_as_large_as_asked_and_is_drawn(rows: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [row | {"max_error": -1.0} for row in rows]
    one, same, other = (verify(broken, sample=5, sample_seed=seed) for seed in (0, 0, 1))
    lines = [[finding["line"] for finding in report["findings"]] for report in (one, same, other)]
    assert lines[0] == lines[1] != lines[2] and [len(set(held)) for held in lines] == [5, 5, 5]
    assert one["asked"] == 5 and one["rows"] == 18
    with pytest.raises(tailgate.InputError, match="sample"):
        verify(rows, sample=0)


def _command(*arguments: str) -> int:
    return ran(command, "verify", *arguments)


def test_the_command_says_which_line_of_which_file_differs(rows: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, bad = tmp_path / "good.jsonl", tmp_path / "bad.jsonl"
    good.write_bytes(encode(rows[:4]))
    bad.write_bytes(encode([rows[4], rows[5] | {"max_error": 0.5}]))
    assert _command("--rows", str(good)) == 0
    assert "verified: 4 of 4" in capsys.readouterr().out
    assert _command("--rows", str(good), str(bad)) == 1
    shown = capsys.readouterr().out
    assert f"{bad}, line 2" in shown and "max_error: row 0.5, here" in shown and "claimed: 6 of 6" in shown
    assert _command("--rows", str(good), str(bad), "--json") == 1
    report = json.loads(capsys.readouterr().out)
    assert [(f["file"], f["line"]) for f in report["findings"]] == [(str(bad), 2)]
    good.write_bytes(encode([row | {"version": "9.9"} for row in rows[:2]]))
    assert _command("--rows", str(good), "--json") == 1  # nothing was checked
