"""A policy trained again has the same weights; what cannot be trained again is said, and nothing that a file names is imported."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tailgate import cli
from tailgate.agents.learners.learning import made_with
from tailgate.studies.collect import add_policy
from tailgate.studies.retrain import retrain
from tailgate.training import train

SETTINGS = ["scenario=gusty-stop-and-go-v0", "defence=kf", "seeds=2", "workers=1", "tensorboard=false", "environment.interval=5"]
SMALL = {
    "ppo": ["learner=ppo", "teacher=best", "select_episodes=8", "steps=1280", "rivals=['dos_jam:trigger=near,threshold=40']",
            "ppo={envs: 16, rollout: 40, batch_size: 160, epochs: 2, hidden: [16]}"],
    "cem": ["learner=cem", "teacher=null", "steps=20000", "cem={population: 8, episodes: 4, hidden: []}"],
}  # fmt: skip


@pytest.fixture(scope="module", params=["cem", pytest.param("ppo", marks=pytest.mark.long)])
def policies(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    out = tmp_path_factory.mktemp("runs")
    config = train.load_config(None, [*SETTINGS, *SMALL[request.param], f"out={out}", f"name={request.param}"])
    return train.train(config, lambda seed, now: None)


def test_the_weights_come_out_again(policies: list[Path]) -> None:
    """Also of the second seed alone, and where the teacher was chosen among the rivals."""
    found = [retrain(str(path)) for path in policies]
    for again in found:
        assert again.verdict == "same" and again.sha256 == again.here != "" and again.steps > 0, again
    assert len({again.here for again in found}) == 2


@pytest.mark.long
def test_a_policy_of_the_zoo_is_its_source(policies: list[Path], tmp_path: Path) -> None:
    """Its weights are packed, PPO's into half the bytes; a record that claims another source changes nothing."""
    path = add_policy(policies[0], "packed", "a copy", episodes=2, folder=tmp_path)
    assert retrain(str(path)).verdict == "same"
    assert retrain(str(_changed(path, tmp_path / "other", source_sha256="x"))).verdict == "same"
    other = add_policy(policies[1], "other", "a copy", episodes=2, folder=tmp_path)
    source = json.loads(path.read_text())["training"]
    again = retrain(str(_changed(other, tmp_path / "other", seed=source["seed"], source_sha256=source["source_sha256"])))
    assert again.verdict == "differs" and again.here == retrain(str(path)).here


@pytest.mark.long
def test_what_was_trained_with_is_recorded_and_told(policies: list[Path], tmp_path: Path) -> None:
    training = json.loads(policies[0].read_text())["training"]
    held, torch = training["made_with"], training["learner"] == "ppo"
    assert held == made_with(training["learner"]) and held["numpy"] and ("torch" in held) == ("torch CPU capability" in held) == torch
    for made, words in (
        (held, "the same versions"),
        (held | {"numpy": "1.0"}, f"numpy 1.0 there, {held['numpy']} here"),
        ({}, "machine none there"),
        (None, "not recorded"),
    ):
        assert words in retrain(str(_changed(policies[0], tmp_path, seed=7, made_with=made))).why


def _changed(path: Path, folder: Path, **training: Any) -> Path:
    """A copy of a policy whose record says something else."""
    folder.mkdir(exist_ok=True)
    copy = folder / path.name
    shutil.copy(path.with_suffix(".safetensors"), folder)
    data = json.loads(path.read_text())
    copy.write_text(json.dumps(data | {"training": data["training"] | training}))
    return copy


@pytest.mark.long
def test_weights_of_another_training_are_found(policies: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = _changed(policies[0], tmp_path, seed=7)
    again = retrain(str(other))
    assert again.verdict == "differs" and again.here[:12] in again.why
    assert cli.main(["leaderboard", "retrain", str(policies[0]), str(other), "--json"]) == 1
    assert [p["verdict"] for p in json.loads(capsys.readouterr().out)["policies"]] == ["same", "differs"]
    assert cli.main(["leaderboard", "retrain", str(policies[0])]) == 0
    assert "1 of 1 policies have the same weights" in " ".join(capsys.readouterr().out.split())


def test_a_policy_that_decides_otherwise_is_another_one(policies: list[Path], tmp_path: Path) -> None:
    """The weights alone do not say what an output does."""
    data = json.loads(policies[0].read_text())
    for name, value in (("action", data["action"] | {"value": -9.0}), ("squashed", True), ("knowledge", "grey")):
        copy = _changed(policies[0], tmp_path)
        copy.write_text(json.dumps(data | {name: value}))
        again = retrain(str(copy))
        assert again.verdict == "differs" and name in again.why and again.here == again.sha256


def test_what_cannot_be_trained_again_is_said(policies: list[Path], tmp_path: Path) -> None:
    config = json.loads(policies[0].read_text())["training"]["config"]
    for changes, words in (
        ({"config": None}, "configuration"),
        ({"seed": "x"}, "seed"),
        ({"config": config | {"defence": "this:That"}}, "registered defence"),
        ({"config": config | {"rivals": ["this:That"]}}, "registered attack"),
        ({"config": config | {"scenario": "/tmp/mine.yaml"}}, "scenario"),
        ({"config": config | {"steps": -1}}, "steps"),
        ({"config": config | {"nonsense": 1}}, "nonsense"),
        ({"config": config | {"learner": "oracle"}}, "learner"),
        ({"defence_version": 99}, "version 99"),
        ({"defence_digest": "x"}, "digest x"),
    ):
        again = retrain(str(_changed(policies[0], tmp_path, **changes)))
        assert again.verdict == "unchecked" and words in again.why, (changes, again)
    assert "this" not in [name for name in sys.modules if name == "this"]
    assert retrain(str(tmp_path / "none.json")).verdict == "unchecked"
    assert cli.main(["leaderboard", "retrain", str(tmp_path / "none.json")]) == 1
