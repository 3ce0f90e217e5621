"""The ghost: a second state's readings, along the modes that last."""

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import NotApplicable
from tailgate.core import draws
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout


def _run(attack, defence="dkf", seeds=2, **threat):
    place = load_scenario("thesis-ch5-v0").with_threat(agents=(), fdi_bound=1e5, **threat)
    return rollout(place.loop(tailgate.make_defence(defence)), attack, draws.keys("report", range(seeds)))


def test_a_linear_filter_follows_the_ghost():
    """What is added to the readings is C_i g with g+ = A g, and the estimate comes to x + g."""
    trace = _run(tailgate.make_attack("ghost", size=100.0))
    added, model = trace.wires - trace.clean, trace.model
    g = np.linalg.lstsq(model.C[0], added[20, 0, 0], rcond=None)[0]  # 14 sensors of 20 states: any g of those readings
    np.testing.assert_allclose(model.C[0] @ g, added[20, 0, 0], rtol=1e-9, atol=1e-9)
    ghost = trace.estimate[-1, 0, 0] - trace.truth[-1, 0, 0]
    before = trace.estimate[-2, 0, 0] - trace.truth[-2, 0, 0]
    np.testing.assert_allclose(ghost, model.A @ before, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(added[-1, 0], model.C @ ghost, rtol=1e-3, atol=0.05)
    assert 50.0 < np.linalg.norm(ghost) < 200.0


def test_it_saturates_the_resilient_estimator_without_an_end():
    """(5.8) moves by about the same in every step: after 30 steps the error is more than ten times that of the third."""
    trace = _run(tailgate.make_attack("ghost", size=700.0), "norm_resilient")
    error = trace.model.error(trace.estimate, trace.truth)[:, 0].max(axis=1)
    assert error[-1] > 5.0 * error[22] and error[-1] > 20.0


@pytest.mark.long
def test_grown_in_slowly_it_passes_a_gate_that_hears_it_at_once():
    """A jump alarms; the same size grown in over 30 steps does not, and moves the estimate."""
    jump, slow = (_run(tailgate.make_attack("ghost", size=90.0, grow=grow), "chi2_dkf") for grow in (0.0, 30.0))
    assert jump.alarm[20].any() and not slow.alarm[20:].any()
    assert slow.model.error(slow.estimate, slow.truth)[-1].max() > 40.0


def test_it_keeps_to_agents_targets_and_bounds():
    """Only granted agents and targets are touched; beyond the bound it ends, and where nothing fits it does not apply."""
    trace = _run(tailgate.make_attack("ghost", size=50.0, agents=(3, 4), targets=("y2",)))
    assert set(zip(*np.nonzero(trace.target.any(axis=(0, 1))), strict=True)) == {(3, 1), (4, 1)} and not trace.refused.any()
    with pytest.raises(NotApplicable, match="size"):
        tailgate.make_attack("ghost", size=1e9).prepare(load_scenario("thesis-ch5-v0").brief())
