"""Rows: the same whatever the batch, the workers and interruptions; a failure costs its own rows."""

import dataclasses
import json
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import draws, no_command
from tailgate.core.reach import blind
from tailgate.core.scenario import Scenario, Suite, load_scenario
from tailgate.envs import SensorNetwork
from tailgate.estimators import Kalman, Oracle
from tailgate.evaluation import cells as evaluation
from tailgate.evaluation import rows as rows_module
from tailgate.evaluation.cells import Cell, cells_of, run, run_cell
from tailgate.evaluation.resume import complete
from tailgate.evaluation.rows import read_rows
from tailgate.evaluation.summary import summarise
from tailgate.play import trace
from tailgate.play.metrics import METRICS
from tailgate.play.trace import Trace, episodes_at_once, rollout

PLACE = "thesis-ch4-v0"  # a short one
SUITE = Suite("small", "", ("linear-dos-v0",), (12,), ("kf", "chi2_kf"), ("none", "dropout:start_step=30,probability=0.5"), 9)  # the fewest steps


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
        if self.how == "late":
            estimate.score[(draws.step >= 20) & (np.arange(len(draws.step)) >= 2)] = np.inf
        if self.how == "shape":
            estimate = estimate._replace(score=estimate.score[0])
        if self.how == "type":
            estimate = estimate._replace(alarm=estimate.alarm.astype(float))
        return {"nothing": None, "alone": estimate, "swapped": (estimate, state)}.get(self.how, (state, estimate))


PAIRS = [
    ("nothing", "defence output: got 'NoneType'; expected a pair (state, Estimate)"),
    ("alone", "defence output: got 'Estimate'; expected a pair"),
    ("swapped", "defence output: got '(Estimate, "),
]


@pytest.mark.thin(2)
@pytest.mark.parametrize(("how", "reason"), [("raise", "broken"), ("nan", "NaN"), ("shape", "score"), ("type", "alarm"), *PAIRS])
def test_a_defence_that_fails_costs_its_own_rows_only(how: str, reason: str) -> None:
    rows = tailgate.evaluate(scenarios=[PLACE], defences=["kf", Faulty(how=how)], attacks=["none"], seeds=3)
    assert [row["status"] for row in rows] == ["ok"] * 3 + ["error"] * 3
    assert reason in rows[-1]["reason"] and rows[-1]["crashed"] is None and rows[-1]["trace_hash"] is None
    good, bad = summarise(rows)
    assert good["n"] == 3 and bad["failed"] == 3 and bad["crash"] is None


def test_of_what_is_not_finite_the_first_step_the_rows_and_a_seed_are_told() -> None:
    cell = Cell("s", PLACE, None, "kf", "none", 5, first_seed=40, batch=4)
    first, *_, last = run_cell(cell, defence=Faulty(how="late"))
    told = "defence output score: got 'NaN or infinity in step 20, in 2 of 4 rows, the first of them row 2'; expected finite numbers (row 2: seed 42)"
    assert first["reason"] == f"InputError: {told}" and first["status"] == "error" and (last["seed"], last["status"]) == (44, "ok")


def test_a_defence_that_kills_its_process_costs_its_own_rows_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deadly.py").write_text(
        "import os\nfrom dataclasses import dataclass\nfrom tailgate.estimators import Kalman\n\n@dataclass(frozen=True)\n"
        "class Deadly(Kalman):\n    def step(self, *arguments):\n        os._exit(3)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    cells = [Cell("s", PLACE, None, name, "none", 2) for name in ("kf", "deadly:Deadly", "chi2_kf")]
    rows = run(cells, workers=2)
    assert [row["status"] for row in rows] == ["ok", "ok", "error", "error", "ok", "ok"]
    assert "died" in rows[2]["reason"]
    sys.modules.pop("deadly", None)


def test_a_pairing_without_meaning_is_skipped_with_the_reason() -> None:
    rows = tailgate.evaluate(scenarios=[PLACE], defences=["none"], attacks=["stealth"], seeds=2)
    assert {row["status"] for row in rows} == {"skipped"} and "look" in rows[0]["reason"]


def test_a_single_name_is_a_list_of_one() -> None:
    """And a keyword that is nearly one of the function's is named."""
    part: dict[str, Any] = {"seeds": 2, "threat": {"budget": 3}}
    rows = tailgate.evaluate(scenarios="braking-v0", defences="kf", attacks="none", doses=4, **part)
    assert rows == tailgate.evaluate(scenarios=["braking-v0"], defences=["kf"], attacks=["none"], doses=[4], **part) and len(rows) == 2
    with pytest.raises(InputError, match=r"argument of evaluate: got 'defence'; expected one of these \(did you mean 'defences'\?\)") as caught:
        tailgate.evaluate(scenarios="braking-v0", defence="kf")  # type: ignore[call-arg]
    assert isinstance(caught.value, TypeError) and str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_objects_keep_their_card() -> None:
    """The oracle as an object is the oracle by name, down to the last bit."""
    attack = "fdi:start_step=60,value=-4"
    by_object = tailgate.evaluate(scenarios=[PLACE], defences=[Oracle()], attacks=[attack], seeds=3)
    by_name = tailgate.evaluate(scenarios=[PLACE], defences=["oracle"], attacks=[attack], seeds=3)
    assert by_object[0]["uses"] == ["measurements", "truth"]
    assert [row["trace_hash"] for row in by_object] == [row["trace_hash"] for row in by_name]


def test_a_seed_counts_once_in_the_summary() -> None:
    rows = run_cell(Cell("s", PLACE, None, "kf", "none", 4))
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
    arguments: dict[str, Any] = {"scenarios": [PLACE], "defences": ["kf"], "attacks": ["none"], "seeds": 1}
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
    rows = run_cell(Cell("s", PLACE, None, "kf", "none", 1))
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps(rows[0]) + "\n{broken\n")
    with pytest.raises(InputError, match="line 2"):
        read_rows(path)
    path.write_text(json.dumps({k: v for k, v in rows[0].items() if k != "crashed"}))
    with pytest.raises(InputError, match=r"line 1: crashed"):
        read_rows(path)


@pytest.mark.parametrize("part", ["defences", "attacks", "held_out"])
def test_a_suite_file_never_imports_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str) -> None:
    (tmp_path / "evil_part.py").write_text("from pathlib import Path\nPath('ran').touch()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "s.yaml").write_text(yaml.safe_dump({"scenarios": ["braking-v0"], "defences": ["kf"], "attacks": ["none"], part: ["evil_part:Mine"]}))
    with pytest.raises(InputError, match=r"evil_part:Mine.*imports nothing"):
        tailgate.evaluate(str(tmp_path / "s.yaml"))
    assert not (tmp_path / "ran").exists()


def test_rows_of_objects_are_written_too(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    rows = tailgate.evaluate(scenarios=[PLACE], defences=["kf", Oracle()], attacks=["none"], seeds=2, out=out)
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
    (row,) = run_cell(Cell("s", PLACE, None, "kf", "none", 1))
    (tmp_path / "rows.jsonl").write_text(json.dumps(row | {field: value}))
    with pytest.raises(InputError, match=f"line 1: {field}"):
        read_rows(tmp_path / "rows.jsonl")


def test_different_defences_never_share_an_identity() -> None:
    """Two compositions without parameters differ in their parts, and so do their rows and cards."""
    from tailgate.envs.gym.gymnasium_env import AdversaryEnv
    from tailgate.estimators import AcceptAll, ChiSquare, GateOut, KalmanFilter, Score, compose

    plain, gated = compose(KalmanFilter(), Score(), AcceptAll()), compose(KalmanFilter(), ChiSquare(), GateOut())
    rows = tailgate.evaluate(scenarios=[PLACE], defences=[plain, gated], attacks=["none"], seeds=2)
    assert len(summarise(rows)) == 2
    assert AdversaryEnv(defence=plain).card()["hash"] != AdversaryEnv(defence=gated).card()["hash"]


def test_a_mode_that_does_not_exist_is_refused() -> None:
    @dataclass(frozen=True)
    class Ninth(Kalman):
        def step(self, plan: Any, state: Any, received: Any, known_u: Any, draws: Any) -> Any:
            state, estimate = super().step(plan, state, received, known_u, draws)
            return state, estimate._replace(mode=np.full_like(estimate.mode, 9))

    rows = tailgate.evaluate(scenarios=[PLACE], defences=[Ninth()], attacks=["none"], seeds=1)
    assert "mode" in rows[0]["reason"] and "NORMAL" in rows[0]["reason"]


PLATOON = Cell("s", "platoon-braking-v0", None, "none", "fdi:start_step=200,value=60,chance=0.5", 7)


@pytest.mark.long
def test_a_cell_plays_no_more_at_once_than_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The batch is cut where a trace would need more than trace.MEMORY; the rows do not change, nor do those of a cell that fails, words apart."""
    sizes: list[int] = []

    def counted(loop: Any, attack: Any, keys: Any, **options: Any) -> Trace:
        sizes.append(len(keys.key))
        return rollout(loop, attack, keys, **options)

    monkeypatch.setattr(evaluation, "rollout", counted)
    whole, broken = run_cell(PLATOON), run_cell(PLATOON, defence=Faulty(how="nan"))
    loop = load_scenario("platoon-braking-v0").loop(Kalman())
    used = sum(held.nbytes for held in _recorded(loop).values())
    assert 0.98 < used / (1e9 / episodes_at_once(loop.model, loop.horizon, 10**9)) < 1.02
    monkeypatch.setattr(trace, "MEMORY", 3.5 * used)
    assert _results(run_cell(PLATOON)) == _results(whole) and {row["status"] for row in whole} == {"ok"}
    again = [row | {"reason": ""} for row in run_cell(PLATOON, defence=Faulty(how="nan"))]  # which names rows of the batch
    assert _results(again) == _results([row | {"reason": ""} for row in broken]) and {row["status"] for row in broken} == {"error"}
    monkeypatch.setattr(trace, "MEMORY", 1.0)
    assert episodes_at_once(loop.model, loop.horizon, 256) == 1
    assert sizes == [7, 7, 3, 3, 1, 3, 3, 1]


def _recorded(loop: Any) -> dict[str, Any]:
    """What a recorder holds of one episode."""
    state = loop.start(draws.keys("train", [0]))
    recorder = trace.Recorder(loop, state)
    _, frame = loop.advance(state, no_command(1, loop.model.agents, len(loop.model.wires)))
    recorder.put(trace.signals_of(frame), np.ones(1, bool))
    return recorder.signals


class OwnTruth(SensorNetwork):
    """A network whose agents' truths are copies."""

    def truth(self, plan: Any, state: Any, held: Any) -> Any:
        return np.array(super().truth(plan, state, held))


def test_a_truth_that_agents_share_is_stored_once() -> None:
    """One copy in memory, as many as there are agents to a reader, and the fingerprints of a truth that is stored in full."""
    place = dataclasses.replace(load_scenario("network-weak-v0"), horizon=15)
    plant = OwnTruth(**{field.name: getattr(place.plant, field.name) for field in dataclasses.fields(place.plant)})
    shared, own = (
        rollout(dataclasses.replace(place, plant=p).loop(tailgate.make_defence("dkf")), tailgate.make_attack("none"), draws.keys("train", range(3)))
        for p in (place.plant, plant)
    )
    assert shared.truth.shape == own.truth.shape == (15, 3, 10, 10)
    assert shared.truth.strides[2] == 0 and own.truth.strides[2] != 0
    assert [shared.trace_hash(i) for i in range(3)] == [own.trace_hash(i) for i in range(3)]


def test_every_scenario_of_many_agents_is_checked_once_per_defence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attacks and doses do not prepare the same filter again before anything is played: that of a long platoon takes minutes."""
    made: list[str] = []
    real = Scenario.loop

    def counted(self: Scenario, *arguments: Any) -> Any:
        made.append(self.name)
        return real(self, *arguments)

    monkeypatch.setattr(Scenario, "loop", counted)
    suite = Suite("s", "", ("network-weak-v0", "thesis-ch6-v0"), (1, 2, None), ("dkf", "none"), ("none", "fdi", "stealth", "covert"), 2)
    assert len(cells_of(suite)) == 48
    assert sorted(made) == ["network-weak-v0"] * 2 + ["thesis-ch6-v0"] * 2


def test_agents_and_wires_are_checked_before_anything_is_played() -> None:
    """Also where the defence has no meaning: the attack and the threat model are looked at by themselves."""
    for change, words in (({"threat": {"agents": [10]}}, "agents: got 10"), ({"attacks": ["fdi:targets=[distance]"]}, "got 'distance'")):
        arguments: dict[str, Any] = {"scenarios": ["network-weak-v0"], "defences": ["none"], "attacks": ["none"], "seeds": 1}
        with pytest.raises(InputError, match=words):
            tailgate.evaluate(**(arguments | change))


def test_a_network_has_rows_without_a_road(tmp_path: Path) -> None:
    """They are read again, say how large the error was, and have null for what needs a road; a summary has both."""
    out = tmp_path / "rows.jsonl"
    rows = tailgate.evaluate(scenarios=["network-weak-v0"], defences=["dkf", "none"], attacks=["fdi:value=20"], seeds=2, out=out)
    assert read_rows(out) == rows and [row["status"] for row in rows] == ["ok", "ok", "skipped", "skipped"]
    assert rows[0]["min_gap"] is None and rows[0]["max_error"] > 5.0 and rows[0]["crashed"] == 0.0
    good, bad = summarise(rows)
    assert good["min_gap"] is None and good["max_error"]["median"] > 5.0 and bad["crash"] is None and "directly" in bad["reason"]


SCENARIOS = (Path(__file__).parents[1] / "docs/scenarios.md").read_text(encoding="utf-8")


def test_the_network_of_the_documentation_plays(tmp_path: Path) -> None:
    """As it stands; and nobody in it knows the state alone."""
    (tmp_path / "mine.yaml").write_text(next(b for b in SCENARIOS.split("```yaml\n") if b.startswith("about: Five agents")).split("```")[0], encoding="utf-8")
    rows = tailgate.evaluate(scenarios=[str(tmp_path / "mine.yaml")], defences=["dkf"], attacks=["fdi"], seeds=2)
    assert {row["status"] for row in rows} == {"ok"} and rows[0]["attack_steps"] == 180.0
    model = load_scenario(str(tmp_path / "mine.yaml")).brief().model
    assert blind(model, np.eye(5, dtype=bool)) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("scenario", "plant", "threat", "defence", "attack"),
    [
        ("network-weak-v0", {"agents": 5, "states": 6, "graph": "path", "directed": True}, {}, "dkf", "none"), ("thesis-ch5-v0", {"agents": 7}, {}, "dkf", "none"),
        ("network-weak-v0", {"agents": 3, "edges": ((0, 3),)}, {}, "dkf", "none"), ("platoon-braking-v0", {}, {"agents": (5,)}, "dkf", "none"),
        ("platoon-braking-v0", {}, {}, "rkf", "none"), ("network-noisy-v0", {}, {}, "none", "none"), ("platoon-braking-v0", {}, {}, "dkf", "covert"),
        ("network-noisy-v0", {}, {}, "dkf", "program"),
    ],
)  # fmt: skip
def test_the_error_texts_of_the_documentation_are_those_that_come(scenario: str, plant: Any, threat: Any, defence: str, attack: str) -> None:
    place = load_scenario(scenario).with_threat(**threat)
    place = dataclasses.replace(place, plant=dataclasses.replace(place.plant, **plant))
    if "directed" in plant:
        place = dataclasses.replace(place, sensor=dataclasses.replace(place.sensor, modes_seen=1))
    with pytest.raises(InputError) as caught:
        tailgate.make_attack(attack).prepare(place.loop(tailgate.make_defence(defence)).brief)
    assert f"\n{caught.value}\n" in SCENARIOS


def test_rows_of_another_cell_end_a_run(tmp_path):
    """A process with another version of somebody's class would make them; nothing of them is kept."""
    row = {"cell": "old", "seed": 0, "status": "ok", "defence": "mine:Mine"}
    out = tmp_path / "rows.jsonl"
    with pytest.raises(InputError, match="row of mine:Mine: got 'cell old, seed 0'; expected cell new, seed 0: all processes with the same files"):
        complete(["new"], {"new": [("new", 0)]}, out, lambda _: iter_of((0, [row])), None)
    assert not out.exists() and not list(tmp_path.glob("**/new*"))


def iter_of(*held):
    yield from held


def test_a_suite_s_knowledge_reaches_objects_too() -> None:
    suite = Suite("s", "", ("thesis-ch4-v0",), (5,), ("kf",), ("fdi",), 2, knowledge="grey")
    named, held = (tailgate.evaluate(suite, defences=[defence]) for defence in ("kf", tailgate.make_defence("kf")))
    assert all(one[name] == two[name] for one, two in zip(named, held, strict=True) for name in ("knowledge", "config_hash", "trace_hash"))
    assert {row["knowledge"] for row in held} == {"grey"}
