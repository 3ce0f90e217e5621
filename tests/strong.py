"""What tests of strength share: short scenarios, and policies whose records say what a test wants."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tailgate.agents.policy.network_policy import save_policy
from tailgate.agents.policy.zoo import ZooAttack
from tailgate.core.neural import Network
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import ObservationCodec

PLACE = "gusty-stop-and-go-v0"
THREAT: dict[str, Any] = {"kinds": ["dos_jam", "fdi"], "budget": 20, "fdi_bound": 3.0}
ZOO = f"zoo:name={ZooAttack().name}"


def cut(directory: Path, horizon: int, **threat: Any) -> str:
    """The scenario cut to so many steps, as a file."""
    source = Path(__file__).parents[1] / "configs" / "scenarios" / f"{PLACE}.yaml"
    data = yaml.safe_load(source.read_text())
    data |= {"horizon": horizon, "threat_model": data["threat_model"] | {"end": None} | threat}
    path = directory / "brief.yaml"
    path.write_text(yaml.safe_dump(data))
    return str(path)


@pytest.fixture(scope="module")
def brief_place(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The scenario cut to 60 steps, attacked from step 10 on."""
    return cut(tmp_path_factory.mktemp("scenario"), 60, onset=10)


@pytest.fixture(scope="module")
def half_place(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The first 320 steps, within which the zoo's policy attacks and some of its episodes collide."""
    return cut(tmp_path_factory.mktemp("scenario"), 320)


def always(directory: Path, name: str, value: float = -3.0, seed: int = 0, **threat: Any) -> Path:
    """A policy that attacks whenever it may, from the first step on, with the record of a training."""
    changed = THREAT | threat
    brief = load_scenario(PLACE).with_threat(**changed).brief()
    names, spec = ObservationCodec(brief).names, ActionSpec(action="mode", value=value)
    size = ActionCodec(spec, brief).size
    bias = np.zeros(size)
    bias[-1] = 1.0
    config = {"scenario": PLACE, "defence": "chi2_kf", "threat": changed, "outcome": None}
    header = {
        "action": spec, "observation": names, "knowledge": "black", "agents": 1,
        "training": {"learner": "hand", "seed": seed, "config": config},
    }  # fmt: skip
    return save_policy(directory / name, Network((np.zeros((len(names), size)),), (bias,)), header)


def recorded(path: Path, **fields: Any) -> Path:
    """The policy with other fields in its training's configuration."""
    data = json.loads(path.read_text())
    data["training"]["config"] |= fields
    path.write_text(json.dumps(data))
    return path
