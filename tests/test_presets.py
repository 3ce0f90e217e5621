"""Presets of train.py and their outcomes."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from tailgate import cli
from tailgate.agents.learners.cem import Config as CemConfig
from tailgate.agents.learners.learning import LEARNERS
from tailgate.agents.learners.ppo import Config
from tailgate.base.errors import InputError
from tailgate.core.schema import as_data, build
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.evaluation.baselines import outcomes
from tailgate.training import train

PRESETS = sorted(path.stem for path in (Path(__file__).parents[1] / "configs").glob("*.yaml"))


@pytest.mark.thin(3)
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_played(name: str) -> None:
    """Scenario, defences, rivals, environment and learner of each fit together."""
    if name == "highway":
        pytest.importorskip("highway_env")
    config = train.load_config(name, [])
    train.check(config)
    build(Config, dict(config.ppo), "ppo").check()
    assert config.name == name and config.rivals


@pytest.mark.parametrize("name", [name for name in PRESETS if train.load_config(name, []).learner == "cem"])
def test_a_preset_of_the_cross_entropy_method_searches_for_twenty_generations(name: str) -> None:
    """Even where every episode is played to its horizon."""
    if name == "highway":
        pytest.importorskip("highway_env")
    config = train.load_config(name, [])
    seat, cem = Seat.make(**train.environment_of(config)), build(CemConfig, dict(config.cem), "cem")
    decisions = -(-seat.loop.horizon // seat.action.spec.interval)
    assert config.steps >= 20 * cem.population * cem.episodes * decisions


def test_a_preset_may_change_another(tmp_path: Path) -> None:
    """Field by field, each as a whole; a base has no base, and is one by name or file."""
    mine = tmp_path / "mine.yaml"
    mine.write_text("base: radar\nname: mine\nthreat: {budget: 3}\nenvironment: {action: mode}\n")
    changed, radar = train.load_config(str(mine), ["steps=7"]), train.load_config("radar", [])
    assert changed == dataclasses.replace(radar, name="mine", threat={"budget": 3}, environment={"action": "mode"}, steps=7)
    for base in ("radar-cem", "[1]", "none-such"):
        mine.write_text(f"base: {base}\n")
        with pytest.raises(InputError, match=r"config\.base"):
            train.load_config(str(mine), [])


def test_an_outcome_is_a_metric_that_every_episode_has(tmp_path: Path) -> None:
    """A wrong name lists the metrics; one that is undefined somewhere is refused when it is met."""
    with pytest.raises(InputError, match=r"config\.outcome.*'gap'.*min_gap"):
        train.load_config(None, ["outcome=gap"])
    assert train.outcome_of(train.load_config("network", [])) == "rmse_position"
    assert train.outcome_of(train.load_config("platoon", ["outcome=max_error"])) == "max_error"
    row = {"status": "ok", "attack": "fdi", "recovery_time": None}
    with pytest.raises(InputError, match="recovery_time"):
        outcomes([row], "recovery_time")


def test_the_help_of_train_shows_what_a_bare_train_uses(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """And the value of a preset that leaves the field out, where it is another."""
    monkeypatch.setenv("COLUMNS", "9999")
    with pytest.raises(SystemExit, match="0"):
        cli.main(["train", "--help"])
    shown = dict(re.findall(r"(?m)^  ([a-z_]+) +.*\(default: (.*)\)$", capsys.readouterr().out))
    used, blank = ({f.name: as_data(getattr(c, f.name)) for f in dataclasses.fields(c)} for c in (train.load_config(None, []), train.TrainConfig()))
    for name, text in shown.items():
        value, _, other = text.partition("; in a preset that leaves it out: ")
        assert value.endswith("...") or json.loads(value) == used[name]
        assert json.loads(other) == blank[name] != used[name] if other else used[name] == blank[name]
    below = {"threat", "environment", *LEARNERS}  # their keys are listed one by one
    assert shown.keys() == {f.name for f in dataclasses.fields(train.TrainConfig)} - below and shown["steps"].startswith("40000000; ")
