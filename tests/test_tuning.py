"""The search for hyper-parameters: a journal that can be gone on with, a declared space, and a configuration that trains."""

import dataclasses
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("optuna")

from tailgate import cli
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout
from tailgate.training import tuning
from tailgate.training.train import load_config

SPACE: tuning.Space = {
    "cem.sd": {"log": [0.3, 2.0]}, "cem.elite": {"range": [0.2, 0.5]}, "cem.episodes": {"range": [2, 4]},
    "cem.hidden": {"choices": [[], [4]]}, "gamma": {"choices": [0.9, 1.0]},
}  # fmt: skip


def _search(directory: Path, trials: int, name: str = "small", **changes: Any) -> tuning.Search:
    """Trials of one tiny generation each, on a network of ten sensors: no road, short episodes."""
    overrides = [
        f"out={directory}", f"name={name}", "cem.population=4", "steps=600", "outcome=rmse_position", "scenario=thesis-ch5-v0",
        "defence=dkf", "threat={kinds: [fdi], fdi_bound: 5.0}", "environment={action: mode, value: 5.0, reward: error, error_scale: 30.0, interval: 10}",
    ]  # fmt: skip
    search = tuning.make_search("gusty", overrides, trials, learner="cem", episodes=3)
    return dataclasses.replace(search, **({"space": SPACE} | changes))


def _told(report: dict[str, Any]) -> list[tuple[Any, ...]]:
    return [(e["ordinal"], e["value"], json.dumps(e["parameters"], sort_keys=True)) for e in report["trials"]]


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuning.Search, dict[str, Any]]:
    """An uninterrupted search of four trials."""
    search = _search(tmp_path_factory.mktemp("straight"), 4)
    return search, tuning.tune(search)


@pytest.mark.long
def test_an_interrupted_search_goes_on_as_if_it_had_not_been(tmp_path: Path, straight: tuple[tuning.Search, dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut off in the third trial's training: the same values and outcomes in the end, and the trial that was cut off is marked as failed."""
    search, count = _search(tmp_path, 4), 0
    train = tuning.train

    def interrupted(config: Any, progress: Any) -> Any:
        nonlocal count
        count += 1
        if count == 3:
            raise KeyboardInterrupt
        return train(config, progress)

    monkeypatch.setattr(tuning, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tuning.tune(search)
    report = tuning.tune(search)
    assert _told(report) == _told(straight[1])
    assert count == 5  # two, the one that was cut off, and two
    states = [trial.state.name for trial in tuning._open(search).get_trials()]
    assert states == ["COMPLETE", "COMPLETE", "FAIL", "COMPLETE", "COMPLETE"]


@pytest.mark.long
def test_a_finished_search_trains_nothing_and_more_trials_add_to_it(straight: tuple[tuning.Search, dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    search, report = straight
    monkeypatch.setattr(tuning, "train", lambda *_: pytest.fail("trained again"))
    assert tuning.tune(search) == report
    with pytest.raises(pytest.fail.Exception, match="trained again"):
        tuning.tune(dataclasses.replace(search, trials=5))


@pytest.mark.long
def test_a_search_of_another_configuration_is_refused(straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    """Its trials would be compared with others' outcomes."""
    search, _ = straight
    for other in (dataclasses.replace(search, episodes=4), dataclasses.replace(search, seed=1), dataclasses.replace(search, space={"gamma": SPACE["gamma"]})):
        with pytest.raises(InputError, match="another name"):
            tuning.tune(other)


def test_values_lie_in_the_space_and_differ(straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    """Ranges of whole numbers give whole numbers, choices come back as they were written."""
    values = [entry["parameters"] for entry in straight[1]["trials"]]
    assert len({json.dumps(v) for v in values}) == 4
    for v in values:
        assert 0.3 <= v["cem.sd"] <= 2.0 and 0.2 <= v["cem.elite"] <= 0.5 and v["cem.hidden"] in ([], [4]) and v["gamma"] in (0.9, 1.0)
        assert isinstance(v["cem.episodes"], int) and 2 <= v["cem.episodes"] <= 4


def test_the_objective_is_the_outcome_on_tune_seeds(straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    """Played by hand, every trial's policy has its value; the best is the largest, and report seeds would give another."""
    search, report = straight
    spec, place = Spec("defence", "dkf"), load_scenario("thesis-ch5-v0").with_threat(**search.base.threat)
    loop = place.loop(spec.make(), spec.entry.uses)
    for entry in report["trials"][:2]:
        attack = PolicyAttack(Path(entry["policy"]))
        value, other = (METRICS["rmse_position"](rollout(loop, attack, draws.keys(purpose, range(3)))).mean() for purpose in ("tune", "report"))
        assert entry["value"] == value != other
    assert report["best"]["value"] == max(entry["value"] for entry in report["trials"])


def test_trials_train_on_another_seed_than_what_is_reported(straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    assert straight[0].trained.first_seed == straight[0].base.first_seed + 100


def test_the_best_configuration_trains(straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    """best.yaml is a configuration with the best trial's values in it, and everything else of the preset."""
    search, report = straight
    config = load_config(report["config"], [])
    best = report["best"]["parameters"]
    assert config.gamma == best["gamma"] and config.cem == {"population": 4} | {key.removeprefix("cem."): v for key, v in best.items() if key != "gamma"}
    assert (config.scenario, config.learner, config.steps, config.name) == ("thesis-ch5-v0", "cem", 600, "small-tuned")
    assert json.loads((search.directory / "trials.json").read_text()) == report


def test_the_journal_holds_json_lines_and_nothing_that_runs(straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    lines = (straight[0].directory / "journal.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) > 20 and all(isinstance(json.loads(line), dict) for line in lines)
    assert sorted(p.suffix for p in straight[0].directory.iterdir() if p.is_file()) == [".json", ".jsonl", ".yaml"]


@pytest.mark.long
def test_values_that_a_learner_refuses_cost_their_trial_only(tmp_path: Path) -> None:
    """A population of one has no elite: those trials say so, are not played again, and the others count."""
    search = _search(tmp_path, 5, space={"cem.population": {"choices": [1, 4]}})
    report = tuning.tune(search)
    failed = [entry for entry in report["trials"] if entry["state"] == "fail"]
    assert 0 < len(failed) < 5 and all("population" in entry["reason"] and entry["parameters"]["cem.population"] == 1 for entry in failed)
    assert report["best"]["parameters"] == {"cem.population": 4}
    assert tuning.tune(search) == report


@pytest.mark.long
def test_a_policy_that_diverges_costs_its_trial_only(tmp_path: Path) -> None:
    """A step size under which continuous actions are no longer numbers: said, not played again, and the search goes on."""
    pytest.importorskip("stable_baselines3")
    overrides = [
        f"out={tmp_path}", "name=wild", "steps=1200", "outcome=rmse_position", "scenario=thesis-ch5-v0", "defence=dkf", "threat={kinds: [fdi], fdi_bound: 5.0}",
        "environment={action: continuous, reward: error, error_scale: 30.0, interval: 10}", "ppo={envs: 16, rollout: 16, batch_size: 64, epochs: 2, hidden: [4]}",
    ]  # fmt: skip
    search = dataclasses.replace(tuning.make_search("gusty", overrides, 4, episodes=3), space={"ppo.learning_rate": {"choices": [1e30, 1e-3]}})
    report = tuning.tune(search)
    failed = [entry for entry in report["trials"] if entry["state"] == "fail"]
    assert 0 < len(failed) < 4 and all("ppo.learning_rate" in e["reason"] and e["parameters"]["ppo.learning_rate"] == 1e30 for e in failed)
    assert report["best"]["parameters"] == {"ppo.learning_rate": 1e-3}
    assert tuning.tune(search) == report


@pytest.mark.parametrize("preset", ["car-following", "gusty"])
def test_what_was_tuned_is_what_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str) -> None:
    """A teacher that is the best of the rivals has them in each trial; best.yaml is the preset with the values found, to the last field."""
    seen: list[Any] = []
    monkeypatch.setattr(tuning, "train", lambda config, progress: seen.append(config) or [tmp_path / "none.json"])
    monkeypatch.setattr(tuning, "objective", lambda config, policy, episodes: config.gamma)
    overrides = [f"out={tmp_path}", "seeds=3", "white_box=[stealth]"]
    search = dataclasses.replace(tuning.make_search(preset, overrides, 3), space={"gamma": {"choices": [0.9, 0.95]}})
    report = tuning.tune(search)
    whole = load_config(preset, overrides)
    assert whole.rivals and (preset != "car-following" or whole.teacher == "best")
    for config in seen:
        assert (config.teacher, config.rivals) == (whole.teacher, whole.rivals if whole.teacher else ()) and (config.seeds, config.white_box) == (1, ())
    found = report["best"]["parameters"]["gamma"]
    assert load_config(report["config"], []) == dataclasses.replace(whole, name=f"{whole.name}-tuned", gamma=found)
    fewer = dataclasses.replace(search, base=dataclasses.replace(search.base, rivals=whole.rivals[:1]))
    assert (fewer.digest != search.digest) == (whole.teacher is not None)


@pytest.mark.long
def test_trials_side_by_side(tmp_path: Path) -> None:
    """Two processes, one journal: every trial once."""
    report = tuning.tune(_search(tmp_path, 3), workers=2)
    assert [entry["ordinal"] for entry in report["trials"]] == [0, 1, 2] and {e["state"] for e in report["trials"]} == {"complete"}
    assert all(np.isfinite(entry["value"]) for entry in report["trials"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("cem.sdd: {log: [1, 2]}", "cem.sd"), ("scenario: {choices: [a]}", "space.scenario"), ("cem.sd: {between: [1, 2]}", "range"),
        ("cem.sd: {log: [0, 2]}", "above 0"), ("cem.sd: {range: [2, 1]}", "low < high"), ("cem.sd: 3", "range"), ("{}", "at least one"),
        ("ppo.clip: {range: [0.1, 0.2]}", "ppo.clip"), ("environment.speed: {choices: [1]}", "environment"),
    ],
)  # fmt: skip
def test_a_bad_space_is_one_clear_error(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "space.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        tuning.read_space(str(path), "cem")


@pytest.mark.parametrize("learner", sorted(tuning.SPACES))
def test_the_built_in_spaces_are_valid(tmp_path: Path, learner: str) -> None:
    """Every field exists, and every end of it makes a configuration that the learner accepts."""
    if learner == "ppo":
        pytest.importorskip("stable_baselines3")
    from tailgate.agents.learners.learning import learner_of
    from tailgate.core.schema import build

    path = tmp_path / "space.yaml"
    path.write_text(yaml.safe_dump(tuning.SPACES[learner]))
    space = tuning.read_space(str(path), learner)
    for end in (0, -1):
        values = {field: next(iter(form.values()))[end] for field, form in space.items()}
        config = tuning.configured(load_config("quickstart", []), values)
        build(learner_of(learner).Config, dict(getattr(config, learner)), learner).check()


def test_the_command_prints_what_it_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "space.yaml").write_text("cem.sd: {log: [0.3, 2.0]}")
    base = tuning.as_data(_search(tmp_path, 1).base)
    config = {key: value for key, value in base.items() if key in ("scenario", "defence", "threat", "environment", "steps", "outcome", "cem", "learner")}
    (tmp_path / "preset.yaml").write_text(yaml.safe_dump(config | {"name": "said", "out": str(tmp_path)}))
    words = ["tune", "--config", str(tmp_path / "preset.yaml"), "--trials", "2", "--episodes", "2", "--space", str(tmp_path / "space.yaml")]
    assert cli.main(words) == 0
    assert "best" in capsys.readouterr().out
    assert cli.main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "said-tune" / "trials.json").read_text())
    assert cli.main([*words, "--trials", "0"]) == 2
    assert cli.main([*words, "--seed", "-1"]) == 2


def test_any_seed_of_a_search_will_do(tmp_path: Path) -> None:
    """Those above what numpy takes too."""
    search = dataclasses.replace(_search(tmp_path, 1), seed=10**9)
    search.directory.mkdir(parents=True)
    assert tuning._open(search, 0).study_name


def test_what_a_killed_search_left_of_its_journal_stops_nobody(tmp_path: Path, straight: tuple[tuning.Search, dict[str, Any]]) -> None:
    """Half a line at the end, and the lock that Optuna itself would wait 30 s for."""
    search = _search(tmp_path, 1)
    tuning.tune(search)
    journal = search.directory / "journal.jsonl"
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 4, "worker')
    os.symlink(journal, f"{journal}.lock")
    started = time.monotonic()
    assert _told(tuning.tune(search)) == _told(straight[1])[:1]
    assert time.monotonic() - started < 20.0 and journal.read_bytes().startswith(whole)
    assert all(json.loads(line) for line in journal.read_bytes().splitlines())
