"""Bounded noise of the odometry sensor."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core.draws import Role, keys
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import as_data
from tailgate.envs.sensors.odometry import Odometry

STEPS = np.zeros(20_000, np.int64)


def _noise(sensor, draws):
    model = dataclasses.replace(load_scenario("stop-and-go-v0"), sensor=sensor).brief().model
    zeros = np.zeros((len(draws.key), 1, 3))
    return sensor.measure(sensor.prepare(model), zeros, np.ones((len(zeros), 1), bool), draws).y[:, 0]


def test_uniform_noise_is_bounded_and_has_the_variance_that_everyone_is_told():
    """A sensor accurate to e would leave the interval that a defence makes of its variance, or fill only a part of it."""
    sensor = make("sensor", "odometry", noise="uniform", noise_var=(0.03, 0.0075))
    noise = _noise(sensor, keys("train", range(20_000)).at(Role.SENSOR, STEPS))
    half = np.array([0.3, 0.15])
    assert (np.abs(noise) <= half).all() and (np.abs(noise).max(axis=0) > 0.999 * half).all()
    assert noise.var(axis=0) == pytest.approx([0.03, 0.0075], rel=0.03)
    assert noise.mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.006)
    assert np.corrcoef(noise.T)[0, 1] == pytest.approx(0.0, abs=0.03)


def test_gaussian_noise_keeps_its_draws_and_the_scenarios_their_hashes():
    """The option would change published traces, or the hash under which their scenarios are recorded."""
    draws = keys("train", range(50)).at(Role.SENSOR, STEPS[:50])
    np.testing.assert_array_equal(_noise(Odometry((4.0, 1.0)), draws), np.array([2.0, 1.0]) * draws.normal((1, 2))[:, 0])
    assert "noise" not in as_data(Odometry()) and as_data(Odometry(noise="uniform"))["noise"] == "uniform"


def test_another_law_is_refused_by_name():
    """A misspelt law would be taken for the Gaussian one."""
    with pytest.raises(InputError, match="noise"):
        make("sensor", "odometry", noise="triangular")
