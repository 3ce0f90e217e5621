"""Seven sensors of one car, what a defence adds to a command, and what the suite grants."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.envs.plants.radar_following import RadarFollowing
from tailgate.envs.sensors.redundant import DEVICES, Redundant
from tailgate.play.trace import rollout


@pytest.mark.long
def test_each_device_has_its_own_noise():
    """Readings less the truth have the standard deviations of the devices, and are independent."""
    trace = rollout(load_scenario("redundant-two-v0").loop(tailgate.make_defence("kf")), tailgate.make_attack("none"), keys("train", range(64)))
    model, sensor = trace.model, Redundant()
    noise = (trace.clean[..., 0, :7] - np.einsum("qn,kbn->kbq", model.C[0], trace.truth[:, :, 0])).reshape(-1, 7)
    sd = [getattr(sensor, name) for name in DEVICES]
    np.testing.assert_allclose(noise.std(axis=0), sd, rtol=0.02)
    np.testing.assert_allclose(np.corrcoef(noise.T), np.eye(7), atol=0.03)
    assert model.sensors == DEVICES and set(np.flatnonzero(model.C[0, :, 1]).tolist()) == {DEVICES.index("wheels")}


def test_another_plant_is_refused():
    with pytest.raises(InputError, match="car-following plant"):
        Redundant().matrices(RadarFollowing())


def test_the_raw_car_believes_its_lidar():
    place = load_scenario("redundant-one-v0")
    trace = rollout(place.loop(tailgate.make_defence("none")), tailgate.make_attack("none"), keys("train", range(4)))
    np.testing.assert_array_equal(trace.estimate[:, :, 0, 0], trace.clean[:, :, 0, DEVICES.index("lidar")])


@pytest.mark.parametrize("number, name", [(1, "one"), (2, "two"), (3, "three")])
def test_the_scenarios_differ_in_what_an_attacker_reaches(number, name):
    """The most accurate ones, whatever the suite changes."""
    place, suite = load_scenario(f"redundant-{name}-v0"), load_suite("redundant-v0")
    assert place.threat_model.targets == ("lidar", "radar_long", "radar_short")[:number] and place.name in suite.scenarios
    one = load_scenario("redundant-one-v0")
    assert dataclasses.replace(place, name="", about="", threat_model=one.threat_model) == dataclasses.replace(one, name="", about="")
    trace = rollout(place.loop(tailgate.make_defence("kf")), Spec("attack", "fdi:start_step=100,value=5").make(), keys("train", range(2)))
    changed = (trace.wires != trace.clean).any(axis=(0, 1, 2))[:7]
    assert {DEVICES[i] for i in np.flatnonzero(changed)} == set(place.threat_model.targets)


@pytest.mark.parametrize("offset, said", [(np.zeros((4, 1, 2)), "shape"), (np.full((4, 1, 1), np.nan), "finite")])
def test_what_is_added_to_a_command_is_checked(offset, said):
    class Adds(type(tailgate.make_defence("kf"))):
        def step(self, plan, state, received, known_u, draws):
            state, estimate = super().step(plan, state, received, known_u, draws)
            return state, estimate._replace(offset=offset)

    place = load_scenario("redundant-one-v0")
    with pytest.raises(InputError, match=f"offset.*{said}"):
        rollout(dataclasses.replace(place, horizon=5).loop(Adds()), tailgate.make_attack("none"), keys("train", range(4)))


def test_limits_count_after_what_is_added():
    """A command that is pushed up by 10 stays at the largest that the defence allows."""

    class Pushed(type(tailgate.make_defence("kf"))):
        def step(self, plan, state, received, known_u, draws):
            state, estimate = super().step(plan, state, received, known_u, draws)
            limits = np.broadcast_to(np.array([-1.0, 0.5]), (len(known_u), 1, 1, 2))
            return state, estimate._replace(offset=np.full(known_u.shape, 10.0), limits=limits)

    place = dataclasses.replace(load_scenario("redundant-one-v0"), horizon=20)
    trace = rollout(place.loop(Pushed()), tailgate.make_attack("none"), keys("train", range(4)))
    assert (trace.control == 0.5).all()
