"""Classes of somebody else, who has not read about the engine, are traced as they stand, to the bits of the plain loop."""

import dataclasses

import numpy as np
import pytest

from tailgate import draws
from tailgate.agents.scripted import NoAttack
from tailgate.engine.rollouts import Rollout, rollout_of
from tailgate.scenario import load_scenario
from tailgate.threat import ThreatModel
from tailgate.trace import Trace, rollout

from .engines import trace_as_plain
from .strangers import Gyroscope, Nudge, Pendulum, Upright, stubborn

THREAT = ThreatModel(kinds=("fdi",), fdi_bound=1.0, onset=20, sees_measurement=True)


def _loop(defence=None, **changes):
    place = dataclasses.replace(
        load_scenario("scalar-hold-v0"), plant=Pendulum(), sensor=Gyroscope(), controller=Upright(), horizon=150, threat_model=THREAT
    )
    return dataclasses.replace(place, **changes).loop(defence or stubborn())


@pytest.mark.parametrize("rival", [NoAttack(), Nudge()], ids=["alone", "attacked"])
def test_a_plant_with_its_sensor_controller_and_defence(rival):
    trace = trace_as_plain(_loop(), rival)
    attacked = isinstance(rival, Nudge)
    assert (np.abs(trace.truth[..., 0]).max() == 1.5) == attacked and (trace.kind != 0).any() == attacked  # pushed, the rod falls


def test_an_attack_is_in_the_program():
    """Machine code of plant, sensor, defence, controller and attack in one."""
    loop, keys = _loop(), draws.keys("report", range(67))
    program = rollout_of(loop, Nudge())
    assert isinstance(program, Rollout), program
    fast = Trace(loop.model, loop.horizon, *program.play(keys, True), loop.controller.desired_gap)
    plain = rollout(loop, Nudge(), keys, plain=True)
    assert [fast.trace_hash(row) for row in range(67)] == [plain.trace_hash(row) for row in range(67)]
    assert np.unique(plain.value[plain.kind != 0]).size > 100


def test_other_numbers_of_a_strangers_classes_are_not_traced_again(monkeypatch):
    rollout_of(_loop(), Nudge())
    monkeypatch.setattr("tailgate.engine.program.traced", lambda *_: pytest.fail("traced again"))
    monkeypatch.setattr("tailgate.engine.rollouts.traced", lambda *_: pytest.fail("traced again"))
    loop, keys = _loop(stubborn(eta=5.0), plant=Pendulum(pull=0.5), sensor=Gyroscope((0.02, 0.03))), draws.keys("report", range(5))
    program = rollout_of(loop, Nudge(gain=0.9))
    assert isinstance(program, Rollout), program
    fast = Trace(loop.model, loop.horizon, *program.play(keys, True), loop.controller.desired_gap)
    plain = rollout(loop, Nudge(gain=0.9), keys, plain=True)
    assert [fast.trace_hash(row) for row in range(5)] == [plain.trace_hash(row) for row in range(5)]
