"""The cross-entropy method: it learns, it resumes to the bit, and what it exports plays as it did in training."""

import dataclasses
import json

import numpy as np
import pytest

from tailgate.agents.learners.cem import Config, Learner, Shape
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.scenario import config_path
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout

ROAD = {
    "scenario": "gusty-stop-and-go-v0", "defence": "kf", "threat": {"kinds": ["fdi"], "budget": 30, "fdi_bound": 6.0}, "value": -6.0, "interval": 30,
    "reward": "min_gap", "gap_shaping": 0.0, "error_shaping": 0.0,
}
SMALL = Config(population=8, episodes=4, hidden=(4,))
RACE = dataclasses.replace(SMALL, starts=3, trial=3)
ROUND = 8 * 4 * 10  # decisions of a generation of `brief` without a collision


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """The environment of ROAD with half of its time, in ten decisions, of which some collide."""
    path = tmp_path_factory.mktemp("scenario") / "brief.yaml"
    text = config_path("scenarios", ROAD["scenario"], "scenario").read_text().replace("horizon: 600", "horizon: 300")
    path.write_text(text.replace("end: 500", "end: 300").replace("onset: 50", "onset: 10"))
    return ROAD | {"scenario": str(path)}


def run(environment, steps, seed=0, config=SMALL, **options):
    learner = Learner(seed, 0.99, config, environment)
    learner.learn(steps, lambda progress: None, **options)
    return learner


def test_a_weight_vector_is_its_layers():
    """The parts of a vector are disjoint and cover it, one vector or many."""
    shape = Shape(((3, 2), (2, 5)))
    assert shape.length == 3 * 2 + 2 + 2 * 5 + 5
    theta = np.arange(4 * shape.length, dtype=float).reshape(4, -1)
    many, one = shape.layers(theta), shape.layers(theta[2])
    for (weight, bias), (w, b), (i, o) in zip(many, one, shape.sizes, strict=True):
        assert weight.shape == (4, i, o) and bias.shape == (4, o)
        np.testing.assert_array_equal(weight[2], w)
        np.testing.assert_array_equal(bias[2], b)
    assert sorted(np.concatenate([part.ravel() for layer in one for part in layer])) == sorted(theta[2])


def test_it_learns(brief):
    """In ten generations the mean's reward on fresh seeds doubles that of rest, and beats the first generation's by far."""
    config = Config(population=24, episodes=12, hidden=(8,), extra_until=8)
    learner = Learner(0, 0.99, config, brief)
    first, _ = learner._play(learner.mean[None])
    learner.generation = 0
    learner.learn(10 * 24 * 12 * 10, lambda progress: None)
    before, after = first[0], np.mean([entry["reward"] for entry in learner.curve[-3:]])
    assert after > before + 0.3
    assert [entry["steps"] for entry in learner.curve] == sorted({entry["steps"] for entry in learner.curve})


def test_the_elite_is_the_best():
    """One generation by hand: the mean moves to the mean of the members with the largest reward, member 0 being the mean."""
    learner = Learner(3, 0.99, SMALL, ROAD)
    mean, sd = learner.mean.copy(), learner.sd.copy()
    theta = mean + sd * np.random.default_rng([3, 0]).standard_normal((8, len(mean)))
    theta[0] = mean
    twin = Learner(3, 0.99, SMALL, ROAD)
    reward, _ = twin._play(theta)
    elite = theta[np.argsort(-reward, kind="stable")[:2]]
    learner.learn(1, lambda progress: None)
    np.testing.assert_allclose(learner.mean, mean + 0.7 * (elite.mean(axis=0) - mean))
    np.testing.assert_allclose(learner.sd, np.sqrt(elite.var(axis=0) + (0.1 * 199 / 200) ** 2))
    assert learner.steps == twin.steps and learner.generation == 1


@pytest.mark.parametrize("action", ["mode", "continuous"], ids=["discrete", "continuous"])
def test_what_is_exported_plays_as_in_training(brief, action, tmp_path):
    """The mean's reward and collisions in training are those of the exported policy on the same episodes."""
    learner = run(brief | {"action": action}, 3 * ROUND)
    first = learner.seed * 1_000_000 + learner.generation * SMALL.episodes
    reward, crashed = learner._play(learner.mean[None])
    attack = PolicyAttack(learner.export(tmp_path / "policy", {"learner": "cem"}))
    trace = rollout(learner.seat.loop, attack, draws.keys("train", range(first, first + SMALL.episodes)))
    assert measure(trace)["crashed"].mean() == crashed[0]
    fell = 20.0 - np.minimum(measure(trace)["min_gap"], 20.0).clip(0.0)
    assert reward[0] <= np.mean(fell / 20.0) + crashed[0] + 1e-9  # undiscounted, of which the discounted is no more
    assert json.loads((tmp_path / "policy.json").read_text())["training"]["learner"] == "cem"


def test_two_runs_of_a_seed_and_a_resumed_one_agree(brief, tmp_path):
    """Same seed, same policy file; interrupted and resumed, the same as well; another seed, another policy."""
    whole = run(brief, 4 * ROUND).export(tmp_path / "whole", {}).with_suffix(".safetensors").read_bytes()
    assert run(brief, 4 * ROUND).export(tmp_path / "again", {}).with_suffix(".safetensors").read_bytes() == whole
    run(brief, 2 * ROUND, checkpoint=tmp_path / "check")
    second = Learner(0, 0.99, SMALL, brief)
    second.load(tmp_path / "check")
    assert 2 * ROUND <= second.steps < 4 * ROUND and second.generation == len(second.curve) > 1
    second.learn(4 * ROUND, lambda progress: None)
    assert second.export(tmp_path / "resumed", {}).with_suffix(".safetensors").read_bytes() == whole
    assert run(brief, 4 * ROUND, seed=1).export(tmp_path / "other", {}).with_suffix(".safetensors").read_bytes() != whole


def test_of_several_starts_the_best_goes_on(brief):
    """After the trials the search is where its best start would have been by itself, and goes on as that one."""
    alone = [Learner(0, 0.99, SMALL, brief) for _ in range(3)]
    for start, learner in enumerate(alone):
        learner.start = start
        for _ in range(3):
            learner._generation()
    scores = [learner.curve[-1]["reward"] for learner in alone]
    assert len(set(scores)) > 1
    best = alone[int(np.argmax(scores))]
    race = run(brief, 1, config=RACE)
    assert [point["reward"] for point in race.curve] == [point["reward"] for learner in alone for point in learner.curve]
    np.testing.assert_array_equal(race.mean, best.mean)
    best._generation()
    race.learn(race.steps + 1, lambda progress: None)
    np.testing.assert_array_equal(race.mean, best.mean)
    np.testing.assert_array_equal(race.sd, best.sd)


@pytest.mark.thin(2)
@pytest.mark.parametrize("generations", [2, 3, 5, 9, 10])
def test_a_search_that_is_interrupted_between_its_starts(brief, generations, tmp_path):
    """Stopped within a trial, at its end or after the last: resumed, it comes to the same policy."""
    whole = run(brief, 10 * ROUND, config=RACE)
    assert len(whole.curve) > 10
    left = iter(range(generations))

    def stop(progress):
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Learner(0, 0.99, RACE, brief).learn(10 * ROUND, stop, tmp_path / "check")
    second = Learner(0, 0.99, RACE, brief)
    second.load(tmp_path / "check")
    assert len(second.curve) == generations
    second.learn(10 * ROUND, lambda progress: None)
    np.testing.assert_array_equal(second.mean, whole.mean)
    assert second.curve == whole.curve


def test_a_checkpoint_that_does_not_fit(brief, tmp_path):
    """Damaged, of another seed, of another environment, of other settings: refused, and nothing is changed."""
    run(brief, ROUND, checkpoint=tmp_path / "check")
    (tmp_path / "broken").write_bytes((tmp_path / "check").read_bytes()[:200])
    (tmp_path / "text").write_text("nothing")
    cases = [
        ("broken", {}), ("text", {}), ("missing", {}), ("check", {"seed": 1}), ("check", {"environment": brief | {"value": -5.0}}),
        ("check", {"config": Config(population=8, episodes=4, hidden=(5,))}),
    ]
    for name, changes in cases:
        given = {"seed": 0, "config": SMALL, "environment": brief} | changes
        learner = Learner(given["seed"], 0.99, given["config"], given["environment"])
        with pytest.raises(InputError, match="checkpoint"):
            learner.load(tmp_path / name)
        assert learner.generation == 0 and not learner.curve


def test_settings_that_do_not_fit():
    """A population of one has no elite."""
    with pytest.raises(InputError, match="population"):
        Config(population=1).check()
