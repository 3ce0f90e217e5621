"""Which loops have lanes: all that quick-v0 can play, and no white-box attack but scripts."""

import dataclasses

import numpy as np
import pytest

from tailgate import draws
from tailgate.agents.scripted import Jam
from tailgate.errors import NotApplicable
from tailgate.evaluation import cells_of
from tailgate.fused import Constants, Refused, fuse, script
from tailgate.registry import Spec
from tailgate.scenario import load_scenario, load_suite
from tailgate.trace import rollout


def _cells(suite):
    """Of each cell its loop and its attack."""
    for cell in cells_of(suite):
        rival, guard = Spec("attack", cell.attack), Spec("defence", cell.defence)
        attack = rival.make()
        yield cell, cell.place(attack, rival.entry.knowledge).loop(guard.make(), guard.entry.uses), attack


def test_every_cell_of_quick_v0_that_has_a_meaning_is_fused():
    """What is refused raises in the plain loop as well: a defence that shows the white-box attack no innovation."""
    suite, refused = dataclasses.replace(load_suite("quick-v0"), scenarios=("stop-and-go-v0",)), set()
    for cell, loop, attack in _cells(suite):
        assert script.known(attack)
        if isinstance(fuse(loop, attack), Refused):
            refused.add(cell.defence)
            with pytest.raises(NotApplicable, match="innovation"):
                rollout(loop, attack, draws.keys("report", [0]))
    assert refused == {"none", "imm", "safe_state", "safe_state_brake"}


def test_only_scripts_are_white_boxes_in_a_lane():
    """A script sees the road alone whatever it is granted; of anyone else it is not known what he does with the defence."""

    class Mine(Jam):
        pass

    place = load_scenario("stop-and-go-v0").with_threat(knowledge="white")
    loop, stealth = place.loop(Spec("defence", "chi2_kf").make()), Spec("attack", "stealth").make()
    assert [type(fuse(loop, attack)) for attack in (None, Mine(), Jam(), stealth)] == [Refused, Refused, Constants, Constants]
    keys = draws.keys("report", range(3))
    one, two = (rollout(loop, Jam(start_step=90), keys, plain=plain) for plain in (False, True))
    assert [one.trace_hash(b) for b in range(3)] == [two.trace_hash(b) for b in range(3)]


def test_a_defence_that_shows_something_else_is_asked_itself():
    """A subclass's own `look` is not in the lane."""
    from tailgate.estimators.chi_square import GatedKalman

    class Coy(GatedKalman):
        def look(self, plan, state, received, known_u):
            shown = super().look(plan, state, received, known_u)
            return shown._replace(gate=np.full(shown.innovation.r.shape[:2], 1.0))

    place = load_scenario("gusty-stop-and-go-v0").with_threat(knowledge="white")
    stealth, keys = Spec("attack", "stealth:start_step=60").make(), draws.keys("report", range(2))
    found = fuse(place.loop(Coy()), stealth)
    assert isinstance(found, Refused) and "innovation" in found.why
    assert rollout(place.loop(Coy()), stealth, keys).trace_hash(0) != rollout(place.loop(GatedKalman()), stealth, keys).trace_hash(0)


def test_a_safe_set_that_hears_no_leader_is_played_by_the_plain_loop():
    """Its gap is told by the leader's message, which only a defence gets that asks for it."""
    loop = load_scenario("stop-and-go-v0").loop(Spec("defence", "safe_state").make())
    found = fuse(loop)
    assert isinstance(found, Refused) and "hears no leader" in found.why
