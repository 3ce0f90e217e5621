"""A proof covers the last step and each limit of a command. A loop at rest is at rest. Systems that are not linear are refused."""

import dataclasses

import numpy as np
import pytest

from tailgate import cli
from tailgate.base.errors import NotApplicable
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.trust.affine import affine_loop
from tailgate.trust.probing import probed
from tailgate.trust.prove import prove
from tailgate.trust.tube import Tube

from .proofs import CAR, LANE, car


def test_the_gap_behind_the_last_step_is_covered():
    """An attack of one step can move a gap only behind that step."""
    tube = Tube(affine_loop(car(targets=("position",)), steps=1))
    assert tube.lower_gap(0.0).shape == (2,) and tube.pushed["gap"][0, 0] == 0.0 < tube.pushed["gap"][1, 0]


@pytest.mark.parametrize(("low", "high"), [(-5.0, None), (None, 2.0)])
def test_a_controller_with_one_limit_keeps_it(low, high):
    """One limit that is missing takes nothing from the other; fewer limits may prove more of their own side only."""
    place = car()
    one = dataclasses.replace(place.controller, accel_min=low, accel_max=high)
    law = probed(one, place.brief().model)
    assert (law.low[0], law.high[0]) == (-np.inf if low is None else low, np.inf if high is None else high)
    rest = {"at_rest": True, "lead": (-0.1, 0.1), "steps": 60}
    wide = dataclasses.replace(place.with_threat(targets=("position",), fdi_bound=50.0), controller=one)
    both, single = (Tube(affine_loop(p, **rest)).largest(50.0) for p in (dataclasses.replace(wide, controller=place.controller), wide))
    assert both <= single < Tube(affine_loop(wide, **rest)).largest(50.0, limits=False)


def test_a_loop_at_rest_is_at_rest_behind_any_leader():
    """He begins to drive at step 1: before, the gap is the desired one at a constant speed."""
    place = car()
    for lead in ((-3.0, 1.5), (0.0, 1.5)):
        tube = Tube(affine_loop(place, at_rest=True, lead=lead, steps=3))
        assert tube.gap.centre[0, 0] == pytest.approx(92.15, abs=1e-4) and tube.speed.centre[0, 0] == pytest.approx(29.05, abs=1e-4)
    fine = dataclasses.replace(load_scenario("stop-and-go-fine-v0"), controller=place.controller)
    assert Tube(affine_loop(fine, at_rest=True, steps=3)).speed.centre[0, 0] == pytest.approx(29.05, abs=1e-3)


def test_a_controller_that_bends_and_a_plant_that_switches_are_refused():
    place = load_scenario("lane-keeping-v0")
    with pytest.raises(NotApplicable, match=r"controller.*LaneStanley.*linear between its limits"):
        affine_loop(dataclasses.replace(place, controller=make("controller", "lane_stanley")))
    with pytest.raises(NotApplicable, match=r"plant.*CarFollowingLiteral"):
        affine_loop(load_scenario("thesis-ch4-literal-v0"))


def test_what_a_proof_does_not_cover_is_told(capsys):
    held = prove(CAR, set_speed=False, steps=20, threat={"kinds": ["fdi", "dos_jam"]})["attack"]
    assert held["not_covered"] == ["dos_jam", "a car behind"]
    assert cli.main(["trust", "--prove", "--scenario", LANE, "--steps", "5"]) == 0
    assert "injected values alone are covered, and nothing of:" in " ".join(capsys.readouterr().out.split())
