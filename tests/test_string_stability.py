"""String stability: the gains of the model, their supremum, and what the loop itself does, quiet and attacked."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core.draws import keys
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.envs.manoeuvres import Sine
from tailgate.envs.plants.platoon import Platoon, PlatoonSensors
from tailgate.thesis.string_stability import Peak, growth, peak, sweep, transfer

WEIGHTS = ((1.0, 1.0), (0.5, 0.5), (1.0, 0.0))


def cacc(**changes):
    return make("controller", "cacc", **changes)


@pytest.mark.thin(3)
@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("kp, kd", [(0.1, 0.5), (0.5, 1.0), (0.1, 4.0), (3.0, 0.5), (3.0, 4.0)])
def test_the_law_is_string_stable_at_a_headway_of_three_seconds(weights, kp, kd):
    """No car's gain exceeds 1 for kp >= 0.1 and kd >= 0.5, whatever the weights."""
    found = peak(Platoon(), cacc(kp=kp, kd=kd, weights=weights))
    assert found.stable and (found.gain == 1.0).all() and (found.frequency == 0.0).all()


def test_soft_gains_are_not_string_stable():
    """kp = 0.05, kd = 0.3 and the printed weights amplify by 1.18."""
    found = peak(Platoon(), cacc(kp=0.05, kd=0.3, weights=(1.0, 1.0)))
    assert not found.stable and found.gain.max() == pytest.approx(1.18, abs=0.005)
    assert 0.15 < found.frequency[np.argmax(found.gain)] < 0.4


@pytest.mark.parametrize("kp, stable", [(0.2, False), (0.25, True)])
def test_without_messages_the_headway_decides(kp, stable):
    """A string of cars without messages is string stable for kp >= 2 / tau_h^2, here 0.222."""
    assert peak(Platoon(), cacc(kp=kp, kd=1.0), local=True).stable == stable


def test_a_peak_is_the_supremum():
    """No gain on a fine grid exceeds it, and it is reached at its frequency."""
    plant, law = Platoon(followers=6), make("controller", "consensus_cacc", b=0.6, k=0.2)
    found, w = peak(plant, law), np.geomspace(1e-3, 1e2, 8001)
    grid = np.abs(transfer(plant, law, w))
    assert found.gain[-1] > 1.2  # these gains amplify
    assert (grid.max(axis=0) <= found.gain + 1e-9).all()
    for i in np.flatnonzero(found.frequency):
        assert np.abs(transfer(plant, law, found.frequency[i : i + 1]))[0, i] == pytest.approx(found.gain[i], rel=1e-12)


@pytest.mark.parametrize("name", ["cacc", "ploeg_cacc", "consensus_cacc"])
def test_slow_changes_are_followed_by_all(name):
    """The gain tends to 1 and its phase to 0 as the frequency does; and it dies out at high frequencies."""
    V = transfer(Platoon(), make("controller", name), np.array([1e-4, 1e3]))
    np.testing.assert_allclose(V[0], 1.0, atol=6e-3)
    assert (np.abs(V[1, 1:]) < 1e-2).all()


def test_growth_is_the_model_s():
    """exp(growth dt) is the largest eigenvalue of the sampled model, the leader's two aside, in either kind of topology."""
    for topology, law in (("predecessor_leader", cacc()), ("bidirectional", make("controller", "consensus_cacc", leader="estimated"))):
        plant = Platoon(topology=topology, followers=3)
        values = np.abs(np.linalg.eigvals(plant.model(PlatoonSensors(), law).A))
        assert np.sort(values)[-3] == pytest.approx(np.exp(growth(plant, law) * plant.dt), abs=1e-4)


def test_a_loop_that_is_not_stable_has_no_gain():
    """peak refuses it; a long string of nearly equal eigenvalues is not taken for one."""
    with pytest.raises(InputError, match="stable"):
        peak(Platoon(), make("controller", "ploeg_cacc", kp=1.0, kd=0.1))
    assert growth(Platoon(followers=60), cacc()) == pytest.approx(growth(Platoon(followers=1), cacc()), abs=1e-6)


def test_peak_stable_allows_for_rounding_only():
    """1 and a rounding error pass, a thousandth does not."""
    assert Peak(np.array([1.0, 1.0 + 1e-12]), np.zeros(2)).stable
    assert not Peak(np.array([1.0, 1.001]), np.zeros(2)).stable


def test_the_sine_keeps_the_mean_speed_and_its_amplitude():
    """Its value at step k is A cos(2 pi f k dt), also after many turns and for rows that began at different times."""
    wave = Sine(amplitude=0.7, frequency=0.13)
    plan, draws = wave.prepare(0.1), keys("train", range(2)).at(3, np.zeros(2, np.int64))
    state, values = wave.start(plan, draws), []
    for k in range(5000):
        state, accel = wave.accel(plan, state, np.full(2, k), np.zeros(2), draws)
        values.append(accel)
    want = 0.7 * np.cos(2.0 * np.pi * 0.13 * 0.1 * np.arange(5000))
    np.testing.assert_allclose(np.array(values), np.stack([want, want], axis=1), atol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("name", ["cacc", "ploeg_cacc"])
def test_the_linear_loop_measures_what_the_model_says(name):
    """Gains of a simulated sweep on the thesis's linear platoon agree with the transfer function."""
    place = load_scenario("thesis-ch6-v0")
    place = dataclasses.replace(place, plant=dataclasses.replace(place.plant, dt=0.1), controller=make("controller", name))
    found = sweep(place, [0.4, 1.5], settle=50.0, periods=2)
    want = np.abs(transfer(place.plant, place.controller, found.frequency))
    np.testing.assert_allclose(found.speed, want, rtol=1e-3, atol=2e-5)
    np.testing.assert_allclose(found.accel, want, rtol=2e-2, atol=2e-5)
    assert (np.abs(found.frequency / [0.4, 1.5] - 1.0) < 0.02).all() and not found.collided.any()


@pytest.mark.long
def test_sampled_cars_measure_what_the_model_says():
    """Cars whose controllers run at 50 Hz on estimates have the gains of the continuous model within a few per cent."""
    place = load_scenario("platoon-braking-v0")
    still = PlatoonSensors(noise_sd=(0.0, 0.0, 0.0), told_sd=(0.1, 0.1, 0.05))
    plant = dataclasses.replace(place.plant, dt=0.02, leader_input_known=True, gap_range=0.0, initial_sd=0.0, followers=3)
    place = dataclasses.replace(place.with_threat(agents=()), plant=plant, sensor=still)
    found = sweep(place, [0.6], settle=30.0, periods=1)
    want = np.abs(transfer(plant, place.controller, found.frequency))
    np.testing.assert_allclose(found.speed, want, rtol=0.03)


@pytest.mark.long
def test_attacks_on_messages_break_a_string_and_a_control_defence_mends_it():
    """Ploeg's law behind messages 2 s old amplifies from car to car; on the own sensors alone it does not."""
    place = dataclasses.replace(load_scenario("platoon-v2v-v0").with_threat(onset=1), controller=make("controller", "ploeg_cacc"))
    options = {"amplitude": 1.0, "settle": 40.0, "periods": 2}
    sliding = "composed:filter=dkf,detector=score,mitigation=sliding_mode,mitigation.when=always"
    quiet, late, mended = (
        sweep(place, [0.4], defence, attack, **options).speed[0]
        for defence, attack in (("dkf", "none"), ("dkf", "delay:age=20"), (sliding, "delay:age=20"))
    )
    assert (np.diff(quiet) < 0.0).all() and (np.diff(late) > 0.0).all() and late[-1] > 1.5
    assert (mended[1:] < 0.9).all()
