"""Attackers that a suite trains against a defence."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tailgate.base.errors import InputError
from tailgate.base.files import write_json
from tailgate.core.scenario import Suite, config_path, load_suite
from tailgate.core.schema import as_data
from tailgate.evaluation.baselines import left_out
from tailgate.evaluation.cells import evaluate
from tailgate.training import train as training
from tailgate.training.adaptive import as_begun, asked_of, configs_of, fitting, plan_of, train_against
from tailgate.training.train import train

PLAN = {
    "config": "car-following", "dose": 12, "changes": ["environment.interval=20", "environment.frames=1"],
    "learners": {"cem": ["teacher=null", "steps=600", "cem={population: 4, episodes: 5, hidden: []}"]}, "seeds": 2,
}  # fmt: skip
SUITE = Suite("own-v0", "", ("gusty-stop-and-go-v0", "stop-and-go-v0"), (12,), ("kf",), ("none",), 3, {"kinds": ["fdi"], "fdi_bound": 5.0}, adaptive=PLAN)


def test_every_learner_is_trained_at_every_knowledge(tmp_path: Path) -> None:
    """Two trainings on the first scenario, at the suite's dose and within its threat model, against the defence that is named."""
    black, grey = configs_of(SUITE, "kf:gain=steady", tmp_path)
    assert (black.name, grey.name) == ("kf_gain=steady-cem-black", "kf_gain=steady-cem-grey")
    assert black.defence == "kf:gain=steady" and black.scenario == "gusty-stop-and-go-v0" and black.seeds == 2
    assert black.threat == {"kinds": ["fdi"], "fdi_bound": 5.0, "budget": 12, "knowledge": "black"} and grey.threat["knowledge"] == "grey"
    assert black.environment["interval"] == 20 and black.steps == 600 and black.teacher is None
    assert configs_of(SUITE, "kf", tmp_path, seeds=1, extra=("steps=40",))[0].steps == 40


@pytest.mark.long
def test_policies_play_as_attacks_and_are_trained_once(tmp_path: Path) -> None:
    """A second call trains nothing; the policies play on every scenario of the suite, as learned attacks of their own knowledge."""
    configs = configs_of(SUITE, "kf", tmp_path, extra=("workers=1",))
    said: list[str] = []
    policies = train_against(configs, lambda label, done, of, text: said.append(label))
    assert len(policies) == 4 and said
    before = [path.stat().st_mtime_ns for path in policies]
    assert train_against(configs, lambda *args: pytest.fail("trained again")) == policies
    more = configs_of(SUITE, "kf", tmp_path, extra=("workers=2", "episodes=7"))  # which change no policy
    assert train_against(more, lambda *args: pytest.fail("trained again")) == policies
    assert [path.stat().st_mtime_ns for path in policies] == before
    rows = evaluate(SUITE, attacks=[str(path) for path in policies])
    assert len(rows) == 4 * 2 * 3 and all(row["status"] == "ok" and row["learned"] for row in rows)
    assert {row["knowledge"] for row in rows} == {"black", "grey"}
    assert json.loads(policies[0].read_text())["training"]["config"]["defence"] == "kf"


@pytest.mark.long
def test_published_policies_are_not_trained_again(tmp_path: Path) -> None:
    """Without checkpoints what is there stays byte by byte and what is missing comes back the same; what is of another training is refused."""
    black = configs_of(SUITE, "kf", tmp_path, extra=("workers=1",))[:1]
    first, second = train_against(black, lambda *args: None)
    held = [path.with_suffix(".safetensors").read_bytes() for path in (first, second)]
    for path in (*tmp_path.glob("*/checkpoint-*"), second, second.with_suffix(".safetensors")):
        path.unlink()
    record = json.loads(first.read_text())
    record["training"]["made_with"] = {"machine": "another"}
    first.write_text(json.dumps(record))
    labels: list[str] = []
    assert train_against(black, lambda label, *rest: labels.append(label)) == [first, second]
    assert set(labels) == {"kf-cem-black, seed 1"}
    assert json.loads(first.read_text()) == record
    assert [path.with_suffix(".safetensors").read_bytes() for path in (first, second)] == held
    for path in tmp_path.glob("*/checkpoint-*"):
        path.unlink()
    second.unlink()
    for name, value in (("seed", 1), ("defence_digest", "f"), ("defence_version", 99), ("config", record["training"]["config"] | {"gamma": 0.5})):
        first.write_text(json.dumps(record | {"training": record["training"] | {name: value}}))
        with pytest.raises(InputError, match=r"policy-0\.json"):
            train_against(black, lambda *args: None)
    first.write_text(json.dumps(record))
    (told,) = tmp_path.glob("*/config.json")
    before = told.read_bytes()
    with pytest.raises(InputError, match=r"policy-0\.json"):
        train(dataclasses.replace(black[0], steps=1200), lambda *args: None, resume=True)
    assert told.read_bytes() == before and first.with_suffix(".safetensors").read_bytes() == held[0]
    first.with_suffix(".safetensors").unlink()  # a policy without weights is none
    busy = [dataclasses.replace(black[0], workers=2)]  # changes no result, and so not the file that was published
    assert train_against(busy, lambda *args: None) == [first, second] and told.read_bytes() == before
    assert [path.with_suffix(".safetensors").read_bytes() for path in (first, second)] == held


def test_policies_play_where_the_attacker_sees_and_may_do_as_much() -> None:
    """Networks of another shape are trained on apart, and asked for apart; another car with the same radio is not."""
    plan = {"config": "network", "dose": 5, "learners": {"cem": ["steps=600"]}, "knowledge": ["black"], "seeds": 1}
    places = ("network-restless-v0", "network-restless-weak-v0")
    suite = Suite("own-v0", "", places, (5,), ("dkf",), ("none",), 3, adaptive=plan | {"scenarios": list(places)})
    first, second = configs_of(suite, "dkf", Path("runs"))
    assert (first.name, second.name) == (f"dkf-cem-black-{places[0]}", f"dkf-cem-black-{places[1]}")
    assert (first.scenario, second.scenario) == places
    assert fitting(suite, first) == places[:1] and fitting(suite, second) == places[1:]
    assert [(one.name, one.scenarios) for one in asked_of(suite)] == [(f"cem-black-{name}", (name,)) for name in places]
    assert fitting(SUITE, configs_of(SUITE, "kf", Path("runs"))[0]) == SUITE.scenarios
    assert asked_of(SUITE)[0].scenarios == SUITE.scenarios


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ({}, ["adaptive", "learners"]), (PLAN | {"learners": {"ppoo": []}}, ["ppoo", "ppo"]), (PLAN | {"learners": {}}, ["learners"]),
        (PLAN | {"knowledge": ["blck"]}, ["blck", "black"]), (PLAN | {"seed": 3}, ["seed", "seeds"]), (PLAN | {"dose": 0}, ["dose", "0"]),
        (PLAN | {"scenarios": ["nowhere-v0"]}, ["scenarios", "nowhere-v0"]),
    ],
)  # fmt: skip
def test_a_plan_that_makes_no_sense_is_one_clear_error(plan: dict[str, object], words: list[str]) -> None:
    """The field, the value and what was expected."""
    with pytest.raises(InputError) as error:
        plan_of(Suite("own-v0", adaptive=plan))
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("there", "typed", "words"),
    [
        ("gamma=1.0", "gama=1.0", "adaptive: config: unknown field: got 'gama'"), ("population", "popul", "adaptive: config.cem: unknown field: got 'popul'"),
        ("environment.action", "environment.act", "adaptive: config.environment: unknown field: got 'act'"),
        ("knowledge: [black]", "knowledge: [blck]", "adaptive.knowledge: got 'blck'"), ("  config: car-", "  confg: car-", "adaptive: unknown field: got 'confg'"),
        ("  - chi2_kf\n", "  - chi2_fk\n", "defence: got 'chi2_fk'"), ("  - fdi_ramp:", "  - fdi_rmp:", "attack: got 'fdi_rmp'"),
        (", stop-and-go-v0", ", stop-and-go-v1", "scenario: got 'stop-and-go-v1'"), ("held_out: [fdi_", "held_out: [fd_", "attack: got 'fd_bernoulli'"),
        ("sd=4", "sdd=4", "attack fdi_gaussian: unknown field: got 'sdd'"),
    ],
)  # fmt: skip
def test_a_typing_error_in_the_file_of_a_suite_is_told_when_it_is_read(there: str, typed: str, words: str, tmp_path: Path) -> None:
    """With the file, and the field in it; what is right loads."""
    text, path = Path(config_path("suites", "quick-v0", "suite")).read_text(), tmp_path / "mine.yaml"
    path.write_text(text)
    assert dataclasses.replace(load_suite(str(path)), name="quick-v0") == load_suite("quick-v0")
    assert text.count(there) == 1
    path.write_text(text.replace(there, typed))
    with pytest.raises(InputError) as error:
        load_suite(str(path))
    assert str(error.value).startswith(f"suite {path}: {words}; expected ")


def test_a_file_of_a_suite_is_looked_through_without_torch() -> None:
    path = config_path("suites", "radar-v0", "suite")
    done = f"import sys; from tailgate.core.scenario import load_suite; load_suite({str(path)!r}); assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", done], check=False).returncode == 0


def test_a_defence_is_never_imported_for_training(tmp_path: Path) -> None:
    """Code is named on the command line only, and a configuration is written to disk."""
    with pytest.raises(InputError, match="registered name"):
        configs_of(SUITE, "somebody:Else", tmp_path)


def test_a_run_of_before_the_horizon_was_an_end_goes_on_as_it_was(tmp_path: Path) -> None:
    """Policies of one run are of one environment; a suite's plan asks for both alike."""
    config = training.load_config("gusty", [f"out={tmp_path}", "name=old"])
    earlier = {key: value for key, value in as_data(config).items() if key not in ("horizon_ends", "demonstrations")}
    config.directory.mkdir()
    write_json(config.directory / "config.json", earlier)
    assert not training.is_training(config, config.directory / "config.json")
    begun = as_begun(config, config.directory / "config.json")
    assert not begun.horizon_ends and training.is_training(begun, config.directory / "config.json")
    assert training.plan_key(earlier) == training.plan_key(as_data(config)) == training.plan_key(as_data(begun))
    assert not training.load_config("gusty", [f"out={tmp_path}", "name=old"], resume=True).horizon_ends
    training.same_run(begun)
    with pytest.raises(InputError, match="horizon_ends"):
        training.same_run(config)


def test_rivals_that_cannot_act_here_are_left_out() -> None:
    rows = [{"status": "ok", "attack_steps": 0, "refused_commands": 9, "reason": ""}, {"status": "ok", "attack_steps": 0, "refused_commands": 0, "reason": ""}]
    assert "each of its commands is refused" in left_out(rows)
    assert left_out([{**rows[0], "attack_steps": 1}]) == left_out(rows[1:]) == ""
    assert left_out([{"status": "skipped", "reason": "no radar"}]) == "no radar"


def test_a_run_of_something_else_decides_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is set aside, and what is trained in its place has the horizon that was asked for."""
    config = training.load_config("gusty", [f"out={tmp_path}", "name=old"])
    config.directory.mkdir()
    write_json(config.directory / "config.json", {"steps": 1, "scenario": "other"})
    asked: list[Any] = []
    monkeypatch.setattr("tailgate.training.train.train_together", lambda runs, *_: asked.extend(runs))
    train_against([config], lambda *_: None)
    assert asked == [(config, False)] and config.horizon_ends
