"""Scenarios whose vehicle is not the one that everyone is told."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import list_scenarios, load_scenario
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout

ROAD = "gusty-stop-and-go-v0"


def played(scenario, defence="kf", episodes=20):
    """A clean trace of a scenario, cut to 20 s."""
    import dataclasses

    scenario = dataclasses.replace(scenario, horizon=min(scenario.horizon, 200))
    loop = scenario.loop(Spec("defence", defence).make())
    return loop, rollout(loop, Spec("attack", "none").make(), draws.keys("tune", range(episodes)))


def changed(tmp_path: Path, truth: object, base: str = ROAD) -> str:
    """A scenario file with this truth."""
    from tailgate.core.scenario import config_path

    data = yaml.safe_load(config_path("scenarios", base, "scenario").read_text()) | {"truth": truth}
    path = tmp_path / "changed.yaml"
    path.write_text(yaml.safe_dump(data))
    return str(path)


def test_no_truth_of_its_own_changes_nothing() -> None:
    """A scenario without `truth` has the hash and the trace of one that never heard of it."""
    plain = load_scenario(ROAD)
    assert not plain.truth and plain.config_hash == "dd5cf715942b2e28"
    loop, _ = played(plain, episodes=1)
    assert loop.told is None and loop.load == 1.0


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in list_scenarios() if load_scenario(n).truth])
def test_everyone_is_told_the_nominal_model(name: str) -> None:
    """Defence, attacker and channel go by the model of the scenario without `truth`; the vehicle does not, and drives with no collision."""
    import dataclasses

    scenario = load_scenario(name)
    nominal = dataclasses.replace(scenario, truth={})
    (loop, own), (plain, told) = played(scenario), played(nominal)
    for part in ("A", "B", "C", "Q", "R"):
        assert np.array_equal(getattr(loop.model, part), getattr(plain.model, part))
        assert np.array_equal(getattr(loop.brief.model, part), getattr(scenario.brief().model, part))
    assert scenario.config_hash != nominal.config_hash
    assert not np.array_equal(own.truth, told.truth)
    assert not measure(own)["crashed"].any()


def test_a_loaded_car_brakes_less_than_it_is_told_to() -> None:
    """With 1.25 times the mass the acceleration settles at 0.8 of a constant command."""
    import dataclasses

    from tailgate.core.loop import Loop
    from tailgate.envs.controllers.adaptive_cruise import AdaptiveCruise

    class Steady(AdaptiveCruise):
        def step(self, plan, state, estimate, v2v, odometry):
            state, u = super().step(plan, state, estimate, v2v, odometry)
            return state, np.full_like(u, 1.0)

    place = load_scenario(ROAD)
    plant = dataclasses.replace(place.plant, process_var=(0.0, 0.0, 0.0))
    guard = Spec("defence", "none").make()
    for load, settles in ((1.0, 1.0), (1.25, 0.8)):
        loop = Loop(plant, place.sensor, Steady(), place.manoeuvre, place.threat_model, 150, guard, told=plant.model(place.sensor, Steady()), load=load)
        trace = rollout(loop, Spec("attack", "none").make(), draws.keys("tune", [0]), terminate=False)
        assert trace.signals["accel"][-1, 0, 0] == pytest.approx(settles, abs=1e-5)


def test_worn_sensors_show_in_the_readings_alone() -> None:
    """Twice the variance of the noise is in what is read, and R stays as it was told."""
    loop, trace = played(load_scenario("car-following-noisy-v0"), episodes=200)
    noise = trace.signals["clean"][:, :, 0, :2] - trace.truth[:, :, 0, :2]
    assert noise.std() == pytest.approx(1.5, rel=0.02)
    assert np.array_equal(loop.model.R[0], np.eye(2))


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        ({"mass": 2}, ["truth", "mass", "load"]), ({"load": 0}, ["truth.load", "0"]), ({"load": True}, ["truth.load"]),
        ({"load": "heavy"}, ["truth.load", "heavy"]), ({"plant": {"weight": 1}}, ["truth.plant", "weight"]), ({"plant": [1]}, ["truth.plant"]),
        ({"sensor": {"noise_var": [-1, 1]}}, ["noise_var"]), ("heavy", ["truth"]),
    ],
)  # fmt: skip
def test_bad_truth_is_one_clear_error(tmp_path: Path, truth: object, words: list[str]) -> None:
    """The field, the value and what was expected."""
    with pytest.raises(InputError) as error:
        load_scenario(changed(tmp_path, truth)).loop(Spec("defence", "kf").make())
    assert all(word in str(error.value) for word in words), str(error.value)


def test_a_truth_of_another_size_is_refused(tmp_path: Path) -> None:
    """Six cars are not four."""
    name = changed(tmp_path, {"plant": {"followers": 6}}, "platoon-gusty-v0")
    with pytest.raises(InputError, match="number of agents"):
        load_scenario(name).loop(Spec("defence", "dkf").make())
