"""A new component is one file in the folder of its kind; nothing else is edited. A plant adds a scenario file."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = {
    "estimators/filters/sceptic.py": '''
"""A defence."""

from dataclasses import dataclass

from tailgate.core import param
from tailgate.core.registry import register
from tailgate.estimators import ChiSquare, Composed, GateOut
from tailgate.estimators.filters.kalman import KalmanFilter


@register("defence", "sceptic", reference="A. Newcomer 2027")
@dataclass(frozen=True)
class Sceptic(Composed):
    """Believes no reading that is far off."""

    eta: float = param(12.0, "threshold [-]")

    def parts(self):
        return KalmanFilter(), ChiSquare(eta=self.eta), GateOut()
''',
    "agents/scripts/shove.py": '''
"""An attack."""

from dataclasses import dataclass

import numpy as np

from tailgate.core import Kind, param
from tailgate.core.registry import register


@register("attack", "shove")
@dataclass(frozen=True)
class Shove:
    """Adds the same value in every other step."""

    value: float = param(-2.0, "value [unit of the wire]")

    def prepare(self, brief):
        return brief

    def start(self, plan, batch, draws):
        return None

    def decide(self, plan, state, view, draws):
        return state, plan.command(view.k % 2 == 0, Kind.FDI, plan.granted, np.array(self.value))
''',
    "envs/gym/discomfort.py": '''
"""A reward."""

import numpy as np

from tailgate.core.registry import register
from tailgate.envs.gym.rewards import Payment


@register("reward", "discomfort")
class Discomfort(Payment):
    """Pays for hard braking."""

    def terms(self, step, scale):
        return (np.maximum(-step.frame.scene.accel[:, 0] - 1.0, 0.0),)
''',
    "agents/learners/guess.py": '''
"""Guessing: the best of a few random policies."""

from dataclasses import dataclass

from tailgate.agents.learners import cem
from tailgate.core.registry import register


@dataclass(frozen=True)
class Config(cem.Config):
    """Hyper-parameters of guessing."""

    sd: float = 2.0


@register("learner", "guess")
class Learner(cem.Learner):
    """One training run of one seed."""
''',
    "envs/plants/drift.py": '''
"""A plant."""

from dataclasses import dataclass

from tailgate.core import param
from tailgate.core.registry import register
from tailgate.envs.plants.scalar import ScalarLoop


@register("plant", "drift")
@dataclass(frozen=True)
class Drift(ScalarLoop):
    """A random walk that grows."""

    a: float = param(1.01, "factor of a step [-]")
''',
    "configs/scenarios/drift-v0.yaml": '''
about: A random walk that grows.
plant: {name: drift}
sensor: {name: exact_reading}
controller: {name: state_feedback}
manoeuvre: {name: constant, value: 0.0}
horizon: 30
threat_model: {kinds: [fdi], budget: 12, sees_measurement: true}
''',
}
METRIC = '''

@metric("m/s^2")
def hardest_braking(trace: Trace) -> Array:
    """The hardest braking of the first agent."""
    return np.max(np.where(trace.live, -trace.signals["accel"][:, :, 0], 0.0), axis=0)
'''


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """Return a runner of commands in a copy of the package that has a few more files."""
    home = tmp_path_factory.mktemp("house")
    copy = home / "tailgate"
    shutil.copytree(ROOT / "src/tailgate", copy, ignore=shutil.ignore_patterns("__pycache__"))  # links become folders
    for name, text in FILES.items():
        assert not (copy / name).exists()
        (copy / name).write_text(text.lstrip("\n"), encoding="utf-8")
    with (copy / "play/metrics.py").open("a", encoding="utf-8") as file:
        file.write(METRIC)
    environment = os.environ | {"PYTHONPATH": str(home)}

    def call(*words):
        done = subprocess.run([sys.executable, *words], cwd=home, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    assert str(copy) in call("-c", "import tailgate; print(tailgate.__file__)")
    return call


def test_a_defence_an_attack_and_a_metric(extended, tmp_path):
    extended("-m", "tailgate", "evaluate", "--scenario", "gusty-stop-and-go-v0", "--defence", "sceptic:eta=9", "--attack", "shove", "--seeds", "2",
             "--out", str(tmp_path / "rows.jsonl"))  # fmt: skip
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert len(rows) == 2 and all(row["status"] == "ok" and row["attack_steps"] > 100 and row["hardest_braking"] > 0.5 for row in rows)
    assert "A. Newcomer 2027" in extended("-m", "tailgate", "list", "defences", "--json")


def test_a_plant(extended, tmp_path):
    extended("-m", "tailgate", "evaluate", "--scenario", "drift-v0", "--defence", "kf", "--attack", "shove", "--seeds", "2", "--out", str(tmp_path / "rows.jsonl"))
    assert all(json.loads(line)["status"] == "ok" for line in (tmp_path / "rows.jsonl").read_text().splitlines())


@pytest.mark.long
def test_a_learner_and_a_reward(extended, tmp_path):
    small = ["learner=guess", "guess.population=8", "guess.episodes=2", "guess.hidden=[]", "environment.reward=discomfort", "steps=3000", "rivals=[]"]
    extended("-m", "tailgate", "train", *small, "episodes=4", "select_episodes=4", "others=[]", "white_box=[]", "tensorboard=false", "workers=1", f"out={tmp_path}")
    (policy,) = tmp_path.glob("*/policy-0.json")
    training = json.loads(policy.read_text())["training"]
    assert training["learner"] == "guess" and training["config"]["settings"]["guess"]["population"] == 8
    assert training["config"]["environment"]["reward"] == "discomfort" and training["made_with"]["numpy"]
    said = "import tailgate.envs.gym.rewards as r, sys; r.Reward('nothing')"
    with pytest.raises(AssertionError, match="reward: got 'nothing'; expected"):
        extended("-c", said)
