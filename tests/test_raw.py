"""No defence: what an agent reads and hears is what it believes."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import NotApplicable
from tailgate.core import Model, Prior, Received
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.cacc import Column
from tailgate.play.trace import rollout

NONE = tailgate.make_defence("none")


def test_a_car_believes_its_own_sensors_and_those_that_it_hears():
    """Its gap, speed and acceleration, its predecessor's and the leader's as they arrived, lies and all; the rest stays at its prior."""
    place = dataclasses.replace(load_scenario("platoon-braking-v0"), horizon=30).with_threat(onset=5, agents=())
    trace = rollout(place.loop(NONE), tailgate.make_attack("fdi", agents=(2,), value=7.0), keys("train", range(4)))
    columns = [[0, 1, 2], *([Column.gap(i), Column.speed(i), Column.accel(i)] for i in range(1, 5))]
    for i in range(5):
        heard = {0, i, max(i - 1, 0)}
        for j in heard:
            np.testing.assert_array_equal(trace.estimate[:, :, i, columns[j]], trace.wires[:, :, j, :3])
        rest = [c for c in range(19) if c not in [column for j in heard for column in columns[j]]]
        assert (trace.estimate[:, :, i, rest] == trace.estimate[:1, :, i, rest]).all() and len(rest) == 19 - 3 * len(heard)
        np.testing.assert_allclose(trace.estimate[0][:, i, rest], trace.truth[0][:, i, rest], atol=1.0)


def lone(C, graph):
    """A model of three states at rest, whose agents read them by C (N, q, 3)."""
    C = np.asarray(C, float)
    agents, q, n = C.shape
    return Model(np.eye(n), np.zeros((n, 0)), np.zeros(n), C, np.eye(n), np.array([np.eye(q)] * agents), np.array(graph, bool), 1.0, ("a", "b")[:q])


def test_the_own_reading_comes_first_and_a_missing_one_is_filled_by_who_is_heard():
    """Where several tell the same state the own sensor counts, else a neighbour's; what nobody tells keeps its last value."""
    x, y, z = np.eye(3)
    model = lone([[x, y], [x, z], [y, z]], [[1, 1, 1], [0, 1, 0], [0, 1, 1]])
    plan = NONE.prepare(model)
    state = NONE.start(plan, Prior(np.full((1, 3, 3), -1.0), np.zeros((1, 3, 3, 3))))

    def step(state, valid):
        y = np.array([[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]])
        state, estimate = NONE.step(plan, state, Received(y, np.array([valid], bool), np.zeros((1, 3))), np.zeros((1, 3, 0)), None)
        return state, estimate.x[0].tolist()

    state, believed = step(state, [[1, 1], [1, 1], [1, 1]])
    assert believed == [[1.0, 2.0, 6.0], [3.0, -1.0, 4.0], [3.0, 5.0, 6.0]]
    state, believed = step(state, [[0, 0], [1, 1], [1, 0]])
    assert believed == [[3.0, 5.0, 4.0], [3.0, -1.0, 4.0], [3.0, 5.0, 4.0]]
    state, believed = step(state, [[0, 0], [0, 0], [0, 0]])
    assert believed == [[3.0, 5.0, 4.0], [3.0, -1.0, 4.0], [3.0, 5.0, 4.0]]


@pytest.mark.parametrize("row", [[2.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
def test_a_sensor_of_no_state_itself_is_not_applicable(row):
    """A gain, a sum, or nothing at all cannot be believed as a state."""
    with pytest.raises(NotApplicable, match="each read one state directly"):
        NONE.prepare(lone([[row, [0.0, 1.0, 0.0]]], [[1]]))
