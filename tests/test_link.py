"""Readings that are lost or late without an attack."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout

PLACE = dataclasses.replace(load_scenario("gusty-stop-and-go-v0"), horizon=80)


def play(truth, seeds=range(6), attack="none", place=PLACE, **options):
    place = dataclasses.replace(place, truth=truth)
    return rollout(place.loop(tailgate.make_defence("kf")), tailgate.make_attack(attack, **options), draws.keys("report", seeds))


def test_late_readings_are_those_of_some_steps_before() -> None:
    """The first one stands for what is not there yet; the world's noise is that of a prompt link."""
    now, late = play({}), play({"latency": 3})
    assert np.array_equal(late.wires[0], now.wires[0]) and np.array_equal(late.wires[2], now.wires[0]) and np.array_equal(late.wires[3], now.wires[0])
    assert np.array_equal(late.wires[4], now.wires[1]) and not np.array_equal(late.estimate[9], now.estimate[9])


def test_a_share_of_the_readings_is_lost_and_keeps_the_last_that_came() -> None:
    """One in five within what 6 x 79 x 2 draws allow; a lost one is known to be, and its wire holds its value."""
    trace = play({"loss": 0.2})
    gone = ~trace.valid[1:]
    assert abs(gone.mean() - 0.2) < 4.0 * np.sqrt(0.16 / gone.size) and trace.valid[0].all()
    assert np.array_equal(trace.wires[1:, ..., :2][gone], trace.wires[:-1, ..., :2][gone])


def test_an_attack_adds_to_what_arrives() -> None:
    """A bias on a late reading is on the late one."""
    late, biased = play({"latency": 3}), play({"latency": 3}, attack="fdi", value=-4.0, start_step=60)
    first = 59  # step 60
    assert np.allclose(biased.wires[first][..., :2], late.wires[first][..., :2] - 4.0) and np.array_equal(biased.wires[:first], late.wires[:first])


def test_a_row_depends_on_itself_alone() -> None:
    """To the bit, among six and alone."""
    truth = {"loss": 0.2, "latency": 2}
    whole = play(truth)
    assert [whole.trace_hash(i) for i in range(6)] == [play(truth, [i]).trace_hash(0) for i in range(6)]


def test_a_radar_has_no_link_and_a_loss_is_a_probability() -> None:
    """One clear error each."""
    with pytest.raises(InputError, match="a radar is read where it hears"):
        play({"loss": 0.1}, place=load_scenario("radar-following-v0"))
    with pytest.raises(InputError, match=r"truth.loss"):
        play({"loss": 1.5})
