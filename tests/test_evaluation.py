"""Rows: the same whatever the batch, the workers and interruptions; a failure costs its own rows."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tailgate
from tailgate import evaluation
from tailgate import rows as rows_module
from tailgate.errors import InputError
from tailgate.estimators import Kalman, Oracle
from tailgate.evaluation import Cell, cells_of, run, run_cell
from tailgate.metrics import METRICS
from tailgate.rows import read_rows
from tailgate.scenario import Suite
from tailgate.summary import summarise

SUITE = Suite("small", "", ("gusty-stop-and-go-v0",), (12,), ("kf", "chi2_kf"), ("none", "fdi:trigger=near,threshold=30,value=-4"), 9)


def _results(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in ("batch", "cell")} for row in rows]


def test_rows_do_not_depend_on_the_batch_or_the_workers(tmp_path: Path) -> None:
    whole = run(cells_of(SUITE))
    parts = run(cells_of(SUITE, batch=4))
    spawned = run(cells_of(SUITE, batch=5), tmp_path / "rows.jsonl", workers=2)
    assert _results(whole) == _results(parts) == _results(spawned)
    assert read_rows(tmp_path / "rows.jsonl") == spawned
    assert len({row["trace_hash"] for row in whole[:9]}) == 9  # of one cell: nine different episodes


def test_a_row_has_every_column_and_no_nan() -> None:
    (row,) = run_cell(Cell("s", "braking-v0", None, "kf", "none", 1))
    for name in (*rows_module.KEYS, "seed", "batch", "engine", "status", "reason", "trace_hash", "decision_hash", "version", "threat_model", *METRICS):
        assert name in row, name
    assert row["impact_speed"] is None and row["detection_delay"] is None  # undefined without a collision, without an attack
    json.dumps(row, allow_nan=False)


def test_an_interrupted_run_resumes_and_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "rows.jsonl"
    cells = cells_of(SUITE)
    played: list[Cell] = []
    real = run_cell

    def counted(cell: Cell) -> list[dict[str, Any]]:
        if len(played) == 2:
            raise KeyboardInterrupt
        played.append(cell)
        return real(cell)

    monkeypatch.setattr(evaluation, "run_cell", counted)
    with pytest.raises(KeyboardInterrupt):
        run(cells, out)
    assert not out.exists()
    monkeypatch.setattr(evaluation, "run_cell", lambda cell: played.append(cell) or real(cell))
    rows = run(cells, out)
    assert [cell.attack for cell in played] == [cell.attack for cell in cells] and len(played) == 4  # the first two were not played again
    monkeypatch.undo()
    assert rows == run(cells)
    assert [p.name for p in tmp_path.iterdir()] == ["rows.jsonl"]


@dataclass(frozen=True)
class Faulty(Kalman):
    """Goes wrong in one of several ways."""

    how: str = "raise"

    def step(self, plan: Any, state: Any, received: Any, known_u: Any, draws: Any) -> Any:
        state, estimate = super().step(plan, state, received, known_u, draws)
        if self.how == "raise":
            raise RuntimeError("broken")
        if self.how == "nan":
            estimate.x[..., 0] = np.nan
        if self.how == "shape":
            estimate = estimate._replace(score=estimate.score[0])
        if self.how == "type":
            estimate = estimate._replace(alarm=estimate.alarm.astype(float))
        return state, estimate


@pytest.mark.parametrize(("how", "reason"), [("raise", "broken"), ("nan", "NaN"), ("shape", "score"), ("type", "alarm")])
def test_a_defence_that_fails_costs_its_own_rows_only(how: str, reason: str) -> None:
    rows = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["kf", Faulty(how=how)], attacks=["none"], seeds=3)
    assert [row["status"] for row in rows] == ["ok"] * 3 + ["error"] * 3
    assert reason in rows[-1]["reason"] and rows[-1]["crashed"] is None and rows[-1]["trace_hash"] is None
    good, bad = summarise(rows)
    assert good["n"] == 3 and bad["failed"] == 3 and bad["crash"] is None


def test_a_defence_that_kills_its_process_costs_its_own_rows_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deadly.py").write_text(
        "import os\nfrom dataclasses import dataclass\nfrom tailgate.estimators import Kalman\n\n@dataclass(frozen=True)\n"
        "class Deadly(Kalman):\n    def step(self, *arguments):\n        os._exit(3)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    cells = [Cell("s", "gusty-stop-and-go-v0", None, name, "none", 2) for name in ("kf", "deadly:Deadly", "chi2_kf")]
    rows = run(cells, workers=2)
    assert [row["status"] for row in rows] == ["ok", "ok", "error", "error", "ok", "ok"]
    assert "died" in rows[2]["reason"]
    sys.modules.pop("deadly", None)


def test_a_pairing_without_meaning_is_skipped_with_the_reason() -> None:
    rows = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["none"], attacks=["stealth"], seeds=2)
    assert {row["status"] for row in rows} == {"skipped"} and "look" in rows[0]["reason"]


def test_objects_keep_their_card() -> None:
    """The oracle as an object is the oracle by name, down to the last bit."""
    attack = "fdi:trigger=near,threshold=30,value=-4"
    by_object = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=[Oracle()], attacks=[attack], seeds=3)
    by_name = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["oracle"], attacks=[attack], seeds=3)
    assert by_object[0]["uses"] == ["measurements", "truth"]
    assert [row["trace_hash"] for row in by_object] == [row["trace_hash"] for row in by_name]


def test_a_seed_counts_once_in_the_summary() -> None:
    rows = run_cell(Cell("s", "gusty-stop-and-go-v0", None, "kf", "none", 4))
    assert summarise(rows + rows)[0]["n"] == 4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"defences": ["kff"]}, ["kff", "'kf'"]), ({"attacks": ["fdy"]}, ["fdy", "'fdi'"]), ({"scenarios": ["brake-v0"]}, ["brake-v0", "braking-v0"]),
        ({"doses": [-1]}, ["dose", "-1"]), ({"seeds": 0}, ["seeds", "0"]), ({"batch": 0}, ["batch", "0"]), ({"workers": 0}, ["workers", "0"]),
        ({"defences": ["chi2_kf:eta=-1"]}, ["eta", "-1", "greater than 0"]), ({"defences": ["chi2_kf:etta=3"]}, ["etta", "eta"]),
        ({"attacks": ["fdi:targets=[positio]"]}, ["positio", "position"]), ({"threat": {"budgett": 3}}, ["budgett", "budget"]),
        ({"purpose": "reports"}, ["purpose", "report"]), ({"attacks": ["nothing.json"]}, ["nothing.json"]), ({"attacks": []}, ["attacks"]),
        ({"defences": ["no.such.module:Class"]}, ["no.such.module"]), ({"threat": {"fdi_bound": float("nan")}}, ["fdi_bound", "nan"]),
    ],
)  # fmt: skip
def test_bad_input_is_refused_before_anything_is_played(change: dict[str, Any], words: list[str], tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"scenarios": ["gusty-stop-and-go-v0"], "defences": ["kf"], "attacks": ["none"], "seeds": 1}
    with pytest.raises(InputError) as caught:
        tailgate.evaluate(**(arguments | change), out=tmp_path / "rows.jsonl")
    message = str(caught.value)
    assert all(word in message for word in words) and "expected" in message and "\n" not in message
    assert not (tmp_path / "rows.jsonl").exists()


def test_an_unwritable_output_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"out.*writable"):
        run(cells_of(SUITE), tmp_path / "file" / "rows.jsonl")


def test_damaged_rows_are_refused_with_their_line(tmp_path: Path) -> None:
    rows = run_cell(Cell("s", "gusty-stop-and-go-v0", None, "kf", "none", 1))
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps(rows[0]) + "\n{broken\n")
    with pytest.raises(InputError, match="line 2"):
        read_rows(path)
    path.write_text(json.dumps({k: v for k, v in rows[0].items() if k != "crashed"}))
    with pytest.raises(InputError, match=r"line 1: crashed"):
        read_rows(path)


def test_a_suite_file_never_imports_code(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("scenarios: [braking-v0]\ndefences: ['os:system']\nattacks: [none]\n")
    with pytest.raises(InputError, match="os:system"):
        tailgate.evaluate(str(tmp_path / "s.yaml"))


def test_rows_of_objects_are_written_too(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    rows = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["kf", Oracle()], attacks=["none"], seeds=2, out=out)
    assert len(rows) == 4 and read_rows(out) == rows


def test_an_output_directory_is_refused_and_strangers_files_are_kept(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="out"):
        run(cells_of(SUITE), tmp_path)
    parts = tmp_path / ".rows.jsonl.parts"
    parts.mkdir()
    (parts / "mine.txt").write_text("keep")
    run(cells_of(SUITE)[:1], tmp_path / "rows.jsonl")
    assert (parts / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize(
    ("field", "value"), [("min_gap", float("nan")), ("min_gap", "x"), ("seed", [1]), ("scenario", {}), ("uses", 5), ("crashed", 0.5), ("dose", "abc")]
)
def test_a_row_with_a_wrong_value_is_refused_with_its_line(tmp_path: Path, field: str, value: Any) -> None:
    (row,) = run_cell(Cell("s", "gusty-stop-and-go-v0", None, "kf", "none", 1))
    (tmp_path / "rows.jsonl").write_text(json.dumps(row | {field: value}))
    with pytest.raises(InputError, match=f"line 1: {field}"):
        read_rows(tmp_path / "rows.jsonl")


def test_different_defences_never_share_an_identity() -> None:
    """Two compositions without parameters differ in their parts, and so do their rows and cards."""
    from tailgate.envs.faces import AdversaryEnv
    from tailgate.estimators import AcceptAll, ChiSquare, GateOut, KalmanFilter, Score, compose

    plain, gated = compose(KalmanFilter(), Score(), AcceptAll()), compose(KalmanFilter(), ChiSquare(), GateOut())
    rows = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=[plain, gated], attacks=["none"], seeds=2)
    assert len(summarise(rows)) == 2
    assert AdversaryEnv(defence=plain).card()["hash"] != AdversaryEnv(defence=gated).card()["hash"]


def test_a_mode_that_does_not_exist_is_refused() -> None:
    @dataclass(frozen=True)
    class Ninth(Kalman):
        def step(self, plan: Any, state: Any, received: Any, known_u: Any, draws: Any) -> Any:
            state, estimate = super().step(plan, state, received, known_u, draws)
            return state, estimate._replace(mode=np.full_like(estimate.mode, 9))

    rows = tailgate.evaluate(scenarios=["gusty-stop-and-go-v0"], defences=[Ninth()], attacks=["none"], seeds=1)
    assert "mode" in rows[0]["reason"] and "NORMAL" in rows[0]["reason"]
