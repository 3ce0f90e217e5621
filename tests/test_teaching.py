"""Ids whose name ends in -v1: worth learning, and learned by the recipe of the documentation."""

import json
import sys
from pathlib import Path

import gymnasium
import pytest

from tailgate.envs.gym.attacker_mdp import FACES

pytest.importorskip("stable_baselines3")
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import teaching

IDS = [name for name in FACES if name.endswith("-v1")]
ROADS = [name for name in IDS if "Network" not in name]
ROOT = Path(__file__).parents[1]


@pytest.mark.thin(4)
@pytest.mark.parametrize("name", IDS)
def test_a_task_has_a_budget_and_no_shaping(name):
    env = gymnasium.make(name)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    card = env.unwrapped.card()
    assert card["scenario"]["threat_model"]["budget"] == FACES[name]["threat"]["budget"] and env.spec.max_episode_steps <= 30
    assert card["reward"]["gap_shaping"] == card["reward"]["error_shaping"] == 0.0
    assert ("Continuous" in name) == isinstance(env.action_space, gymnasium.spaces.Box)


@pytest.mark.thin(4)
@pytest.mark.parametrize("name", ROADS)
def test_random_actions_do_little(name):
    assert teaching.damage(name, lambda env, _: env.action_space.sample()) < 0.1


@pytest.mark.long
@pytest.mark.parametrize("name", IDS)
def test_plain_ppo_learns_an_attack(name):
    """It does three times what random actions do, and two thirds of what the best listed script does."""
    chance = teaching.damage(name, lambda env, _: env.action_space.sample())
    found, _ = teaching.learned(name, 0)
    assert found > (1.2 * chance if "Network" in name else max(0.25, 3.0 * chance)) and found > 0.66 * teaching.scripted(name)[0]


def test_the_page_has_the_figures_of_the_record():
    record = json.loads((ROOT / "benchmarks/results/teaching.json").read_text(encoding="utf-8"))
    text = (ROOT / "docs/environment.md").read_text(encoding="utf-8")
    assert list(record) == IDS
    for name, entry in record.items():
        assert teaching.line(name, entry) in text, name
